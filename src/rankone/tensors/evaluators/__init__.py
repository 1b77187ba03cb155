"""Evaluation of solutions: of one train, over stretches, in branches, of pieces.

- ``branch_evaluator``: evaluation of what a box is divided into: branches, and pieces that tile
  it
- ``decisions``: which of several branches holds: by the forks at which they part, and by events
  they graze
- ``evaluator``: evaluation of tensor trains at many points, at one point, along curves and on
  grids
- ``timeline_evaluator``: evaluation over clock time of slabs over stretches
"""
