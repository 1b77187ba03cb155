"""Functions that vanish where a system is not smooth, and what vanishes by the equations there.

That is at the :mod:`boundaries <rankone.problem.expressions.boundaries>`, :mod:`peaks and steps
<rankone.problem.expressions.boundaries>` of its expressions. *Moving cuts* are switches whose
times move with parameters: cuts of each trajectory. *State surfaces* are functions of the
unknowns, such as a pulse ``Piecewise((1, (x > 2) & (x < 2.001)), (0, True))``, looked at where a
step crosses them.
*Parameter surfaces* are where further trajectories are checked.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence

import numpy as np
import sympy as sp
from sympy.core.function import AppliedUndef
from sympy.core.relational import Relational
from sympy.logic.boolalg import Boolean

from rankone.problem.expressions.boundaries import (
    CONTINUOUS,
    DISCONTINUOUS,
    Variables,
    boundaries,
    extrema,
    peaks,
    steps,
    subexpressions,
    valleys,
)
from rankone.problem.expressions.conditions import slope
from rankone.problem.expressions.notation import exact
from rankone.problem.forms import Coordinate
from rankone.support.arrays import NEGLIGIBLE

# Functions of two sides, one of which may be narrow
_SIDES = (sp.Abs, sp.Max, sp.Min, Relational, sp.Heaviside, sp.sign)
MAX_SURFACES = 64
"""Surfaces over the states, or over the parameters: every check point and step evaluates them."""
_STEEP_DIGITS = 3.0  # Digits of the numbers in a logistic step from which steps may miss it
# Second derivative of an exponent times the squared horizon: above this, steps may miss a peak
_NARROW_CURVATURE = 1e4


def moving_cuts(
    coordinates: Sequence[Coordinate], rates: Sequence[sp.Expr]
) -> tuple[tuple[sp.Expr, ...], tuple[sp.Expr, ...]]:
    """Times, as functions of the parameters, of jumps and peaks of functions of both, then kinks.

    Boundaries are linear in time, or periodic functions of what is. Peaks are those of narrow
    exponentials of squares, and of hyperbolic cosines.
    """
    steps = _moving_boundaries(coordinates, rates, DISCONTINUOUS)
    steps |= {*_moving_peaks(coordinates, rates)}
    others = _moving_boundaries(coordinates, rates, CONTINUOUS)
    at_steps, further = (
        tuple(sorted(times, key=sp.default_sort_key)) for times in (steps, others - steps)
    )
    return at_steps, further


def _moving_boundaries(
    coordinates: Sequence[Coordinate], rates: Sequence[sp.Expr], functions: tuple[type, ...]
) -> set[sp.Expr]:
    """Times, as functions of the parameters, at which some functions of both are not smooth."""
    t, symbols = coordinates[0].symbol, {c.symbol for c in coordinates}
    times: set[sp.Expr] = set()
    for boundary, levels in boundaries(rates, functions):
        argument, spacing, shift = boundary, sp.S.One, sp.S.Zero
        if isinstance(boundary, sp.sin | sp.cos) and levels == (0.0,):
            argument, levels, spacing = boundary.args[0], None, sp.pi
            shift = sp.pi / 2 if isinstance(boundary, sp.cos) else shift
        rate, involved = slope(argument, t), argument.free_symbols
        if argument.has(AppliedUndef) or len(involved) < 2 or not involved <= symbols:
            continue
        if rate in (0, sp.nan) or rate.has(t):
            continue
        if levels is None:
            wholes = _wholes((argument - shift) / spacing, coordinates)
            at = [spacing * k + shift for k in wholes]
        else:
            at = [sp.Rational(level) for level in levels]
        times.update((level - argument.subs(t, 0)) / rate for level in at)
    return times


def _wholes(expression: sp.Expr, coordinates: Sequence[Coordinate]) -> range:
    """The integers between the values of an expression at the corners; none if there are many."""
    used = [c for c in coordinates if c.symbol in expression.free_symbols]
    corners = itertools.product(*((c.lower, c.upper) for c in used))
    symbols = [c.symbol for c in used]
    at = [expression.subs(dict(zip(symbols, corner, strict=True))) for corner in corners]
    if not all(value.is_real and value.is_finite for value in at):
        return range(0)
    first, last = math.ceil(min(at)), math.floor(max(at))
    return range(first, last + 1) if last - first < MAX_SURFACES else range(0)


def _moving_peaks(coordinates: Sequence[Coordinate], rates: Sequence[sp.Expr]) -> Iterator[sp.Expr]:
    """Times, as functions of the parameters, of the peaks of narrow exponentials of squares.

    Hyperbolic cosines are taken as the exponentials of their squares that they are in the middle.
    """
    clock, *parameters = coordinates
    t, symbols = clock.symbol, {c.symbol for c in coordinates}
    centre = {p.symbol: sp.Float(0.5 * (p.lower + p.upper)) for p in parameters}
    for node in subexpressions(rates, sp.exp, sp.cosh, sp.sech):
        exponent = node.exp if isinstance(node, sp.exp) else -(node.args[0] ** 2) / 2
        involved = exponent.free_symbols
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

    A side of a boundary that is as narrow as a peak, as of ``Max(0, 1 - ((x - a)/w)**2)``, has its
    middle among those of peaks.

    Each is in the first of these only; there are at most 64 in all, of more the sharpest.
    """

    def moving(expression: sp.Basic) -> set[sp.Expr]:
        unknowns = set(expression.atoms(AppliedUndef))
        return unknowns | (expression.free_symbols & {time} if not unknowns else set())

    smooth = (f for f, _ in boundaries(rates, _SIDES) if not f.has(*_SIDES, sp.Piecewise))
    middles = ((side, middle) for side in smooth for middle in extrema(side, moving))
    sorts = (
        itertools.chain(peaks(rates, moving), middles),
        ((f, f) for f in _zeros(rates, CONTINUOUS)),
        itertools.chain(
            _steep_steps(rates, moving), ((f, f) for f in _zeros(rates, DISCONTINUOUS))
        ),
    )
    surfaces: set[sp.Expr] = set()
    by_sort = []
    for functions in sorts:
        sharpest: dict[sp.Expr, float] = {}
        for function, surface in functions:
            if moving(surface):
                sharpest[surface] = max(sharpness(function), sharpest.get(surface, 0.0))
        distinct = [f for f in _distinct(sharpest) if not surfaces & {f, -f}]
        if len(distinct) > MAX_SURFACES - len(surfaces):
            first = sorted(distinct, key=lambda f: -max(sharpest[f], sharpest.get(-f, 0.0)))
            distinct = _distinct(first[: MAX_SURFACES - len(surfaces)])
        by_sort.append(tuple(distinct))
        surfaces.update(distinct)
    at_peaks, at_kinks, at_steps = by_sort
    return at_peaks, at_kinks, at_steps


def _steep_steps(rates: Sequence[sp.Expr], moving: Variables) -> Iterator[tuple[sp.Expr, sp.Expr]]:
    """Steps over the states; logistic ones only if they are steep: neurons have many wide ones."""
    for function, surface in steps(rates, moving):
        if not function.is_Pow or sharpness(function) >= _STEEP_DIGITS:
            yield function, surface


def sharpness(function: sp.Basic) -> float:
    """How far the numbers in a function are from one, in digits: far where it is narrow."""
    return digits(float(abs(x)) for x in function.atoms(sp.Number) if x.is_finite)


def digits(numbers: Iterable[float]) -> float:
    """How far numbers are from one, at most; zeros do not count."""
    return max((abs(math.log10(x)) for x in numbers if x > 0.0), default=0.0)


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
    return tuple(_distinct(several)[:MAX_SURFACES])


def _zeros(expressions: Sequence[sp.Expr], functions: tuple[type, ...]) -> Iterator[sp.Expr]:
    """Functions whose zeros are where some functions are not smooth."""
    for boundary, levels in boundaries(expressions, functions):
        if levels is None:
            yield sp.sin(sp.pi * boundary)
        elif len(levels) <= MAX_SURFACES:
            yield from (boundary - exact(sp.Float(level)) for level in levels)


def _distinct(functions: Iterable[sp.Expr]) -> list[sp.Expr]:
    """Each once up to its sign, in SymPy's order."""
    kept: dict[sp.Expr, None] = {}
    for function in sorted(set(functions), key=sp.default_sort_key):
        if -function not in kept:
            kept[function] = None
    return list(kept)


# -----------------------------------------------------------------------------
# What vanishes by the equations at a surface: speeds of states that rest there, jumps of rates.
#
# A tank ``Piecewise((0, (h >= 1) & (net > 0)), (net, True))`` rests full while ``net`` is positive.
# The rates are the same on both sides of ``net = 0``, where it begins to empty: that is a kink.


_MOST_SIDES = 5  # Most sides of others of which all combinations are looked at

Sides = Mapping[sp.Dummy, sp.Expr]
"""What stands for sides in rates, with the states that hold them."""


def zero_where(expression: sp.Expr, sides: Sides) -> Boolean:
    """On which sides an expression is zero whatever the unknowns are: a condition on the states."""
    used = _used([expression], sides)
    if len(used) > _MOST_SIDES:
        return sp.false
    where = [
        (_vanishes(expression.xreplace(values)), signs) for signs, values in _choices(used, sides)
    ]
    if all(zero == sp.true for zero, _ in where):
        return sp.true
    return sp.Or(
        *(
            sp.And(
                zero,
                *(sign * sides[side] > sp.S.Half for side, sign in zip(used, signs, strict=True)),
            )
            for zero, signs in where
        )
    )


def only_kinks(rates: Sequence[sp.Expr], surface: sp.Expr, side: sp.Dummy, others: Sides) -> bool:
    """Whether rates are the same on both sides of a surface, wherever it is crossed."""
    used = _used([*rates, surface], others)
    if len(used) > _MOST_SIDES:
        return False
    for _, values in _choices(used, others):
        root = _root(surface.xreplace(values))
        if root is None:
            return False
        above, below = ({**values, side: sp.Integer(sign)} for sign in (1, -1))
        for rate in rates:
            change = rate.xreplace(above) - rate.xreplace(below)
            if _vanishes(change.xreplace(root)) != sp.true:
                return False
    return True


def _used(expressions: Sequence[sp.Expr], sides: Sides) -> list[sp.Dummy]:
    """The sides in expressions."""
    return [s for s, state in sides.items() if any(each.has(s, state) for each in expressions)]


def _choices(
    used: Sequence[sp.Dummy], sides: Sides
) -> Iterator[tuple[tuple[int, ...], dict[sp.Expr, sp.Expr]]]:
    """All combinations of sides, as signs and as values of what stands for them."""
    for signs in itertools.product((1, -1), repeat=len(used)):
        pairs = list(zip(used, map(sp.Integer, signs), strict=True))
        yield signs, {**dict(pairs), **{sides[side]: sign for side, sign in pairs}}


def _root(surface: sp.Expr) -> dict[sp.Expr, sp.Expr] | None:
    """An unknown or symbol where a surface is zero; None where it is linear in none of them."""
    for each in sorted({*surface.atoms(AppliedUndef), *surface.free_symbols}, key=str):
        dummy = sp.Dummy(real=True)
        plain = surface.xreplace({each: dummy})
        slope = sp.diff(plain, dummy)
        if slope != 0 and not slope.has(dummy):
            return {each: -plain.xreplace({dummy: sp.S.Zero}) / slope}
    return None


def _vanishes(expression: sp.Expr) -> Boolean:
    """Where an expression without sides is zero whatever the unknowns are."""
    if expression.has(sp.Piecewise):
        expression = sp.piecewise_fold(expression)
    if not isinstance(expression, sp.Piecewise):
        return sp.true if _is_zero(expression) else sp.false
    where, before = sp.false, sp.false
    for piece, condition in expression.args:
        where = sp.Or(where, sp.And(condition, sp.Not(before), _vanishes(piece)))
        before = sp.Or(before, condition)
    return where


def _is_zero(expression: sp.Expr) -> bool:
    """Whether an expression is zero everywhere; at a random place most others are not."""
    if expression.is_number:
        return bool(expression == 0)
    random = np.random.default_rng(4021)
    atoms = sorted({*expression.atoms(AppliedUndef), *expression.free_symbols}, key=str)
    value = expression.xreplace({each: sp.Float(random.uniform(0.5, 1.5)) for each in atoms})
    if value.is_number:
        size = abs(sp.N(value))
        if not size.is_finite or size > NEGLIGIBLE:
            return False
    return bool(sp.expand(expression) == 0)
