"""Networks whose rates switch over the unknowns, some of which slide along a surface."""

from __future__ import annotations

import random
from collections.abc import Callable

import sympy as sp

import rankone as ro
from tests.honesty.cases import Case, kind, number, t, unknown

__all__ = ["levels", "switches"]

Term = tuple[str, sp.Expr]


@kind
def switches(draw: random.Random) -> Case:
    """Two to five states, two to four parameters, and one or two terms that switch."""
    return _network(draw, _switching)


@kind
def levels(draw: random.Random) -> Case:
    """The same with staircases and tables of the unknowns, which switch at many levels."""
    return _network(draw, _levelled)


def _network(draw: random.Random, term_of: Callable[[random.Random, list[sp.Expr]], Term]) -> Case:
    count, d = draw.randint(2, 5), draw.randint(2, 4)
    unknowns = [unknown(f"x{i}") for i in range(count)]
    symbols = sp.symbols("a b c d")[:d]
    width = draw.choice([0.05, 0.15, 0.3])
    box = {}
    for symbol in symbols:
        middle = draw.uniform(0.5, 2.0)
        box[symbol] = (round(middle * (1 - width), 6), round(middle * (1 + width), 6))
    end = draw.uniform(2.0, 10.0)
    rates = [-number(draw, 0.3, 1.5) * u for u in unknowns]
    for i in range(count):  # a ring, driven in one place
        rates[i] += number(draw, -1, 1) * unknowns[i - 1]
    rates[0] += symbols[0] * sp.cos(number(draw, 0.5, 2) * t + number(draw, 0, 3))
    rates[draw.randrange(count)] += symbols[-1] * number(draw, 0.2, 1)
    names = []
    for _ in range(draw.randint(1, 2)):
        name, term = term_of(draw, unknowns)
        names.append(name)
        rates[draw.randrange(count)] += draw.choice([1, -1, *symbols]) * term
    initial = [number(draw, -1, 1) for _ in unknowns]
    initial[-1] *= draw.choice(symbols)
    rtol = 10.0 ** -draw.choice([3, 4])
    return Case(" ".join(names), unknowns, rates, initial, box, end, rtol, [], [], switches=True)


def _switching(draw: random.Random, unknowns: list[sp.Expr]) -> Term:
    """A term that switches, and its name."""
    x, y = draw.sample(unknowns, 2)
    level = number(draw, -0.5, 0.8)
    terms = {
        "Max": sp.Max(0, x - level),
        "Abs": sp.Abs(x - y),
        "Heaviside": number(draw, 0.3, 1) * sp.Heaviside(x - level),
        "sign": number(draw, 0.2, 0.6) * sp.sign(x),
        "Piecewise": sp.Piecewise((x - level, x > level), (y / 2, True)),
        "clip": sp.Min(level + 1, sp.Max(level, x)),
    }
    return draw.choice(list(terms.items()))


def _levelled(draw: random.Random, unknowns: list[sp.Expr]) -> Term:
    """A term with many levels, and its name."""
    x = draw.choice(unknowns)
    argument, height = number(draw, 0.5, 2.5) * x + number(draw, -0.5, 0.5), number(draw, 0.1, 0.5)
    inner = sorted({round(draw.uniform(-2, 2), 3) for _ in range(draw.randint(2, 9))})
    points = [-50, *inner, 50]
    heights = [round(draw.uniform(-1, 1), 3) for _ in points]
    terms = {
        "floor": height * sp.floor(argument),
        "ceiling": height * sp.ceiling(argument),
        "frac": height * sp.frac(argument),
        "Mod": sp.Mod(argument, height + sp.Rational(1, 5)),
        "lines": ro.table(points, heights)(argument),
        "steps": ro.table(points, heights, "previous")(argument) / 2,
    }
    return draw.choice(list(terms.items()))
