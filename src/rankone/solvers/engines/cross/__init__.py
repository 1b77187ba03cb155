"""``method="cross"``: trajectories at chosen parameter points, interpolated in a tensor train.

- ``cross_engine``: interpolate, check against SciPy, ask for more where it does not suffice
- ``cross_options``: options and constants of the cross engine, and what its next attempt costs
- ``sampled``: stacked trajectories on a time grid, held as coefficients in a growing orthonormal
  basis
- ``steep``: why an interpolation does not converge, and how many nodes its worst points need

Nodes, left points and ranks are chosen by :mod:`rankone.tensors.trains.adaptive`, which outputs
use too; the interpolation itself is :mod:`rankone.tensors.trains.cross`, and
:mod:`rankone.tensors.bases.time_grid` has the slabs.

A function of the parameters whose values are trajectories is interpolated (compare ALS-Cross:
Dolgov & Scheichl, SIAM/ASA J. Uncertainty Quantification 7 (2019), 260; DMRG-cross: Savostyanov &
Oseledets, 2011). It needs the pointwise right-hand side alone, and the flow amplifies no error:
each trajectory starts from its own exact initial value.
"""

from rankone.solvers.engines.cross.cross_engine import ENGINE
from rankone.solvers.engines.cross.cross_options import CrossOptions, CrossRecord

__all__ = ["ENGINE", "CrossOptions", "CrossRecord"]
