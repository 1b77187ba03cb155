"""Solves: a solution over the whole box, with a measured error.

In come a system and a :class:`~rankone.solvers.request.SolveRequest`; out goes an
:class:`~rankone.solvers.outcome.Outcome`: separated tensors on each slab, the error that was
measured against reference trajectories, and how the solve ended.

- ``attempts``: one attempt after the other: reference, march, check, tighten, until the measured
  error fits
- ``branches``: solves where the order of events changes inside the box: a solution for each
  order, checked
- ``branching``: the branches of a search for orders: continued over the box, and where each two
  of them part
- ``engines``: the engines, one folder each
- ``march``: one pass over the horizon, slab after slab, and how errors grow that are made on the
  way
- ``outcome``: what an engine returns, and the problem and the request behind it as plain data
- ``reduced``: fields reduced to a few coefficients, and measured against full trajectories
- ``remedies``: what to do about a solve that is refused: a remedy is tried before it is offered
- ``request``: the request of a solve: domain, tolerance, check, limits, and what is observed
- ``selection``: the engines by name, and a solve that tries one after another
- ``stretches_by_markers``: the reference of a solve, one for all attempts, over stretches where
  markers pay
- ``tuning``: tuning of a solve and of its check: attempts, ways, branches, points and references
- ``verification``: where is a solution worst? Reference trajectories, candidate points, and the
  measured error
- ``ways``: the interface of engines, and the ways in which one solves: as written, in order, in
  branches
"""
