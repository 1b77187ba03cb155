"""``method="train"``: tensor-train sweeps on the preconditioned Volterra form.

===============  ===============================================================================
module           subject
===============  ===============================================================================
``engine``       attempts: inner tolerances, tightened after the check
``length``       lengths of slabs
``iteration``    the solve of one slab, and when its sweeps have converged or diverged
``sweep``        two-site alternating sweeps: contraction, truncated SVD, enrichment
``slab``         operators of one slab: collocation, mean Jacobian, kernels of the term groups
``inverse``      its Jacobian and preconditioner, as one matrix or by sparse factors
``terms``        kernels of many states, from the table of terms
``nodes``        parameter nodes: first, refined, coarsened, and after a jump
``options``      limits, discretisation and tuning constants
===============  ===============================================================================
"""

from rankone.solvers.train.engine import ENGINE
from rankone.solvers.train.options import TrainOptions

__all__ = ["ENGINE", "TrainOptions"]
