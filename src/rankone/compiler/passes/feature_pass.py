"""The features of a system: all that is not smooth, or so narrow that samples may miss it.

They are derived here once, as expressions, and printed into the generated module; numeric code sees
them as :class:`rankone.trajectories.system.features.Features`. Cuts are points of one coordinate
at which functions of it alone are not smooth, solved for exactly: ``Heaviside(t - 60)``, ``Abs(k -
1/3)``, ``Piecewise((1, t < 8), (0, True))`` and their like change where an argument vanishes or
two of them meet. SymPy solves these boundary equations where they are polynomials, or compositions
of elementary functions with known inverses. A boundary that repeats, as in ``floor(t)`` or
``sign(sin(w*t))``, becomes one point and a period. All other features are
:mod:`~rankone.compiler.passes.surfaces`.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import scipy.optimize
import scipy.special
import sympy as sp
from numpy.typing import ArrayLike
from sympy.core.function import AppliedUndef

from rankone.compiler.passes.first_order import FirstOrderSystem
from rankone.compiler.passes.surfaces import (
    MAX_SURFACES,
    digits,
    moving_cuts,
    parameter_surfaces,
    state_surfaces,
)
from rankone.problem.algebra.term_table import TermTable
from rankone.problem.expressions.admissible import numeric
from rankone.problem.expressions.boundaries import DISCONTINUOUS, boundaries, peaks, steps
from rankone.problem.expressions.conditions import slope
from rankone.problem.expressions.notation import text_of
from rankone.problem.forms import Coordinate
from rankone.support.arrays import EPSILON, EXACT_DIGITS, MANY_SAMPLES, TINY, Array
from rankone.support.budget import check_time
from rankone.support.errors import quote, written
from rankone.trajectories.system.verdict import SwitchingTerm

_MAX_DEGREE = 12  # Of polynomials whose roots SymPy isolates exactly; above it this takes seconds
_MAX_LEVELS = 1000  # Levels of a ``floor`` of a nonlinear function that are solved for
# A function that changes over the interval divided by this is narrow: samples would miss it
_NARROW_PARTS = 3e4
_NARROW_CHANGE = 0.01  # Relative change over that distance from which a function is narrow
_KINKED = (sp.Abs, sp.Max, sp.Min)


@dataclass(frozen=True)
class Cuts:
    """Points of one coordinate at which known functions of it are not smooth.

    ``points`` do not repeat; outside the interval of the coordinate perhaps some are missing.
    ``periodic`` has a point and a period for those that do.
    """

    points: set[float] = field(default_factory=set)
    periodic: set[tuple[float, float]] = field(default_factory=set)

    def inside(self, lower: float, upper: float, max_repeats: int) -> list[float]:
        """The points, and those that repeat, from the first in an interval to its end."""
        inside = [*self.points]
        for point, period in self.periodic:
            first = math.ceil((lower - point) / period)
            count = min(math.floor((upper - point) / period) - first + 1, max_repeats)
            inside += [point + period * (first + k) for k in range(max(count, 0))]
        return inside


@dataclass(frozen=True)
class SymbolicFeatures:
    """Where expressions of a system are not smooth; see
    :class:`rankone.trajectories.system.features.Features`.

    There are cuts for each coordinate; peaks, kinks and steps are the surfaces over the states.
    ``names`` are those of the coordinates; ``switches`` are the surfaces whose sides are held, by
    the names of their events.
    """

    cuts: tuple[Cuts, ...]
    moving_steps: tuple[sp.Expr, ...]
    other_moving_cuts: tuple[sp.Expr, ...]
    parameter_surfaces: tuple[sp.Expr, ...]
    peaks: tuple[sp.Expr, ...]
    kinks: tuple[sp.Expr, ...]
    steps: tuple[sp.Expr, ...]
    names: tuple[str, ...]
    switches: Mapping[str, sp.Expr] = field(default_factory=dict)

    def __str__(self) -> str:
        """What is not smooth, one line a feature."""
        lines = [
            f"at {name} = {', '.join(f'{point:g}' for point in sorted(cuts.points))}"
            for name, cuts in zip(self.names, self.cuts, strict=True)
            if cuts.points
        ]
        lines += [
            f"at {name} = {point:g}, and every {period:g}"
            for name, cuts in zip(self.names, self.cuts, strict=True)
            for point, period in sorted(cuts.periodic)
        ]
        lines += [f"at {self.names[0]} = {text_of(time)}" for time in self.moving_cuts]
        lines += [f"{name}: {text_of(g)} = 0" for name, g in self.switches.items()]
        held = {sign * g for g in self.switches.values() for sign in (1, -1)}
        others = (g for g in self.state_surfaces if g not in held)
        lines += [f"where {text_of(g)} = 0" for g in (*others, *self.parameter_surfaces)]
        return "\n".join(lines or ["smooth everywhere"])

    @property
    def moving_cuts(self) -> tuple[sp.Expr, ...]:
        """Times that move with the parameters, those of jumps first."""
        return (*self.moving_steps, *self.other_moving_cuts)

    def without(self, sides: Sequence[sp.Expr]) -> SymbolicFeatures:
        """The features but for the surfaces over states that are sides of switches."""
        if not sides:
            return self
        peaks, kinks, steps = (
            tuple(surface for surface in surfaces if not surface.has(*sides))
            for surfaces in (self.peaks, self.kinks, self.steps)
        )
        return replace(self, peaks=peaks, kinks=kinks, steps=steps)

    @property
    def state_surfaces(self) -> tuple[sp.Expr, ...]:
        """The surfaces of peaks, then of kinks, then of steps."""
        return (*self.peaks, *self.kinks, *self.steps)


def features_of(
    coordinates: Sequence[Coordinate], rates: Sequence[sp.Expr], further: Sequence[sp.Expr]
) -> SymbolicFeatures:
    """All features of a system: the one place that derives them.

    ``rates`` are right-hand sides that do not separate. ``further`` are initial values, values
    after jumps, and the factors of a right-hand side that separates.
    """
    expressions = [*rates, *further]
    return SymbolicFeatures(
        cuts_of(coordinates, expressions),
        *moving_cuts(coordinates, rates),
        parameter_surfaces(coordinates, expressions),
        *state_surfaces(coordinates[0].symbol, rates),
        tuple(coordinate.name for coordinate in coordinates),
    )


def features_of_table(system: FirstOrderSystem, table: TermTable) -> SymbolicFeatures:
    """The features of a system of many states from the table of its rates.

    Laws of one form differ in where their surfaces over the states are. No more of them are looked
    at than there may be surfaces, those with the numbers farthest from one.
    """
    time = system.coordinates[0].symbol
    states = dict(enumerate(system.functions))
    plain = dict(zip(table.states, system.functions, strict=True))
    inner: dict[sp.Expr, int] = {}

    def slot(symbol: int) -> sp.Expr:
        """A state, a further law, or what stands for a sum of states in another law."""
        if symbol in states:
            return states[symbol]
        if not table.is_linear(symbol):
            return table.written(symbol).xreplace(plain)
        stand_in = sp.Function(f"law {symbol}")(time)
        inner[stand_in] = symbol
        return stand_in

    by_form: list[list[sp.Expr]] = [[] for _ in table.forms]
    for value in sorted(
        table.values, key=lambda value: -digits(abs(float(x)) for x in value.numbers)
    ):
        if len(by_form[value.form]) < MAX_SURFACES:
            slots = map(slot, value.symbols)
            by_form[value.form].append(table.forms[value.form].filled(slots, value.numbers))
    laws = [first for first, *_ in by_form]
    several = [further for first, *further in by_form if any(state_surfaces(time, [first]))]
    in_turns = (law for each in itertools.zip_longest(*several) for law in each if law is not None)
    laws += itertools.islice(in_turns, MAX_SURFACES)
    features = features_of(system.coordinates, [*table.functions, *laws], system.initial)

    def of_states(surface: sp.Expr) -> sp.Expr:
        used = [stand_in for stand_in in inner if surface.has(stand_in)]
        return surface.xreplace({f: table.written(inner[f]).xreplace(plain) for f in used})

    peaks, kinks, steps = (
        tuple(map(of_states, surfaces))
        for surfaces in (features.peaks, features.kinks, features.steps)
    )
    return replace(features, peaks=peaks, kinks=kinks, steps=steps)


def switching_term(
    system: FirstOrderSystem, state: int | None = None, *, kinks: bool = False
) -> SwitchingTerm | None:
    """Which term switches over the unknowns, and how to smooth it; None if there is none.

    ``state`` is one whose rate is known to switch; by default the first that may. With ``kinks`` it
    is one that kinks, where none jumps.
    """
    if system.table is not None:  # its functions are smooth
        return None
    for index in range(len(system.rhs)) if state is None else (state,):
        if (term := _switching_in(system, index, DISCONTINUOUS, _smooth_step)) is not None:
            return term
    for index in range(len(system.rhs)) if kinks and state is None else ():
        if (term := _switching_in(system, index, _KINKED, _smooth_kink)) is not None:
            return term
    return None


def _switching_in(
    system: FirstOrderSystem,
    index: int,
    functions: tuple[type, ...],
    smooth: Callable[[sp.Expr, sp.Expr, str], str],
) -> SwitchingTerm | None:
    """The first term of a rate that switches by some functions, if there is one.

    ``smooth`` writes what may stand in their place, for the term and the boundary.
    """
    plain = {
        f: sp.Symbol(state.name) for f, state in zip(system.functions, system.states, strict=True)
    }
    for term in sp.Add.make_args(system.rhs[index]):
        switches = {
            boundary: levels
            for boundary, levels in boundaries([term], functions)
            if boundary.has(AppliedUndef)
        }
        if not switches:
            continue
        inner = {each for node in term.atoms(sp.Max, sp.Min) for each in _nested(node)}
        first = min(switches, key=lambda each: (each in inner, *_inner_first(each)))
        boundary, plain_term, levels = first.xreplace(plain), term.xreplace(plain), switches[first]
        origin = system.origins[index]
        equation = f"the equation of {quote(system.states[index].name)}"
        equation = equation if origin is None else f"equation {origin}"
        if levels is None or any(levels):  # more than one
            at = None if levels is None else tuple(map(float, levels))
            return SwitchingTerm(written(plain_term), equation, written(boundary), "", at)
        place = written(plain_term), equation, written(_shorter(boundary))
        taken = {s.name for s in system.states} | {c.name for c in system.coordinates}
        names = (f"w{'_' * k}" for k in itertools.count())
        width = next(name for name in names if name not in taken)
        return SwitchingTerm(*place, smooth(plain_term, boundary, width), width=width)
    return None


def _smooth_step(_: sp.Expr, boundary: sp.Expr, width: str) -> str:
    """A smooth step of a width over a boundary."""
    return f"tanh({_factor(boundary)}/{width})"


def _smooth_kink(term: sp.Expr, boundary: sp.Expr, width: str) -> str:
    """What may stand for the Max, Min or Abs that kinks at a boundary, with a width."""
    root = f"sqrt({_factor(_shorter(boundary))}**2 + {width}**2)"
    for node in term.atoms(sp.Max, sp.Min):
        for a, b in itertools.combinations(node.args, 2):
            if a - b in (boundary, -boundary):
                sign = "+" if isinstance(node, sp.Max) else "-"
                return f"({written(a + b)} {sign} {root})/2"
    return root


def _shorter(boundary: sp.Expr) -> sp.Expr:
    """What vanishes at the same places, without a sign in front if there is a choice."""
    return min(boundary, -boundary, key=sp.count_ops)


def _factor(expression: sp.Expr) -> str:
    """An expression as it is written in a product or a power."""
    return written(expression) if expression.is_Symbol else f"({written(expression)})"


def _nested(extreme: sp.Expr) -> set[sp.Expr]:
    """Where what is inside of an extreme of extremes meets other arguments of it."""
    plain = [each for each in extreme.args if not isinstance(each, sp.Max | sp.Min)]
    nested = [each for each in extreme.args if each not in plain]
    pairs = ((a, b) for a in plain for other in nested for b in other.args)
    return {sign * (a - b) for a, b in pairs for sign in (1, -1)}


def _inner_first(boundary: sp.Expr) -> tuple[bool, object]:
    """A key that sorts boundaries with kinks inside behind the others."""
    return boundary.has(*_KINKED), sp.default_sort_key(boundary)


class _Unsolved(Exception):
    """A boundary equation has no solution in closed form."""


# What the search for exact roots raises if there are none in closed form
_FAILURES = (_Unsolved, NotImplementedError, ValueError, TypeError, sp.PolynomialError)


def cuts_of(coordinates: Sequence[Coordinate], expressions: Iterable[sp.Basic]) -> tuple[Cuts, ...]:
    """For each coordinate the cuts of functions of it alone."""
    expressions = list(expressions)
    by_symbol = {c.symbol: c for c in coordinates}
    cuts = {c.symbol: Cuts() for c in coordinates}
    for boundary, levels in boundaries(expressions):
        symbols = boundary.free_symbols
        if len(symbols) == 1 and not boundary.has(AppliedUndef) and symbols <= by_symbol.keys():
            (symbol,) = symbols
            _solve(boundary, levels, by_symbol[symbol], cuts[symbol])
    for symbol, coordinate in by_symbol.items():
        _add_narrow(expressions, coordinate, cuts[symbol])
    return tuple(cuts.values())


def _add_narrow(expressions: Sequence[sp.Basic], coordinate: Coordinate, cuts: Cuts) -> None:
    """Add the points of peaks and steps that are too narrow for samples."""
    x = coordinate.symbol

    def alone(expression: sp.Basic) -> set[sp.Expr]:
        of_x = expression.free_symbols == {x} and not expression.has(AppliedUndef)
        return {x} if of_x else set()

    for node, surface in itertools.chain(peaks(expressions, alone), steps(expressions, alone)):
        if not alone(node) or not alone(surface):
            continue
        try:
            points, periodic = _roots(surface, x)
        except _FAILURES:
            points, periodic = _sampled(surface, coordinate), set()
        function = numeric(node, coordinate)
        cuts.points.update(at for at in points if _is_narrow(function, coordinate, at))
        for first, period in periodic:
            inside = first + period * math.ceil((coordinate.lower - first) / period)
            if _is_narrow(function, coordinate, inside):
                cuts.periodic.add((first, period))


def _is_narrow(function: Callable[[ArrayLike], Array], coordinate: Coordinate, at: float) -> bool:
    """Whether a function changes over a distance that samples would not see."""
    near = (coordinate.upper - coordinate.lower) / _NARROW_PARTS
    if not coordinate.lower <= at <= coordinate.upper:
        return False
    heights = function(np.array([at - near, at, at + near]))
    if not np.isfinite(heights[1]):
        return False
    huge = 0.25 / TINY  # so that differences are numbers
    heights = np.nan_to_num(heights, nan=huge, posinf=huge, neginf=-huge)
    return bool(np.ptp(heights) > _NARROW_CHANGE * np.abs(heights).max())


def _solve(
    boundary: sp.Expr, levels: Sequence[float] | None, coordinate: Coordinate, cuts: Cuts
) -> None:
    """Add the points at which a boundary expression takes one of the levels."""
    check_time()
    x = coordinate.symbol
    rate = slope(boundary, x)
    if rate.is_number and rate is not sp.nan:  # linear
        rate, start = float(rate), float(boundary.subs(x, 0))
        if rate and levels is None:
            cuts.periodic.add((0.0 - start / rate, 1.0 / abs(rate)))
        elif rate:
            cuts.points.update((level - start) / rate for level in levels or ())
        return
    for level in _integers(boundary, coordinate) if levels is None else levels:
        equation = boundary - sp.Rational(level)
        try:
            points, periodic = _roots(equation, x)
        except _FAILURES:
            points, periodic = _sampled(equation, coordinate), set()
        cuts.points.update(points)
        cuts.periodic.update(periodic)


def _roots(equation: sp.Expr, x: sp.Symbol) -> tuple[set[float], set[tuple[float, float]]]:
    """Real zeros of an expression: those that are alone, and first ones with periods.

    It is a polynomial, or a polynomial of one function with a known inverse; else _Unsolved.
    """
    if equation.is_Mul:
        pairs = [_roots(factor, x) for factor in equation.args if factor.has(x)]
        return set().union(*(p for p, _ in pairs)), set().union(*(q for _, q in pairs))
    if equation.is_polynomial(x):
        return set(_polynomial_roots(equation, x)), set()
    outer = sp.Dummy("y", real=True)
    inner_nodes = [node for node in equation.atoms(sp.Function, sp.Pow) if node.has(x)]
    for node in sorted(inner_nodes, key=lambda a: (-a.count_ops(), sp.default_sort_key(a))):
        polynomial = equation.xreplace({node: outer})
        if polynomial.has(x) or not polynomial.is_polynomial(outer):
            continue
        points: set[float] = set()
        periodic: set[tuple[float, float]] = set()
        for root in _polynomial_roots(polynomial, outer):
            inner, levels, period = _inverse(node, root)
            for y in levels:
                roots = _roots(inner - y, x) if period is None else _repeated(inner, y, period, x)
                points |= roots[0]
                periodic |= roots[1]
        return points, periodic
    raise _Unsolved


def _polynomial_roots(equation: sp.Expr, x: sp.Symbol) -> list[float]:
    polynomial = sp.Poly(equation, x)
    if polynomial.degree() > _MAX_DEGREE:
        raise _Unsolved
    floats = (c if c.is_Float else sp.Float(c, EXACT_DIGITS) for c in polynomial.coeffs())
    exact = map(sp.Rational, floats)
    rational = sp.Poly.from_dict(dict(zip(polynomial.monoms(), exact, strict=True)), x)
    return [float(root) for root in sp.real_roots(rational)]


def _inverse(node: sp.Expr, y: float) -> tuple[sp.Expr, list[float], float | None]:
    """The argument of a function, its levels where the function is y, and their period."""
    argument = node.args[0]
    if isinstance(node, sp.exp):
        return node.exp, [math.log(y)] if y > 0.0 else [], None
    if node.is_Pow:
        return _inverse_power(node, y)
    name = node.func.__name__
    if name in _PIECEWISE_CONSTANT:  # it changes at its own boundaries only
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


def _inverse_power(power: sp.Expr, y: float) -> tuple[sp.Expr, list[float], None]:
    """The base of a power that is y, if its exponent is a number, or the exponent."""
    base, exponent = power.as_base_exp()
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
    inner: sp.Expr, level: float, period: float, x: sp.Symbol
) -> tuple[set[float], set[tuple[float, float]]]:
    """Where a linear function takes a level, up to multiples of a period."""
    rate = slope(inner, x)
    if not rate.is_number or rate == 0 or rate is sp.nan:
        raise _Unsolved
    return set(), {((level - float(inner.subs(x, 0))) / float(rate), period / abs(float(rate)))}


def _arc(y: float, function: Callable[[float], float]) -> list[float]:
    return [function(y)] if abs(y) <= 1.0 else []


# Functions that take a level on whole intervals or never
_PIECEWISE_CONSTANT = ("Heaviside", "sign", "floor", "ceiling")
# Periodic functions: where they take a level, and their period
_PERIODIC: dict[str, tuple[Callable[[float], list[float]], float]] = {
    "sin": (lambda y: [a for v in _arc(y, math.asin) for a in (v, math.pi - v)], 2.0 * math.pi),
    "cos": (lambda y: [a for v in _arc(y, math.acos) for a in (v, -v)], 2.0 * math.pi),
    "tan": (lambda y: [math.atan(y)], math.pi),
}
# Inverses of monotone functions; they raise a ValueError for levels that are never taken
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
    function = numeric(equation, coordinate)
    points = np.linspace(coordinate.lower, coordinate.upper, MANY_SAMPLES)
    heights = function(points)
    changes = np.flatnonzero(heights[:-1] * heights[1:] < 0.0)
    roots = {float(x) for x in points[heights == 0.0]} if np.any(heights) else set()
    tight = {"xtol": TINY, "rtol": 4.0 * EPSILON}
    for i in changes:
        root = scipy.optimize.brentq(lambda at: float(function(at)), *points[i : i + 2], **tight)
        roots.add(float(root))
    return roots


def _integers(boundary: sp.Expr, coordinate: Coordinate) -> list[float]:
    """The integers between the least and the largest value on the interval."""
    points = np.linspace(coordinate.lower, coordinate.upper, MANY_SAMPLES)
    heights = numeric(boundary, coordinate)(points)
    heights = heights[np.isfinite(heights)]
    if not heights.size or np.ptp(heights) > _MAX_LEVELS:
        return []
    return [float(n) for n in range(math.ceil(heights.min()), math.floor(heights.max()) + 1)]
