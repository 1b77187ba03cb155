"""Is a problem well defined on a domain, its own or one that it is moved to?

Tables have to cover their intervals. In terms that do not separate, functions of one coordinate are
checked as factors are; the rest is evaluated at the start of trajectories all over the box.
Piecewise functions must have a branch everywhere: gaps in time and parameters are refused; gaps in
unknowns depend on the trajectories, and the generated module tells whether a state lies in one.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
import sympy as sp
from numpy.typing import NDArray
from sympy.core.function import AppliedUndef
from sympy.core.relational import Relational

from rankone.compiler.passes.feature_pass import cuts_of
from rankone.compiler.passes.first_order import FirstOrderSystem
from rankone.problem.algebra.algebraic import no_consistent_values
from rankone.problem.expressions.admissible import gaps, known_functions, located_defect, numeric
from rankone.problem.expressions.stable import in_floats
from rankone.problem.forms import Coordinate, SeparatedForm, State
from rankone.problem.functions import Table, known_applied
from rankone.problem.problem import Problem
from rankone.solvers.request import Domain
from rankone.support.arrays import (
    AT_ONCE,
    COINCIDENT,
    HALVINGS,
    MANY_SAMPLES,
    SAMPLES,
    SEED,
    Array,
    bisected,
    corners,
    spread,
)
from rankone.support.errors import OptionError, ProblemError, RankoneWarning, number, quote
from rankone.trajectories.system.features import GAP_REMEDY
from rankone.trajectories.system.system import System, refuse_gap

NamedExpression: TypeAlias = "tuple[str, int | None, sp.Expr]"
"""What an expression is, the user's equation it comes from, and the expression."""


def check_tables(system: FirstOrderSystem, coordinates: Sequence[Coordinate]) -> None:
    """Raise a ProblemError if a table of one coordinate does not cover its interval."""
    coordinate_of = {c.symbol: c for c in coordinates}
    for table in known_applied([*system.examined_rates, *system.initial]):
        argument = table.args[0]
        symbols = argument.free_symbols
        if not isinstance(table, Table) or len(symbols) != 1 or argument.has(AppliedUndef):
            continue
        coordinate = coordinate_of[next(iter(symbols))]
        lower, upper = coordinate.lower, coordinate.upper
        points = np.linspace(lower, upper, MANY_SAMPLES)
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
    functions_of = known_functions(coordinates, system.known_expressions)
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


def _starting_points(parameters: Sequence[Coordinate]) -> Array:
    """The centre of the box, random points and corners, (d, N)."""
    generator = np.random.default_rng(SEED)
    at_corners = corners(len(parameters), SAMPLES, generator)
    inside = generator.random((SAMPLES, len(parameters)))
    unit = np.concatenate([np.full((1, len(parameters)), 0.5), inside, at_corners])
    lower = np.array([c.lower for c in parameters])
    upper = np.array([c.upper for c in parameters])
    return np.asarray((lower + (upper - lower) * unit).T)


def check_start(
    first_order: FirstOrderSystem, system: System, coordinates: Sequence[Coordinate]
) -> None:
    """Raise a ProblemError if some trajectory starts where u or f is not finite.

    Trajectories start at the centre of the box, its corners and random points.
    """
    clock, *parameters = coordinates
    p = _starting_points(parameters)
    with np.errstate(all="ignore"):
        u = system.initial(p)
        f = system.rhs(clock.lower, u, p)
    for i, state in enumerate(first_order.states):
        bad = np.flatnonzero(~np.isfinite(u[i]))
        if bad.size and i in first_order.constraints.guessed:
            names = [c.name for c in parameters]
            raise no_consistent_values(names, p[:, bad[0]], [state.expression])
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
            Problem(
                problem.equations,
                (t, *domain.horizon),
                box,
                problem.initial,
                constants=problem.constants,
                definitions=problem.definitions,
            )
        check_stages(first_order, form, system, coordinates)
    except ProblemError as error:
        raise OptionError(error.message, term=error.term, remedy=error.remedy) from error


def check_stages(
    first_order: FirstOrderSystem,
    form: SeparatedForm,
    system: System,
    coordinates: Sequence[Coordinate],
) -> None:
    """Raise unless what was compiled for one domain, or other constants, holds on coordinates."""
    check_tables(first_order, coordinates)
    if form.general:
        check_known(first_order, coordinates)
        check_start(first_order, system, coordinates)
    for dimension, coordinate in enumerate(coordinates):
        for factor in form.factors[dimension]:
            defect = located_defect(factor.expression, coordinate, dimension)
            if defect is not None:
                raise OptionError(
                    defect,
                    term=factor.expression,
                    remedy="choose other ranges, or compile the problem with these",
                )


@dataclass(frozen=True)
class Gap:
    """A gap that depends on the unknowns: what has it, and the user's equation it comes from.

    The piecewise function has no branch where the condition ``region`` holds.
    """

    name: str
    equation: int | None
    function: sp.Expr
    region: sp.Basic

    def text(self, names: dict[sp.Basic, sp.Basic] | None = None) -> str:
        """What a message says of it, with some expressions replaced."""
        function, region = self.function.xreplace(names or {}), self.region.xreplace(names or {})
        return f"{quote(function)} in {self.name} has no branch where {quote(region)}"


def check_gaps(
    expressions: Iterable[NamedExpression],
    coordinates: Sequence[Coordinate],
    remedy: str = GAP_REMEDY,
) -> None:
    """Raise a ProblemError if a piecewise function has a gap on the domain.

    Conditions on one coordinate each are checked exactly; those that couple coordinates are checked
    at points all over the domain and where lines between them cross a boundary.
    """
    symbols = {coordinate.symbol for coordinate in coordinates}
    for name, origin, expression in expressions:
        for function, region in gaps(expression):
            if region.atoms(AppliedUndef) or not region.free_symbols <= symbols:
                continue
            involved = [c for c in coordinates if c.symbol in region.free_symbols]
            couples = any(len(r.free_symbols) != 1 for r in region.atoms(Relational))
            place = (_point_inside if couples else _cell_inside)(region, involved)
            if place is not None:
                raise ProblemError(
                    f"{quote(function)} in {name} has no branch {place}",
                    equation=origin,
                    term=function,
                    remedy=remedy,
                )


def gaps_in_unknowns(expressions: Iterable[NamedExpression]) -> list[Gap]:
    """The gaps that depend on unknowns, each once."""
    distinct = {
        (function, region): Gap(name, origin, function, region)
        for name, origin, expression in expressions
        for function, region in gaps(expression)
        if region.atoms(AppliedUndef)
    }
    return list(distinct.values())


def _cell_inside(region: sp.Basic, involved: Sequence[Coordinate]) -> str | None:
    """The first cell between the boundaries of each coordinate that lies in a region."""
    edges = [_edges(region, coordinate) for coordinate in involved]
    shape = [len(each) - 1 for each in edges]
    indices = np.unravel_index(np.arange(min(math.prod(shape), AT_ONCE)), shape)
    centres = [
        0.5 * (each[:-1] + each[1:])[index] for each, index in zip(edges, indices, strict=True)
    ]
    inside = np.flatnonzero(_truth(region, involved)(np.array(centres)))
    if not inside.size:
        return None
    texts = []
    for c, each, index in zip(involved, edges, indices, strict=True):
        lower, upper = index[inside[0]], index[inside[0]] + 1
        if len(involved) == 1:  # the whole of a gap that boundaries divide
            apart = np.flatnonzero(np.diff(inside) > 1)
            upper = inside[apart[0] if apart.size else -1] + 1
        texts.append(f"{each[lower]:.9g} < {c.name} < {each[upper]:.9g}")
    return f"for {' and '.join(texts)}"


def _edges(region: sp.Basic, coordinate: Coordinate) -> Array:
    """The ends of an interval and what boundaries of a region lie inside, ascending."""
    lower, upper = float(coordinate.lower), float(coordinate.upper)
    (cuts,) = cuts_of([coordinate], [region])
    edges = [lower, upper, *cuts.inside(lower, upper, AT_ONCE)]
    inside = np.unique([edge for edge in edges if lower <= edge <= upper])
    least = COINCIDENT * max(abs(lower), abs(upper))
    return np.asarray(inside[np.concatenate([[True], np.diff(inside) > least])])


def _point_inside(region: sp.Basic, involved: Sequence[Coordinate]) -> str | None:
    """A point of the box that lies in a region, whose boundaries may couple coordinates."""
    lower, upper = np.array([[float(c.lower), float(c.upper)] for c in involved]).T[:, :, None]
    truth = _truth(region, involved)
    sides = [_truth(relation, involved) for relation in region.atoms(Relational)]

    def pattern(points: Array) -> Array:
        return np.array([side(points) for side in sides])

    unit = spread(MANY_SAMPLES, len(involved), np.random.default_rng(SEED)).T
    points = lower + (upper - lower) * unit
    a, b = points[:, ::2], points[:, 1::2]
    samples, at_start = [points], pattern(a)

    def like_start(middle: Array) -> NDArray[np.bool_]:
        if len(samples) < HALVINGS // 2:
            samples.append(middle)
        return np.asarray((pattern(middle) == at_start).all(axis=0))

    # to where the first of the conditions changes on each line
    _, b = bisected(a, b, like_start)
    points = np.concatenate([*samples, b], axis=1)
    inside = np.flatnonzero(truth(points))
    if not inside.size:
        return None
    at = points[:, inside[0]]
    named = ", ".join(f"{c.name} = {x:.6g}" for c, x in zip(involved, at, strict=True))
    return f"where {quote(region)}, for example at {named}"


def _truth(condition: sp.Basic, involved: Sequence[Coordinate]) -> Callable[[Array], Array]:
    """A condition as a function of points (d, m): (m,)."""
    function = sp.lambdify([c.symbol for c in involved], in_floats(condition), ["numpy", "scipy"])

    def evaluate(points: Array) -> Array:
        with np.errstate(all="ignore"):
            return np.broadcast_to(np.asarray(function(*points), dtype=bool), points.shape[1:])

    return evaluate
