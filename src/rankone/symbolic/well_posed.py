"""Is a problem well defined on a domain, its own or one that it is moved to?

Tables have to cover their intervals. In what does not separate, functions of one coordinate are
checked as factors are; the rest is evaluated at the start of trajectories all over the box.
"""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import sympy as sp
from sympy.core.function import AppliedUndef

from rankone.expressions.admissible import known_functions, located_defect
from rankone.expressions.stable import NUMPY, stable
from rankone.frontend.problem import Problem
from rankone.ir.domain import Domain
from rankone.ir.forms import Coordinate, SeparatedForm
from rankone.ir.functions import Table, known_applied
from rankone.ir.system import System, refuse_gap
from rankone.support.arrays import Array
from rankone.support.errors import OptionError, ProblemError, RankoneWarning
from rankone.support.wording import number, quote
from rankone.symbolic.first_order import FirstOrderSystem

__all__ = [
    "check_known",
    "check_moved",
    "check_start",
    "check_tables",
]


_SAMPLES = 257
_MOST_CORNERS, _RANDOM = 64, 64
_OTHER_BOX = "change the box or the horizon"


def check_tables(system: FirstOrderSystem, coordinates: Sequence[Coordinate]) -> None:
    """Raise a ProblemError if a table of one coordinate does not cover its interval."""
    places = {c.symbol: c for c in coordinates}
    for part in known_applied([*system.rhs, *system.initial]):
        argument = part.args[0]
        symbols = argument.free_symbols
        if not isinstance(part, Table) or len(symbols) != 1 or argument.has(AppliedUndef):
            continue
        coordinate = places[next(iter(symbols))]
        lower, upper = coordinate.lower, coordinate.upper
        points = np.linspace(lower, upper, _SAMPLES)
        values = np.broadcast_to(
            sp.lambdify(coordinate.symbol, stable(argument), [NUMPY, "numpy", "scipy"])(points),
            points.shape,
        )
        first, last = part.points[0], part.points[-1]
        outside = (values < first) | (values > last)
        if outside.any():
            at = points[int(np.argmax(outside))]
            interval = f"[{lower:g}, {upper:g}]"
            reached = "" if argument == coordinate.symbol else f" is {values[outside][0]:.6g}"
            raise ProblemError(
                f"{quote(part)} is a table over [{first:g}, {last:g}], and {quote(argument)} "
                f"leaves it: {coordinate.name} in {interval}, outside at {coordinate.name} = "
                f"{at:.6g}" + (f", where the argument{reached}" if reached else ""),
                equation=_equation(system, part),
                term=part,
                remedy=f"extend the table, or {_OTHER_BOX}",
            )


def check_known(system: FirstOrderSystem, coordinates: Sequence[Coordinate]) -> None:
    """Raise a ProblemError if a known function of one coordinate is not finite and real."""
    known = known_functions(coordinates, [*system.rhs, *system.initial])
    for dimension, (coordinate, functions) in enumerate(zip(coordinates, known, strict=True)):
        for function in functions:
            wrong = located_defect(function, coordinate, dimension)
            if wrong is not None:
                raise ProblemError(
                    wrong,
                    equation=_equation(system, function),
                    term=function,
                    remedy="change the interval so that the factor is finite and real on it",
                )


def check_start(
    first_order: FirstOrderSystem, system: System, coordinates: Sequence[Coordinate]
) -> None:
    """Raise a ProblemError if the start of some trajectory is not finite, or f there.

    Looked at are the centre of the box, corners and random points.
    """
    clock, *parameters = coordinates
    p = _points(parameters)
    with np.errstate(all="ignore"):
        u = system.initial(p)
        f = system.rhs(clock.lower, u, p)
    for i, state in enumerate(first_order.states):
        bad = np.flatnonzero(~np.isfinite(u[i]))
        if bad.size:
            raise ProblemError(
                f"the initial value of {quote(state.expression)}, "
                f"{quote(first_order.initial[i])}, is not finite and real at "
                f"{_where(parameters, p[:, bad[0]])}",
                term=first_order.initial[i],
                remedy="change the box or the initial value",
            )
    for i, state in enumerate(first_order.states):
        bad = np.flatnonzero(~np.isfinite(f[i]))
        if bad.size:
            refuse_gap(system, clock.lower, u[:, bad[0]], p[:, bad[0]])
            start = ", ".join(
                f"{s.name} = {value:.6g}"
                for s, value in zip(first_order.states, u[:, bad[0]], strict=True)
            )
            raise ProblemError(
                f"the derivative of {quote(state.expression)}, {quote(first_order.rhs[i])}, is not "
                f"finite and real at the start, {clock.name} = {number(clock.lower)}, with "
                f"{_where(parameters, p[:, bad[0]])}, where {start}",
                equation=first_order.origins[i],
                term=first_order.rhs[i],
                remedy="change the box, the initial values or the equation",
            )


def _points(parameters: Sequence[Coordinate]) -> Array:
    """Centre, corners and random points of the box, (d, m)."""
    d = len(parameters)
    rng = np.random.default_rng(20140)
    if 2**d <= _MOST_CORNERS:
        corners = np.array(list(itertools.product([0.0, 1.0], repeat=d))).reshape(2**d, d)
    else:
        corners = rng.integers(0, 2, (_MOST_CORNERS, d)).astype(float)
    unit = np.concatenate([np.full((1, d), 0.5), rng.random((_RANDOM, d)), corners])
    lower = np.array([c.lower for c in parameters])
    upper = np.array([c.upper for c in parameters])
    return np.asarray((lower + (upper - lower) * unit).T)


def _where(parameters: Sequence[Coordinate], point: Array) -> str:
    named = (f"{c.name} = {value:.6g}" for c, value in zip(parameters, point, strict=True))
    return ", ".join(named) or "no parameters"


def _equation(system: FirstOrderSystem, part: sp.Expr) -> int | None:
    """The user's equation that a part of the system comes from, if it is one of the equations."""
    pairs = zip(system.rhs, system.origins, strict=True)
    return next((origin for f, origin in pairs if f.has(part)), None)


_OTHER_RANGES = "choose other ranges, or compile the problem with these"


def check_moved(
    problem: Problem,
    first_order: FirstOrderSystem,
    form: SeparatedForm,
    system: System,
    domain: Domain,
) -> None:
    """Raise unless the problem is well posed on a domain and its separated form holds there.

    The form was found on the box of the problem: the signs under its roots are those of that box.

    Raises
    ------
    OptionError
        As a new problem on that domain would, or if a factor is not finite and real on it.
    """
    t, *_ = problem.time
    box = dict(zip(problem.parameters, domain.box, strict=True))
    intervals = (domain.horizon, *domain.box)
    pairs = zip(form.coordinates, intervals, strict=True)
    moved_all = [replace(c, lower=lower, upper=upper) for c, (lower, upper) in pairs]
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RankoneWarning)
            Problem(problem.equations, (t, *domain.horizon), box, problem.initial)
        check_tables(first_order, moved_all)
        if form.general:
            check_known(first_order, moved_all)
            check_start(first_order, system, moved_all)
    except ProblemError as error:
        raise OptionError(error.message, term=error.term, remedy=error.remedy) from error
    for dimension, moved in enumerate(moved_all):
        for factor in form.factors[dimension]:
            wrong = located_defect(factor.expression, moved, dimension)
            if wrong is not None:
                raise OptionError(wrong, term=factor.expression, remedy=_OTHER_RANGES)
