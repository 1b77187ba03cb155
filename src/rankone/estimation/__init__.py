"""Parameters from data, posterior distributions and best values: methods of a solution."""

from rankone.estimation import minimize as _minimize
from rankone.estimation import posterior as _posterior
from rankone.estimation import search as _search
from rankone.solution.core import SolutionCore

__all__ = ["EstimationFromData"]


class EstimationFromData(SolutionCore):
    """A solution that is fitted to data, and whose parameters are chosen."""

    fit = _search.fit
    posterior = _posterior.posterior
    minimize = _minimize.minimize
