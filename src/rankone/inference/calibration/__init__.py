"""Calibration problems: parameters from data over bounds that are too wide for one solution.

- ``boxes``: the box follows the fit: around the end of a search, and moved until the optimum is
  inside
- ``calibrate``: ``rankone.calibrate``: random starts over wide bounds, and a box around the
  optimum
- ``calibrated_parameters``: parameters of a calibration problem, and the checked records of its
  tables
- ``calibration_problem``: what users hold
- ``descent``: the way down from one start, by least squares in a box of trust (Gauss–Newton)
- ``experiment_conditions``: what conditions make of a model, and problems of single experiments
- ``experiment_solutions``: experiments of a calibration problem as fits read solutions: values are
  trajectories
- ``linearised``: how far the data determine each parameter at an optimum, by linearisation
- ``measured``: measurements of a calibration problem as experiments that solutions are fitted to
- ``objective_of_files``: the objective of a calibration problem: the likelihood of its experiments,
  and of its priors
- ``petab_files``: files of a PEtab problem, read and checked by the package ``petab``
- ``profiles``: how far each parameter can go from an optimum within the bounds, by trajectories
- ``result``: what a calibration found, and whether to believe it
- ``searched``: the likelihoods that searches take: of experiments, and of problems from files
- ``solutions``: solutions of a calibration problem over a box, which are fitted and have
  posteriors
- ``solving``: solves a calibration problem over a box: one solution an experiment, or one for all
- ``starts``: many starts in the unit cube of the bounds, and which of them go on
"""
