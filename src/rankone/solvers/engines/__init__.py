"""The engines: ``method="cross"``, ``method="train"`` and ``method="greedy"``.

- ``cross_engine``: the cross engine: interpolate, check against SciPy, ask for more where it does
  not suffice
- ``cross_samples``: stacked trajectories as samples of an interpolation, and why one does not
  converge
- ``engine_options``: options and tuning of the three engines, and what an attempt costs them
- ``greedy_engine``: ``method="greedy"``: march from slab to slab, check against SciPy, refine
- ``greedy_enrichment``: enrichment of one unknown: fixed point over the dimensions,
  normalisation, projection
- ``greedy_operators``: sums of products and their arithmetic, and the operators of a slab on
  shape functions
- ``train_engine``: attempts of the tensor-train engine, and the sweeps that solve one slab
- ``train_length``: lengths of slabs, and the nodes of the parameters on them
- ``train_operators``: operators of a slab on Radau nodes, and the inverse that preconditions its
  equations
- ``train_sweep``: two-site alternating sweeps for the fixed point U = E U_s + S (f(U) - A U) on
  one slab

The cross engine interpolates trajectories at chosen parameter points: a function of the parameters
whose values are trajectories (compare ALS-Cross: Dolgov & Scheichl, SIAM/ASA J. Uncertainty
Quantification 7 (2019), 260; DMRG-cross: Savostyanov & Oseledets, 2011). It needs the pointwise
right-hand side alone, and the flow amplifies no error: each trajectory starts from its own exact
initial value. Nodes, left points and ranks are chosen by :mod:`rankone.tensors.adaptive`,
which outputs use too. The train engine solves the preconditioned Volterra form by sweeps. The
greedy engine is the classic proper generalized decomposition of the slides.
"""
