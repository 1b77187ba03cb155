"""Evaluation of solutions: of one train, over stretches, in branches, of pieces.

- ``branch_evaluator``: evaluation of branches: orders of events that hold in parts of the box
- ``decisions``: which of several branches holds: by the forks at which they part, and by events
  they graze
- ``evaluator``: evaluation of tensor trains at many points, at one point, along curves and on
  grids
- ``forks``: what tells branches apart, as those who decide see it: forks, and events that are
  grazed
- ``piece_evaluator``: boxes that tile a box, and evaluation of the piece that holds a point
- ``timeline_evaluator``: evaluation over clock time of slabs over stretches
"""
