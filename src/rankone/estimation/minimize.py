"""The best parameters of a box: least or largest values of unknowns, with constraints."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import minimize as scipy_minimize

from rankone.arrays import Array
from rankone.errors import OptionError
from rankone.estimation.free import Free, free_parameters
from rankone.estimation.model import TrainModel
from rankone.estimation.observations import checked_times, state_name
from rankone.options import checked_number
from rankone.solution_core import SolutionCore
from rankone.spread import spread
from rankone.wording import listing, quote, shown

__all__ = ["Optimum", "minimize"]

_LOOKED_AT = 256
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
    """

    x: dict[str, float]
    fun: float
    success: bool
    message: str
    values: dict[str, Any]
    parameters: dict[str, float]
    evaluations: int


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

    def many(self, z: Array) -> Array:
        """Values at points (N, n): shape (N, states, times)."""
        return self._model.values(self.free.points(z)).reshape(len(z), *self._shape)


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
        values = self.states.many(z)[:, 0]
        return np.array([-np.minimum(self._inside(row), 0.0).sum() for row in values])

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
    starts: int = 4,
) -> Optimum:
    """The best parameters; arguments and errors are those of :meth:`~rankone.Solution.minimize`."""
    solution._evaluator  # noqa: B018 - raises if nothing was solved
    if sense not in ("min", "max"):
        raise OptionError(f"sense={sense!r} is unknown", remedy='choose "min" or "max"')
    free = free_parameters(solution, fixed, bounds, start)
    starts = checked_number("starts", starts, 0 if start is not None else 1, _LOOKED_AT)
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
    points = spread(_LOOKED_AT, len(free.names), np.random.default_rng(7))
    limits = _constraints(solution, constraints, t, free, points)
    found = np.array([goal.at(v, z) for v, z in zip(states.many(points), points, strict=True)])
    usable = np.isfinite(found)
    if not usable.any():
        raise OptionError("the objective is not finite anywhere in the box", term=objective)
    goal.scale = float(np.ptp(found[usable])) or 1.0
    missed = np.sum([limit.missed(points) for limit in limits], axis=0) if limits else 0.0 * found
    merit = np.where(usable, goal.sign * found / goal.scale + 1e3 * missed, np.inf)
    chosen = [] if free.start is None else [free.start]
    chosen += list(points[np.argsort(merit)][:starts])
    return _best(goal, limits, chosen)


def _best(goal: _Objective, limits: Sequence[_Constraint], starts: Sequence[Array]) -> Optimum:
    """The best of the searches from all starts (sequential quadratic programming)."""
    given = [{"type": "ineq", "fun": limit.margins, "jac": limit.slopes} for limit in limits]
    best: tuple[tuple[float, float], Array, bool, str] | None = None
    for start in starts:
        done = _search(goal, start, given)
        z = np.clip(done.x, 0.0, 1.0)
        missed = max((float(-limit.margins(z).min()) for limit in limits), default=0.0)
        missed = missed if missed > _FEASIBLE else 0.0
        rank = missed, float(done.fun) if math.isfinite(done.fun) else math.inf
        if best is None or rank < best[0]:
            best = rank, z, bool(done.success), str(done.message)
    assert best is not None
    (missed, _), z, ended, message = best
    values = goal.states(z)[0]
    free = goal.states.free
    if missed:
        message = f"no parameters were found that fulfil the constraints: {_worst(limits, z)}"
    elif ended:
        message = (
            "the search ended at a minimum" if goal.sign > 0 else "the search ended at a maximum"
        )
        message += _edges(free, z)
    every = {**free.named(z), **free.fixed}
    return Optimum(
        x=free.named(z),
        fun=goal.at(values, z),
        success=ended and not missed,
        message=message,
        values=goal.named(values),
        parameters={name: every[name] for name in free.order},
        evaluations=goal.evaluations,
    )


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
        scale = float(np.ptp(states.many(points))) or 1.0
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
