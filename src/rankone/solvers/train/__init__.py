"""``method="train"``: tensor-train sweeps on the preconditioned Volterra form.

======================  ==========================================================================
module                  subject
======================  ==========================================================================
``groups``              terms that share their parameter factors; diagonal parameter operators
``slab``                collocation, mean Jacobian and kernels of one time slab
``products``            a symmetric environment against two copies of a core
``sweep``               two-site alternating sweeps: contraction, truncated SVD, enrichment
``convergence``         whether the sweeps on a slab are done, or hopeless
``nodes``               parameter nodes: first, refined, coarsened
``iteration``           the solve of one slab
``jump``                the states after a jump, on nodes that resolve them
``length``              the lengths of slabs
``engine``              inner tolerances, tightened after the check
``options``             limits and discretisation
======================  ==========================================================================
"""

from rankone.solvers.train.engine import ENGINE
from rankone.solvers.train.options import TrainOptions

__all__ = ["ENGINE", "TrainOptions"]
