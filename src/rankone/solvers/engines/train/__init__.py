"""``method="train"``: tensor-train sweeps on the preconditioned Volterra form.

- ``length``: lengths of slabs, and the nodes of the parameters on them
- ``slab_operators``: operators of a slab on Radau nodes, and the inverse that preconditions its
  equations
- ``sweep``: two-site alternating sweeps for the fixed point U = E U_s + S (f(U) - A U) on one
  slab
- ``train_engine``: attempts of the tensor-train engine, and the sweeps that solve one slab
- ``train_options``: options and tuning constants of the tensor-train engine
"""

from rankone.solvers.engines.train.train_engine import ENGINE
from rankone.solvers.engines.train.train_options import TrainOptions

__all__ = ["ENGINE", "TrainOptions"]
