"""Parameters from data, posterior distributions and best values: methods of a solution.

======================  ==========================================================================
``observations``        measured data, checked
``free_parameters``     free parameters, their bounds, and starts
``least_squares``       least squares in a unit cube, for many starts at once
``search``              ``fit``
``fit``                 the result of ``fit``, and reasons not to trust it
``identification``      which parameters and combinations the data identify; profile likelihoods
``posterior``           ``posterior``, by quadrature or by a Markov chain
``cube_distributions``  distributions in a unit cube, on cells or as points of a chain
``objective``           objectives and constraints on a unit cube, with derivatives
``minimize``            ``minimize``
``expressions``         quantities of parameters: functions, text, or symbols
======================  ==========================================================================
"""

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
