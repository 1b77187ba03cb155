"""Calibration problems: parameters from data over bounds that are too wide for one solution.

======================  ============================================================================
``petab_files``         files of a PEtab problem, read and checked by the package ``petab``
``parameters``          parameters with their scales, bounds and priors
``records``             what the tables say: conditions, observables, measurements
``conditions``          what conditions make of the numbers of a model
``dynamics``            the compiled model, and its slopes in what it takes from outside
``resting``             steady states of experiments, with derivatives
``following``           trajectories of experiments, with derivatives
``simulation``          states at the times of measurements, with derivatives
``outputs``             observables and their noise at the measurements
``likelihood``          the objective, its gradient, and pseudo-residuals
``evaluation``          the objective in two steps: states, and what is observed of them
``conditioned``         problems of single experiments
``measured``            what was measured, as experiments of fits
``solving``             solutions of all experiments over a box
``solutions``           what they are held in, with their fit and posterior
``problem``             :class:`CalibrationProblem` and :func:`rankone.read_petab`
``around``              the box around the end of a fit
``cube``                estimated parameters in the unit cube between their bounds
``nested``              scales, offsets and levels of noise at their best for given states
``descent``             the way down from one start, by least squares in a box of trust
``starts``              many starts, and which of them go on
``uncertainty``         how far the data determine each parameter
``profiles``            how far parameters can go, by trajectories
``comparison``          measurements beside predictions, for plots
``of_files``            the likelihood of a problem from files, as searches take it
``from_files``          the calibration of a problem from files
``of_experiments``      the likelihood of experiments by trajectories
``boxes``               the box that follows the fit
``result``              :class:`rankone.Calibration`: what was found, and whether to believe it
``calibrate``           :func:`rankone.calibrate`
======================  ============================================================================
"""
