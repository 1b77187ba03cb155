"""The engines, one folder each.

- ``cross``: ``method="cross"``: trajectories at chosen parameter points, interpolated in a tensor
  train
- ``greedy``: ``method="greedy"``: the classic proper generalized decomposition of the slides
- ``train``: ``method="train"``: tensor-train sweeps on the preconditioned Volterra form
"""
