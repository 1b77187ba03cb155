"""Tensors: trains and sums of products, their arithmetic, cross interpolation and evaluation.

- ``adaptive``: adaptive cross interpolation: nodes, left points and tolerances chosen until it
  suffices
- ``branch_evaluator``: evaluation of what a box is divided into: branches, and pieces that tile
  it
- ``canonical``: the canonical form: sums of products of functions of one coordinate
- ``cross``: cross interpolation: a tensor train over [column] | p_1 | ... | p_d from sampled
  columns
- ``decisions``: which of several branches holds: by the forks at which they part, and by events
  they graze
- ``evaluator``: evaluation of tensor trains at many points, at one point, along curves and on
  grids
- ``slab``: trains of a slab, and the coordinate of a parameter that needs the fewest nodes
- ``timeline_evaluator``: evaluation over clock time of slabs over stretches
- ``train``: tensor trains, their truncated decompositions, and skeletons of matrices
"""
