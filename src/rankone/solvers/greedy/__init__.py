"""``method="greedy"``: the classic proper generalized decomposition of the slides.

======================  ==========================================================================
module                  subject
======================  ==========================================================================
``terms``               the right-hand side term by term, and which states lag which
``operators``           D = sum (x) D_j^i and G = sum (x) G_j^i on shape functions
``enrichment``          fixed point, normalisation, projection, update, residual of one unknown
``lagging``             decoupled equations, update of G
``slabs``               from slab to slab
``length``              the lengths of slabs
``engine``              more nodes or a tighter tolerance after the check
``nodes``               numbers of nodes
``options``             choices by name, and the choice of the slides
``history``             what happened in every loop, as data
======================  ==========================================================================
"""

from rankone.solvers.greedy.engine import ENGINE
from rankone.solvers.greedy.history import GreedySlabRecord
from rankone.solvers.greedy.options import GreedyOptions

__all__ = ["ENGINE", "GreedyOptions", "GreedySlabRecord"]
