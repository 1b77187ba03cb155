"""``method="train"``: tensor-train sweeps on the preconditioned Volterra form.

======================  ==========================================================================
module                  subject
======================  ==========================================================================
``groups``              terms that share their parameter factors; diagonal parameter operators
``slab``                collocation, mean Jacobian and kernels of one time slab
``sweep``               two-site alternating sweeps: contraction, truncated SVD, enrichment
``march``               adaptive slabs and parameter nodes over the horizon
``engine``              inner tolerance, check against SciPy, tightening
``options``             limits and discretisation
======================  ==========================================================================
"""

from rankone.solvers.train.engine import solve_train
from rankone.solvers.train.options import TrainOptions

__all__ = ["TrainOptions", "solve_train"]
