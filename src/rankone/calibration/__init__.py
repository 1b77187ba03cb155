"""Calibration problems from files: a model, experiments under several conditions, measurements.

======================  ============================================================================
``petab_files``         files of a PEtab problem, read and checked by the package ``petab``
``parameters``          parameters with their scales, bounds and priors
``records``             what the tables say: conditions, observables, measurements
``conditions``          what conditions make of the numbers of a model
``dynamics``            the compiled model, and its slopes in what it takes from outside
``simulation``          states at the times of measurements, with derivatives
``outputs``             observables and their noise at the measurements
``likelihood``          the objective, its gradient, and pseudo-residuals
``problem``             :class:`CalibrationProblem` and :func:`rankone.read_petab`
======================  ============================================================================
"""
