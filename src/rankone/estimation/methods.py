"""What is estimated from data and optimised, as methods of a solution."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rankone.estimation.fit import Fit
from rankone.estimation.minimize import Optimum, minimize
from rankone.estimation.posterior import Posterior, posterior
from rankone.estimation.search import fit
from rankone.solution.core import SolutionCore

__all__ = ["EstimationFromData"]


class EstimationFromData(SolutionCore):
    """A solution that is fitted to data, and whose parameters are chosen."""

    def fit(
        self,
        times: Any,
        data: Any,
        *,
        observe: Any = None,
        sigma: Any = None,
        weights: Any = None,
        fixed: Mapping[Any, Any] | None = None,
        start: Mapping[Any, Any] | None = None,
        bounds: Mapping[Any, Any] | None = None,
        starts: int = 4,
        effort: str | float = "normal",
        level: float = 0.95,
        missing: str = "error",
    ) -> Fit:
        """Parameters from data, by weighted least squares with exact derivatives.

        Parameters
        ----------
        times : array_like (times,) or mapping
            When the data were measured, in the unit of time; the same time may come more than
            once. A mapping from outputs gives each its own times.
        data : array_like (times,) or (outputs, times), or mapping
            What was measured: of one output, of several, or for each by name.
        observe : name, symbol or list of them, optional
            The unknowns that were measured, or derivatives that are states. By default those
            named by the data, or all unknowns.
        sigma : float or array_like, optional
            Standard deviation of the noise: a number, one for each output, or one for each datum.
            If it is not given, one for all data is estimated from the residuals.
        weights : array_like, optional
            Instead of sigma, factors of the squares, in the same shapes: one over the variance up
            to a factor, which is estimated.
        fixed : mapping, optional
            Parameters that are known, by names or symbols, and their values.
        start : mapping, optional
            A value of some parameters to start from; the others start in the middle.
        bounds : mapping, optional
            Intervals of some parameters, parts of the box; by default the box.
        starts : int
            Number of further starts, the best of points all over the box.
        effort : {"low", "normal", "high"} or float
            Factor on the number of points and of starts: 0.2, 1, 10 or another one.
        level : float
            Of the intervals.
        missing : {"error", "drop"}
            Whether data that are NaN are an error, or left out.

        Returns
        -------
        Fit
            With the estimates ``x``, ``covariance``, ``interval()``, ``residuals``,
            ``identifiable``, ``success`` and ``message``. It is a success if the search ended
            inside of the bounds, every parameter is identified, the residuals are not far above
            sigma, and the error of the solution is small beside the noise.

        Raises
        ------
        OptionError
            If shapes do not fit, data are NaN, there are fewer data than free parameters, sigma
            is not positive, an unknown or a parameter is not known, all parameters are fixed or
            a start is outside of its bounds.
        EvaluationError
            If a time is outside of the horizon, or a value outside of the box.
        """
        return fit(
            self,
            times,
            data,
            observe=observe,
            sigma=sigma,
            weights=weights,
            fixed=fixed,
            start=start,
            bounds=bounds,
            starts=starts,
            effort=effort,
            level=level,
            missing=missing,
        )

    def posterior(
        self,
        times: Any,
        data: Any,
        *,
        observe: Any = None,
        sigma: Any = None,
        prior: Mapping[Any, Any] | None = None,
        fixed: Mapping[Any, Any] | None = None,
        bounds: Mapping[Any, Any] | None = None,
        weights: Any = None,
        missing: str = "error",
        seed: int = 0,
        steps: int = 1000,
    ) -> Posterior:
        """The distribution of the parameters after the data are known, for Gaussian noise.

        Up to three free parameters by quadrature on cells that are refined where the density is,
        beyond by a Markov chain, for which emcee is needed.

        Parameters
        ----------
        times, data, observe, sigma, fixed, bounds, weights, missing
            As for :meth:`fit`. If sigma is not given it is integrated over, with the density
            1/sigma.
        prior : mapping, optional
            For parameters, by names or symbols, frozen continuous distributions of scipy.stats,
            cut at the bounds. Others have the distribution that the problem gives them, or are
            uniform. Priors are independent, also where the problem has correlations.
        seed, steps : int
            Of the Markov chain.

        Returns
        -------
        Posterior
            With ``mean``, ``std``, ``covariance``, ``quantile``, ``interval``, ``density`` and
            ``sample``.

        Raises
        ------
        OptionError, EvaluationError
            As for :meth:`fit`, and if a prior does not fit.
        RankoneError
            If emcee is needed and not installed.
        """
        return posterior(
            self,
            times,
            data,
            observe=observe,
            sigma=sigma,
            prior=prior,
            fixed=fixed,
            bounds=bounds,
            weights=weights,
            missing=missing,
            seed=seed,
            steps=steps,
        )

    def minimize(
        self,
        objective: Any,
        t: Any = None,
        *,
        sense: str = "min",
        fixed: Mapping[Any, Any] | None = None,
        start: Mapping[Any, Any] | None = None,
        bounds: Mapping[Any, Any] | None = None,
        constraints: Mapping[Any, Any] | None = None,
        starts: int = 16,
        effort: str | float = "normal",
    ) -> Optimum:
        """The parameters for which an unknown, or a function of the unknowns, is least.

        The objective is looked at all over the box (a Sobol sequence, the centre, corners). From
        the best points of the basins seen there, and from the best after 30 generations of
        differential evolution, searches begin: sequential quadratic programming (SciPy) with
        derivatives from the separated form. The same call gives the same result.

        Parameters
        ----------
        objective : name, symbol or callable
            An unknown, whose value at the time ``t`` is the objective, or a function
            ``f(values, parameters)`` of two dictionaries: values of all states at ``t`` by name,
            numbers or arrays like ``t``, and all parameters. It has to be smooth.
        t : float or array_like
            Time of the objective; several for a function. None if nothing depends on time.
        sense : {"min", "max"}
        fixed, start, bounds
            As for :meth:`fit`.
        starts : int
            Most searches from basins of the box; half as many follow from the last generation. 0
            with a ``start`` searches from there alone.
        effort : {"low", "normal", "high"} or float
            Factor on the number of points, generations and searches: 0.2, 1, 10 or another one.
        constraints : mapping, optional
            For unknowns ``(lower, upper)`` at the times ``t``, or ``(lower, upper, times)``; None
            for no limit. Limits are numbers, or one for each time; they hold at these times.

        Returns
        -------
        Optimum
            With ``x``, ``fun``, ``success``, ``message`` and ``values``. ``is_global`` says
            whether it is the best of the box as far as seen, or may be local.

        Raises
        ------
        OptionError, EvaluationError
            As for :meth:`fit`, and if the objective is no number or the limits contradict.
        """
        return minimize(
            self,
            objective,
            t,
            sense=sense,
            fixed=fixed,
            start=start,
            bounds=bounds,
            constraints=constraints,
            starts=starts,
            effort=effort,
        )
