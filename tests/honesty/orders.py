"""Doses, thresholds and slips that come in several orders inside the box."""

from __future__ import annotations

import random

import numpy as np
import sympy as sp

import rankone as ro
from rankone.solvers.branches import order_search
from rankone.solvers.request import SolveArguments, SolveRequest
from rankone.solvers.stretches_by_markers import timed_system
from rankone.support.budget import limited
from tests.honesty.cases import Case, kind, number, t, unknown

__all__ = ["orders", "shares_of_orders"]

x, y, v, w = (unknown(name) for name in ("x", "y", "v", "w"))
a, b, c = sp.symbols("a b c")
_LEAST_SHARE = 0.03  # Of the box, in which a second order holds
_MOST_DRAWS = 100


@kind
def orders(draw: random.Random) -> Case:
    """The order of events, or of slips and sticks, changes inside the box."""
    for _ in range(_MOST_DRAWS):
        case = draw.choice((_doses, _dose_and_threshold, _race, _redosed, _slips, _driven, _stops))(
            draw
        )
        shares = shares_of_orders(case)
        if len(shares) > 1 and sorted(shares)[-2] >= _LEAST_SHARE:
            return case
    raise AssertionError("no case has several orders")


def shares_of_orders(case: Case) -> list[float]:
    """The shares of the box on which each order holds; none where trajectories end early."""
    compiled = ro.compile(case.problem())
    system = compiled._held or compiled.system
    request = SolveRequest.of(system, [], {}, SolveArguments(rtol=1e-3))
    timed, _ = timed_system(system, request.domain)
    try:
        with limited(5e9):
            groups = order_search(timed, request).groups()
    except ro.RankoneError:
        return []
    sizes = np.array([len(places) for places in groups.values()])
    return (sizes / sizes.sum()).tolist()


def _case(draw, name, unknowns, rates, initial, intervals, end, **more) -> Case:
    """A case whose parameters vary around the middles of intervals by some share."""
    box = {}
    for symbol, (lower, upper) in intervals.items():
        box[symbol] = (round(float(lower), 6), round(float(upper), 6))
    initial = [sp.sympify(each) for each in initial]
    return Case(name, unknowns, rates, initial, box, float(end), 1e-4, [], [], **more)


def _around(draw: random.Random, middle: float, least: float, most: float) -> tuple[float, float]:
    """An interval around about a middle, of a half width between two shares of it."""
    middle *= draw.uniform(0.9, 1.1)
    half = middle * draw.uniform(least, most)
    return middle - half, middle + half


def _effect(draw: random.Random, u: sp.Expr) -> sp.Expr:
    """What a dose makes of an unknown."""
    amount = number(draw, 0.3, 1.5)
    return draw.choice([u + amount, u + amount, amount * u, amount, u + amount * c])


def _doses(draw: random.Random) -> Case:
    """Two or three doses into one or two compartments."""
    at = [a, b, number(draw, 1.5, 2.5)][: draw.randint(2, 3)]
    draw.shuffle(at)
    rate = draw.choice([-number(draw, 0.2, 1) * x, -number(draw, 0.3, 2) * x / (x + 1)])
    doses = [
        ro.Event(t - time, "rising", then={x: _effect(draw, x)}, name=f"dose_{k}")
        for k, time in enumerate(at)
    ]
    box = {a: _around(draw, 2, 0.1, 0.4), b: _around(draw, 2, 0.1, 0.4), c: (0.5, 1.0)}
    rates = [rate, number(draw, 0.2, 1) * x - c * y]
    return _case(draw, "doses", [x, y], rates, [1, 0], box, draw.uniform(4, 6), events=doses)


def _dose_and_threshold(draw: random.Random) -> Case:
    """A dose at a time of its own, and what happens where a level is passed."""
    level = number(draw, 0.4, 0.7)
    dose = ro.Event(t - a, "rising", then={x: _effect(draw, x)}, name="dose")
    low = ro.Event(x - level, "falling", then={y: y + 1}, name="low")
    k = number(draw, 0.3, 0.6)
    middle = float(sp.log(1 / level) / k)
    box = {a: _around(draw, middle, 0.2, 0.5), b: (0.8, 1.2), c: (0.5, 1.0)}
    rates = [-k * b * x, -c * y]
    end = middle * draw.uniform(1.8, 3)
    return _case(draw, "threshold", [x, y], rates, [1, 0], box, end, events=[dose, low])


def _race(draw: random.Random) -> Case:
    """Two unknowns of which one or the other passes its level first, and acts on the other."""
    first = ro.Event(x - 1, "rising", then={x: number(draw, 0, 0.5), y: number(draw, 0.7, 1) * y})
    second = ro.Event(y - 1, "rising", then={y: number(draw, 0, 0.4), x: x / number(draw, 1, 2)})
    rates = [a - number(draw, 0.1, 0.4) * x, b - number(draw, 0.1, 0.4) * y]
    box = {a: _around(draw, 1, 0.05, 0.3), b: _around(draw, 1, 0.05, 0.3)}
    return _case(
        draw, "race", [x, y], rates, [0, 0], box, draw.uniform(1, 4), events=[first, second]
    )


def _redosed(draw: random.Random) -> Case:
    """Doses by need, where a level is passed, beside one by the clock."""
    need = ro.Event(x - number(draw, 0.4, 0.8), "falling", then={x: x + b}, name="need")
    dose = ro.Event(t - a, "rising", then={x: x + number(draw, 0.2, 0.8)}, name="dose")
    box = {a: _around(draw, 2, 0.1, 0.5), b: _around(draw, 1, 0.05, 0.2), c: (0.4, 0.6)}
    rates = [-c * x, number(draw, 0.2, 1) * (x - y)]
    return _case(
        draw, "redosed", [x, y], rates, [1, 0], box, draw.uniform(3, 6), events=[need, dose]
    )


def _slips(draw: random.Random) -> Case:
    """A mass on a spring that comes to rest by friction, after more or fewer swings."""
    damping = draw.choice([0, number(draw, 0.02, 0.2)])
    rates = [v, -a * x - damping * v - b * sp.sign(v)]
    box = {
        a: _around(draw, 1, 0.05, 0.2),
        b: _around(draw, 0.3, 0.05, 0.3),
        c: _around(draw, 2, 0.05, 0.3),
    }
    end = draw.uniform(4, 10)
    return _case(draw, "slips", [x, v], rates, [c, 0], box, end, switches=True)


def _driven(draw: random.Random) -> Case:
    """A mass with friction that is driven: it sticks at some turning points, or slips on."""
    frequency = number(draw, 0.4, 1.5)
    rates = [v, a * sp.cos(frequency * t) - x - b * sp.sign(v)]
    box = {a: _around(draw, 1.5, 0.05, 0.2), b: _around(draw, 0.5, 0.05, 0.3)}
    start = [number(draw, -0.5, 0.5), number(draw, 0.3, 1)]
    return _case(draw, "driven", [x, v], rates, start, box, draw.uniform(3, 9), switches=True)


def _stops(draw: random.Random) -> Case:
    """Two blocks on a rough table, each of which comes to rest at its own time."""
    pull = number(draw, 0.1, 0.5)
    rates = [-a * sp.sign(v) - pull * v, -b * sp.sign(w) + number(draw, 0, 0.3) * v]
    box = {
        a: _around(draw, 1, 0.05, 0.3),
        b: _around(draw, 1, 0.05, 0.3),
        c: _around(draw, 1, 0.05, 0.2),
    }
    return _case(draw, "stops", [v, w], rates, [c, 1], box, draw.uniform(1.2, 2.5), switches=True)
