"""What happens at times that depend on parameters: impacts, relays, spikes, doses."""

from __future__ import annotations

import random

import sympy as sp

import rankone as ro
from tests.honesty.cases import Case, kind, number, t, unknown

__all__ = ["events"]

x, v, n = (unknown(name) for name in ("x", "v", "n"))
a, b = sp.symbols("a b")


@kind
def events(draw: random.Random) -> Case:
    """Events that reset states: some graze, some are near either end of time, some coincide."""
    makers = (_bounce, _relay, _spikes, _doses, _threshold)
    name, unknowns, rates, initial, happening, end = draw.choice(makers)(draw)
    width = draw.choice([0.02, 0.1, 0.3])
    box = {
        symbol: (float(middle * (1 - width)), float(middle * (1 + width)))
        for symbol, middle in ((a, number(draw, 0.5, 2)), (b, number(draw, 0.5, 2)))
    }
    rtol = float(sp.Float(10) ** draw.choice([-3, -4, -5]))
    return Case(name, unknowns, rates, initial, box, end, rtol, [], [], events=happening)


def _bounce(draw: random.Random) -> tuple:
    """A ball on a floor that moves, or stands still."""
    floor = draw.choice([0, number(draw, 0.01, 0.1) * sp.sin(number(draw, 1, 5) * b * t)])
    kept, drag = number(draw, 0.3, 0.95), number(draw, 0, 0.3)
    after = -kept * v + (1 + kept) * sp.diff(floor, t)
    hit = ro.Event(x - floor, "falling", then={x: floor, v: after}, name="hit")
    rates = [v, -number(draw, 2, 10) * b - drag * v]
    return "bounce", [x, v], rates, [a, 0], [hit], draw.uniform(0.5, 3)


def _relay(draw: random.Random) -> tuple:
    """A relay with hysteresis."""
    low, gap = number(draw, 0.2, 0.6), number(draw, 0.05, 0.3)
    on = ro.Event(x - low, "falling", then={n: 1}, name="on")
    off = ro.Event(x - low - gap, "rising", then={n: 0}, name="off")
    force = draw.choice([0, number(draw, 0.01, 0.3) * sp.sin(3 * t)])
    rates = [-a * x + 2 * b * n + force, sp.S.Zero]
    return "relay", [x, n], rates, [number(draw, 0, 1), 1], [on, off], draw.uniform(1, 6)


def _spikes(draw: random.Random) -> tuple:
    """Integrate and fire, driven at its own time."""
    level, wave = number(draw, 0.3, 1.2), draw.choice([0, number(draw, 0.1, 1)])
    spike = ro.Event(
        x - level, "rising", then={x: draw.choice([0, x - level, -x / 2])}, name="fire"
    )
    rates = [a - number(draw, 0, 0.8) * x + wave * sp.cos(2 * b * t)]
    return "spikes", [x], rates, [0], [spike], draw.uniform(1, 6)


def _doses(draw: random.Random) -> tuple:
    """Doses at times of parameters, some of which swap or lie at either end."""
    end = draw.uniform(2, 5)
    times = [a, a + b, number(draw, 0.5, 3) * b][: draw.randrange(1, 4)]
    given = [
        ro.Event(t - at, "rising", then={x: x + number(draw, 0.1, 2)}, name=f"dose{k}")
        for k, at in enumerate(times)
    ]
    return "doses", [x], [-number(draw, 0.2, 2) * x * draw.choice([1, x])], [1], given, end


def _threshold(draw: random.Random) -> tuple:
    """An oscillator that is kicked, and stopped, where it reaches levels near its height."""
    level = number(draw, 0.5, 1.02) * draw.choice([a, 1])
    kick = ro.Event(x - level, "rising", then={v: number(draw, -0.9, 1.2) * v}, name="kick")
    stop = ro.Event(x + number(draw, 0.6, 2), "falling", terminal=True, name="stop")
    happening = [kick, stop][: draw.randrange(1, 3)]
    return "threshold", [x, v], [v, -b * x], [0, a], happening, draw.uniform(1, 8)
