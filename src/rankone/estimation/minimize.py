"""The best parameters of a box: least or largest values of unknowns, with constraints."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import minimize as scipy_minimize

from rankone.estimation.basins import basins, evolved, screened
from rankone.estimation.free import Free, free_parameters
from rankone.estimation.model import TrainModel
from rankone.estimation.observations import checked_times, state_name
from rankone.solution.core import SolutionCore
from rankone.support.arrays import Array
from rankone.support.budget import NORMAL, operations_for
from rankone.support.errors import OptionError
from rankone.support.options import checked_number
from rankone.support.wording import count, listing, quote, shown

__all__ = ["Optimum", "minimize"]

_LOOKED_AT, _GENERATIONS = 1024, 30
"""Points all over the box at which the objective is looked at, and generations of the best."""
_MOST_STARTS, _MOST_POINTS = 256, 2**17
_SECOND = 2
"""Searches from the basins of the sample over those from the last generation."""
_VALUES = 2_000_000
"""Values of unknowns that are held together."""
_SAME, _MISSED = 1e-6, 1e3
"""Difference of objectives, relative to their range over the box, up to which minima are as good;
weight of constraints that are missed."""
_FEASIBLE = 1e-6
"""How far a constraint may be missed, in units of the spread of its unknown over the box."""
_STEP = 1e-6
_TOLERANCES = (1e-12, 1e-9, 1e-7)
"""Of the scaled objective, one after the other."""

Objective = Callable[[dict[str, Any], dict[str, float]], float]


@dataclass(frozen=True)
class Optimum:
    """The best parameters found.

    Attributes
    ----------
    x : dict of str to float
        The free parameters.
    fun : float
        The objective there.
    success : bool
        Whether a search ended at a minimum that fulfils the constraints.
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
        How many of them ended at a value as good as this one.
    is_global : bool
        Whether this is the best of the box as far as it was looked at: several searches agree, or
        every basin of the points that were looked at was searched. Otherwise it may be local.
    """

    x: dict[str, float]
    fun: float
    success: bool
    message: str
    values: dict[str, Any]
    parameters: dict[str, float]
    evaluations: int
    searches: int = 1
    agreeing: int = 1
    is_global: bool = False


class _States:
    """Some states at times, for one point z of the cube, with derivatives."""

    def __init__(
        self, solution: SolutionCore, names: Sequence[str], times: Array, free: Free
    ) -> None:
        self.names, self.times, self.free = tuple(names), times, free
        rows = np.array([solution.states.index(name) for name in names], dtype=np.intp)
        self._shape = (rows.size, times.size)
        slabs = solution.outcome.slabs
        self._model = TrainModel(slabs, np.repeat(rows, times.size), np.tile(times, rows.size))

    def __call__(self, z: Array) -> tuple[Array, Array]:
        """Values (states, times) and derivatives (states, times, n) with respect to z."""
        values, slopes = self._model.both(self.free.points(z[None]), self.free.positions)
        slopes = slopes[0].reshape(*self._shape, -1) * self.free.width
        return values[0].reshape(self._shape), slopes

    def many(self, z: Array) -> Iterator[Array]:
        """Values (states, times) at points (N, n), one after the other."""
        size = max(_VALUES // max(math.prod(self._shape), 1), 1)
        for begin in range(0, len(z), size):
            points = self.free.points(z[begin : begin + size])
            yield from self._model.values(points).reshape(-1, *self._shape)


@dataclass(frozen=True)
class _Constraint:
    """One unknown between limits (times,) at times."""

    states: _States
    lower: Array
    upper: Array
    scale: float

    def margins(self, z: Array) -> Array:
        """How far inside the limits, (k,): negative where they are missed; scaled."""
        return self._inside(self.states(z)[0][0])

    def slopes(self, z: Array) -> Array:
        """Derivatives of the margins, (k, n)."""
        slope = self.states(z)[1][0] / self.scale
        return np.concatenate([slope[np.isfinite(self.lower)], -slope[np.isfinite(self.upper)]])

    def missed(self, z: Array) -> Array:
        """Sum by which the limits are missed at points (N, n): shape (N,)."""
        values = self.states.many(z)
        return np.array([-np.minimum(self._inside(row[0]), 0.0).sum() for row in values])

    def _inside(self, values: Array) -> Array:
        below, above = np.isfinite(self.lower), np.isfinite(self.upper)
        low, high = (values - self.lower)[below], (self.upper - values)[above]
        return np.asarray(np.concatenate([low, high]) / self.scale)


class _Objective:
    """The objective on the cube, scaled; with the sign that makes it one to minimise."""

    def __init__(self, states: _States, function: Objective | None, sign: float, one: bool) -> None:
        self.states, self.function, self.sign, self.one = states, function, sign, one
        self.scale, self.evaluations = 1.0, 0

    def named(self, values: Array) -> dict[str, Any]:
        """Values (states, times) by name; numbers if there is one time."""
        pairs = zip(self.states.names, values, strict=True)
        return {name: float(row[0]) if self.one else row for name, row in pairs}

    def at(self, values: Array, z: Array, inside: bool = True) -> float:
        """The objective for values of the unknowns (states, times) at z."""
        if self.function is None:
            return float(values[0, 0])
        free = self.states.free
        x = (
            free.named(z)
            if inside
            else dict(zip(free.names, map(float, free.lower + free.width * z), strict=True))
        )
        every = {**x, **free.fixed}
        given = {name: every[name] for name in free.order}
        found = self.function(self.named(values), given)
        try:
            return float(found)
        except (TypeError, ValueError):
            raise OptionError(
                f"the objective gives {shown(found)}, not a number", term=found
            ) from None

    def many(self, z: Array) -> Array:
        """The objective at points (N, n), unscaled and with its own sign."""
        return np.array([self.at(v, one) for v, one in zip(self.states.many(z), z, strict=True)])

    def __call__(self, z: Array) -> tuple[float, Array]:
        """Scaled value and gradient (n,)."""
        self.evaluations += 1
        values, slopes = self.states(z)
        factor = self.sign / self.scale
        if self.function is None:
            return factor * float(values[0, 0]), factor * slopes[0, 0]
        gradient = np.empty(z.size)
        for j in range(z.size):  # along the tangent: the unknowns move with the parameter
            step = np.zeros(z.size)
            step[j] = _STEP
            change = slopes[:, :, j] * _STEP
            ahead = self.at(values + change, z + step, inside=False)
            gradient[j] = (ahead - self.at(values - change, z - step, inside=False)) / (2.0 * _STEP)
        return factor * self.at(values, z), factor * gradient


def minimize(
    solution: SolutionCore,
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
    """The best parameters; arguments and errors are those of :meth:`~rankone.Solution.minimize`."""
    solution._evaluator  # noqa: B018 - raises if nothing was solved
    if sense not in ("min", "max"):
        raise OptionError(f"sense={sense!r} is unknown", remedy='choose "min" or "max"')
    free = free_parameters(solution, fixed, bounds, start)
    starts = checked_number("starts", starts, 0 if start is not None else 1, _MOST_STARTS)
    times, one = checked_times(solution, t), np.ndim(t) == 0
    by_name = isinstance(objective, str) or not _is_function(objective)
    names = [state_name(solution, objective)] if by_name else list(solution.states)
    if by_name and not one:
        raise OptionError(
            f"{quote(names[0])} is to be best at several times",
            term=t,
            remedy="give one time, or a function of the values as the objective",
        )
    states = _States(solution, names, times, free)
    function = None if by_name else objective
    goal = _Objective(states, function, 1.0 if sense == "min" else -1.0, one)
    factor = operations_for(effort) / NORMAL
    starts = min(math.ceil(factor * starts), _MOST_STARTS)
    points = screened(min(math.ceil(factor * _LOOKED_AT), _MOST_POINTS), len(free.names))
    limits = _constraints(solution, constraints, t, free, points[:_MOST_STARTS])
    values = goal.many(points)
    usable = np.isfinite(values)
    if not usable.any():
        raise OptionError("the objective is not finite anywhere in the box", term=objective)
    goal.scale = float(np.ptp(values[usable])) or 1.0
    merit = _Merit(goal, limits)
    merits = merit.of(values, points)
    lowest = points[basins(points, merits)]
    minima = [] if free.start is None else [merit.search(free.start)]
    minima += [merit.search(point) for point in lowest[:starts]]
    if starts:
        ends = np.array([minimum.z for minimum in minima])
        pool = np.concatenate([ends, points]), np.concatenate([merit(ends), merits])
        second = evolved(merit, *pool, math.ceil(factor * _GENERATIONS))[: -(-starts // _SECOND)]
        minima += [merit.search(point) for point in second]
    return _optimum(merit, minima, len(lowest) <= starts)


@dataclass(frozen=True)
class _Minimum:
    """Where a search ended: scaled objective, and by how much a constraint is missed."""

    z: Array
    value: float
    missed: float
    ended: bool
    message: str

    @property
    def rank(self) -> tuple[float, float]:
        """The best minimum has the least."""
        return self.missed, self.value

    def as_good_as(self, other: _Minimum) -> bool:
        """Whether a search ended at a minimum with the same value as another one."""
        return self.missed <= other.missed and self.value <= other.value + _SAME


@dataclass(frozen=True)
class _Merit:
    """The objective, scaled, with what constraints are missed by."""

    goal: _Objective
    limits: Sequence[_Constraint]

    def __call__(self, points: Array) -> Array:
        """Merits of points (N, n), the least the best; infinite where the objective is not."""
        return self.of(self.goal.many(points), points)

    def of(self, values: Array, points: Array) -> Array:
        """The same where the values of the objective are known."""
        merits = self.goal.sign * values / self.goal.scale
        for limit in self.limits:
            merits = merits + _MISSED * limit.missed(points)
        return np.where(np.isfinite(merits), merits, np.inf)

    def search(self, start: Array) -> _Minimum:
        """Where sequential quadratic programming ends from a start."""
        given = [{"type": "ineq", "fun": each.margins, "jac": each.slopes} for each in self.limits]
        done = _search(self.goal, start, given)
        z = np.clip(done.x, 0.0, 1.0)
        missed = max((float(-limit.margins(z).min()) for limit in self.limits), default=0.0)
        missed = missed if missed > _FEASIBLE else 0.0
        value = float(done.fun) if math.isfinite(done.fun) else math.inf
        return _Minimum(z, value, missed, bool(done.success), str(done.message))


def _optimum(merit: _Merit, minima: Sequence[_Minimum], every_basin: bool) -> Optimum:
    """The best of the minima; ``every_basin``: all basins of the sample were searched."""
    best = min(minima, key=lambda minimum: minimum.rank)
    best = next((each for each in minima if each.ended and each.as_good_as(best)), best)
    agreeing = sum(minimum.as_good_as(best) for minimum in minima)
    goal, free = merit.goal, merit.goal.states.free
    values = goal.states(best.z)[0]
    every = {**free.named(best.z), **free.fixed}
    success = best.ended and not best.missed
    is_global = success and (every_basin or agreeing > 1)
    message = best.message
    if best.missed:
        missed = _worst(merit.limits, best.z)
        message = f"no parameters were found that fulfil the constraints: {missed}"
    elif best.ended:
        what = "minimum" if goal.sign > 0 else "maximum"
        message = f"{_told(what, len(minima), agreeing, is_global)}{_edges(free, best.z)}"
    return Optimum(
        x=free.named(best.z),
        fun=goal.at(values, best.z),
        success=success,
        message=message,
        values=goal.named(values),
        parameters={name: every[name] for name in free.order},
        evaluations=goal.evaluations,
        searches=len(minima),
        agreeing=agreeing,
        is_global=is_global,
    )


def _told(what: str, searches: int, agreeing: int, is_global: bool) -> str:
    """What kind of minimum the searches ended at."""
    said = f"{agreeing} of {count(searches, 'search', 'searches')} ended at"
    if is_global:
        return f"{said} this {what}, the best of the box as far as seen"
    remedy = "remedy: raise effort, or narrow the bounds"
    return f"{said} this {what}, which may be a local one; {remedy}"


def _search(goal: _Objective, start: Array, constraints: Sequence[Mapping[str, Any]]) -> Any:
    """One search; where rounding ends it early, once more with a tolerance that it can meet."""
    for tolerance in _TOLERANCES:
        done = scipy_minimize(
            goal,
            start,
            jac=True,
            method="SLSQP",
            bounds=[(0.0, 1.0)] * start.size,
            constraints=constraints,
            options={"ftol": tolerance, "maxiter": 300},
        )
        if done.success:
            break
        start = np.clip(done.x, 0.0, 1.0)
    return done


def _worst(limits: Sequence[_Constraint], z: Array) -> str:
    """The constraint that is missed most."""
    limit = min(limits, key=lambda one: float(one.margins(z).min()))
    amount = -float(limit.margins(z).min()) * limit.scale
    return f"{quote(limit.states.names[0])} misses its limits by {amount:.4g}"


def _edges(free: Free, z: Array) -> str:
    """Which parameters are at an end of their bounds."""
    ends = [
        f"{quote(name)} at its {'lower' if at < 0.5 else 'upper'} bound"
        for name, at in zip(free.names, z, strict=True)
        if min(at, 1.0 - at) <= 1e-9
    ]
    return f", with {' and '.join(ends)}" if ends else ""


def _constraints(
    solution: SolutionCore, given: Any, t: Any, free: Free, points: Array
) -> list[_Constraint]:
    """Check limits of unknowns."""
    if not isinstance(given, Mapping | None):
        raise OptionError(
            f"constraints={given!r} is not a mapping from unknowns to limits",
            term=given,
            remedy="give {unknown: (lower, upper)} or {unknown: (lower, upper, times)}",
        )
    found = []
    for key, limits in (given or {}).items():
        name = state_name(solution, key)
        if not isinstance(limits, list | tuple) or len(limits) not in (2, 3):
            raise OptionError(
                f"the limits of {quote(name)} are {shown(limits)}",
                term=limits,
                remedy="give (lower, upper) or (lower, upper, times); None for no limit",
            )
        times = checked_times(solution, limits[2] if len(limits) == 3 else t)
        states = _States(solution, [name], times, free)
        lower = _limit(name, limits[0], -math.inf, times.size)
        upper = _limit(name, limits[1], math.inf, times.size)
        if not (lower <= upper).all() or not np.isfinite([lower, upper]).any():
            raise OptionError(
                f"the limits of {quote(name)} leave nothing, or everything",
                term=limits,
                remedy="give a lower limit that is not above the upper one",
            )
        scale = float(np.ptp(list(states.many(points)))) or 1.0
        found.append(_Constraint(states, lower, upper, scale))
    return found


def _limit(name: str, given: Any, none: float, size: int) -> Array:
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


def _is_function(objective: Any) -> bool:
    """Whether an objective is a function of values, and no symbol or unknown."""
    symbolic = hasattr(objective, "free_symbols") or hasattr(objective, "derivative_count")
    if callable(objective) and not symbolic and not isinstance(objective, str):
        return True
    if symbolic:
        return False
    raise OptionError(
        f"the objective {shown(objective)} is neither an unknown nor a function",
        term=objective,
        remedy=f"name an unknown, or give a function of {listing(['values', 'parameters'])}",
    )
