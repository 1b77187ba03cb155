"""``method="train"``: tensor-train sweeps on the preconditioned Volterra form.

======================  ==========================================================================
module                  subject
======================  ==========================================================================
``groups``              terms that share their parameter factors; diagonal parameter operators
``slab``                collocation, mean Jacobian and kernels of one time slab
``products``            a symmetric environment against two copies of a core
``sweep``               two-site alternating sweeps: contraction, truncated SVD, enrichment
``convergence``         whether the sweeps on a slab are done, or hopeless
``nodes``               parameter nodes to begin with
``march``               adaptive slabs and parameter nodes over the horizon
``engine``              inner tolerance, check against SciPy, tightening
``options``             limits and discretisation
======================  ==========================================================================
"""

from rankone.solvers.train.engine import ENGINE, solve_train
from rankone.solvers.train.options import TrainOptions

__all__ = ["ENGINE", "TrainOptions", "solve_train"]
