"""Statistics of a solution over its box: every integral is a product of one-dimensional ones.

- ``densities``: densities and probabilities of the unknowns over the box, from sets of evenly
  spread points
- ``lines``: averages over lines through the box, divided where the solution jumps
- ``moments``: moments of one train, and variance-based sensitivities
- ``over_box``: moments, sensitivities and quantiles of a solution over its box, as methods
- ``piece_statistics``: statistics of solutions that were joined of pieces: sums over pieces, with
  their probabilities
- ``solution_statistics``: statistics of states at given times, and how certain shares of the
  variance are
- ``timeline_statistics``: statistics of solutions with events: by lines that are divided where
  the solution jumps
"""
