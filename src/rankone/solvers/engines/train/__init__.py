"""``method="train"``: tensor-train sweeps on the preconditioned Volterra form.

- ``inverse``: the Jacobian of one slab and S = (D M / h - A)^{-1}, as one matrix or by sparse
  factors
- ``iteration``: the solve of one slab: sweeps until the residual is small, on as many nodes as
  needed
- ``length``: lengths of slabs, and the nodes of the parameters on them
- ``slab_operators``: the operators of one time slab, dense or as kernels of many states
- ``sweep``: two-site alternating sweeps for the fixed point U = E U_s + S (f(U) - A U) on one
  slab
- ``train_engine``: the tensor-train engine: march, check against SciPy, tighten until the
  measured error fits
- ``train_options``: options and tuning constants of the tensor-train engine
"""

from rankone.solvers.engines.train.train_engine import ENGINE
from rankone.solvers.engines.train.train_options import TrainOptions

__all__ = ["ENGINE", "TrainOptions"]
