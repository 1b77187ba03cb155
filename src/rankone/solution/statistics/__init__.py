"""Statistics of a solution over its box: every integral is a product of one-dimensional ones.

- ``composite_statistics``: statistics of solutions with events, and of those that were joined of
  pieces
- ``densities``: densities and probabilities of the unknowns over the box, from sets of evenly
  spread points
- ``lines``: averages over lines through the box, divided where the solution jumps
- ``moments``: moments of one train, and variance-based sensitivities
- ``over_box``: moments, sensitivities and quantiles of a solution over its box, as methods
- ``solution_statistics``: statistics of states at given times, and how certain shares of the
  variance are
"""
