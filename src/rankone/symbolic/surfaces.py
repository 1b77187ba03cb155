"""Functions that vanish where expressions are not smooth, or change faster than samples may see.

*Boundaries* are where functions such as ``Abs``, ``Heaviside`` or ``Piecewise`` kink or jump.
Smooth functions have *peaks*, such as ``exp(-((t - 60)/1e-3)**2)``, ``1/(1 + (k/1e-4)**2)`` and
``1/cosh(x/1e-3)**2``, and steep *steps*: ``tanh``, ``erf``, ``atan`` and ``1/(1 + exp(...))``, two
of which make a pulse.

*Moving cuts* are switches whose times move with parameters: cuts of each trajectory. *State
surfaces* are functions of the unknowns, such as a pulse ``Piecewise((1, (x > 2) & (x < 2.001)),
(0, True))``, looked at where a step crosses them. *Parameter surfaces* are where further
trajectories are checked.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Iterator, Sequence

import sympy as sp
from sympy.core.function import AppliedUndef
from sympy.core.relational import Relational

from rankone.ir.forms import Coordinate
from rankone.ir.functions import Table
from rankone.symbolic.derivatives import slope

Variables = Callable[[sp.Basic], Iterable[sp.Expr]]
"""The variables of an expression that count."""
CONTINUOUS = (sp.Abs, sp.Max, sp.Min, sp.asin, sp.acos, sp.Pow)
"""Functions that are continuous, but not smooth everywhere."""
DISCONTINUOUS = (Relational, sp.Heaviside, sp.sign, sp.floor, sp.ceiling, sp.frac, sp.Mod, Table)
"""Functions that may jump."""
# Functions that change most where their argument vanishes
_STEEPEST_AT_ZERO = (sp.tanh, sp.erf, sp.erfc, sp.atan, sp.cosh, sp.sech)
_MAX_SURFACES = 64  # Surfaces of each sort: every check point and step evaluates them all
# Second derivative of an exponent times the squared horizon: above this, steps may miss a peak
_NARROW_CURVATURE = 1e4
_SHIFT_DIGITS = 20  # Decimal digits of a logarithm in a threshold: more than a float holds


def boundaries(
    expressions: Iterable[sp.Basic], functions: tuple[type, ...] = (*CONTINUOUS, *DISCONTINUOUS)
) -> Iterator[tuple[sp.Expr, Sequence[float] | None]]:
    """Where some functions are not smooth: expressions, and the levels that they take there.

    The levels are None for all integers.
    """
    zero = (0.0,)
    for node in {node for expression in expressions for node in expression.atoms(*functions)}:
        if isinstance(node, Relational):
            yield node.lhs - node.rhs, zero
        elif isinstance(node, sp.Heaviside | sp.sign | sp.Abs):
            yield node.args[0], zero
        elif isinstance(node, sp.Max | sp.Min):
            yield from ((a - b, zero) for a, b in itertools.combinations(node.args, 2))
        elif isinstance(node, sp.floor | sp.ceiling | sp.frac):
            yield node.args[0], None
        elif isinstance(node, sp.Mod):
            yield node.args[0] / node.args[1], None
        elif isinstance(node, sp.asin | sp.acos):
            yield node.args[0], (-1.0, 1.0)
        elif node.is_Pow and node.exp.is_number and not node.exp.is_integer:
            yield node.base, zero
        elif isinstance(node, Table) and node.kind != "cubic":
            yield node.args[0], node.points


def peaks(
    expressions: Iterable[sp.Basic], variables: Variables
) -> Iterator[tuple[sp.Expr, sp.Expr]]:
    """Functions that may be peaks, and what vanishes in the middle of each.

    How narrow they are depends on the values of the variables. ``variables`` gives those of an
    expression.
    """
    for node in subexpressions(expressions, sp.exp, sp.Pow, *_STEEPEST_AT_ZERO):
        if isinstance(node, sp.exp):
            surfaces = list(_extrema(node.exp, variables))
        elif not node.is_Pow:
            surfaces = list(_extrema(node.args[0], variables))
            surfaces += [node.args[0]] if isinstance(node, sp.cosh | sp.sech) else []
        elif node.exp.is_number and node.exp.is_negative:
            surfaces = list(_extrema(node.base, variables))
        else:
            continue
        yield from ((node, surface) for surface in surfaces)


def steps(
    expressions: Iterable[sp.Basic], variables: Variables
) -> Iterator[tuple[sp.Expr, sp.Expr]]:
    """Functions that may be steep steps, and what vanishes in the middle of each."""
    for node in subexpressions(expressions, sp.Pow, *_STEEPEST_AT_ZERO):
        if not node.is_Pow:
            yield node, node.args[0]
        elif node.exp.is_number and node.exp.is_negative:
            yield from ((node, surface) for surface in _thresholds(node.base, variables))


def valleys(expressions: Iterable[sp.Basic]) -> Iterator[sp.Expr]:
    """Functions that are least where an exponential or a reciprocal is largest."""
    for node in subexpressions(expressions, sp.exp, sp.Pow):
        if isinstance(node, sp.exp):
            yield -node.exp
        elif node.exp.is_number and node.exp.is_negative:
            yield node.base


def subexpressions(expressions: Iterable[sp.Basic], *functions: type) -> list[sp.Expr]:
    """The applications of some functions, each once, in SymPy's order."""
    nodes = {node for expression in expressions for node in expression.atoms(*functions)}
    return sorted(nodes, key=sp.default_sort_key)


def moving_cuts(coordinates: Sequence[Coordinate], rates: Sequence[sp.Expr]) -> tuple[sp.Expr, ...]:
    """Times, as functions of the parameters, at which functions of both switch or are narrow.

    Boundaries that are linear in time, and the peaks of narrow exponentials of squares.
    """
    t, symbols = coordinates[0].symbol, {c.symbol for c in coordinates}
    times = set(_moving_peaks(coordinates, rates))
    for boundary, levels in boundaries(rates):
        rate, involved = slope(boundary, t), boundary.free_symbols
        if boundary.has(AppliedUndef) or len(involved) < 2 or not involved <= symbols:
            continue
        if rate not in (0, sp.nan) and not rate.has(t):
            times.update((sp.Rational(v) - boundary.subs(t, 0)) / rate for v in levels or ())
    return tuple(sorted(times, key=sp.default_sort_key))


def _moving_peaks(coordinates: Sequence[Coordinate], rates: Sequence[sp.Expr]) -> Iterator[sp.Expr]:
    """Times, as functions of the parameters, of the peaks of narrow exponentials of squares."""
    clock, *parameters = coordinates
    t, symbols = clock.symbol, {c.symbol for c in coordinates}
    centre = {p.symbol: sp.Float(0.5 * (p.lower + p.upper)) for p in parameters}
    for node in subexpressions(rates, sp.exp):
        exponent, involved = node.exp, node.exp.free_symbols
        if len(involved) < 2 or not involved <= symbols or exponent.has(AppliedUndef):
            continue
        rate = slope(exponent, t)
        curvature = slope(rate, t)
        if curvature in (0, sp.nan) or curvature.has(t):
            continue
        size = abs(curvature.subs(centre)) * (clock.upper - clock.lower) ** 2
        if size.is_number and size > _NARROW_CURVATURE:
            yield -rate.subs(t, 0) / curvature


def state_surfaces(
    time: sp.Symbol, rates: Sequence[sp.Expr]
) -> tuple[tuple[sp.Expr, ...], tuple[sp.Expr, ...], tuple[sp.Expr, ...]]:
    """Functions of the unknowns, or of time, that vanish in peaks, at kinks and at steps.

    Each is in the first of these only; there are at most 64 in all.
    """

    def moving(expression: sp.Basic) -> set[sp.Expr]:
        unknowns = set(expression.atoms(AppliedUndef))
        return unknowns | (expression.free_symbols & {time} if not unknowns else set())

    of_steps = (surface for _, surface in steps(rates, moving))
    sorts = (
        (surface for _, surface in peaks(rates, moving)),
        _zeros(rates, CONTINUOUS),
        itertools.chain(of_steps, _zeros(rates, DISCONTINUOUS)),
    )
    surfaces: set[sp.Expr] = set()
    by_sort = []
    for functions in sorts:
        distinct = (f for f in _distinct(filter(moving, functions)) if not surfaces & {f, -f})
        by_sort.append(tuple(itertools.islice(distinct, _MAX_SURFACES - len(surfaces))))
        surfaces.update(by_sort[-1])
    at_peaks, at_kinks, at_steps = by_sort
    return at_peaks, at_kinks, at_steps


def parameter_surfaces(
    coordinates: Sequence[Coordinate], expressions: Sequence[sp.Expr]
) -> tuple[sp.Expr, ...]:
    """Functions of several parameters that vanish, or are least, where others are narrow."""
    parameters = {coordinate.symbol for coordinate in coordinates[1:]}

    def variables(expression: sp.Basic) -> list[sp.Expr]:
        return sorted(expression.free_symbols & parameters, key=str)

    narrow = itertools.chain(peaks(expressions, variables), steps(expressions, variables))
    surfaces = itertools.chain(
        (surface for _, surface in narrow),
        valleys(expressions),
        _zeros(expressions, (*CONTINUOUS, *DISCONTINUOUS)),
    )
    of_parameters = (f for f in surfaces if f.free_symbols <= parameters)
    several = (f for f in of_parameters if len(f.free_symbols) > 1 and not f.has(AppliedUndef))
    return tuple(_distinct(several)[:_MAX_SURFACES])


def _zeros(expressions: Sequence[sp.Expr], functions: tuple[type, ...]) -> Iterator[sp.Expr]:
    """Functions whose zeros are where some functions are not smooth."""
    for boundary, levels in boundaries(expressions, functions):
        if levels is None:
            yield sp.sin(sp.pi * boundary)
        elif len(levels) <= _MAX_SURFACES:
            yield from (boundary - sp.Rational(level) for level in levels)


def _distinct(functions: Iterable[sp.Expr]) -> list[sp.Expr]:
    """Each once up to its sign, in SymPy's order."""
    kept: dict[sp.Expr, None] = {}
    for function in sorted(set(functions), key=sp.default_sort_key):
        if -function not in kept:
            kept[function] = None
    return list(kept)


def _thresholds(base: sp.Expr, variables: Variables) -> Iterator[sp.Expr]:
    """What vanishes where an exponential is as large as the only other addend."""
    for term in base.args if base.is_Add and len(base.args) == 2 else ():
        other_term = base - term
        for step in term.atoms(sp.exp):
            ratio = term / step / other_term
            if not variables(ratio) and not _squares(step.exp, variables):
                shift = sp.log(sp.Abs(ratio))
                if shift.is_number:
                    shift = sp.Rational(str(sp.N(shift, _SHIFT_DIGITS)))
                yield step.exp + shift


def _extrema(expression: sp.Expr, variables: Variables) -> Iterator[sp.Expr]:
    """What vanishes where an expression is least or largest: what is squared, or its slope.

    A sum of several squares is least where no single function vanishes.
    """
    squares = _squares(expression, variables)
    yield from squares if len(squares) == 1 else ()
    for variable in variables(expression) if not squares else ():
        rate = slope(expression, variable)
        if rate.has(variable) and not slope(rate, variable).has(variable):
            yield rate


def _squares(expression: sp.Basic, variables: Variables) -> list[sp.Expr]:
    """What is raised to an even power, and is not inside another such power."""
    if not variables(expression):
        return []
    if expression.is_Pow and expression.exp.is_even and expression.exp.is_positive:
        return [expression.base]
    return [square for argument in expression.args for square in _squares(argument, variables)]
