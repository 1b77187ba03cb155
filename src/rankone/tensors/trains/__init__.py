"""Tensors: trains and sums of products, their arithmetic, cross interpolation and evaluation.

- ``adaptive``: adaptive cross interpolation: nodes, left points and tolerances chosen until it
  suffices
- ``canonical``: the canonical form: sums of products of functions of one coordinate
- ``cross``: cross interpolation: a tensor train over [column] | p_1 | ... | p_d from sampled
  columns
- ``rank_one_sums``: arithmetic of sums of products: tensors held as one factor matrix for each
  dimension
- ``slab``: trains of a slab, and the coordinate of a parameter that needs the fewest nodes
- ``train``: tensor trains, their truncated decompositions, and skeletons of matrices
"""
