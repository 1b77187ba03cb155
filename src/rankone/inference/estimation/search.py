"""Parameters of solutions from data, by least squares or maximum likelihood."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from rankone.inference.estimation import least_squares, likelihood
from rankone.inference.estimation.estimates import leverages_of
from rankone.inference.estimation.experiments import Experiment, Trial, failures_of, trials_of
from rankone.inference.estimation.fit import Fit
from rankone.inference.estimation.free_parameters import (
    Bounds,
    ParameterValues,
    free_parameters,
    with_start,
)
from rankone.inference.estimation.identification import (
    Best,
    degrees_of_freedom,
    identify,
    jumps_within,
)
from rankone.inference.estimation.intervals import checked_level, quantile_of
from rankone.inference.estimation.noise import noise_of
from rankone.inference.estimation.observations import Measurements, Observations
from rankone.inference.estimation.tables import is_table
from rankone.solution.evaluation.core import SolutionCore
from rankone.support.arrays import COARSE, MANY_SAMPLES, NEGLIGIBLE, Array, spread
from rankone.support.budget import NORMAL, operations_for
from rankone.support.errors import EvaluationError, OptionError, count, listing, quote, shown
from rankone.support.options import LEVEL, checked_number, of_keywords, takes_options_of
from rankone.tensors.joint_distribution import Distributions, by_name, measures_of

_SCREENED_POINTS = 128  # Points of the box among which the starts are chosen, for normal effort


@dataclass(frozen=True, kw_only=True)
class Options:
    """What fits are asked for beside the data; see :meth:`Solution.fit`."""

    fixed: Mapping[Any, Any] | None = None
    start: ParameterValues = None
    bounds: Bounds = None
    prior: Distributions = None
    starts: int = 4
    effort: str | float = "normal"
    level: float = LEVEL


_OF_DATA = {each.name for each in fields(Experiment)} - {"data", "times", "fixed"}


@takes_options_of(Experiment)
@takes_options_of(Options)
def fit(self: SolutionCore, times: object, data: Measurements | None = None, **options: Any) -> Fit:
    """Parameters from data, by least squares or maximum likelihood with exact derivatives.

    Parameters
    ----------
    times : array_like (times,), mapping, or table
        Times of the measurements; a time may occur more than once. A mapping from outputs
        gives each its own times. Or a table alone, without ``data``: a pandas DataFrame, or a
        mapping from names to columns, with a column of time and one for each unknown or
        observable. Cells may be empty. Columns ``condition`` and ``subject`` tell experiments
        apart, columns named like parameters hold values of them, and ``sigma`` or ``sigma_x``
        the standard deviation of each measurement.
    data : array_like (times,) or (outputs, times), or mapping
        Measurements of one output, of several, or of each by name.
    observe : name, symbol, expression, list of them, or mapping, optional
        What was measured: unknowns, derivatives that are states, or expressions of them, of
        parameters and of time, such as ``"log(C)"``; with names of their own as a mapping,
        ``{"signal": "scale*x + offset"}``. New names in an expression are further parameters:
        those that enter linearly need no bounds. By default the names of the data, or all
        unknowns.
    sigma : float, array_like, expression or mapping, optional
        Standard deviation of the noise: one number, one for each output, or one for each
        datum; or an expression, ``"a + b*x"``, whose new names are levels that are estimated.
        Without sigma and noise it is estimated: one for each output. So is that of outputs that
        a mapping leaves out. ``sigma="s"`` estimates one that all outputs share.
    noise : {"constant", "proportional", "combined", "log-normal", "student"} or mapping, optional
        The kind of noise, for all outputs or for each. Each output has levels of its own, which
        are estimated unless sigma gives them: ``sigma_x`` the standard deviation, ``relative_x``
        that in shares of the prediction, both for combined noise. The level of log-normal noise
        is the standard deviation of the logarithm. Student's noise has four degrees of freedom
        and its standard deviation as level, which is 1.41 times the scale of its distribution.
    weights : array_like, optional
        Factors of the squares in place of sigma, in the same shapes: one over the variance up
        to a common factor, which is estimated.
    fixed : mapping, optional
        Values of known parameters, by names or symbols; for a table with a column ``condition``
        or ``subject`` perhaps mappings by label, ``{"low": {"dose": 1}, "high": {"dose": 5}}``.
    doses : mapping, optional
        The parameter that is the amount of a dose, with the column of amounts: ``{dose: "amt"}``.
        The table then has a row for each dose of a subject or condition, at its time, beside those
        of data, and perhaps the columns ``evid``, ``mdv``, ``addl`` and ``ii`` of NONMEM. The
        solution is that of one dose at its start. Those of several add up: this takes a linear
        system.
    start : mapping, optional
        Values of some parameters to start from; the others start in the middle.
    bounds : mapping, optional
        Intervals of some parameters inside the box; by default the box. ``(1e-3, 10, "log")``
        searches over decades.
    prior : mapping, optional
        For some parameters frozen continuous distributions of scipy.stats. The estimate is the
        largest posterior density in the coordinates of the search.
    starts : int
        Number of further starts, the best of a sample all over the box.
    effort : {"low", "normal", "high"} or float
        Factor on the numbers of points and starts: 0.2, 1, 10 or any other.
    level : float
        Probability of the intervals.
    missing : {"error", "drop"}
        Whether NaN among the data is an error, or left out.
    name : str, optional
        The name of the experiment in messages and plots.

    Returns
    -------
    Fit
        With the estimates ``x``, ``covariance``, ``interval()``, ``residuals``,
        ``identifiable``, ``success`` and ``message``. It is a success if the search converged
        inside the bounds, every parameter is identified, the residuals are not far above
        sigma, and the error of the solution is small beside the noise.

    Raises
    ------
    OptionError
        If shapes do not fit, data are NaN, free parameters outnumber the data, sigma is not
        positive, a name is unknown, all parameters are fixed or a start is outside its bounds.
    EvaluationError
        If a time is outside the horizon, or a value outside the box; or if an event ends the
        solution before the last of the data at all points that are tried.
    """
    self._evaluator  # noqa: B018 - raises if nothing was solved
    fixed = options.pop("fixed", None)
    every = fixed.items() if isinstance(fixed, Mapping) else ()
    conditions = {key: own for key, own in every if isinstance(own, Mapping)}
    if data is None and not isinstance(times, Mapping) and not is_table(times):
        raise OptionError(
            "data are missing", remedy="give fit(times, data), or fit(table) with a column of time"
        )
    of_data = {name: options.pop(name) for name in _OF_DATA & options.keys()}
    clock: Any = None if data is None else times
    experiment = Experiment(times if data is None else data, clock, fixed=conditions, **of_data)
    if isinstance(fixed, Mapping):
        fixed = {key: x for key, x in fixed.items() if key not in conditions}
    wanted = of_keywords(Options, "fit", {"fixed": fixed, **options})
    return fitted(trials_of([(self, experiment)]), wanted)


@takes_options_of(Options)
def fit_experiments(
    pairs: Sequence[tuple[SolutionCore, Experiment]],
    *,
    noise: object = None,
    **options: Any,
) -> Fit:
    """Fit several experiments together, of one solution or of several that share parameters.

    Parameters
    ----------
    pairs : list of (Solution, Experiment)
        Parameters of the same name are the same parameter, unless an experiment fixes them. So are
        parameters of observables and levels of noise: each output has one standard deviation in
        all experiments, unless they give it, or name levels of their own, ``sigma="s_low"``.
    noise : str or mapping, optional
        The kind of noise of experiments that say nothing of theirs; see :meth:`Solution.fit`.
    fixed, start, bounds, prior, starts, effort, level
        As for :meth:`Solution.fit`.

    Returns
    -------
    Fit
        ``values_in(name)`` has all parameters of the solution in one experiment.

    Raises
    ------
    OptionError, EvaluationError
        As for :meth:`Solution.fit`, and if the solutions share no interval of a parameter.
    """
    listed = list(pairs) if isinstance(pairs, list | tuple) else []
    if not listed or not all(isinstance(pair, tuple | list) and len(pair) == 2 for pair in listed):
        raise OptionError(
            f"{shown(pairs)} is not a list of pairs",
            term=pairs,
            remedy="give [(solution, rankone.Experiment(data, ...)), ...]",
        )
    for solution, _ in listed:
        if not isinstance(solution, SolutionCore):
            raise OptionError(f"{shown(solution)} is not a Solution", term=solution)
    listed = [(solution, _with_noise(experiment, noise)) for solution, experiment in listed]
    return fitted(trials_of(listed), of_keywords(Options, "fit", options))


def _with_noise(experiment: Experiment, noise: object) -> Experiment:
    """An experiment with a kind of noise, if it says nothing of its own."""
    if not isinstance(experiment, Experiment):
        return experiment  # refused with the other things that are none
    own = (experiment.noise, experiment.sigma, experiment.weights)
    return replace(experiment, noise=noise) if all(each is None for each in own) else experiment


def fitted(trials: tuple[Trial, ...], options: Options) -> Fit:
    """The fit of trials."""
    level = checked_level(options.level)
    least = 0 if options.start is not None else 1
    starts = checked_number("starts", options.starts, least, _SCREENED_POINTS)
    factor = operations_for(options.effort) / NORMAL
    starts = min(math.ceil(factor * starts), _SCREENED_POINTS)
    screened = max(min(math.ceil(factor * _SCREENED_POINTS), MANY_SAMPLES), starts, 1)
    problem = problem_of(trials, options)
    points = spread(screened, len(problem.free.names), np.random.default_rng(7))
    points[0] = 0.5
    problem = likelihood.with_linear_ranges(problem, points)
    if options.start is not None:
        named = by_name("start", options.start, problem.free.order)
        problem = replace(problem, free=with_start(problem.free, named))
    _check_size(problem)
    likelihood.check_certain(problem, points)
    ends = least_squares.minima_across_jumps(problem, _starts(problem, starts, points))
    k = chosen(problem, ends)
    bounded = by_name("bounds", options.bounds, problem.free.order)
    idle = likelihood.idle_levels(problem, ends.z[k], float(ends.cost[k]), bounded)
    if idle:
        held = {**by_name("fixed", options.fixed, problem.free.order), **idle}
        return fitted(trials, replace(options, fixed=held))
    return judged(problem, ends, k, level, points)


def problem_of(trials: tuple[Trial, ...], options: Options) -> likelihood.Likelihood:
    """The likelihood of trials, with what is fixed, bounded or known before."""
    trials = with_levels(trials, always=bool(options.prior))
    solutions = list({id(trial.solution): trial.solution for trial in trials}.values())
    used = {name for trial in trials for name in trial.parameters}
    every = {name for solution in solutions for name in solution.parameters}
    asked = (options.fixed, options.bounds, options.prior)
    declared = [str(getattr(key, "name", key)) for each in asked for key in (each or ())]
    ranges = likelihood.ranges_of(trials, declared)
    absent = [name for name in every if name not in used]
    for option, choices in (("fixed", options.fixed), ("bounds", options.bounds)):
        for key in choices or ():
            if str(key) in absent:
                raise OptionError(
                    f"{option}: the experiments fix {quote(key)} themselves", term=key
                )
    free = free_parameters(
        solutions, options.fixed, options.bounds, options.start, extras=ranges, absent=absent
    )
    priors = by_name("prior", options.prior, free.order)
    for name in priors:
        if name in free.fixed:
            raise OptionError(f"{quote(name)} is fixed, and has a prior", term=name)
    box = [(float(a), float(b)) for a, b in zip(free.lower, free.upper, strict=True)]
    measures = measures_of(free.names, box, priors, {})
    informed = tuple(measure for measure in measures if measure.distribution is not None)
    return likelihood.Likelihood(trials, likelihood.within_support(free, informed), informed)


def with_levels(trials: tuple[Trial, ...], *, always: bool = False) -> tuple[Trial, ...]:
    """Trials with a level of noise for each observable where the noise is not known.

    Those of a single observable, and those with weights, have a common factor that is no parameter,
    unless ``always``.
    """
    unknown = [not trial.observations.sigma_known for trial in trials]
    names = {name for trial in trials for name in trial.observations.names}
    common = len(names) == 1 or all(trial.observations.weighted for trial in trials)
    if not any(unknown) or (all(unknown) and common and not always):
        return trials
    return tuple(
        replace(trial, observations=_with_constant_noise(trial)) if open_ else trial
        for trial, open_ in zip(trials, unknown, strict=True)
    )


def _with_constant_noise(trial: Trial) -> Observations:
    noises = tuple(
        replace(noise_of("constant", name, noise.spread, given=False), spread=noise.spread)
        for name, noise in zip(trial.observations.names, trial.observations.noises, strict=True)
    )
    return replace(trial.observations, noises=noises, sigma_known=True)


def _check_size(problem: likelihood.Likelihood) -> None:
    """Raise an OptionError if there are fewer data than parameters."""
    free_sigma = not problem.unit_known
    names = problem.free.names
    if problem.size + len(problem.priors) < len(names) + free_sigma:
        raise OptionError(
            f"there are {count(problem.size, 'value')} for "
            f"{count(len(names), 'parameter')}{' and sigma' if free_sigma else ''}: "
            f"{listing(names)}",
            remedy="measure more, or fix parameters: fixed={name: value}"
            + ("; or give sigma" if free_sigma else ""),
        )


def _starts(problem: likelihood.Likelihood, starts: int, points: Array) -> Array:
    """The best points (k, n) of the cube that are apart, after the start that was given."""
    n = len(problem.free.names)
    places, costs = problem.costs(points, start=True)
    usable = np.isfinite(costs)
    if not usable.any():
        reason = (
            "the likelihood is not finite, wherever it was tried: the solution ends before the "
            "last of the data, an observable has no value, or the noise is zero there"
        )
        raise EvaluationError(
            "; ".join([*failures_of(problem.trials), reason]),
            remedy="leave out such data, or restrict the solution to parameters where it goes on",
        )
    order = np.argsort(np.where(usable, costs, np.inf))[: usable.sum()]
    searched = [j for j in range(n) if j not in {*problem.levels, *problem.linear}]
    chosen: list[Array] = [] if problem.free.start is None else [problem.free.start]
    apart = 0.5 * starts ** (-1.0 / max(len(searched), 1)) if starts else 0.0
    most = len(chosen) + (starts if searched else min(starts, 1))
    for point in places[order]:
        if len(chosen) == most:
            break
        if all(np.abs(point - start)[searched].max(initial=0.0) >= apart for start in chosen) or (
            not searched
        ):
            chosen.append(point)
    return np.array(chosen)


# -----------------------------------------------------------------------------
# The minimum that a fit reports, and what is said of it.


DISTINCT_DISTANCE = 1e-2
"""Distance in the cube above which minima are different ones."""
_LEAST_FREEDOM = 0.5  # Least degrees of freedom of a level of noise that is corrected for them


def chosen(problem: likelihood.Likelihood, ends: least_squares.Minima) -> int:
    """The best minimum; among equally good ones the farthest from the bounds."""
    best = int(ends.cost.argmin())
    mean = float(least_squares.squares_of(ends.residuals[best : best + 1])[0]) / problem.size
    good = np.flatnonzero(ends.cost <= ends.cost.min() + COARSE * mean)
    inside = np.minimum(ends.z[good], 1.0 - ends.z[good]).min(axis=1)
    apart = np.abs(ends.z[good] - ends.z[best]).max(axis=1)
    if apart.max() <= COARSE:
        return best
    return int(good[np.argmax(inside)])


def judged(
    problem: likelihood.Likelihood, ends: least_squares.Minima, k: int, level: float, points: Array
) -> Fit:
    """The fit at one of the minima: what is identified there, and what else fits."""
    z, cost, jacobian = ends.z[k], float(ends.cost[k]), ends.jacobian[k]
    dof = degrees_of_freedom(problem, cost, jacobian)
    least = max(dof, 1.0)
    noise_given = problem.unit_known and not problem.levels
    unit = 1.0 if problem.unit_known else math.sqrt(cost / least)
    q = quantile_of(level, noise_given, least)
    reported, freedom = _corrected(problem, z, jacobian)
    centre = Best(z, cost, np.zeros((z.size, 0)))
    if problem.levels:
        jacobian = problem.linearised(reported[None], settle=False).jacobian[0]
        centre = _at_levels(problem, reported)
    identification, levels = identify(problem, centre, jacobian, q, unit), None
    centre = replace(centre, root=identification.root)
    if problem.levels:
        levels = likelihood.level_uncertainty(problem, jacobian, identification.seen, freedom)
        identification = identification.enlarged(levels)
    limit = problem.size * math.log1p(q**2 / least) if problem.levels else (q * unit) ** 2
    distinct = () if identification.flat else _others(problem, ends, k, limit)
    jumps = jumps_within(problem, reported, q * identification.root, jacobian / (unit or 1.0))
    return Fit(
        level=level,
        converged=bool(ends.converged[k]),
        stuck=bool(ends.stuck[k]),
        kinked=bool(ends.kinked[k]),
        dof=dof,
        _problem=problem,
        _best=Best(z, cost, identification.root),
        _centre=centre,
        _z=reported,
        _identification=identification,
        _freedom=freedom,
        _levels=levels,
        others=distinct,
        jumps=jumps,
        sizes=_largest_states(problem, points),
    )


def _at_levels(problem: likelihood.Likelihood, reported: Array) -> Best:
    """The best point with the levels of noise that are reported, from which profiles go."""
    held = np.zeros((1, reported.size), dtype=bool)
    held[:, list(problem.levels)] = True
    ends = least_squares.minima(problem, reported[None], held)
    return Best(ends.z[0], float(ends.cost[0]), np.zeros((reported.size, 0)))


def _corrected(
    problem: likelihood.Likelihood, z: Array, jacobian: Array
) -> tuple[Array, dict[int, float]]:
    """The estimate z (n,) with levels of noise corrected for the degrees of freedom used.

    With it the share of the data that is left to estimate each level, by its position.

    The mean square of n residuals is too small by the sum of their leverages h (Patterson &
    Thompson, "Recovery of inter-block information", 1971, to first order): its expectation is
    (n - h) sigma^2.
    """
    if not problem.groups:
        return z, {}
    leverages = leverages_of(problem, jacobian)
    values, shares = problem.free.values(z), {}
    for group in problem.groups:
        names = {problem.free.names[j] for j in group}
        own = [
            here
            for trial, i, here in problem.blocks
            if names & set(trial.observations.noises[i].levels)
        ]
        size = sum(here.stop - here.start for here in own)
        freedom = size - sum(float(leverages[here].sum()) for here in own)
        if freedom >= _LEAST_FREEDOM:
            for j in group:
                shares[j] = freedom / size
                values[j] = min(values[j] * math.sqrt(size / freedom), problem.free.upper[j])
    return problem.free.places(values), shares


def _largest_states(problem: likelihood.Likelihood, points: Array) -> tuple[dict[str, float], ...]:
    """For each trial the largest values of its states over points (N, n) of the cube."""
    at = problem.at(problem.free.values(points))
    sizes = []
    for trial in problem.trials:
        states = np.abs(trial.states(at))
        largest = states[np.isfinite(states).all(axis=1)].max(axis=0, initial=0.0)
        own: dict[str, float] = {}
        begin = 0
        for i, rows in enumerate(trial.rows):
            size = trial.observations.noises[i].spread.size
            for row in rows:
                top = float(largest[begin : begin + size].max(initial=0.0))
                own[row] = max(own.get(row, 0.0), top)
                begin += size
        sizes.append(own)
    return tuple(sizes)


def _others(
    problem: likelihood.Likelihood, ends: least_squares.Minima, k: int, limit: float
) -> tuple[dict[str, float], ...]:
    """Minima apart from the chosen one whose costs are within a limit of it.

    Other levels of noise alone are no other values.
    """
    chosen = [ends.z[k]]
    values = [j for j in range(len(problem.free.names)) if j not in problem.levels]
    margin = max(limit, NEGLIGIBLE * abs(float(ends.cost[k])))
    for z, cost, ended in zip(ends.z, ends.cost, ends.converged, strict=True):
        apart = all(
            np.abs(z - minimum)[values].max(initial=0.0) > DISTINCT_DISTANCE for minimum in chosen
        )
        if ended and apart and cost <= ends.cost[k] + margin:
            chosen.append(z)
    levels = {problem.free.names[j] for j in problem.levels}
    return tuple(
        {name: x for name, x in problem.free.named(z).items() if name not in levels}
        for z in chosen[1:]
    )
