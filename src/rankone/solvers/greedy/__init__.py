"""``method="greedy"``: the classic proper generalized decomposition of the slides.

===============  ===============================================================================
module           subject
===============  ===============================================================================
``engine``       attempts and slab lengths: more nodes or a tighter tolerance after the check
``slabs``        from slab to slab: the lagged iteration over the equations
``enrichment``   one unknown: fixed point, normalisation, projection, update, residual
``operators``    terms, nodes and matrices: D = sum (x) D_j^i and G = sum (x) G_j^i
``options``      choices by name, the choice of the slides, and tuning constants
===============  ===============================================================================
"""

from rankone.solvers.greedy.engine import ENGINE
from rankone.solvers.greedy.options import GreedyOptions
from rankone.solvers.greedy.slabs import GreedySlabRecord

__all__ = ["ENGINE", "GreedyOptions", "GreedySlabRecord"]
