"""Jumps at known times: doses, kicks and restarts, also those written as ``DiracDelta`` of time."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import sympy as sp
from sympy.core.function import AppliedUndef

from rankone.problem.box import Time, real_number
from rankone.problem.equations import Symbols, as_expression, check_value
from rankone.problem.expressions.notation import exact, latex_of, text_of
from rankone.problem.forms import Jump
from rankone.problem.functions import Table
from rankone.support.arrays import NEGLIGIBLE
from rankone.support.errors import ProblemError, did_you_mean, listing, quote, shown, warn
from rankone.tensors.coordinates import name_of

Resets = Mapping[float, Mapping[sp.Expr, sp.Expr]]
"""For each time the states that jump, as the user writes them, and their values after it."""
Impulses = dict[float, dict[int, sp.Expr]]
"""For each time what is added to states, by the index of the state."""
MovingImpulses = dict[sp.Expr, dict[int, sp.Expr]]
"""The same for times that depend on parameters."""

_SEVERAL = (tuple, range, frozenset, sp.Tuple)  # Keys that stand for several times
_SWITCHING = (sp.Heaviside, sp.sign, sp.floor, sp.ceiling, sp.Piecewise, sp.Mod)
_REMEDY = "give {time: {unknown: value after it}}, for example {8.0: {x: x + dose}}"
LATE_REMEDY = "remove it, unless `t_final` is to be later"
"""What to do about what happens behind the end of time."""
_AS_JUMPS = "give the values after it as jumps={time: {unknown: value}}"
_ADD_IMPULSE = "an impulse adds to a rate: Eq(x.diff(t), f + dose*DiracDelta(t - 8))"


def check_jumps(jumps: object, symbols: Symbols) -> Resets:
    """Return the jumps by time; a time may be a number or a tuple of numbers.

    A jump before the horizon is an error; one at its end or later is a warning.
    """
    if jumps is None:
        return {}
    if not isinstance(jumps, Mapping):
        raise ProblemError(f"jumps are {shown(jumps)}, not a mapping", term=jumps, remedy=_REMEDY)
    time = symbols.time
    resets: dict[float, dict[sp.Expr, sp.Expr]] = {}
    for key, reset in jumps.items():
        instants = instants_of(key)
        if not instants:
            raise ProblemError("a jump has no times", term=reset, remedy=_REMEDY)
        for instant in instants:
            at = _instant(instant, time)
            if at in resets:
                raise ProblemError(
                    f"there are two jumps at {time[0]} = {at:g}",
                    term=key,
                    remedy="give all that is reset at a time in one mapping",
                )
            after = check_reset(reset, f"the jump at {time[0]} = {at:g}", symbols, _REMEDY)
            resets[at] = {state: _value_at(value, time[0], at) for state, value in after.items()}
    _check_apart(resets, time)
    late = [at for at in sorted(resets) if _is_late(at, time)]
    if late:
        first = f"the jump at {time[0]} = {late[0]:.12g}"
        further = f" and {len(late) - 1} more" if len(late) > 1 else ""
        near = f" by {NEGLIGIBLE:g} of the horizon" if late[0] < time[2] else ""
        warn(
            f"{first}{further}: not before the end of time, {time[2]:.12g}{near}",
            remedy=LATE_REMEDY,
        )
    return {at: resets[at] for at in sorted(resets)}


def instants_of(key: object) -> tuple[Any, ...]:
    """The times that a key of jumps stands for."""
    return tuple(key) if isinstance(key, _SEVERAL) else (key,)


def _instant(instant: object, time: Time) -> float:
    """The time of a jump as a float."""
    at = real_number(instant, "the time of a jump", _REMEDY)
    if at < time[1]:
        raise ProblemError(
            f"the jump at {time[0]} = {at:g} is before the start of time, {time[1]:g}",
            term=instant,
            remedy="give a time inside the horizon",
        )
    return at


def _check_apart(times: Iterable[float], time: Time) -> None:
    """Raise if two jumps are so close that only rounding tells them apart."""
    for a, b in itertools.pairwise(sorted(times)):
        if b - a < NEGLIGIBLE * (time[2] - time[1]):
            raise ProblemError(
                f"the jumps at {time[0]} = {a!r} and {b!r} are too close to each other",
                remedy="make one jump of them",
            )


def check_reset(
    reset: object, subject: str, symbols: Symbols, remedy: str
) -> dict[sp.Expr, sp.Expr]:
    """The states that a jump or an event resets, and their values after it.

    Messages name it as the ``subject``: ``"the jump at t = 8"``.
    """
    states = symbols.states
    if not isinstance(reset, Mapping) or not reset:
        raise ProblemError(
            f"{subject} is {shown(reset)}, not a mapping from unknowns",
            term=reset,
            remedy=remedy,
        )
    after: dict[sp.Expr, sp.Expr] = {}
    for state, written in reset.items():
        if state not in states:
            name = text_of(state) if isinstance(state, sp.Basic) else str(state)
            names = {spelled(s): s for spelled in (text_of, name_of) for s in states}
            hint = did_you_mean(name, names)
            if name in names:
                hint = f" (did you mean {quote(names[name])}?)"
            raise ProblemError(
                f"{subject} resets {shown(state)}, which is not a state{hint}",
                term=state,
                remedy=f"use the states themselves as keys: {listing(states)}",
            )
        value = f"the value of {quote(state)} after {subject}"
        after[state] = check_of_states(
            written,
            value,
            symbols,
            "give an expression of the unknowns before it and of the parameters",
        )
    return after


def check_of_states(written: object, subject: str, symbols: Symbols, remedy: str) -> sp.Expr:
    """An expression of time, states and parameters, with exact numbers."""
    if isinstance(written, str):
        remedy += ", without quotes; Problem.from_strings takes text"
    expression = as_expression(written, subject, remedy)
    subject = f"{subject}, {quote(expression)},"
    expression = symbols.shorthand.put_in(expression)
    strangers = expression.atoms(AppliedUndef, sp.Derivative) - set(symbols.states)
    for stranger in sorted(strangers, key=sp.default_sort_key):
        hint = did_you_mean(str(stranger), map(str, symbols.states))
        message = f"{subject} names {quote(stranger)}, which is not a state{hint}"
        raise ProblemError(message, term=written, remedy=remedy)
    time, *_ = symbols.time
    check_value(expression, subject, symbols, [*symbols.parameters, time], remedy)
    return exact(expression)


def _value_at(expression: sp.Expr, time: sp.Symbol, at: float | sp.Expr) -> sp.Expr:
    """The value at a time; unknowns and their derivatives stay."""
    unknowns = expression.atoms(sp.Derivative) | expression.atoms(AppliedUndef)
    stand_ins = {u: sp.Dummy() for u in unknowns}
    written_back = {dummy: u for u, dummy in stand_ins.items()}
    when = at if isinstance(at, sp.Expr) else exact(sp.Float(at))
    at_time: sp.Expr = expression.xreplace(stand_ins).subs(time, when)
    return at_time.xreplace(written_back)


def system_jumps(
    resets: Mapping[float, Mapping[sp.Expr, sp.Expr]],
    impulses: Mapping[float, Mapping[int, sp.Expr]],
    functions: Mapping[sp.Expr, sp.Expr],
    time: Time,
) -> tuple[Jump, ...]:
    """All jumps by time, in the states of the first-order system.

    ``functions`` maps the states as the user writes them to functions of time.
    """
    for at in sorted(set(resets) & set(impulses)):
        raise ProblemError(
            f"there are both a jump and a DiracDelta at {time[0]} = {at:g}",
            remedy="put the impulse into the jump",
        )
    _check_apart([*resets, *impulses], time)
    states = list(functions.values())
    jumps = []
    for at in sorted([*resets, *impulses]):
        if at in resets:
            after = {functions[u]: v.xreplace(dict(functions)) for u, v in resets[at].items()}
        else:
            after = {states[i]: states[i] + size for i, size in impulses[at].items()}
        jumps.append(Jump(at, tuple(after.get(u, u) for u in states)))
    return tuple(jump for jump in jumps if jump.values != tuple(states))


def at_start(jump: Jump, time: Time) -> bool:
    """Whether a jump is at the start of time, or later by rounding alone."""
    return jump.time - time[1] < NEGLIGIBLE * (time[2] - time[1])


def at_end(jump: Jump, time: Time) -> bool:
    """Whether a jump is at the end of time or later, or earlier by rounding alone."""
    return _is_late(jump.time, time)


def _is_late(at: float, time: Time) -> bool:
    return at >= time[2] - NEGLIGIBLE * (time[2] - time[1])


def jump_latex(states: Sequence[sp.Expr], jumps: Iterable[Jump], time: sp.Symbol) -> Iterator[str]:
    """The same as :func:`jump_texts` as LaTeX, with ``&``."""
    for values_after, times in Jump.kinds(jumps).items():
        at = ", ".join(f"{at:g}" for at in times)
        changes = change_latex(zip(states, values_after, strict=True))
        yield rf"{sp.latex(time)} = {at}:\; & " + r",\; ".join(changes)


def jump_texts(states: Sequence[sp.Expr], jumps: Iterable[Jump], time: str) -> Iterator[str]:
    """Lines such as ``at t = 8, 16: C -> C + D``, one for each kind of jump."""
    for values_after, times in Jump.kinds(jumps).items():
        changes = change_texts(zip(states, values_after, strict=True))
        yield f"at {time} = {', '.join(f'{at:g}' for at in times)}: {', '.join(changes)}"


def change_latex(pairs: Iterable[tuple[sp.Expr, sp.Expr]]) -> list[str]:
    """The same as :func:`change_texts` as LaTeX."""
    return [rf"{latex_of(u)} \to {latex_of(v)}" for u, v in pairs if u != v]


def change_texts(pairs: Iterable[tuple[sp.Expr, sp.Expr]]) -> list[str]:
    """States and their values after a reset as text, as far as they change: ``C -> C + D``."""
    return [f"{text_of(u)} -> {text_of(v)}" for u, v in pairs if u != v]


def without_impulses(
    rates: Sequence[sp.Expr],
    functions: Sequence[sp.Expr],
    origins: Sequence[int | None],
    time: Time,
) -> tuple[tuple[sp.Expr, ...], Impulses]:
    """The rates without their ``DiracDelta`` of time, and what those add to the states.

    An impulse has to be at a known time and to be added to a rate, and nothing that it is
    multiplied by may jump at the same time.
    """
    added: Impulses = {}
    smooth_rates: list[sp.Expr] = []
    for i, (rate, origin) in enumerate(zip(rates, origins, strict=True)):
        smooth, products = _impulses(rate, origin)
        for impulse, factor in products.items():
            when, size = _impulse(impulse, time[0], origin)
            at = _known_instant(impulse, when, time, origin)
            if at < time[1]:
                continue
            _check_steady(factor, impulse, at, time[0], origin)
            sizes = added.setdefault(at, {})
            sizes[i] = sizes.get(i, sp.S.Zero) + size * _value_at(factor, time[0], at)
        smooth_rates.append(smooth)
    for at, sizes in added.items():
        _check_alone(sizes, f"{at:g}", functions, origins, time[0])
    _check_apart(added, time)
    return tuple(smooth_rates), added


def _known_instant(impulse: sp.Expr, when: sp.Expr, time: Time, origin: int | None) -> float:
    """When an impulse is; a warning if that is outside of the horizon."""
    if when.free_symbols:
        listed = listing(sorted(map(str, when.free_symbols)))
        raise _wrong_time(impulse, f"is at a time that depends on {listed}", time[0], origin)
    at = float(when)
    if not math.isfinite(at):
        raise _wrong_time(impulse, "is at no finite time", time[0], origin)
    if at < time[1]:
        warn(
            f"{quote(impulse)} is before the start of time, {time[1]:g}, and does nothing",
            remedy="remove it",
        )
    elif _is_late(at, time):
        warn(f"{quote(impulse)} is not before the end of time, {time[2]:g}", remedy=LATE_REMEDY)
    return at


def moving_impulses(
    rates: Sequence[sp.Expr],
    functions: Sequence[sp.Expr],
    origins: Sequence[int | None],
    time: sp.Symbol,
    parameters: Iterable[sp.Symbol],
) -> tuple[set[sp.DiracDelta], MovingImpulses]:
    """The ``DiracDelta`` of time at times that depend on parameters, and what they add to states.

    They have to be added to rates, and what they are multiplied by may not switch with time.
    """
    deltas: set[sp.DiracDelta] = set()
    added: MovingImpulses = {}
    coordinates = {time, *parameters}
    for i, (rate, origin) in enumerate(zip(rates, origins, strict=True)):
        _, products = _impulses(rate, origin)
        for impulse, factor in products.items():
            if impulse.free_symbols == {time} or not impulse.free_symbols <= coordinates:
                continue
            at, size = _impulse(impulse, time, origin)
            switches = factor.atoms(*_SWITCHING, Table)
            for switch in sorted(switches, key=sp.default_sort_key):
                if time in switch.free_symbols:
                    raise ProblemError(
                        f"{quote(impulse)} is multiplied by {quote(switch)}, which may switch at "
                        "the same time",
                        equation=origin,
                        term=switch,
                        remedy=_AS_JUMPS,
                    )
            deltas.add(impulse)
            sizes = added.setdefault(at, {})
            sizes[i] = sizes.get(i, sp.S.Zero) + size * _value_at(factor, time, at)
    for at, sizes in added.items():
        _check_alone(sizes, str(at), functions, origins, time)
    return deltas, added


def _impulses(rate: sp.Expr, origin: int | None) -> tuple[sp.Expr, dict[sp.DiracDelta, sp.Expr]]:
    """A rate without its impulses, and what each of them is multiplied by."""
    impulses = sorted(rate.atoms(sp.DiracDelta), key=sp.default_sort_key)
    stand_ins = {impulse: sp.Dummy() for impulse in impulses}
    smooth, factors = _split(rate.xreplace(stand_ins), set(stand_ins.values()))
    products = {impulse: factors[stand_in] for impulse, stand_in in stand_ins.items()}
    for impulse, factor in products.items():
        if factor.has(*stand_ins.values()):
            raise ProblemError(
                f"{quote(impulse)} does not enter as a product with what is finite",
                equation=origin,
                term=impulse,
                remedy=_ADD_IMPULSE,
            )
    return smooth, products


def _check_alone(
    sizes: Mapping[int, sp.Expr],
    at: str,
    functions: Sequence[sp.Expr],
    origins: Sequence[int | None],
    time: sp.Symbol,
) -> None:
    """Raise if what is added at one time, by the index of the state, depends on what jumps then."""
    for i, j in itertools.product(sizes, repeat=2):
        if sizes[i].has(functions[j]):
            raise ProblemError(
                f"the impulse at {time} = {at} is multiplied by `{functions[j]}`, which "
                "jumps there itself",
                equation=origins[i],
                term=sizes[i],
                remedy=_AS_JUMPS,
            )


def _split(rate: sp.Expr, impulses: set[sp.Dummy]) -> tuple[sp.Expr, dict[sp.Dummy, sp.Expr]]:
    """A rate without impulses, and what each of them is multiplied by."""
    factors: dict[sp.Dummy, sp.Expr] = dict.fromkeys(impulses, sp.S.Zero)
    smooth = []
    for term in sp.Add.make_args(rate):
        present = sorted(term.free_symbols & impulses, key=sp.default_sort_key)
        smooth.append(term.xreplace(dict.fromkeys(present, sp.S.Zero)) if present else term)
        for impulse in present:
            factors[impulse] += term.diff(impulse)
    return sp.Add(*smooth), factors


def _impulse(
    impulse: sp.DiracDelta, time: sp.Symbol, origin: int | None
) -> tuple[sp.Expr, sp.Expr]:
    """When an impulse is, and its size."""
    argument = impulse.args[0]
    if len(impulse.args) > 1 and impulse.args[1] != 0:
        raise _wrong_time(impulse, "is a derivative of an impulse", time, origin)
    strangers = argument.atoms(AppliedUndef)
    if strangers:
        listed = listing(sorted(map(str, strangers)))
        raise _wrong_time(impulse, f"is at a time that depends on {listed}", time, origin)
    slope = argument.diff(time)
    if slope.has(time) or slope == 0:
        raise _wrong_time(impulse, "is not at one time", time, origin)
    return -argument.subs(time, 0) / slope, 1 / sp.Abs(slope)


def _wrong_time(
    impulse: sp.DiracDelta, message: str, time: sp.Symbol, origin: int | None
) -> ProblemError:
    return ProblemError(
        f"{quote(impulse)} {message}",
        equation=origin,
        term=impulse,
        remedy=f"write DiracDelta({time} - 8) with a number or parameters; what happens at a time "
        "that the solution tells is an Event",
    )


def _check_steady(
    factor: sp.Expr, impulse: sp.Expr, at: float, time: sp.Symbol, origin: int | None
) -> None:
    """Raise if the factor of an impulse switches at the same time."""
    near = NEGLIGIBLE * max(abs(at), 1.0)
    steps = (table for table in factor.atoms(Table) if table.kind == "previous")
    for switch in (*factor.atoms(*_SWITCHING), *steps):
        before, after = (_value_at(switch, time, at + side * near) for side in (-1, 1))
        if not (after - before).is_number or abs(after - before) >= math.sqrt(NEGLIGIBLE):
            raise ProblemError(
                f"{quote(impulse)} is multiplied by {quote(switch)}, which may switch at the same "
                "time",
                equation=origin,
                term=switch,
                remedy=_AS_JUMPS,
            )
