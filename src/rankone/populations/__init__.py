"""Populations: parameters that differ between subjects, from data of all of them.

=================  =====================================================================
``scales``         scales on which the parameters of subjects are normal
``subjects``       subjects of a table, stacked
``predictions``    states of all subjects, each at times of its own
``layout``         the population parameters in a row
``specification``  random parameters, correlations and covariates as users say them
``individuals``    the most probable random effects of each subject
``marginal``       the marginal likelihood by Laplace's method
``slopes``         its derivatives, and those of the random effects
``search``         its optimum
``uncertainty``    standard errors and degrees of freedom
``population``     ``fit_population``
``estimates``      estimates of the population and of the subjects
``fit``            the result: both, and whether to believe it
``predictive_check``  quantiles of data beside those of simulated data
=================  =====================================================================
"""

from rankone.populations import population as _population
from rankone.solution.core import SolutionCore

__all__ = ["PopulationsFromData"]


class PopulationsFromData(SolutionCore):
    """A solution that is fitted to data of many subjects."""

    fit_population = _population.fit_population
