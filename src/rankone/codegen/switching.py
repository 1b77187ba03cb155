"""Where known functions of one coordinate switch, kink or jump, solved for exactly.

``Heaviside(t - 60)``, ``Abs(k - 1/3)``, ``Piecewise((1, t < 8), (0, True))`` and their like change
where an argument vanishes or two of them meet. These boundary equations are solved by SymPy where
they are polynomials, or compositions of elementary functions whose inverses are known. Periodic
ones, as of ``floor(t)`` or ``sign(sin(w*t))``, become a first point and a period.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import scipy.optimize
import scipy.special
import sympy as sp
from sympy.core.function import AppliedUndef
from sympy.core.relational import Relational

from rankone.codegen.derivatives import slope
from rankone.codegen.narrow import peaks, steps
from rankone.expressions.stable import NUMPY, stable
from rankone.ir.forms import Coordinate
from rankone.ir.functions import Table
from rankone.support.arrays import Array
from rankone.support.budget import check_time

__all__ = ["CONTINUOUS", "JUMPS", "Switches", "boundaries", "switches"]

_HIGHEST_DEGREE = 12
"""Degree of polynomials whose roots are isolated exactly."""
_SAMPLES = 4096
"""Samples of a boundary equation that is not solved."""
_MOST_LEVELS = 1000
"""Most values of a ``floor`` of a nonlinear function that are looked for."""
_DIGITS = 25
_SHARP, _CHANGED, _HUGE = 3e4, 0.01, 1e300
"""Part of the interval over which a smooth function is too narrow for samples, if it changes by so
much."""


@dataclass(frozen=True)
class Switches:
    """Points of one coordinate at which known functions of it are not smooth.

    Attributes
    ----------
    points : set of float
        Those that are alone, on the whole real line; outside of the interval of the coordinate
        perhaps not all.
    periodic : set of (float, float)
        A point and a period for the others.
    """

    points: set[float] = field(default_factory=set)
    periodic: set[tuple[float, float]] = field(default_factory=set)


CONTINUOUS = (sp.Abs, sp.Max, sp.Min, sp.asin, sp.acos, sp.Pow)
"""Functions that are continuous, but not smooth everywhere."""
JUMPS = (Relational, sp.Heaviside, sp.sign, sp.floor, sp.ceiling, sp.frac, sp.Mod, Table)
"""Functions that may jump."""


class _Unsolved(Exception):
    """A boundary equation has no solution in closed form."""


def switches(
    coordinates: Sequence[Coordinate], expressions: Iterable[sp.Basic]
) -> tuple[Switches, ...]:
    """For each coordinate the points at which functions of it alone are not smooth."""
    expressions = list(expressions)
    found = {c.symbol: Switches() for c in coordinates}
    places = {c.symbol: c for c in coordinates}
    for boundary, levels in boundaries(expressions):
        symbols = boundary.free_symbols
        if len(symbols) == 1 and not boundary.has(AppliedUndef) and symbols <= places.keys():
            (symbol,) = symbols
            _solve(boundary, levels, places[symbol], found[symbol])
    for symbol, coordinate in places.items():
        _add_narrow(expressions, coordinate, found[symbol])
    return tuple(found.values())


def _add_narrow(expressions: Sequence[sp.Basic], coordinate: Coordinate, found: Switches) -> None:
    """Add the middles of peaks and steps that are too narrow for samples."""
    x = coordinate.symbol

    def own(expression: sp.Basic) -> set[sp.Basic]:
        alone = expression.free_symbols == {x} and not expression.has(AppliedUndef)
        return {x} if alone else set()

    for part, middle in itertools.chain(peaks(expressions, own), steps(expressions, own)):
        if not own(part) or not own(middle):
            continue
        try:
            points, periodic = _roots(middle, x)
        except (_Unsolved, NotImplementedError, ValueError, TypeError, sp.PolynomialError):
            points, periodic = _sampled(middle, coordinate), set()
        function = _numeric(part, x)
        found.points.update(at for at in points if _is_narrow(function, coordinate, at))
        for first, period in periodic:
            inside = first + period * math.ceil((coordinate.lower - first) / period)
            if _is_narrow(function, coordinate, inside):
                found.periodic.add((first, period))


def _is_narrow(function: Callable[[Any], Array], coordinate: Coordinate, at: float) -> bool:
    """Whether a function changes over a distance that samples would not see."""
    near = (coordinate.upper - coordinate.lower) / _SHARP
    if not coordinate.lower <= at <= coordinate.upper:
        return False
    values = function(np.array([at - near, at, at + near]))
    if not np.isfinite(values[1]):
        return False
    values = np.nan_to_num(values, nan=_HUGE, posinf=_HUGE, neginf=-_HUGE)
    return bool(np.ptp(values) > _CHANGED * np.abs(values).max())


def boundaries(
    expressions: Iterable[sp.Basic], kinds: tuple[type, ...] = (*CONTINUOUS, *JUMPS)
) -> Iterator[tuple[sp.Expr, Sequence[float] | None]]:
    """Where functions of some kinds are not smooth: expressions, and values of them.

    The values are None for all integers.
    """
    zero = (0.0,)
    for part in {part for expression in expressions for part in expression.atoms(*kinds)}:
        if isinstance(part, Relational):
            yield part.lhs - part.rhs, zero
        elif isinstance(part, sp.Heaviside | sp.sign | sp.Abs):
            yield part.args[0], zero
        elif isinstance(part, sp.Max | sp.Min):
            yield from ((a - b, zero) for a, b in itertools.combinations(part.args, 2))
        elif isinstance(part, sp.floor | sp.ceiling | sp.frac):
            yield part.args[0], None
        elif isinstance(part, sp.Mod):
            yield part.args[0] / part.args[1], None
        elif isinstance(part, sp.asin | sp.acos):
            yield part.args[0], (-1.0, 1.0)
        elif part.is_Pow and part.exp.is_number and not part.exp.is_integer:
            yield part.base, zero
        elif isinstance(part, Table) and part.kind != "cubic":
            yield part.args[0], part.points


def _solve(
    boundary: sp.Expr, levels: Sequence[float] | None, coordinate: Coordinate, found: Switches
) -> None:
    """Add the points at which a boundary expression takes one of the levels."""
    check_time()
    x = coordinate.symbol
    rate = slope(boundary, x)
    if rate.is_number and rate is not sp.nan:  # linear
        rate, start = float(rate), float(boundary.subs(x, 0))
        if rate and levels is None:
            found.periodic.add((0.0 - start / rate, 1.0 / abs(rate)))
        elif rate:
            found.points.update((level - start) / rate for level in levels or ())
        return
    for level in _integers(boundary, coordinate) if levels is None else levels:
        equation = boundary - sp.Rational(level)
        try:
            points, periodic = _roots(equation, x)
        except (_Unsolved, NotImplementedError, ValueError, TypeError, sp.PolynomialError):
            points, periodic = _sampled(equation, coordinate), set()
        found.points.update(points)
        found.periodic.update(periodic)


def _roots(equation: sp.Expr, x: sp.Symbol) -> tuple[set[float], set[tuple[float, float]]]:
    """Real zeros of an expression: those that are alone, and first ones with periods.

    Raises
    ------
    _Unsolved
        If it is neither a polynomial nor one of a single function that can be inverted.
    """
    if equation.is_Mul:
        pairs = [_roots(factor, x) for factor in equation.args if factor.has(x)]
        return set().union(*(p for p, _ in pairs)), set().union(*(q for _, q in pairs))
    if equation.is_polynomial(x):
        return set(_polynomial_roots(equation, x)), set()
    outer = sp.Dummy("y", real=True)
    parts = [a for a in equation.atoms(sp.Function, sp.Pow) if a.has(x)]
    for part in sorted(parts, key=lambda a: (-a.count_ops(), sp.default_sort_key(a))):
        rest = equation.xreplace({part: outer})
        if rest.has(x) or not rest.is_polynomial(outer):
            continue
        points: set[float] = set()
        periodic: set[tuple[float, float]] = set()
        for value in _polynomial_roots(rest, outer):
            inner, values, period = _inverse(part, value)
            for y in values:
                more = _roots(inner - y, x) if period is None else _repeated(inner, y, period, x)
                points |= more[0]
                periodic |= more[1]
        return points, periodic
    raise _Unsolved


def _polynomial_roots(equation: sp.Expr, x: sp.Symbol) -> list[float]:
    polynomial = sp.Poly(equation, x)
    if polynomial.degree() > _HIGHEST_DEGREE:
        raise _Unsolved
    numbers = (c if c.is_Float else sp.Float(c, _DIGITS) for c in polynomial.coeffs())
    exact = map(sp.Rational, numbers)
    rational = sp.Poly.from_dict(dict(zip(polynomial.monoms(), exact, strict=True)), x)
    return [float(root) for root in sp.real_roots(rational)]


def _inverse(part: sp.Expr, y: float) -> tuple[sp.Expr, list[float], float | None]:
    """The argument of a function, the values of it at which the function is y, and a period."""
    argument = part.args[0]
    if isinstance(part, sp.exp):
        return part.exp, [math.log(y)] if y > 0.0 else [], None
    if part.is_Pow:
        return _inverse_power(part, y)
    name = part.func.__name__
    if name in _STEPS:  # it changes at its own switches alone
        return argument, [], None
    if name == "Abs":
        return argument, [y, -y] if y >= 0.0 else [], None
    if name in _PERIODIC:
        inverse, period = _PERIODIC[name]
        return argument, inverse(y), period
    if name in _INVERSES:
        try:
            return argument, [_INVERSES[name](y)], None
        except (ValueError, OverflowError):
            return argument, [], None
    raise _Unsolved


def _inverse_power(part: sp.Expr, y: float) -> tuple[sp.Expr, list[float], None]:
    """Bases whose power is y: of a fixed exponent, or a fixed base's exponents."""
    base, exponent = part.as_base_exp()
    if base.is_number and base.is_positive:
        return exponent, [math.log(y) / math.log(base)] if y > 0.0 else [], None
    if not exponent.is_Rational:
        raise _Unsolved
    if y == 0.0:
        return base, [0.0] if exponent > 0 else [], None
    root = abs(y) ** (1.0 / float(exponent))
    if exponent.p % 2 == 0:
        return base, [root, -root] if y > 0.0 else [], None
    if exponent.q % 2 == 0:
        return base, [root] if y > 0.0 else [], None
    return base, [math.copysign(root, y)], None


def _repeated(
    inner: sp.Expr, value: float, period: float, x: sp.Symbol
) -> tuple[set[float], set[tuple[float, float]]]:
    """Where a linear function takes a value, up to multiples of a period."""
    rate = slope(inner, x)
    if not rate.is_number or rate == 0 or rate is sp.nan:
        raise _Unsolved
    return set(), {((value - float(inner.subs(x, 0))) / float(rate), period / abs(float(rate)))}


def _arc(y: float, function: Any) -> list[float]:
    return [function(y)] if abs(y) <= 1.0 else []


_STEPS = ("Heaviside", "sign", "floor", "ceiling")
_PERIODIC: dict[str, tuple[Callable[[float], list[float]], float]] = {
    "sin": (lambda y: [a for v in _arc(y, math.asin) for a in (v, math.pi - v)], 2.0 * math.pi),
    "cos": (lambda y: [a for v in _arc(y, math.acos) for a in (v, -v)], 2.0 * math.pi),
    "tan": (lambda y: [math.atan(y)], math.pi),
}
_INVERSES: dict[str, Callable[[float], float]] = {
    "log": math.exp,
    "sinh": math.asinh,
    "tanh": math.atanh,
    "asinh": math.sinh,
    "atan": lambda y: math.tan(y) if abs(y) < 0.5 * math.pi else math.log(-1.0),
    "erf": lambda y: float(scipy.special.erfinv(y)) if abs(y) < 1.0 else math.log(-1.0),
}


def _sampled(equation: sp.Expr, coordinate: Coordinate) -> set[float]:
    """Changes of sign on the interval of the coordinate."""
    function = _numeric(equation, coordinate.symbol)
    points = np.linspace(coordinate.lower, coordinate.upper, _SAMPLES)
    values = function(points)
    changes = np.flatnonzero(values[:-1] * values[1:] < 0.0)
    found = {float(x) for x in points[values == 0.0]} if np.any(values) else set()
    tight = {"xtol": 1e-300, "rtol": 4.0 * np.finfo(float).eps}
    for i in changes:
        root = scipy.optimize.brentq(lambda at: float(function(at)), *points[i : i + 2], **tight)
        found.add(float(root))
    return found


def _integers(boundary: sp.Expr, coordinate: Coordinate) -> list[float]:
    """The integers between the least and the largest value on the interval."""
    points = np.linspace(coordinate.lower, coordinate.upper, _SAMPLES)
    values = _numeric(boundary, coordinate.symbol)(points)
    values = values[np.isfinite(values)]
    if not values.size or np.ptp(values) > _MOST_LEVELS:
        return []
    return [float(n) for n in range(math.ceil(values.min()), math.floor(values.max()) + 1)]


def _numeric(expression: sp.Expr, symbol: sp.Symbol) -> Callable[[Any], Array]:
    """Values at points; NaN where they are not real."""
    function = sp.lambdify(symbol, stable(expression), [NUMPY, "numpy", "scipy"])

    def evaluate(points: Any) -> Array:
        with np.errstate(all="ignore"):
            values = np.asarray(function(points))
        if np.iscomplexobj(values):
            values = np.where(values.imag == 0.0, values.real, np.nan)
        return np.broadcast_to(values.astype(float), np.shape(points))

    return evaluate
