"""``method="greedy"``: the classic proper generalized decomposition of the slides.

- ``enrichment``: enrichment of one unknown: fixed point over the dimensions, normalisation,
  projection
- ``greedy_engine``: ``method="greedy"``: march, check against SciPy, more nodes or a tighter
  tolerance
- ``greedy_options``: options and tuning constants of the classic method
- ``operators``: operators and sources on shape functions: D = sum_i (x)_j D_j^i and G = sum_i
  (x)_j G_j^i
- ``slabs``: from slab to slab: shape functions, the lagged iteration, and the states at the end
"""

from rankone.solvers.engines.greedy.greedy_engine import ENGINE
from rankone.solvers.engines.greedy.greedy_options import GreedyOptions
from rankone.solvers.engines.greedy.slabs import GreedySlabRecord

__all__ = ["ENGINE", "GreedyOptions", "GreedySlabRecord"]
