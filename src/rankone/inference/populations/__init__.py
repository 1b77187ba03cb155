"""Populations: parameters that differ between subjects, from data of all of them.

- ``individuals``: empirical Bayes: the most probable random effects of each subject
- ``marginal``: the marginal likelihood by Laplace's method, its derivatives and its optimum
- ``population``: ``fit_population``: nonlinear mixed effects on a solution, and whether to
  believe them
- ``population_estimates``: estimates of a population: means, spreads, subjects, and how sure they
  are
- ``population_layout``: what users say of a population, and the population parameters in a row
- ``predictive_check``: visual predictive checks: quantiles of data beside those of data simulated
  from a fit
- ``subjects``: subjects of a table, and the states of all of them at the times of their data
"""
