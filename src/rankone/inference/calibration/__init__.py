"""Calibration problems: parameters from data over bounds that are too wide for one solution.

- ``calibrate``: ``rankone.calibrate``: random starts over wide bounds, and a box around the
  optimum, which follows the fit
- ``calibration_problem``: what users hold of a problem from files
- ``experiment_objective``: the objective of a problem from files: experiments on trajectories of
  its model, and priors
- ``petab_files``: files of a PEtab problem, read and checked by the package ``petab``
- ``records``: the checked records of its tables, and the problems and experiments that follow
- ``result``: what a calibration found, and whether to believe it
- ``solutions``: solutions of a problem from files over a box, which are fitted and have posteriors
- ``trajectory_likelihood``: the likelihoods that searches take, of experiments and of problems
  from files, and how far each parameter can go from an optimum
"""
