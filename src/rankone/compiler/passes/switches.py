"""Switches of the rates, each held on one side of its surface until a trajectory crosses it.

``Abs``, ``sign``, ``Heaviside``, ``Max``, ``Min`` and conditions of ``Piecewise`` switch where a
function g(t, u, p) of the unknowns, their *surface*, vanishes. The side of the surface becomes a
state of its own: 1 where g > 0, -1 where g < 0. It has the rate zero and is set by an event, so
that the rates of both sides are smooth and no step straddles the surface.

Where the rates jump and push trajectories back to the surface from both sides, they *slide* along
it (Filippov, Differential Equations with Discontinuous Righthand Sides, Kluwer 1988, section 4).
The side is 0 then, and the rates are the mean of those of both sides,

    f = (1 + s)/2 f₊ + (1 - s)/2 f₋,   with s from dg/dt = 0,

until s leaves [-1, 1]. Coulomb friction that sticks is the classic example. What is full or
empty *rests*: dg/dt is zero on one side by the equations. There s is that side exactly, and the
speed of the other side alone, or the end of what makes it zero, lets trajectories leave.

Switches of the clock, such as ``Heaviside(t - a)``, are held as well: so each order of them and of
others is continued smoothly. Where all are at times that are the same for all parameters, or there
are too many, they stay as they are written.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import IntEnum, auto
from functools import cached_property, reduce
from typing import TypeAlias

import sympy as sp
from sympy.core.function import AppliedUndef
from sympy.core.relational import Relational
from sympy.logic.boolalg import Boolean

from rankone.compiler.passes.first_order import FirstOrderSystem
from rankone.compiler.passes.surfaces import Sides, only_kinks, zero_where
from rankone.problem.expressions.conditions import Differentiator, definite_sign, slope
from rankone.problem.forms import EventForm, Jump, State
from rankone.solvers.outcome import Role
from rankone.support.arrays import FEW
from rankone.trajectories.system.features import FALLING

MOST_SWITCHES, MOST_LEVELS = 12, 40
"""Most surfaces whose sides are held, one for all levels of a function, and most levels of all."""
_MOST_COUPLED = 3  # Most surfaces whose sliding depends on each other
# Most pieces of a rate that is not linear in its sides
_MOST_COPIES = 3**FEW
_MOST_NODES = 20_000  # Of all rates with sides written out: compiling more takes minutes
_LEAST = sp.Float("1e-300")  # Beside the square of a divisor that may be zero


_Held: TypeAlias = tuple[sp.Expr, sp.Expr]  # An expression with sides, and as it was written
_Case: TypeAlias = tuple[sp.Expr, Boolean]  # Of a piecewise function


@dataclass(frozen=True)
class _Place:
    """Where a surface is: where a ``function`` has a ``level``, above which its side has a sign.

    Surfaces of one function at several levels never vanish together.
    """

    function: sp.Expr
    level: sp.Expr
    sign: int


class NotHeld(Exception):
    """The switches of a system cannot be held on their sides."""


@dataclass(eq=False)
class _Switch:
    """A surface, what stands for its side, and whether rates may jump there.

    ``surface`` has the sides of others in place of what switches inside of it, ``written`` has not.
    ``side`` is the effective side in rates, any number from -1 to 1 while trajectories slide;
    ``state`` is the side as a state. Where the surface is crossed once at a time that is known,
    that is ``at``, and ``behind`` is the side after it.
    """

    surface: sp.Expr
    written: sp.Expr
    side: sp.Dummy
    state: sp.Expr
    name: str
    jumps: bool = False
    at: sp.Expr | None = None
    behind: sp.Expr = sp.S.Zero

    @cached_property
    def place(self) -> _Place:
        """Where the surface is."""
        return _place_of(self.surface)


def held_switches(system: FirstOrderSystem) -> FirstOrderSystem | None:
    """The system with the sides of its switches as states, the last ones; None without switches.

    The last events, as many, set these states.

    Raises
    ------
    NotHeld
        If there are too many switches, or how they slide is not known.
    """
    failure: NotHeld | None = None
    for least in (_Kind.FIXED, _Kind.MOVING, _Kind.STATES):
        replacement = _Replacement(system, least)
        rates = [replacement.held(rate) for rate in system.examined_rates]
        if replacement.most <= _Kind.FIXED:
            break
        try:
            return _with_switches(system, replacement.switches, rates)
        except NotHeld as not_held:
            failure = not_held
    if failure is not None:
        raise failure
    return None


def _with_switches(
    system: FirstOrderSystem, found: Sequence[_Switch], rates: Sequence[sp.Expr]
) -> FirstOrderSystem:
    """The system with the sides of the switches that were found, with rates that have these."""
    switches = _by_level(found)
    distinct = [s for k, s in enumerate(switches) if not _beside(s, switches[:k])]
    if len(distinct) > MOST_SWITCHES or len(switches) > MOST_LEVELS:
        raise NotHeld
    for switch in switches:
        if switch.jumps:
            changed = [rate for rate in rates if switch.side in rate.free_symbols]
            others = _states_of(switches, switch)
            switch.jumps = not only_kinks(changed, switch.surface, switch.side, others)
    return _with_sides(system, switches, _Sliding(system, switches, rates))


class _Kind(IntEnum):
    """What an expression changes with along a trajectory, the least of it first."""

    CONSTANT = auto()
    FIXED = auto()
    """With the clock alone: it is the same for all parameters."""
    MOVING = auto()
    """With the clock and parameters."""
    STATES = auto()


class _Replacement:
    """Replaces what switches by expressions of sides, from a ``least`` kind on.

    ``most`` is the largest kind of what was replaced.
    """

    def __init__(self, system: FirstOrderSystem, least: _Kind) -> None:
        self.switches: list[_Switch] = []
        self.most = _Kind.CONSTANT
        self._system, self._least = system, least
        self._names = {state.name for state in system.states}
        self._names |= {coordinate.name for coordinate in system.coordinates}
        self._names |= {event.name for event in system.events}
        self._by_place: dict[tuple[sp.Expr, sp.Expr], _Switch] = {}
        self._extremes: dict[sp.Expr, tuple[_Held, _Held]] = {}

    def held(self, expression: sp.Expr, bounded: bool = False) -> sp.Expr:
        """The expression with sides, from the inside out.

        Steps look a little beyond a surface. What is ``bounded`` there, since a function around it
        ends, stays as it is.
        """
        if self._kind(expression) < self._least or isinstance(expression, sp.Symbol | AppliedUndef):
            return expression
        bounded |= isinstance(expression, sp.log)
        bounded |= expression.is_Pow and not expression.exp.is_integer
        args = [self.held(a, bounded) for a in expression.args]
        if isinstance(expression, sp.Max | sp.Min | sp.Abs):
            other = self._continuous(expression, args)
            return expression.func(*args) if bounded else other
        if isinstance(expression, sp.sign):
            return self._side(args[0], expression.args[0], jumps=True)
        if isinstance(expression, sp.Heaviside):
            return (1 + self._side(args[0], expression.args[0], jumps=True)) / 2
        if isinstance(expression, Relational):
            return self._condition(expression, *args)
        return expression.func(*args)

    def _kind(self, expression: sp.Expr) -> _Kind:
        if expression.has(AppliedUndef):
            return _Kind.STATES
        free = expression.free_symbols
        if self._system.coordinates[0].symbol not in free:
            return _Kind.CONSTANT
        return _Kind.MOVING if len(free) > 1 else _Kind.FIXED

    def _condition(self, relation: Relational, left: sp.Expr, right: sp.Expr) -> Boolean:
        if isinstance(relation, sp.Eq | sp.Ne):  # on the surface alone
            return sp.false if isinstance(relation, sp.Eq) else sp.true
        side = self._side(left - right, relation.lhs - relation.rhs, jumps=True)
        return relation.func(side, 0)

    def _continuous(self, function: sp.Expr, args: Sequence[sp.Expr]) -> sp.Expr:
        """An absolute value, or an extreme."""
        if isinstance(function, sp.Abs):
            return args[0] * self._side(args[0], function.args[0], jumps=False)

        def extreme(first: _Held, second: _Held) -> _Held:
            (a, a_written), (b, b_written) = first, second
            both = function.func(a_written, b_written)
            if self._kind(both) < self._least:
                return both, both
            side = self._side_between(first, second)
            if side is None:
                side = self._side(a - b, a_written - b_written, jumps=False)
            self._extremes[both] = first, second
            side = side if isinstance(function, sp.Max) else -side
            return a * (1 + side) / 2 + b * (1 - side) / 2, both

        return reduce(extreme, zip(args, function.args, strict=True))[0]

    def _side_between(self, first: _Held, second: _Held) -> sp.Expr | None:
        """The side of the difference of two expressions, through those that they are extremes of.

        So ``Max(-12, Min(12, v))`` switches where v is -12, as 12 never is. None where several
        surfaces are left.
        """
        for turned, (one, other) in ((False, (first, second)), (True, (second, first))):
            if one[1] not in self._extremes:
                continue
            inner = [(part, other) for part in self._extremes[one[1]]]
            signs = [definite_sign(a[0] - b[0], self._system.coordinates[1:]) for a, b in inner]
            largest = isinstance(one[1], sp.Max)
            decides = sp.Integer(1 if largest else -1)
            if decides in signs:
                return -decides if turned else decides
            open_pairs = [pair for pair, sign in zip(inner, signs, strict=True) if sign is None]
            if not open_pairs:
                return decides if turned else -decides
            if len(open_pairs) > 1:
                continue
            ((a, a_written), (b, b_written)) = open_pairs[0]
            side = self._side_between(*open_pairs[0])
            if side is None:
                side = self._side(a - b, a_written - b_written, jumps=False)
            return -side if turned else side
        return None

    def _side(self, surface: sp.Expr, written: sp.Expr, *, jumps: bool) -> sp.Expr:
        """The effective side of a surface."""
        kind = self._kind(surface)
        if kind < self._least:
            return sp.sign(surface)
        self.most = max(self.most, kind)
        place = _place_of(surface)
        if switch := self._by_place.get((place.function, place.level)):
            switch.jumps |= jumps
            return place.sign * switch.place.sign * switch.side
        name, event_name = self._new_name("side"), self._new_name("switch")
        t = self._system.coordinates[0].symbol
        switch = _Switch(
            surface,
            written,
            sp.Dummy(name, real=True),
            sp.Function(name)(t),
            event_name,
            jumps,
        )
        if kind < _Kind.STATES and surface == written:
            rate = slope(surface, t)
            if rate != 0 and not rate.has(t, sp.nan):
                switch.at, switch.behind = -surface.subs(t, 0) / rate, sp.sign(rate)
        self.switches.append(switch)
        self._by_place[place.function, place.level] = switch
        return switch.side

    def _new_name(self, stem: str) -> str:
        """A name that nothing else has."""
        name = next(n for k in itertools.count() if (n := f"{stem}_{k}") not in self._names)
        self._names.add(name)
        return name


def _mixed(rate: sp.Expr, switches: Sequence[_Switch]) -> sp.Expr:
    """A rate that is linear in the side of each surface that may be slid along."""
    branching = [s for s in switches if any(s.side in c.free_symbols for c in _conditions(rate))]
    if len({s.place.function for s in branching}) > FEW:
        raise NotHeld
    copies = 1
    for switch in switches:
        if switch.jumps and not _linear(rate, switch.side):
            levels = [
                s for s in (switch, *_beside(switch, switches)) if s.side in rate.free_symbols
            ]
            levels = sorted((s for s in levels if s.jumps), key=lambda each: each.place.level)
            copies *= 2 * len(levels) + 1
            if copies > _MOST_COPIES:
                raise NotHeld
            rate = _between_levels(rate, levels)
    return rate


def _between_levels(rate: sp.Expr, levels: Sequence[_Switch]) -> sp.Expr:
    """A rate in pieces between ascending levels of one function; on each it is the mean."""
    signs = [switch.place.sign for switch in levels]
    pieces = [
        rate.subs(
            {s.side: z if i < k else -z for i, (s, z) in enumerate(zip(levels, signs, strict=True))}
        )
        for k in range(len(levels) + 1)
    ]
    if any(piece.has(sp.I, sp.oo, -sp.oo, sp.zoo, sp.nan) for piece in pieces):
        raise NotHeld
    cases = []
    for switch, sign, below, above in zip(levels, signs, pieces, pieces[1:], strict=False):
        share, state = (1 + sign * switch.side) / 2, sign * switch.state
        cases += [
            (below, state < -sp.S.Half),
            ((1 - share) * below + share * above, state < sp.S.Half),
        ]
    return sp.Piecewise(*cases, (pieces[-1], True))


def _conditions(expression: sp.Expr) -> Iterator[Boolean]:
    """The conditions of piecewise functions in an expression."""
    for piecewise in expression.atoms(sp.Piecewise):
        yield from (condition for _, condition in piecewise.args)


def _linear(rate: sp.Expr, side: sp.Symbol) -> bool:
    """Whether a rate is linear in a side, which chooses no branch."""
    if side not in rate.free_symbols:
        return True
    return all(side not in c.free_symbols for c in _conditions(rate)) and (
        sp.diff(rate, side, 2) == 0
    )


class _Sliding:
    """The effective sides of switches, and how fast trajectories leave surfaces.

    ``sides`` maps what stands for sides in rates to expressions of the states. ``speeds`` are dg/dt
    of each switch, of sides as they stand in the rates. Where trajectories may slide, ``pulls`` are
    two numbers: they slide while the first, which drives them off, is not larger than the second.
    ``rests`` tell where they rest.
    """

    def __init__(
        self, system: FirstOrderSystem, switches: Sequence[_Switch], rates: Sequence[sp.Expr]
    ) -> None:
        self.switches, self._system = switches, system
        held = [s for s in switches if s.side in self._speed(s.surface, rates).free_symbols]
        rates_as_held = rates
        rates = [_mixed(rate, held) for rate in rates]
        self.speeds = [
            self._speed(s.surface, rates).xreplace(_sides_beside(s, switches)) for s in switches
        ]
        self.sides: dict[sp.Expr, sp.Expr] = {}
        self.pulls: dict[sp.Expr, tuple[sp.Expr, sp.Expr]] = {}
        self.rests: dict[sp.Expr, _Rests] = {}
        sliding = [s for s in switches if s.jumps and self._depends(s, s) and self._pull(s) != 0]
        if any(other.side in s.surface.free_symbols for s in sliding for other in switches):
            raise NotHeld  # a surface that moves when another one is crossed
        for switch in switches:
            if switch not in sliding:
                self.sides[switch.side] = switch.state
        for group in _in_order(sliding, self._depends):
            self.sides.update(self._effective(group))
            self._check_size(rates)
        self.slides = {s.side: s in sliding for s in switches}
        self.idle = self._idle(rates_as_held)
        self.rates = [rate.xreplace(self.sides) for rate in rates]

    def _idle(self, rates: Sequence[sp.Expr]) -> dict[_Switch, Boolean]:
        """Where the side of a switch changes no rate, by the sides of those that always do.

        There its surface is passed without an event: orders of what changes nothing are no orders.
        Not where another side must have changed by then, as of ``Max(0, 1 - Abs(x))`` at x = 0.
        """
        where = dict[_Switch, Boolean]()
        for switch in self.switches:
            relied_on = any(idle.has(switch.state) for idle in where.values())
            at_once = switch.at is not None or self.slides[switch.side]
            if relied_on or at_once or _beside(switch, self.switches):
                continue
            others = _states_of([s for s in self.switches if s not in where], switch)
            above, below = ({switch.side: sign} for sign in (sp.S.One, sp.S.NegativeOne))
            changed = [rate for rate in rates if switch.side in rate.free_symbols]
            changes = [rate.xreplace(above) - rate.xreplace(below) for rate in changed]
            idle = sp.And(*(zero_where(change, others) for change in changes))
            told_by = {*idle.atoms(AppliedUndef), *idle.free_symbols}
            told_by -= {*others.values(), self._system.coordinates[0].symbol}
            if idle not in (sp.true, sp.false) and not told_by:
                there = {
                    other.state: sp.sign(height)
                    for other in self.switches
                    if switch.side in other.surface.free_symbols
                    and (height := other.surface.xreplace({switch.side: sp.S.Zero})).is_number
                }
                if idle.xreplace(there) != sp.false:
                    where[switch] = idle
        return where

    def _depends(self, a: _Switch, b: _Switch) -> bool:
        """Whether the speed at the surface of one depends on the side of the other."""
        return b.side in self.speeds[self.switches.index(a)].free_symbols

    def _pull(self, switch: _Switch) -> sp.Expr:
        """How the speed at a surface changes with its own side, which chooses no branch there."""
        speed = self.speeds[self.switches.index(switch)]
        return _slope(speed.xreplace({switch.state: sp.S.Zero}), switch.side)

    def _speed(self, surface: sp.Expr, rates: Sequence[sp.Expr]) -> sp.Expr:
        """dg/dt along trajectories."""
        t = self._system.coordinates[0].symbol
        states = {u: sp.Dummy(u.func.__name__, real=True) for u in self._system.functions}
        plain = surface.xreplace(states)
        speed = Differentiator(t)(plain)
        for state, rate in zip(states.values(), rates, strict=True):
            speed += Differentiator(state)(plain) * rate
        return speed.xreplace({dummy: u for u, dummy in states.items()})

    def _check_size(self, rates: Sequence[sp.Expr]) -> None:
        """Raise NotHeld if rates with sides written out have too many nodes."""
        sizes = {side: _size(effective) for side, effective in self.sides.items()}
        nodes = (node for rate in rates for node in sp.preorder_traversal(rate))
        if sum(sizes.get(node, 1) for node in nodes) > _MOST_NODES:
            raise NotHeld

    def _effective(self, group: Sequence[_Switch]) -> dict[sp.Expr, sp.Expr]:
        """The effective sides of switches whose sliding depends on each other.

        A side is that of its state, or keeps trajectories on the surface where that is 0.
        """
        if len(group) > _MOST_COUPLED:
            raise NotHeld
        unknowns = [s.side for s in group]
        rows, right = [], []
        for switch in group:
            speed = self.speeds[self.switches.index(switch)].xreplace(self.sides)
            slopes = [_slope(speed, side) for side in unknowns]
            if any(slope.has(*unknowns) for slope in slopes):
                raise NotHeld
            on_side = _on_side(switch)
            diagonal = [sp.Integer(s is switch) for s in group]
            pairs = zip(diagonal, slopes, strict=True)
            rows.append([sp.Piecewise((a, on_side), (b, True)) for a, b in pairs])
            rest = -speed.subs(dict.fromkeys(unknowns, 0))
            right.append(sp.Piecewise((switch.state, on_side), (rest, True)))
        if len(group) == 1:  # in one function, which does not divide where it need not
            speed = self.speeds[self.switches.index(group[0])].xreplace(self.sides)
            speed = speed.xreplace({group[0].state: sp.S.Zero})  # it chooses no branch while 0
            slope = _slope(speed, unknowns[0])
            drift = speed.subs(unknowns[0], 0)
            self.pulls[unknowns[0]] = drift, -slope  # positive where it attracts from both sides
            rests = self.rests[unknowns[0]] = self._rests_of(group[0])
            on_side = group[0].state, _on_side(group[0])
            cases = [*rests.cases(sp.S.One, sp.S.NegativeOne)]
            # Rates may be the same on both sides where what makes one of them zero ends
            ends = cases or slope.has(sp.Piecewise)
            share = -drift * slope / (slope**2 + _LEAST) if ends else -drift / slope
            return {unknowns[0]: sp.Piecewise(on_side, *cases, (share, True))}
        matrix, vector = sp.Matrix(rows), sp.Matrix(right)
        solved = matrix.adjugate() * vector / matrix.det(method="berkowitz")
        self.pulls.update(
            (side, (share, sp.S.One)) for side, share in zip(unknowns, solved, strict=True)
        )
        return dict(zip(unknowns, solved, strict=True))

    def _rests_of(self, switch: _Switch) -> _Rests:
        """Where trajectories rest at the surface of a switch that slides alone."""
        speed = self.speeds[self.switches.index(switch)].xreplace({switch.state: sp.S.Zero})
        above, below = (speed.xreplace({switch.side: sp.Integer(sign)}) for sign in (1, -1))
        others = _states_of(self.switches, switch)
        where = zero_where(above, others), zero_where(below, others)
        return _Rests(*where, above.xreplace(self.sides), below.xreplace(self.sides))


@dataclass(frozen=True)
class _Rests:
    """Where the speed at a surface is zero ``above`` or ``below`` it, and what it is on each side.

    The speed of the other side holds trajectories there while it pushes.
    """

    above: Boolean
    below: Boolean
    speed_above: sp.Expr
    speed_below: sp.Expr

    def cases(self, above: sp.Expr, below: sp.Expr) -> Iterator[tuple[sp.Expr, Boolean]]:
        """Cases of a piecewise function: what is so where they rest above, and below."""
        pairs = (above, self.above), (below, self.below)
        yield from ((each, rest) for each, rest in pairs if rest != sp.false)


def _states_of(switches: Sequence[_Switch], without: _Switch) -> Sides:
    """What stands for the sides of all switches but one, with their states."""
    return {s.side: s.state for s in switches if s is not without}


def _place_of(surface: sp.Expr) -> _Place:
    constant, function = surface.as_coeff_Add()
    factor, function = function.primitive()
    if function.could_extract_minus_sign():
        factor, function = -factor, -function
    return _Place(function, -constant / factor, 1 if factor > 0 else -1)


def _beside(switch: _Switch, switches: Sequence[_Switch]) -> list[_Switch]:
    """The other switches whose surfaces never vanish where that of a switch does."""
    function = switch.place.function
    return [o for o in switches if o is not switch and o.place.function == function]


def _sides_beside(switch: _Switch, switches: Sequence[_Switch]) -> dict[sp.Expr, sp.Expr]:
    """The sides of the surfaces beside that of a switch, where this one vanishes."""
    sides: dict[sp.Expr, sp.Expr] = {}
    for other in _beside(switch, switches):
        above = switch.place.level > other.place.level
        side = sp.Integer(other.place.sign if above else -other.place.sign)
        sides |= {other.side: side, other.state: side}
    return sides


def _by_level(switches: Sequence[_Switch]) -> list[_Switch]:
    """The switches, of which those of one function at several levels ascend with these.

    Surfaces that have sides of others in them stay behind these.
    """
    ordered = list(switches)
    inner = {symbol for each in switches for symbol in each.surface.free_symbols}
    for k, first in enumerate(switches):
        levels = [first, *_beside(first, switches)]
        if _beside(first, switches[:k]) or any(each.side in inner for each in levels):
            continue
        places = sorted(map(switches.index, levels))
        names = [(switches[place].name, switches[place].state) for place in places]
        ascending = sorted(levels, key=lambda each: each.place.level)
        for place, switch, (name, state) in zip(places, ascending, names, strict=True):
            ordered[place] = switch
            switch.name, switch.state = name, state
    return ordered


def _size(expression: sp.Expr) -> int:
    """The number of nodes of an expression."""
    return sum(1 for _ in sp.preorder_traversal(expression))


def _slope(speed: sp.Expr, side: sp.Symbol) -> sp.Expr:
    """How a speed, linear in a side, changes with it."""
    return speed.subs(side, 1) - speed.subs(side, 0)


def _on_side(switch: _Switch) -> Boolean:
    """Whether a trajectory does not slide along the surface."""
    return sp.Abs(switch.state) > sp.S.Half


def _in_order(
    switches: Sequence[_Switch], depends: Callable[[_Switch, _Switch], bool]
) -> list[list[_Switch]]:
    """Groups of switches that depend on each other, each behind those that it depends on."""
    edges = [(b, a) for a in switches for b in switches if a is not b and depends(a, b)]
    reach = {s: {s} for s in switches}
    for _ in switches:
        for before, after in edges:
            reach[after] |= reach[before]
    groups: list[list[_Switch]] = []
    for s in sorted(switches, key=lambda s: len(reach[s])):
        if all(s not in group for group in groups):
            groups.append([o for o in switches if o in reach[s] and s in reach[o]])
    return groups


class _Sides:
    """The sides of switches as states: where they begin, and what sets them."""

    def __init__(
        self, system: FirstOrderSystem, switches: Sequence[_Switch], sliding: _Sliding
    ) -> None:
        self._system, self._switches, self._sliding = system, switches, sliding
        self.states = [s.state for s in switches]
        self._surfaces = list[sp.Expr]()
        self._actual = dict[sp.Expr, sp.Expr]()  # Sides that change nothing now, where they count
        for switch in switches:
            surface = switch.surface.xreplace(sliding.sides).xreplace(self._actual)
            self._surfaces.append(surface)
            if switch in sliding.idle:
                idle = _share(sliding.idle[switch])
                actual = idle * sp.sign(surface) + (1 - idle) * switch.state
                self._actual[switch.state] = actual

    def at_start(self) -> list[sp.Expr]:
        """The sides where trajectories begin."""
        clock = self._system.coordinates[0]
        start = dict(zip(self._system.functions, self._system.initial, strict=True))
        start[clock.symbol] = sp.sympify(clock.lower)
        sides = self._sides_at(start)
        now = dict(zip(self.states, sides, strict=True))
        for k, switch in enumerate(self._switches):
            if switch in self._sliding.idle:
                idle = _share(self._sliding.idle[switch]).xreplace(now)
                sides[k] = idle + (1 - idle) * sides[k]
        return sides

    def after(self, values: Sequence[sp.Expr]) -> list[sp.Expr]:
        """The sides after a reset to some values: as before where it leaves the surface alone."""
        reset = dict(zip(self._system.functions, values, strict=True))
        sides = []
        for state, surface, new in zip(
            self.states, self._surfaces, self._sides_at(reset), strict=True
        ):
            moved = sp.sign(surface - surface.xreplace(reset)) ** 2
            sides.append(moved * new + (1 - moved) * state)
        return self._told_anew(sides, reset)

    def _told_anew(
        self, sides: Sequence[sp.Expr], values: Mapping[sp.Expr, sp.Expr]
    ) -> list[sp.Expr]:
        """The sides after an event, of which those that change nothing before or after are told.

        They are 1 while they change nothing, and those of the states' values as soon as they do.
        """
        told, now = [*sides], dict(zip(self.states, sides, strict=True))
        for k, switch in enumerate(self._switches):
            idle = _share(self._sliding.idle.get(switch, sp.false))
            after = idle.xreplace(now)
            if after == idle and told[k] == switch.state:
                continue
            height = self._surfaces[k].xreplace(now).xreplace(values)
            speed = self._sliding.speeds[k].xreplace(self._sliding.sides).xreplace(values)
            side = _or_else(sp.sign(height), _or_else(sp.sign(speed), sp.S.One))
            told[k] = after + (1 - after) * (idle * side + (1 - idle) * told[k])
        return told

    def _sides_at(self, values: Mapping[sp.Expr, sp.Expr]) -> list[sp.Expr]:
        """The sides of the surfaces on which states have some values.

        On a surface it is where trajectories go on to, or 0 where they slide or rest.
        """
        heights: list[sp.Expr] = []
        signs: dict[sp.Expr, sp.Expr] = {}
        for switch in self._switches:  # those inside of others come first
            heights.append(switch.surface.xreplace(signs).xreplace(values))
            signs[switch.side] = sp.sign(heights[-1])
        signs |= {s.state: signs[s.side] for s in self._switches}

        def at(expression: sp.Expr) -> sp.Expr:
            return expression.xreplace(signs).xreplace(values)

        sides = []
        for k, (switch, height) in enumerate(zip(self._switches, heights, strict=True)):
            if self._sliding.slides[switch.side]:
                onward = self._onward(switch, at)
            else:
                speed = at(self._sliding.speeds[k])
                stays = sp.S.Zero if switch.jumps else sp.S.One  # a kink is the same on both sides
                onward = _or_else(sp.sign(speed), stays)
            sides.append(_or_else(sp.sign(height), onward))
        return sides

    def _onward(self, switch: _Switch, at: Callable[[sp.Expr], sp.Expr]) -> sp.Expr:
        """The side that trajectories on a surface go on to, 0 where they slide or rest.

        ``at`` puts in what is known there, before SymPy looks at signs, which takes it long.
        """
        drift, pull = map(at, self._sliding.pulls[switch.side])
        onward = sp.sign(drift) * sp.Heaviside(_size_of(drift) - pull, 0)
        if (rests := self._sliding.rests.get(switch.side)) is None:
            return onward
        falls, rises = (
            sign * sp.Heaviside(sign * at(speed), 0)
            for sign, speed in ((-1, rests.speed_below), (1, rests.speed_above))
        )
        cases = ((side, at(rest)) for side, rest in rests.cases(falls, rises))
        return sp.Piecewise(*cases, (onward, True))

    def crossings(self) -> Iterator[EventForm]:
        """The events that set the sides."""
        for k, switch in enumerate(self._switches):
            side, height = switch.state, switch.state * self._surfaces[k]
            if self._sliding.slides[switch.side]:
                drift, pull = self._sliding.pulls[switch.side]
                speed = self._sliding.speeds[k].xreplace({switch.side: side})
                speed = speed.xreplace(self._sliding.sides).xreplace({side: -side})
                passes = sp.Heaviside(-side * speed, 0)
                stays, leaves = (pull * _size_of(pull) - drift**2, True), (sp.sign(drift), True)
                stay_there, leave = list[_Case](), list[_Case]()
                if rests := self._sliding.rests.get(switch.side):
                    stay_there = [*rests.cases(rests.speed_below, -rests.speed_above)]
                    leave = [*rests.cases(sp.S.NegativeOne, sp.S.One)]
                height = sp.Piecewise((height, _on_side(switch)), *stay_there, stays)
                other = sp.Piecewise((-side * passes, _on_side(switch)), *leave, leaves)
            else:
                other = -side
            other = other if switch.at is None else switch.behind
            if switch.state not in self._actual:
                height, other = (each.xreplace(self._actual) for each in (height, other))
            if (idle := self._sliding.idle.get(switch)) is not None:
                height = sp.Piecewise((sp.S.One, idle), (height, True))
            others = [other if state == side else state for state in self.states]
            then = (*self._system.functions, *self._told_anew(others, {}))
            # At one instant a rest ends by its speed before another switch ends what makes it one
            first = sp.S.One if self._rests_while(switch) else None
            yield EventForm(
                switch.name, height, FALLING, then, terminal=False, at=switch.at, priority=first
            )

    def _rests_while(self, switch: _Switch) -> bool:
        """Whether trajectories rest at a surface as long as others are on some sides."""
        rests = self._sliding.rests.get(switch.side)
        return rests is not None and not {rests.above, rests.below} <= {sp.true, sp.false}


def _share(condition: Boolean) -> sp.Expr:
    """One where a condition on sides holds, zero elsewhere."""
    if condition in (sp.true, sp.false):
        return sp.S.One if condition == sp.true else sp.S.Zero
    if isinstance(condition, sp.Or):
        return 1 - sp.Mul(*(1 - _share(each) for each in condition.args))
    if isinstance(condition, sp.And):
        return sp.Mul(*map(_share, condition.args))
    return sp.Heaviside(condition.gts - condition.lts, 0)


def _or_else(side: sp.Expr, other: sp.Expr) -> sp.Expr:
    """A side, or the other one where it is 0."""
    return side + (1 - side**2) * other


def _size_of(expression: sp.Expr) -> sp.Expr:
    """The absolute value: SymPy's own one is a root of products where symbols may be complex."""
    return expression * sp.sign(expression)


def _with_sides_after(jump: Jump, sides: _Sides, clock: sp.Symbol) -> Jump:
    """A jump that resets sides too."""
    after = sides.after(jump.values)
    held = {u: sp.Dummy(real=True) for side in after for u in side.atoms(AppliedUndef)}
    now = {clock: sp.sympify(jump.time), **{dummy: u for u, dummy in held.items()}}
    return replace(jump, values=(*jump.values, *(s.xreplace(held).xreplace(now) for s in after)))


def _with_sides(
    system: FirstOrderSystem, switches: Sequence[_Switch], sliding: _Sliding
) -> FirstOrderSystem:
    """The system with sides as states, and with the events that set them."""
    sides = _Sides(system, switches, sliding)
    jumps = tuple(
        _with_sides_after(jump, sides, system.coordinates[0].symbol) for jump in system.jumps
    )
    events = tuple(
        e if e.then is None else replace(e, then=(*e.then, *sides.after(e.then)))
        for e in system.events
    )
    further = tuple(State(u.func.__name__, u, Role.AUXILIARY) for u in sides.states)
    return replace(
        system,
        states=(*system.states, *further),
        functions=(*system.functions, *sides.states),
        rhs=(*sliding.rates, *[sp.S.Zero] * len(further)),
        initial=(*system.initial, *sides.at_start()),
        origins=(*system.origins, *[None] * len(further)),
        jumps=jumps,
        events=(*events, *sides.crossings()),
        switches=tuple(s.written for s in switches),
    )
