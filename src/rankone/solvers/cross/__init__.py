"""``method="cross"``: trajectories at chosen parameter points, interpolated in a tensor train.

================  =====================================================================
module            subject
================  =====================================================================
``engine``        attempts: interpolate, check against the reference, refine
``trajectories``  stacked trajectories on a time grid, held in a growing basis
``cost``          what the next attempt costs at least
``worst_lines``   nodes that the worst points of an attempt need
``steep``         why an attempt fails: a steep dependence on a parameter
``options``       limits and discretisation; the record of an attempt
``constants``     tuning constants
================  =====================================================================

Nodes, left points and ranks are chosen by :mod:`rankone.tensors.adaptive`, which outputs use too;
the interpolation itself is :mod:`rankone.tensors.cross`, and
:mod:`rankone.discretization.time_grid` has the slabs.

A function of the parameters whose values are trajectories is interpolated (compare ALS-Cross:
Dolgov & Scheichl, SIAM/ASA J. Uncertainty Quantification 7 (2019), 260; DMRG-cross: Savostyanov &
Oseledets, 2011). It needs the pointwise right-hand side alone, and the flow amplifies no error:
each trajectory starts from its own exact initial value.
"""

from rankone.solvers.cross.engine import ENGINE
from rankone.solvers.cross.options import CrossOptions, CrossRecord

__all__ = ["ENGINE", "CrossOptions", "CrossRecord"]
