"""Parameters from data, posterior distributions, designs and best values: methods of a solution.

======================  ============================================================================
``tables``              tables of measurements, cut into experiments
``observations``        measured data, checked, and what was measured
``doses``               doses of subjects, and the sum of their curves
``dose_table``          tables with rows of doses among those of data
``formulas``            arithmetic of named quantities, from text or symbols
``duals``               arrays with their derivatives
``noise``               kinds of noise, and what a datum adds to a likelihood
``experiments``         experiments, and what their solutions predict
``models``              solutions at the times of data, with derivatives
``integrated``          problems that are integrated at each point instead of solved
``free_parameters``     free parameters, their bounds, scales and starts
``ranges``              intervals of parameters that belong to no solution
``likelihood``          the likelihood of all experiments, on a unit cube
``least_squares``       its minima, for many starts at once
``search``              ``fit``, of one experiment or several
``choice``              the minimum that a fit reports
``estimates``           best values, residuals, criteria
``intervals``           how sure they are
``levels``              what estimated levels of noise add to that
``fit``                 the result of a fit: both, and whether to believe it
``residuals``           predictions and residuals at a point
``curves``              fitted curves and their derivatives
``findings``            reasons not to trust a fit
``checks``              what is odd about residuals
``jumps``               events that pass times of the data
``identification``      which parameters and combinations the data identify; profile likelihoods
``posterior``           ``posterior``, by quadrature or by a Markov chain
``cube_distributions``  distributions in a unit cube, on cells or as points of a chain
``design``              where to measure next
``candidates``          the information of measurements at candidate times
``objective``           objectives and constraints on a unit cube, with derivatives
``minimize``            ``minimize``
``expressions``         quantities of parameters: functions, text, or symbols
======================  ============================================================================
"""

from rankone.estimation import design as _design
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
    design = _design.design
