"""Is a problem well defined on a domain, its own or one that it is moved to?

Tables have to cover their intervals. In terms that do not separate, functions of one coordinate are
checked as factors are; the rest is evaluated at the start of trajectories all over the box.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import sympy as sp
from sympy.core.function import AppliedUndef

from rankone.expressions.admissible import known_functions, located_defect, numeric
from rankone.frontend.problem import Problem
from rankone.ir.domain import Domain
from rankone.ir.forms import Coordinate, SeparatedForm, State
from rankone.ir.functions import Table, known_applied
from rankone.ir.system import System, refuse_gap
from rankone.support.arrays import Array, corners
from rankone.support.errors import OptionError, ProblemError, RankoneWarning
from rankone.support.wording import number, quote
from rankone.symbolic.first_order import FirstOrderSystem

# Points of an interval at which the argument of a table is compared with the table's ends
_TABLE_SAMPLES = 257
# Corners of the box at which the start is evaluated: all of them up to six parameters
_MOST_CORNERS = 64
_RANDOM_STARTS = 64  # Random points of the box at which the start is evaluated
_SEED = 20140


def check_tables(system: FirstOrderSystem, coordinates: Sequence[Coordinate]) -> None:
    """Raise a ProblemError if a table of one coordinate does not cover its interval."""
    coordinate_of = {c.symbol: c for c in coordinates}
    for table in known_applied([*system.rhs, *system.initial]):
        argument = table.args[0]
        symbols = argument.free_symbols
        if not isinstance(table, Table) or len(symbols) != 1 or argument.has(AppliedUndef):
            continue
        coordinate = coordinate_of[next(iter(symbols))]
        lower, upper = coordinate.lower, coordinate.upper
        points = np.linspace(lower, upper, _TABLE_SAMPLES)
        arguments = numeric(argument, coordinate)(points)
        first, last = table.points[0], table.points[-1]
        outside = (arguments < first) | (arguments > last)
        if outside.any():
            at = points[int(np.argmax(outside))]
            message = (
                f"{quote(table)} is a table over [{first:g}, {last:g}], and {quote(argument)} "
                f"leaves it: {coordinate.name} in [{lower:g}, {upper:g}], outside at "
                f"{coordinate.name} = {at:.6g}"
            )
            if argument != coordinate.symbol:
                message += f", where the argument is {arguments[outside][0]:.6g}"
            raise ProblemError(
                message,
                equation=_equation(system, table),
                term=table,
                remedy="extend the table, or change the box or the horizon",
            )


def check_known(system: FirstOrderSystem, coordinates: Sequence[Coordinate]) -> None:
    """Raise a ProblemError if a known function of one coordinate is not finite and real."""
    functions_of = known_functions(coordinates, [*system.rhs, *system.initial])
    for dimension, (coordinate, functions) in enumerate(
        zip(coordinates, functions_of, strict=True)
    ):
        for function in functions:
            defect = located_defect(function, coordinate, dimension)
            if defect is not None:
                raise ProblemError(
                    defect,
                    equation=_equation(system, function),
                    term=function,
                    remedy="change the interval so that the factor is finite and real on it",
                )


def check_start(
    first_order: FirstOrderSystem, system: System, coordinates: Sequence[Coordinate]
) -> None:
    """Raise a ProblemError if some trajectory starts where u or f is not finite.

    Trajectories start at the centre of the box, its corners and random points.
    """
    clock, *parameters = coordinates
    p = _starts(parameters)
    with np.errstate(all="ignore"):
        u = system.initial(p)
        f = system.rhs(clock.lower, u, p)
    for i, state in enumerate(first_order.states):
        bad = np.flatnonzero(~np.isfinite(u[i]))
        if bad.size:
            raise ProblemError(
                f"the initial value of {quote(state.expression)}, "
                f"{quote(first_order.initial[i])}, is not finite and real at "
                f"{_listed(parameters, p[:, bad[0]])}",
                term=first_order.initial[i],
                remedy="change the box or the initial value",
            )
    for i, state in enumerate(first_order.states):
        bad = np.flatnonzero(~np.isfinite(f[i]))
        if bad.size:
            point, start = p[:, bad[0]], u[:, bad[0]]
            refuse_gap(system, clock.lower, start, point)
            raise ProblemError(
                f"the derivative of {quote(state.expression)}, {quote(first_order.rhs[i])}, is not "
                f"finite and real at the start, {clock.name} = {number(clock.lower)}, with "
                f"{_listed(parameters, point)}, where {_listed(first_order.states, start)}",
                equation=first_order.origins[i],
                term=first_order.rhs[i],
                remedy="change the box, the initial values or the equation",
            )


def _starts(parameters: Sequence[Coordinate]) -> Array:
    """Centre, random points and corners of the box, (d, m)."""
    d = len(parameters)
    generator = np.random.default_rng(_SEED)
    at_corners = corners(d, _MOST_CORNERS, generator)
    unit = np.concatenate([np.full((1, d), 0.5), generator.random((_RANDOM_STARTS, d)), at_corners])
    lower = np.array([c.lower for c in parameters])
    upper = np.array([c.upper for c in parameters])
    return np.asarray((lower + (upper - lower) * unit).T)


def _listed(named: Sequence[Coordinate | State], point: Array) -> str:
    """``k = 1, m = 2``."""
    pairs = zip(named, point, strict=True)
    return ", ".join(f"{c.name} = {x:.6g}" for c, x in pairs) or "no parameters"


def _equation(system: FirstOrderSystem, function: sp.Expr) -> int | None:
    """The user's equation with a function in it; None if only initial values have it."""
    pairs = zip(system.rhs, system.origins, strict=True)
    return next((origin for f, origin in pairs if f.has(function)), None)


def check_moved(
    problem: Problem,
    first_order: FirstOrderSystem,
    form: SeparatedForm,
    system: System,
    domain: Domain,
) -> None:
    """Raise unless the problem is well posed on a domain and its separated form holds there.

    The form was made for the box of the problem: the signs under its roots are those of that box.
    An OptionError says what a ProblemError would say of a new problem, or which factor is not
    finite and real.
    """
    t, *_ = problem.time
    box = dict(zip(problem.parameters, domain.box, strict=True))
    intervals = (domain.horizon, *domain.box)
    pairs = zip(form.coordinates, intervals, strict=True)
    coordinates = [replace(c, lower=lower, upper=upper) for c, (lower, upper) in pairs]
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RankoneWarning)
            Problem(problem.equations, (t, *domain.horizon), box, problem.initial)
        check_tables(first_order, coordinates)
        if form.general:
            check_known(first_order, coordinates)
            check_start(first_order, system, coordinates)
    except ProblemError as error:
        raise OptionError(error.message, term=error.term, remedy=error.remedy) from error
    for dimension, coordinate in enumerate(coordinates):
        for factor in form.factors[dimension]:
            defect = located_defect(factor.expression, coordinate, dimension)
            if defect is not None:
                raise OptionError(
                    defect,
                    term=factor.expression,
                    remedy="choose other ranges, or compile the problem with these",
                )
