"""Trajectories of systems that switch, from modes written by hand and SciPy alone.

Each mode has smooth rates of its own and *exits*: a guard that is positive inside the mode, and the
mode that follows where the guard falls through zero. Times at which rates jump by the clock are
cuts of the integration. Nothing of rankone is used.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import scipy.integrate
from numpy.typing import NDArray

__all__ = ["Exit", "Mode", "Reference", "friction", "kinked", "machine"]

Array = NDArray[np.float64]
Reference = Callable[[SimpleNamespace, Array], Array]
"""``reference(p, times)``: the states (n, times) for parameters ``p.name``."""

_RTOL, _ATOL = 1e-11, 1e-12
_STEPS = 300
"""Least number of steps over the horizon."""
_MOST_EXITS = 5_000
_INSET = 1e-13
"""Share of a segment by which its rates are taken inside of its ends."""


@dataclass(frozen=True)
class Exit:
    """Where a mode ends: ``guard(t, u, p)`` falls through zero; ``to(t, u, p)`` is the next mode.

    ``then(t, u, p)`` gives the states right after, if they are reset or set on the surface.
    """

    guard: Callable[..., float]
    to: str | Callable[..., str]
    then: Callable[..., Sequence[float]] | None = None


@dataclass(frozen=True)
class Mode:
    """Smooth rates ``rates(t, u, p)``, and where they end."""

    rates: Callable[..., Sequence[float]]
    exits: tuple[Exit, ...] = ()


def machine(
    modes: Mapping[str, Mode],
    first: str | Callable[..., str],
    start: Callable[[SimpleNamespace], Sequence[float]],
    cuts: Callable[[SimpleNamespace], Sequence[float]] = lambda p: (),
    resets: Mapping[float, Callable[..., Sequence[float]]] | None = None,
    method: str = "DOP853",
) -> Reference:
    """The trajectories of an automaton.

    ``first(t, u, p)`` is the mode at the start and after each cut; a plain name holds at the start
    alone. ``resets`` maps a time, which is a cut, to the states after it, ``reset(u, p)``.
    """
    resets = resets or {}

    def trajectory(p: SimpleNamespace, times: Array) -> Array:
        end = float(times[-1])
        u = np.array(start(p), dtype=float)
        values = np.empty((u.size, times.size))
        inside = {float(c) for c in (*cuts(p), *resets) if 0.0 < c < end}
        name = first if isinstance(first, str) else ""
        for a, b in itertools.pairwise([0.0, *sorted(inside), end]):
            if a in resets:
                u = np.array(resets[a](u, p), dtype=float)
            inset = _INSET * end
            if not isinstance(first, str):
                name = first(a + inset, u, p)
            u, name = _segment(modes, name, u, p, (a, b), inset, method, times, values)
        return values

    return trajectory


def _segment(modes, name, u, p, bounds, inset, method, times, values):
    """Integrate from one cut to the next; the states and the mode there."""
    now, b = bounds
    low, high = now + inset, b - inset
    step = times[-1] / _STEPS
    for _ in range(_MOST_EXITS):
        mode = modes[name]

        def rates(t, u, mode=mode):
            return mode.rates(min(max(t, low), high), u, p)

        guards = []
        for each in mode.exits:

            def guard(t, u, each=each):
                return each.guard(min(max(t, low), high), u, p)

            guard.terminal, guard.direction = True, -1
            guards.append(guard)
        run = scipy.integrate.solve_ivp(
            rates,
            (now, b),
            u,
            method,
            rtol=_RTOL if method != "LSODA" else 1e-10,
            atol=_ATOL,
            max_step=step,
            events=guards or None,
            dense_output=True,
        )
        if run.status < 0:
            raise ArithmeticError(run.message)
        asked = (times >= now) & (times <= run.t[-1])
        if asked.any():
            values[:, asked] = run.sol(times[asked]) if run.t[-1] > now else u[:, None]
        now, u = float(run.t[-1]), run.y[:, -1]
        if run.status == 0:
            return u, name
        left = next(i for i, at in enumerate(run.t_events) if at.size)
        u, exit = run.y_events[left][-1], mode.exits[left]
        name = exit.to if isinstance(exit.to, str) else exit.to(now, u, p)
        if exit.then is not None:
            u = np.array(exit.then(now, u, p), dtype=float)
        if now >= b:
            return u, name
    raise ArithmeticError(f"more than {_MOST_EXITS} exits")


def kinked(
    rates: Callable[..., Sequence[float]],
    start: Callable[[SimpleNamespace], Sequence[float]],
    cuts: Callable[[SimpleNamespace], Sequence[float]] = lambda p: (),
    method: str = "DOP853",
) -> Reference:
    """Trajectories of rates that are continuous between the cuts: short steps at tight rtol."""
    return machine({"": Mode(rates)}, "", start, cuts, method=method)


def friction(
    rates: Callable[..., Sequence[float]],
    surfaces: Sequence[tuple[int, Callable[..., float], Callable[..., float]]],
    start: Callable[[SimpleNamespace], Sequence[float]],
) -> Reference:
    """Trajectories with dry friction, which slips either way or sticks.

    ``rates(t, u, p)`` are those without it. Each surface is the position of a velocity, the speed
    at which it slips, ``speed(u, p)``, and the deceleration by friction, ``limit(u, p)``, which at
    zero speed is also what it takes to break loose.
    """

    def made(signs: tuple[int, ...]) -> Mode:
        def total(t, u, p):
            found = list(rates(t, u, p))
            for sign, (i, _, limit) in zip(signs, surfaces, strict=True):
                found[i] = found[i] - sign * limit(u, p) if sign else 0.0
            return found

        exits = []
        for k, (sign, (i, speed, limit)) in enumerate(zip(signs, surfaces, strict=True)):

            def changed(new: int, k=k) -> str:
                return str((*signs[:k], new, *signs[k + 1 :]))

            if sign:

                def slowed(t, u, p, i=i, limit=limit, changed=changed):
                    return changed(_held(rates(t, u, p)[i], limit(u, p)))

                exits.append(Exit(lambda t, u, p, s=sign, v=speed: s * v(u, p), slowed))
            else:

                def loose(t, u, p, i=i, changed=changed):
                    return changed(int(np.sign(rates(t, u, p)[i])))

                def grip(t, u, p, i=i, limit=limit):
                    return limit(u, p) - abs(rates(t, u, p)[i])

                exits.append(Exit(grip, loose))
        return Mode(total, tuple(exits))

    def first(t, u, p):
        signs = []
        for i, speed, limit in surfaces:
            slip = speed(u, p)
            signs.append(int(np.sign(slip)) or _held(rates(t, u, p)[i], limit(u, p)))
        return str(tuple(signs))

    every = itertools.product((-1, 0, 1), repeat=len(surfaces))
    return machine({str(signs): made(signs) for signs in every}, first, start)


def _held(pull: float, limit: float) -> int:
    """Which way a body at rest begins to slip; 0 if it sticks."""
    return 0 if abs(pull) <= limit else int(np.sign(pull))
