"""The best parameters of a box: least or largest values of unknowns, with constraints."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeGuard

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import minimize as scipy_minimize
from scipy.spatial import cKDTree

from rankone.inference.estimation import estimates as results
from rankone.inference.estimation.experiments import failure_of
from rankone.inference.estimation.fitted_models import model_of
from rankone.inference.estimation.free_parameters import (
    Bounds,
    FreeParameters,
    ParameterValues,
    free_parameters,
)
from rankone.inference.estimation.observations import checked_times, state_name
from rankone.inference.estimation.search import DISTINCT_DISTANCE
from rankone.solution.evaluation.core import SolutionCore
from rankone.support.arrays import (
    AT_ONCE,
    COINCIDENT,
    DIFFERENCE,
    NEGLIGIBLE,
    SAME,
    Array,
    Labelled,
    Table,
    Variables,
)
from rankone.support.budget import NORMAL, operations_for
from rankone.support.errors import OptionError, count, quote, shown, with_remedy
from rankone.support.options import checked_number


@dataclass(frozen=True)
class MinimizeTuning:
    """Tuning of the search for the best parameters of a box."""

    screened_points: int = 1024
    """Points all over the box at which the objective is evaluated first, for normal effort."""
    most_screened_points: int = 2**17
    """Most of these points, whatever the effort."""
    most_corners: int = 64
    """Most corners of the box among these points."""
    most_starts: int = 256
    """Most searches from basins, whatever the effort."""
    first_per_second_search: int = 2
    """Searches from basins of the sample, for each search from the last generation."""
    generations: int = 30
    """Generations of differential evolution, for normal effort."""
    population: int = 32
    """Points of a generation."""
    difference_factors: tuple[float, float] = (0.4, 0.9)
    """Range of the factors of differences, around the 0.5 to 0.8 that Storn and Price advise."""
    crossed_share: float = 0.6
    """Share of the coordinates that are exchanged."""
    seed: int = 7
    """Of the shifted Sobol sequence and of differential evolution: a call repeats itself."""
    missed_weight: float = 1e3
    """Weight of constraints that are missed, beside the scaled objective."""
    tolerances: tuple[float, float, float] = (COINCIDENT, NEGLIGIBLE, 1e-7)
    """Tolerances of the scaled objective, one after the other."""
    most_iterations: int = 300
    """Most iterations of one search with one tolerance."""


TUNING = MinimizeTuning()

_GLOBAL = "; it is the best of the box as far as it was sampled"
_LOCAL = "; it may be a local one"
_LOCAL_REMEDY = "raise effort, or narrow the bounds"


@dataclass(frozen=True, repr=False)
class Optimum(Labelled):
    """The best parameters found.

    Attributes
    ----------
    x : dict of str to float
        The free parameters.
    fun : float
        The objective there.
    success : bool
        Whether a search converged to a minimum that fulfils the constraints, of a solution that
        is a success itself.
    message : str
    values : dict of str to float or ndarray
        The unknowns there, at the times of the objective.
    parameters : dict of str to float
        All parameters, fixed ones as well.
    evaluations : int
        Number of evaluations of the objective with its derivatives.
    searches : int
        Number of searches.
    agreeing : int
        How many of them ended at an equally good value.
    is_global : bool
        Whether this is the best of the box as far as it was sampled: several searches agree, or
        every basin of the sample was searched. Otherwise it may be local.
    """

    x: dict[str, float]
    fun: float
    success: bool
    message: str
    values: dict[str, Number]
    parameters: dict[str, float]
    evaluations: int
    searches: int = 1
    agreeing: int = 1
    is_global: bool = False

    def _table(self) -> Table:
        """The free parameters; the others and the values there are below."""
        rows = [[name, f"{x:.6g}"] for name, x in self.x.items()]
        remarks = [results.verdict(self)]
        held = {name: x for name, x in self.parameters.items() if name not in self.x}
        if held:
            fixed = ", ".join(f"{name} = {x:.6g}" for name, x in held.items())
            remarks.insert(0, f"fixed: {fixed}")
        return Table(f"Optimum: {self.fun:.6g}", ["parameter", "best"], rows, remarks)

    def _variables(self) -> Variables:
        return results.by_parameter({"best": list(self.x.values())}, list(self.x))


def minimize(
    self: SolutionCore,
    objective: object,
    t: ArrayLike | None = None,
    *,
    sense: str = "min",
    fixed: ParameterValues = None,
    start: ParameterValues = None,
    bounds: Bounds = None,
    constraints: Limits = None,
    starts: int = 16,
    effort: str | float = "normal",
) -> Optimum:
    """The parameters for which an unknown, or a function of the unknowns, is least.

    The objective is sampled all over the box (a Sobol sequence, the centre, corners). Searches
    start from the best points of the basins of this sample, and from the best points after 30
    generations of differential evolution. They use sequential quadratic programming (SciPy) with
    derivatives from the separated form. The same call gives the same result.

    Parameters
    ----------
    objective : name, symbol or callable
        An unknown, whose value at the time ``t`` is the objective, or a smooth function
        ``f(values, parameters)`` of two dictionaries: all states at ``t`` by name, numbers or
        arrays like ``t``, and all parameters.
    t : float or array_like
        Time of the objective; several for a function. None if nothing depends on time.
    sense : {"min", "max"}
    fixed, start, bounds
        As for :meth:`fit`.
    starts : int
        Most searches from basins of the box; half as many follow from the last generation. 0
        with a ``start`` searches from that start alone.
    effort : {"low", "normal", "high"} or float
        Factor on the numbers of points, generations and searches: 0.2, 1, 10 or any other.
    constraints : mapping, optional
        For unknowns ``(lower, upper)`` at the times ``t``, or ``(lower, upper, times)``; None
        for no limit. Limits are numbers, or one for each time; they hold at these times.

    Returns
    -------
    Optimum
        With ``x``, ``fun``, ``success``, ``message`` and ``values``. ``is_global`` says
        whether it is the best of the box as far as it was sampled, or may be local.

    Raises
    ------
    OptionError, EvaluationError
        As for :meth:`fit`, and if the objective is not a number or limits contradict each other.
    """
    self._evaluator  # noqa: B018 - raises if nothing was solved
    if sense not in ("min", "max"):
        raise OptionError(f"sense={sense!r} is unknown", remedy='choose "min" or "max"')
    free = free_parameters([self], fixed, bounds, start)
    starts = checked_number("starts", starts, 0 if start is not None else 1, TUNING.most_starts)
    times, one = checked_times(self, t), t is None or np.ndim(t) == 0
    function = objective if is_function(objective) else None
    names = [state_name(self, objective)] if function is None else list(self.states)
    if function is None and not one:
        raise OptionError(
            f"the objective {quote(names[0])} is given at several times",
            term=t,
            remedy="give one time, or a function of the values as the objective",
        )
    sign = 1.0 if sense == "min" else -1.0
    goal = Objective(States(self, names, times, free), function, sign, one)
    factor = operations_for(effort) / NORMAL
    starts = min(math.ceil(factor * starts), TUNING.most_starts)
    screened = min(math.ceil(factor * TUNING.screened_points), TUNING.most_screened_points)
    points = _screened(screened, len(free.names))
    limits = constraints_of(self, constraints, t, free, points[: TUNING.most_starts])
    objectives = goal.many(points)
    usable = np.isfinite(objectives)
    if not usable.any():
        raise OptionError("the objective is not finite anywhere in the box", term=objective)
    goal.scale = float(np.ptp(objectives[usable])) or 1.0
    merit = _Merit(goal, limits)
    merits = merit(points, objectives)
    lowest = points[_basins(points, merits)]
    minima = [] if free.start is None else [merit.search(free.start)]
    minima += [merit.search(point) for point in lowest[:starts]]
    if starts:
        ends = np.array([minimum.z for minimum in minima])
        pool = np.concatenate([ends, points]), np.concatenate([merit(ends), merits])
        descendants = _evolved(merit, *pool, math.ceil(factor * TUNING.generations))
        most = -(-starts // TUNING.first_per_second_search)
        minima += [merit.search(point) for point in descendants[:most]]
    best = _optimum(merit, minima, len(lowest) <= starts)
    if self.success:
        return best
    message = f"{failure_of(self)}; {best.message}"
    return replace(best, success=False, message=message)


@dataclass(frozen=True)
class _Minimum:
    """The end of a search: scaled objective, and by how much a constraint is missed."""

    z: Array
    objective: float
    missed: float
    ended: bool
    message: str

    def as_good_as(self, best: _Minimum) -> bool:
        """Whether a search ended at a minimum that is as good as the best one."""
        equal = self.objective <= best.objective + SAME
        return self.missed <= best.missed and equal


@dataclass(frozen=True)
class _Merit:
    """The scaled objective with a penalty for missed constraints."""

    goal: Objective
    limits: Sequence[Constraint]

    def __call__(self, points: Array, objectives: Array | None = None) -> Array:
        """Merits of points (N, n), the least the best; infinite where the objective is not."""
        objectives = self.goal.many(points) if objectives is None else objectives
        merits = self.goal.sign * objectives / self.goal.scale
        for limit in self.limits:
            merits = merits + TUNING.missed_weight * limit.missed(points)
        return np.where(np.isfinite(merits), merits, np.inf)

    def search(self, start: Array) -> _Minimum:
        """The minimum that sequential quadratic programming reaches from a start.

        If rounding stops it early, it goes on with a tolerance that it can meet.
        """
        inequalities = [{"type": "ineq", "fun": c.margins, "jac": c.slopes} for c in self.limits]
        for tolerance in TUNING.tolerances:
            end = scipy_minimize(
                self.goal,
                start,
                jac=True,
                method="SLSQP",
                bounds=[(0.0, 1.0)] * start.size,
                constraints=inequalities,
                options={"ftol": tolerance, "maxiter": TUNING.most_iterations},
            )
            z = start = np.clip(end.x, 0.0, 1.0)
            if end.success:
                break
        missed = max((float(-limit.margins(z).min()) for limit in self.limits), default=0.0)
        missed = missed if missed > SAME else 0.0
        objective = float(end.fun) if math.isfinite(end.fun) else math.inf
        return _Minimum(z, objective, missed, bool(end.success), str(end.message))


def _optimum(merit: _Merit, minima: Sequence[_Minimum], every_basin: bool) -> Optimum:
    """The best of the minima; ``every_basin``: all basins of the sample were searched."""
    best = min(minima, key=lambda minimum: (minimum.missed, minimum.objective))
    best = next((each for each in minima if each.ended and each.as_good_as(best)), best)
    agreeing = sum(minimum.as_good_as(best) for minimum in minima)
    goal, free = merit.goal, merit.goal.states.free
    states, x = goal.states(best.z)[0], free.named(best.z)
    success = best.ended and not best.missed
    is_global = success and (every_basin or agreeing > 1)
    ended = f"{agreeing} of {count(len(minima), 'search', 'searches')} ended"
    return Optimum(
        x=x,
        fun=goal.at(states, best.z),
        success=success,
        message=_message(merit, best, ended, is_global),
        values=goal.named(states),
        parameters=free.complete(x),
        evaluations=goal.evaluations,
        searches=len(minima),
        agreeing=agreeing,
        is_global=is_global,
    )


def _message(merit: _Merit, best: _Minimum, ended: str, is_global: bool) -> str:
    """What to say of the best minimum; ``ended`` says how many searches ended there."""
    if best.missed:
        limit = min(merit.limits, key=lambda limit: float(limit.margins(best.z).min()))
        amount = -float(limit.margins(best.z).min()) * limit.scale
        return (
            "no parameters were found that fulfil the constraints: "
            f"{quote(limit.states.names[0])} misses its limits by {amount:.4g}"
        )
    if not best.ended:
        return best.message
    extremum = "minimum" if merit.goal.sign > 0 else "maximum"
    at_bounds = merit.goal.states.free.at_bounds(best.z)
    ends = [f"{quote(name)} at its {end} bound" for name, end in at_bounds.items()]
    message = (
        f"{ended} at this {extremum}"
        + (f", with {' and '.join(ends)}" if ends else "")
        + (_GLOBAL if is_global else _LOCAL)
    )
    return with_remedy(message, None if is_global else _LOCAL_REMEDY)


# --- where searches begin ------------------------------------------------------------------------


def _screened(count: int, d: int) -> Array:
    """Points (N, d) of the unit cube: centre, corners, and ``count`` of a shifted Sobol points."""
    corners = itertools.islice(itertools.product((0.0, 1.0), repeat=d), TUNING.most_corners)
    sequence = scipy.stats.qmc.Sobol(d, scramble=False).random_base2(max(count - 1, 1).bit_length())
    shifted = (sequence[:count] + np.random.default_rng(TUNING.seed).random(d)) % 1.0
    return np.concatenate([np.full((1, d), 0.5), np.array(list(corners)), shifted])


def _basins(points: Array, merits: Array) -> NDArray[np.intp]:
    """Indices of points (N, d) that are no worse than their neighbours, the best first.

    They are the minima of the graph that joins each point to its 2 d + 1 nearest neighbours.
    """
    neighbours = min(2 * points.shape[1] + 2, len(points))
    _, nearest = cKDTree(points).query(points, k=neighbours)
    around = merits[nearest.reshape(len(points), -1)].min(axis=1)
    lowest = np.flatnonzero((merits <= around) & np.isfinite(merits))
    return lowest[np.argsort(merits[lowest], kind="stable")]


def _evolved(
    merit: Callable[[Array], Array], points: Array, merits: Array, generations: int
) -> list[Array]:
    """Points (d,) in different basins after differential evolution (Storn, Price 1997).

    The best of the points (N, d), by their merits (N,), are the first generation.
    """
    generator = np.random.default_rng(TUNING.seed)
    chosen = np.argsort(merits, kind="stable")[: TUNING.population]
    population, best_merits = points[chosen], merits[chosen]
    m, d = population.shape
    for _ in range(generations):
        base, plus, minus = (population[generator.permutation(m)] for _ in range(3))
        trial = base + generator.uniform(*TUNING.difference_factors, (m, 1)) * (plus - minus)
        crossed = generator.random((m, d)) < TUNING.crossed_share
        crossed[np.arange(m), generator.integers(0, d, m)] = True
        outside = (trial < 0.0) | (trial > 1.0)
        trial = np.where(outside, generator.random((m, d)), trial)
        trial = np.where(crossed, trial, population)
        trial_merits = merit(trial)
        better = trial_merits < best_merits
        population = np.where(better[:, None], trial, population)
        best_merits = np.where(better, trial_merits, best_merits)
    apart: list[Array] = []
    for point in population[np.argsort(best_merits, kind="stable")]:
        if all(np.abs(point - end).max() > DISTINCT_DISTANCE for end in apart):
            apart.append(point)
    return apart


# -----------------------------------------------------------------------------
# Objectives and constraints of a minimisation, as functions on a unit cube with derivatives.


Number = float | Array
"""A state at one time, or at several."""
ObjectiveFunction = Callable[[dict[str, Any], dict[str, float]], float]
"""A function of states and of parameters, both by name."""
Limits = Mapping[Any, Sequence[ArrayLike | None]] | None
"""For unknowns, names or symbols, lower and upper limits, and perhaps times."""


class States:
    """Some states at times, for one point z of the cube, with derivatives."""

    def __init__(
        self, solution: SolutionCore, names: Sequence[str], times: Array, free: FreeParameters
    ) -> None:
        self.names, self.times, self.free = tuple(names), times, free
        rows = np.array([solution.states.index(name) for name in names], dtype=np.intp)
        self._shape = (rows.size, times.size)
        at = np.repeat(rows, times.size), np.tile(times, rows.size)
        self._model = model_of(solution, *at)

    def __call__(self, z: Array) -> tuple[Array, Array]:
        """Values (states, times) and derivatives (states, times, n) with respect to z."""
        points = self.free.points(z[None])
        states, slopes = self._model.linearised(points, self.free.positions)
        slopes = slopes[0].reshape(*self._shape, -1) * self.free.slopes(z)
        return states[0].reshape(self._shape), slopes

    def many(self, z: Array) -> Iterator[Array]:
        """Values (states, times) at points (N, n), one after the other."""
        size = max(AT_ONCE // max(math.prod(self._shape), 1), 1)
        for begin in range(0, len(z), size):
            points = self.free.points(z[begin : begin + size])
            yield from self._model.values(points).reshape(-1, *self._shape)


@dataclass(frozen=True)
class Constraint:
    """One unknown between limits (times,) at times."""

    states: States
    lower: Array
    upper: Array
    scale: float

    def margins(self, z: Array) -> Array:
        """Scaled distances to the limits, (k,): negative where they are missed."""
        return self._inside(self.states(z)[0][0])

    def slopes(self, z: Array) -> Array:
        """Derivatives of the margins, (k, n)."""
        slope = self.states(z)[1][0] / self.scale
        return np.concatenate([slope[np.isfinite(self.lower)], -slope[np.isfinite(self.upper)]])

    def missed(self, z: Array) -> Array:
        """Sums over the limits of how far they are missed at points (N, n): shape (N,)."""
        rows = self.states.many(z)
        return np.array([-np.minimum(self._inside(row[0]), 0.0).sum() for row in rows])

    def _inside(self, row: Array) -> Array:
        below, above = np.isfinite(self.lower), np.isfinite(self.upper)
        low, high = (row - self.lower)[below], (self.upper - row)[above]
        return np.asarray(np.concatenate([low, high]) / self.scale)


class Objective:
    """The objective on the cube, scaled, with a sign such that it is minimised."""

    def __init__(
        self, states: States, function: ObjectiveFunction | None, sign: float, one: bool
    ) -> None:
        self.states, self.function, self.sign, self.one = states, function, sign, one
        self.scale, self.evaluations = 1.0, 0

    def named(self, states: Array) -> dict[str, Number]:
        """Values (states, times) by name; numbers if there is one time."""
        pairs = zip(self.states.names, states, strict=True)
        return {name: float(row[0]) if self.one else row for name, row in pairs}

    def at(self, states: Array, z: Array, inside: bool = True) -> float:
        """The objective for states (states, times) at z, which may be outside the cube."""
        if self.function is None:
            return float(states[0, 0])
        free = self.states.free
        point = free.values(z) if inside else free.unclipped(z)
        x = free.complete(dict(zip(free.names, map(float, point), strict=True)))
        objective = self.function(self.named(states), x)
        try:
            return float(objective)
        except (TypeError, ValueError):
            raise OptionError(
                f"the objective gives {shown(objective)}, not a number", term=objective
            ) from None

    def many(self, z: Array) -> Array:
        """The objective at points (N, n), unscaled and with its own sign."""
        return np.array([self.at(v, one) for v, one in zip(self.states.many(z), z, strict=True)])

    def __call__(self, z: Array) -> tuple[float, Array]:
        """Scaled value and gradient (n,)."""
        self.evaluations += 1
        states, slopes = self.states(z)
        factor = self.sign / self.scale
        if self.function is None:
            return factor * float(states[0, 0]), factor * slopes[0, 0]
        gradient = np.empty(z.size)
        for j in range(z.size):  # along the tangent: the unknowns move with the parameter
            step = np.zeros(z.size)
            step[j] = DIFFERENCE
            change = slopes[:, :, j] * DIFFERENCE
            ahead = self.at(states + change, z + step, inside=False)
            behind = self.at(states - change, z - step, inside=False)
            gradient[j] = (ahead - behind) / (2.0 * DIFFERENCE)
        return factor * self.at(states, z), factor * gradient


def constraints_of(
    solution: SolutionCore, given: Limits, t: ArrayLike | None, free: FreeParameters, points: Array
) -> list[Constraint]:
    """Checked limits of unknowns, scaled by the range of each unknown over points (N, n)."""
    if not isinstance(given, Mapping | None):
        raise OptionError(
            f"constraints={given!r} is not a mapping from unknowns to limits",
            term=given,
            remedy="give {unknown: (lower, upper)} or {unknown: (lower, upper, times)}",
        )
    constraints = []
    for key, limits in (given or {}).items():
        name = state_name(solution, key)
        if not isinstance(limits, list | tuple) or len(limits) not in (2, 3):
            raise OptionError(
                f"the limits of {quote(name)} are {shown(limits)}",
                term=limits,
                remedy="give (lower, upper) or (lower, upper, times); None for no limit",
            )
        times = checked_times(solution, limits[2] if len(limits) == 3 else t)
        states = States(solution, [name], times, free)
        lower = _limit(name, limits[0], -math.inf, times.size)
        upper = _limit(name, limits[1], math.inf, times.size)
        if not (lower <= upper).all() or not np.isfinite([lower, upper]).any():
            raise OptionError(
                f"the limits of {quote(name)} leave nothing, or everything",
                term=limits,
                remedy="give a lower limit that is not above the upper one",
            )
        scale = float(np.ptp(list(states.many(points)))) or 1.0
        constraints.append(Constraint(states, lower, upper, scale))
    return constraints


def _limit(name: str, given: ArrayLike | None, none: float, size: int) -> Array:
    """One limit for each time."""
    try:
        array = np.asarray(none if given is None else given, dtype=float)
        if not np.isnan(array).any():
            return np.array(np.broadcast_to(array, size))
    except (TypeError, ValueError):
        pass
    raise OptionError(
        f"a limit of {quote(name)} is {shown(given)}, not a number, nor one for each of "
        f"{size} times",
        term=given,
    )


def is_function(objective: object) -> TypeGuard[ObjectiveFunction]:
    """Whether an objective is a function of values, and no name or symbol of an unknown."""
    symbolic = hasattr(objective, "free_symbols") or hasattr(objective, "derivative_count")
    if symbolic or isinstance(objective, str):
        return False
    if callable(objective):
        return True
    raise OptionError(
        f"the objective {shown(objective)} is neither an unknown nor a function",
        term=objective,
        remedy="name an unknown, or give a function of `values` and `parameters`",
    )
