"""Systems over the pseudo-time of their stretches, and functions with many levels.

A staircase in the unknowns is a sum of steps, and a table of straight lines one of kinks:

    floor(g) = k - 1 + Σ Heaviside(g - i), i = k, ..., l,   where k - 1 <= g < l + 1,
    table(g) = y₀ + m₀ (g - x₀) + Σ (mᵢ - mᵢ₋₁) Max(0, g - xᵢ)   inside of the table.

So each level is a :mod:`switch <rankone.compiler.passes.switches>` that is held on its sides.
Beyond the levels that are written the sum is not a number, so that nothing is followed wrongly
there.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
import sympy as sp
from sympy.core.function import AppliedUndef
from sympy.core.relational import Relational

from rankone.compiler.passes.first_order import FirstOrderSystem, weak_form
from rankone.compiler.passes.lifting import NotLiftable, lift
from rankone.compiler.passes.separation import separate
from rankone.compiler.passes.switches import MOST_LEVELS, NotHeld
from rankone.problem.expressions.notation import exact
from rankone.problem.expressions.stable import NUMPY, in_floats
from rankone.problem.forms import Coordinate, GeneralTerm, Jump, SeparatedForm, State
from rankone.problem.functions import Table, namespace_of, table
from rankone.support.arrays import FEW, NEGLIGIBLE, Array, lobatto
from rankone.support.errors import ProblemError

_STAIRS = (sp.floor, sp.ceiling, sp.frac, sp.Mod)
_MARGIN = 0.02  # Part of the reached range on each side, or of a step, in which levels count too

Reached: TypeAlias = Mapping[sp.Expr, tuple[float, float]]
"""The smallest and the largest value that each argument takes on trajectories."""


def levelled(expressions: Iterable[sp.Expr]) -> list[sp.Expr]:
    """The arguments with unknowns of functions with many levels, in SymPy's order."""
    nodes = (node for each in expressions for node in each.atoms(*_STAIRS, Table))
    arguments = {_argument(node) for node in nodes if _has_levels(node)}
    return sorted(arguments, key=sp.default_sort_key)


def by_levels(expression: sp.Expr, reached: Reached) -> sp.Expr:
    """An expression with steps and kinks in place of functions with many levels."""
    if not expression.has(*_STAIRS, Table):
        return expression
    args = [by_levels(each, reached) for each in expression.args]
    if not _has_levels(expression):
        return expression.func(*args)
    span = reached[_argument(expression)]
    if isinstance(expression, Table):
        return _lines(expression, args[0], span)
    if isinstance(expression, sp.Mod):
        return args[0] - args[1] * _floor(args[0] / args[1], span)
    if isinstance(expression, sp.ceiling):
        return -_floor(-args[0], span)
    whole = _floor(args[0], span)
    return args[0] - whole if isinstance(expression, sp.frac) else whole


def _has_levels(node: sp.Expr) -> bool:
    """Whether it is a function of unknowns that kinks or jumps at its levels."""
    if not node.has(AppliedUndef) or not isinstance(node, (*_STAIRS, Table)):
        return False
    return not isinstance(node, Table) or node.kind != "cubic"


def _argument(node: sp.Expr) -> sp.Expr:
    """What passes the levels."""
    first = node.args[0]
    if isinstance(node, sp.Mod):
        return first / node.args[1]
    return -first if isinstance(node, sp.ceiling) else first


def _floor(argument: sp.Expr, span: tuple[float, float]) -> sp.Expr:
    """The floor of an argument as a sum of steps."""
    lower, upper = span
    margin = _MARGIN * max(upper - lower, 1.0)
    first, last = math.ceil(lower - margin), math.floor(upper + margin)
    if last - first >= MOST_LEVELS:  # trajectories that blow up reach any number
        raise NotHeld
    steps = [sp.Heaviside(argument - level, 1) for level in range(first, last + 1)]
    return first - 1 + sp.Add(*steps) + _nothing_beyond(argument, first - 1, last + 1)


def _lines(applied: Table, argument: sp.Expr, span: tuple[float, float]) -> sp.Expr:
    """A table as a sum of steps or kinks at its inner points that are reached."""
    points, heights = map(_exact, (applied.points, applied.values))
    inner = _written_points(applied.points, span)
    before, behind = inner.start - 1, inner.stop
    beyond = _nothing_beyond(argument, applied.points[before], applied.points[behind])
    if applied.kind == "previous":
        rises = (heights[i] - heights[i - 1] for i in inner)
        steps = (
            h * sp.Heaviside(argument - points[i], 1) for h, i in zip(rises, inner, strict=True)
        )
        return sp.Add(heights[before], *steps) + beyond
    pairs = itertools.pairwise(zip(points, heights, strict=True))
    slopes = [(b - a) / (y - x) for (x, a), (y, b) in pairs]
    kinks = ((slopes[i] - slopes[i - 1]) * sp.Max(0, argument - points[i]) for i in inner)
    line = heights[before] + slopes[before] * (argument - points[before])
    return sp.Add(line, *kinks) + beyond


def _exact(numbers: Iterable[float]) -> list[sp.Expr]:
    return [exact(sp.Float(x)) for x in numbers]


def _written_points(points: Sequence[float], span: tuple[float, float]) -> range:
    """The places of the inner points of a table that are reached."""
    inner = range(1, len(points) - 1)
    if len(inner) <= FEW:
        return inner
    lower, upper = span
    margin = _MARGIN * (upper - lower)
    first, last = np.searchsorted(points, [lower - margin, upper + margin]).tolist()
    begin = min(max(first, inner.start), inner.stop)
    return range(begin, max(min(last, inner.stop), begin))


def _nothing_beyond(argument: sp.Expr, lower: float, upper: float) -> sp.Expr:
    """Zero between two numbers, and not a number beyond them.

    They are levels too: trajectories that are continued on the side between them go on beyond.
    """
    zero = table([float(lower) - float(upper), 0.0], [0.0, 0.0])
    ends = (exact(sp.Float(end)) for end in (lower, upper))
    beyond = (sign * (argument - end) for sign, end in zip((-1, 1), ends, strict=True))
    return zero(sp.Add(*(sp.Max(0, excess) for excess in beyond)))


# -----------------------------------------------------------------------------
# A system over the pseudo-time of its stretches, where all events are at known times.
#
# Stretch i lies between the times τ_i(p) and τ_{i+1}(p), functions of the parameters. Over the
# pseudo-time s from i to i + 1 its clock runs evenly, and
#
#     u' = T_i(p) f(t, u, p),  t = τ_i(p) + (s - i) T_i(p),  T_i = τ_{i+1} - τ_i,
#
# so that dt is one more factor of every term. Resets become jumps at s = i, and every switch is on
# one side throughout a stretch.


_SHARES = lobatto(7)[1:-1]  # Times of a stretch at which switches are looked at
_SWITCHES = (
    *(Relational, sp.Heaviside, sp.sign, sp.Abs, sp.Max, sp.Min),
    *(sp.floor, sp.ceiling, sp.Mod, sp.frac),
)


@dataclass(frozen=True)
class KnownTime:
    """A time that is an expression of the parameters, and the states after it if some are reset."""

    at: sp.Expr
    then: tuple[sp.Expr, ...] | None = None


@dataclass(frozen=True)
class KnownStretches:
    """The stretches between known times.

    Each of the ``instants`` begins a stretch, but for the last if there is an ``end``, and ends the
    one before; several events at one instant are in their order. ``end`` is the end of the last
    stretch where it is not an instant.
    """

    instants: tuple[tuple[KnownTime, ...], ...]
    end: sp.Expr | None

    def borders(self, start: float) -> list[sp.Expr]:
        """The times at which stretches begin and end, from the start on."""
        ends = [] if self.end is None else [self.end]
        return [exact_number(start), *(instant[0].at for instant in self.instants), *ends]


def exact_number(number: float) -> sp.Expr:
    """A number as it is in expressions: integers are exact_number."""
    return sp.Integer(int(number)) if float(number).is_integer() else sp.Float(number)


@dataclass(frozen=True)
class StretchedForm:
    """The separated form over stretches, and what its last states stand for, if some are lifted.

    The states are those over clock time, the clock, the length of the stretch, and lifted ones.
    """

    separated: SeparatedForm
    meanings: tuple[sp.Expr, ...] = ()

    @property
    def coupled(self) -> GeneralTerm | None:
        """A term of the rates that does not separate."""
        return next((term for term in self.separated.general if not term.initial), None)


def over_stretches(
    system: FirstOrderSystem, stretches: KnownStretches, points: Array
) -> StretchedForm:
    """The separated form of a system over the pseudo-time of its stretches.

    ``points`` (d, m) of the box show on which side switches are. The clock and the length are
    written as functions of the parameters. Where these do not separate, they are states, and
    functions of states are lifted. The form has general terms if that does not do either.
    """
    writer = _StretchWriter(system, stretches, points)
    first = StretchedForm(separate(weak_form(writer.system(as_states=False))))
    if first.coupled is None:
        return first
    with_states = writer.system(as_states=True)
    form = StretchedForm(separate(weak_form(with_states)))
    if form.coupled is not None:
        try:
            lifting = lift(with_states)
            form = StretchedForm(separate(weak_form(lifting.system)), lifting.meanings)
        except (NotLiftable, ProblemError):
            return first
    return first if form.coupled is not None else form


class _StretchWriter:
    """Writes the equations over pseudo-time."""

    def __init__(self, system: FirstOrderSystem, stretches: KnownStretches, points: Array) -> None:
        self.first_order, self.stretches, self.points = system, stretches, points
        clock, *self.parameters = system.coordinates
        self.time = clock.symbol
        self.borders = stretches.borders(clock.lower)
        self.lengths = [sp.expand(b - a) for a, b in itertools.pairwise(self.borders)]
        taken = {c.name for c in system.coordinates} | {state.name for state in system.states}
        names = [_free(name, taken) for name in ("s", "clock", "length")]
        self.pseudo = sp.Symbol(names[0], real=True)
        self.states = [State(name, sp.Function(name)(self.time)) for name in names[1:]]
        states = [*system.states, *self.states]
        self.functions = [sp.Function(state.name)(self.pseudo) for state in states]
        self.moved = dict(zip(system.functions, self.functions, strict=False))
        self.sided = [self._sided(i) for i in range(len(self.lengths))]
        of_states = enumerate(zip(*self.sided, strict=True))
        self.switched = {k for k, rates in of_states if len(set(rates)) > 1}

    def system(self, *, as_states: bool) -> FirstOrderSystem:
        """The system; its rates have the clock and the length ``as_states`` or as expressions."""
        *_, clock, length = self.functions
        s, n = self.pseudo, len(self.first_order.states)
        rates: list[list[sp.Expr]] = [[] for _ in range(n + 1)]
        for i, (begin, span) in enumerate(zip(self.borders, self.lengths, strict=False)):
            inside = self._inside(i)
            duration = length if as_states else span
            now = clock if as_states else sp.expand(begin + (s - i) * span)
            for k, rate in enumerate(self.sided[i]):
                within = sp.S.One if as_states and k not in self.switched else inside
                if i and within is sp.S.One:
                    continue  # the same in all stretches
                moved = rate.xreplace({**self.moved, self.time: now})
                rates[k].append(sp.expand_mul(within * duration * moved))
            rates[n].append(inside * duration)
        initial = [*self.first_order.initial, self.borders[0], self.lengths[0]]
        coordinate = Coordinate(s.name, s, 0.0, float(len(self.lengths)))
        whole = [length] if as_states else [sp.Add(*rates[n])]
        return replace(
            self.first_order,
            coordinates=(coordinate, *self.parameters),
            states=(*self.first_order.states, *self.states),
            functions=tuple(self.functions),
            initial=tuple(initial),
            origins=(*self.first_order.origins, None, None),
            rhs=(*(sp.Add(*terms) for terms in rates[:n]), *whole, sp.S.Zero),
            jumps=tuple(self._jumps()),
            events=(),
        )

    def _inside(self, i: int) -> sp.Expr:
        """One in stretch i, else zero."""
        count, s = len(self.lengths), self.pseudo
        if count == 1:
            return sp.S.One
        if i == 0:
            return sp.Piecewise((1, s < 1), (0, True))
        if i == count - 1:
            return sp.Piecewise((0, s < i), (1, True))
        return sp.Piecewise((0, s < i), (1, s < i + 1), (0, True))

    def _jumps(self) -> Iterator[Jump]:
        """The resets at the beginning of every stretch but the first."""
        count = len(self.first_order.states)
        instants = self.stretches.instants[: len(self.lengths) - 1]
        for i, instant in enumerate(instants, 1):
            now = self.borders[i]
            states = dict(self.moved)
            for event in instant:
                if event.then is not None:
                    after = [then.xreplace({**states, self.time: now}) for then in event.then]
                    states = dict(zip(self.first_order.functions, after, strict=True))
            values = [states[u] for u in self.first_order.functions[:count]]
            yield Jump(float(i), (*values, now, self.lengths[i]))

    def _sided(self, i: int) -> list[sp.Expr]:
        """The rates in stretch i, where switches in time are on one side."""
        symbols = [c.symbol for c in self.parameters]
        begin, length = (
            _values(each, symbols, self.points) for each in (self.borders[i], self.lengths[i])
        )
        long = length > NEGLIGIBLE * length.max() if length.any() else length == 0.0
        times = np.concatenate([(begin + share * length)[long] for share in _SHARES])
        places = np.concatenate([times[None], np.tile(self.points[:, long], len(_SHARES))])
        variables = [self.time, *symbols]
        rates = list(self.first_order.rhs)
        while True:
            sides: dict[sp.Basic, sp.Basic] = {}
            for node in {node for rate in rates for node in rate.atoms(*_SWITCHES)}:
                explicit = node.free_symbols <= set(variables) and not node.has(AppliedUndef)
                if explicit and self.time in node.free_symbols and not namespace_of([node]):
                    side = _side(node, variables, places)
                    sides |= {} if side is None else {node: side}
            if not sides:
                return rates
            rates = [rate.xreplace(sides) for rate in rates]


def _side(node: sp.Basic, variables: Sequence[sp.Symbol], places: Array) -> sp.Basic | None:
    """What a switch is at all places (variables, N) alike; None if it is not."""
    if isinstance(node, sp.Max | sp.Min):
        heights = [_values(argument, variables, places) for argument in node.args]
        largest = isinstance(node, sp.Max)
        chosen = np.argmax(heights, axis=0) if largest else np.argmin(heights, axis=0)
        return node.args[int(chosen[0])] if (chosen == chosen[0]).all() else None
    argument, levels = node.args[0], node
    if isinstance(node, sp.Abs):
        levels = sp.sign(argument)
    elif isinstance(node, sp.Mod | sp.frac):
        period = node.args[1] if isinstance(node, sp.Mod) else sp.S.One
        levels = sp.floor(argument / period)
    values = _values(levels, variables, places)
    level = float(values[0])
    if not level.is_integer() or (values != level).any():
        return None
    if isinstance(node, Relational):
        return sp.true if level else sp.false
    whole = sp.Integer(int(level))
    if isinstance(node, sp.Abs):
        return whole * argument
    return argument - whole * period if isinstance(node, sp.Mod | sp.frac) else whole


def _values(expression: sp.Basic, variables: Sequence[sp.Symbol], places: Array) -> Array:
    """An expression at places (variables, N): shape (N,)."""
    function = sp.lambdify(list(variables), in_floats(expression), [NUMPY, "numpy", "scipy"])
    with np.errstate(all="ignore"):
        values = np.asarray(function(*places), dtype=float)
    return np.broadcast_to(values, places.shape[1:])


def _free(name: str, taken: set[str]) -> str:
    """The name, with underscores behind it if others have it."""
    while name in taken:
        name += "_"
    return name
