"""``method="cross"``: trajectories at chosen parameter points, interpolated in a tensor train.

======================  ==========================================================================
module                  subject
======================  ==========================================================================
``time_grid``           slabs that resolve the reference, and their nodes
``trajectories``        stacked trajectories on the time grid, compressed in a growing basis
``workers``               chunks of trajectories on the workers of an executor
``nodes``               numbers of parameter nodes, from trajectories on lines through the box
``samples``             trajectories at nodes of the grid, each integrated once
``sweep``               the cross interpolation: row spaces, skeletons, ranks
``engine``              check against the reference, more nodes, points or accuracy
``options``             limits and discretisation
======================  ==========================================================================

A function of the parameters whose values are trajectories is interpolated (compare ALS-Cross:
Dolgov & Scheichl, SIAM/ASA J. Uncertainty Quantification 7 (2019), 260; DMRG-cross: Savostyanov &
Oseledets, 2011). It needs the pointwise right-hand side alone, and nothing that is left out is
amplified by the flow: each trajectory starts from its own exact initial value.
"""

from rankone.solvers.cross.engine import ENGINE
from rankone.solvers.cross.options import CrossOptions
from rankone.solvers.cross.record import CrossRecord

__all__ = ["ENGINE", "CrossOptions", "CrossRecord"]
