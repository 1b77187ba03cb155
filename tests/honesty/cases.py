"""Random and hostile systems: a case is made from its kind and a seed, and from nothing else."""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import dataclass, field

import sympy as sp

import rankone as ro

__all__ = [
    "KINDS",
    "LIMITS",
    "Case",
    "alone",
    "case",
    "kind",
    "limit",
    "logarithmic",
    "number",
    "t",
    "unknown",
]

t = sp.Symbol("t")
KINDS: dict[str, Callable[[random.Random], Case]] = {}
"""Makers of the cases of each kind."""
LIMITS: dict[str, Callable[[random.Random], Case]] = {}
"""The same of known limits, docs/limits.md: wrong successes among them are reported apart."""


@dataclass(frozen=True)
class Case:
    """A system, what is asked, and where the truth must not be stepped over.

    Attributes
    ----------
    rates : list of Expr
        Right-hand sides in the unknowns.
    cuts : list of Expr
        Times at which the right-hand side switches, perhaps functions of the parameters.
    places : list of (Symbol, Expr, Expr)
        Places of a parameter at which something narrow is, and its half width, perhaps functions
        of the other parameters: a third of the points at which the truth is looked at lie there.
    passed : Expr, optional
        The time at which the only unknown has a value, as a function of it, where that is known.
    jumps : dict
        For some times the unknowns that are reset, and their values.
    switches : bool
        Whether rates switch over the unknowns, so that the truth takes narrow steps instead.
    events : list of Event
        The truth is that of single trajectories then, beside the times of events.
    """

    name: str
    unknowns: list[sp.Expr]
    rates: list[sp.Expr]
    initial: list[sp.Expr]
    box: dict[sp.Symbol, tuple[float, float]]
    end: float
    rtol: float
    cuts: list[sp.Expr]
    places: list[tuple[sp.Symbol, sp.Expr, sp.Expr]]
    passed: sp.Expr | None = None
    jumps: dict[float, dict[sp.Expr, sp.Expr]] = field(default_factory=dict)
    events: list[ro.Event] = field(default_factory=list)
    switches: bool = False

    def problem(self) -> ro.Problem:
        """As a user writes it."""
        return ro.Problem(
            [sp.Eq(u.diff(t), rate) for u, rate in zip(self.unknowns, self.rates, strict=True)],
            (t, 0, self.end),
            self.box,
            dict(zip(self.unknowns, self.initial, strict=True)),
            jumps=self.jumps,
            events=self.events,
        )


_SEED_WORDS = {"surfaces": "ridges"}  # Words that keep the cases of kinds that were renamed


def case(kind: str, seed: int) -> Case:
    """The case of a kind with a seed."""
    return {**KINDS, **LIMITS}[kind](random.Random(f"{_SEED_WORDS.get(kind, kind)} {seed}"))


def kind(make: Callable[[random.Random], Case]) -> Callable[[random.Random], Case]:
    """Register a maker of cases under its name."""
    KINDS[make.__name__] = make
    return make


def limit(make: Callable[[random.Random], Case]) -> Callable[[random.Random], Case]:
    """Register a maker of cases that are a known limit."""
    LIMITS[make.__name__] = make
    return make


def number(draw: random.Random, lower: float, upper: float) -> sp.Float:
    """A number of an interval, of four digits."""
    return sp.Float(f"{draw.uniform(lower, upper):.4g}")


def logarithmic(draw: random.Random, lower: float, upper: float) -> sp.Float:
    """The same, drawn on a logarithmic scale."""
    return sp.Float(f"{lower * (upper / lower) ** draw.random():.4g}")


def alone(name: str, rate: sp.Expr, x: sp.Expr, start: sp.Expr, box: dict, **more: object) -> Case:
    """A case with one unknown."""
    given = {"cuts": [], "places": [], **more}
    return Case(name, [x], [rate], [sp.sympify(start)], box, **given)  # type: ignore[arg-type]


def unknown(name: str) -> sp.Expr:
    """A function of time."""
    return sp.Function(name)(t)


# -- switches in time --------------------------------------------------------------------------


def _pulse(draw: random.Random, end: float, width: float) -> tuple[sp.Expr, list[float], str]:
    """A pulse of unit area in one of several notations, its edges, and the notation."""
    first = sp.Float(f"{draw.uniform(0.05, 0.9) * end:.5g}")
    last = sp.Float(first + width, 17)
    length = sp.Float(float(last) - float(first))
    notation = draw.choice(["Heaviside", "Piecewise", "sign"])
    match notation:
        case "Heaviside":
            shape = sp.Heaviside(t - first) * sp.Heaviside(last - t)
        case "Piecewise":
            shape = sp.Piecewise((1, (t > first) & (t < last)), (0, True))
        case _:
            shape = (sp.sign(t - first) - sp.sign(t - last)) / 2
    return shape / length, [float(first), float(last)], notation


@kind
def pulses(draw: random.Random) -> Case:
    """A short pulse of weight comparable to the rest: width 1e-3 to 1e-7 of the horizon."""
    x, k = unknown("x"), sp.Symbol("k")
    end = float(logarithmic(draw, 1.0, 200.0))
    share = 10 ** draw.uniform(-7, -3)
    shape, cuts, notation = _pulse(draw, end, share * end)
    rate = -draw.choice([k, sp.Integer(1)]) * x * number(draw, 1, 5) / end
    rate += draw.choice([k, sp.Integer(3)]) * shape
    name = f"pulse {share:.0e} {notation}"
    box = {k: (1.0, 2.0)}
    return alone(name, rate, x, 5 * k, box, end=end, rtol=10.0 ** -draw.randint(3, 6), cuts=cuts)


# -- features of one parameter -----------------------------------------------------------------


def _feature(draw: random.Random, k: sp.Symbol, width: float) -> tuple[sp.Expr, float, str]:
    """A narrow function of one parameter in (0, 1), its place, and its name."""
    place = number(draw, 0.02, 0.98)
    w = sp.Float(f"{width:.4g}")
    name = draw.choice(["Gaussian", "Lorentz", "tanh", "abs"])
    match name:
        case "Gaussian":
            shape = sp.exp(-(((k - place) / w) ** 2))
        case "Lorentz":
            shape = 1 / (1 + ((k - place) / w) ** 2)
        case "tanh":
            shape = sp.tanh((k - place) / w)
        case _:
            shape = sp.Abs(k - place) * draw.choice([1, 3])
    return shape, float(place), name


@kind
def features(draw: random.Random) -> Case:
    """A peak, a layer or a kink over one of up to four parameters: 0.25 to 10 % of its interval."""
    x = unknown("x")
    symbols = sp.symbols("k a b c")[: draw.randint(1, 4)]
    width = float(logarithmic(draw, 0.0025, 0.1))
    shape, place, name = _feature(draw, symbols[0], width)
    rest = sum((number(draw, 0.2, 0.6) * s for s in symbols[1:]), start=sp.Integer(1))
    where = draw.randrange(3)
    rate = -x * (1 + shape) + rest if where == 0 else -x + shape + rest
    rate = -x * rest + shape if where == 2 else rate
    return alone(
        f"{name} {100 * width:.2g} % of {len(symbols)}",
        rate,
        x,
        draw.choice([0, 1]),
        dict.fromkeys(symbols, (0.0, 1.0)),
        end=draw.uniform(0.5, 3.0),
        rtol=10.0 ** -draw.randint(2, 6),
        places=[(symbols[0], place, 3 * width)],
    )


# -- systems of all sorts ----------------------------------------------------------------------


def _time_factor(draw: random.Random, end: float) -> tuple[sp.Expr, list[float]]:
    at = number(draw, 0.1 * end, 0.9 * end)
    match draw.randrange(8):
        case 0:
            return sp.sin(number(draw, 0.5, 12) * t + number(draw, 0, 3)), []
        case 1:
            return sp.exp(-number(draw, 0.1, 2) * t), []
        case 2:
            return sp.Heaviside(t - at), [float(at)]
        case 3:
            return sp.Abs(t - at), [float(at)]
        case 4:
            later = sp.Float(f"{draw.uniform(float(at), end):.4g}")
            values = [(1, t < at), (number(draw, -1, 2), t < later), (0, True)]
            return sp.Piecewise(*values), [float(at), float(later)]
        case 5:
            shape, cuts, _ = _pulse(draw, end, end * 10 ** draw.uniform(-7, -1.5))
            return shape, cuts
        case 6:
            width = sp.Float(f"{end * 10 ** draw.uniform(-3, -1):.3g}")
            return sp.exp(-(((t - at) / width) ** 2)), [float(at)]
        case _:
            return sp.S.One, []


def _parameter_factor(
    draw: random.Random, k: sp.Symbol, interval: tuple[float, float]
) -> tuple[sp.Expr, list[tuple[sp.Symbol, float, float]]]:
    lower, upper = interval
    unit = (k - lower) / (upper - lower)
    at = number(draw, 0.1, 0.9)
    width = 10 ** draw.uniform(-2.5, -0.5)
    w = sp.Float(f"{width:.3g}")
    place = [(k, lower + float(at) * (upper - lower), 3 * width * (upper - lower))]
    match draw.randrange(8):
        case 0:
            return sp.exp(-unit), []
        case 1:
            return 1 / (1 + unit), []
        case 2:
            return sp.sqrt(unit + number(draw, 0.01, 1)), []
        case 3:
            return sp.Abs(unit - at), place
        case 4:
            return sp.exp(-(((unit - at) / w) ** 2)), place
        case 5:
            return sp.tanh((unit - at) / w), place
        case _:
            return k, []


@kind
def systems(draw: random.Random) -> Case:
    """One to six states, one to six parameters, degree up to four, factors of all sorts."""
    count, d = draw.randint(1, 6), draw.randint(1, 6)
    unknowns = [unknown(f"u{i}") for i in range(count)]
    symbols = sp.symbols(f"p0:{d}")
    box = {}
    for symbol in symbols:
        middle = draw.uniform(0.5, 2.0)
        wide = middle * draw.choice([1e-3, 0.1, 0.4, 0.9])
        box[symbol] = (round(middle - wide, 6), round(middle + wide, 6))
    end = float(logarithmic(draw, 0.3, 10.0))
    cuts: list[float] = []
    places: list[tuple[sp.Symbol, float, float]] = []
    rates = [-number(draw, 0.3, 2) * u for u in unknowns]
    size = 1.0 / count
    for _ in range(draw.randint(1, 2 * count)):
        i = draw.randrange(count)
        monomial = sp.Mul(*(draw.choice(unknowns) for _ in range(draw.randint(0, 4))))
        factor, more = _time_factor(draw, end) if draw.random() < 0.4 else (sp.S.One, [])
        cuts += more
        for symbol in draw.sample(symbols, min(d, draw.randint(0, 2))):
            known, where = _parameter_factor(draw, symbol, box[symbol])
            factor *= known
            places += where
        rates[i] += number(draw, -size, size) * factor * monomial
    used = set().union(*(rate.free_symbols for rate in rates))
    initial = [number(draw, 0.2, 1.5) for _ in unknowns]
    for symbol in symbols:
        if symbol not in used:
            initial[draw.randrange(count)] *= symbol
    used |= set().union(*(sp.sympify(value).free_symbols for value in initial))
    box = {symbol: interval for symbol, interval in box.items() if symbol in used} or box
    where = [place for place in places if place[0] in box]
    rtol = 10.0 ** -draw.uniform(2, 6)
    name = f"{count} states, {len(box)} parameters"
    return Case(name, unknowns, rates, initial, box, end, rtol, sorted(cuts), where)


@kind
def steep(draw: random.Random) -> Case:
    """Bistable equations, thresholds, corners that blow up, and rates over decades."""
    x, y = unknown("x"), unknown("y")
    k, a, b, c = sp.symbols("k a b c")
    rtol = 10.0 ** -draw.uniform(2, 5)
    sides = {k: (-draw.uniform(0.2, 1.0), draw.uniform(0.2, 1.0))}
    more = dict.fromkeys((a, b, c), (0.0, 1.0))
    end = draw.uniform(1.0, 8.0)
    match draw.randrange(8):
        case 0:
            return alone("bistable", x - x**3, x, k, sides, end=end, rtol=rtol)
        case 1:
            wide = draw.uniform(0.02, 0.3)
            box = {**sides, a: (-wide, wide)}
            return alone("bistable, shifted", x - x**3 + a, x, k, box, end=end, rtol=rtol)
        case 2:
            start = a + b + c - number(draw, 0.5, 2.5)
            return alone("bistable, sum", x - x**3, x, start, more, end=end, rtol=rtol)
        case 3:
            start = a * b * c * number(draw, 0.5, 1.3)
            return alone("blow-up in a corner", x**2 - x, x, start, more, end=end, rtol=rtol)
        case 4:
            steepness = logarithmic(draw, 5, 500)
            rate = -x + sp.tanh(steepness * (a + b - number(draw, 0.2, 1.8)))
            return alone("front of a sum", rate, x, 0, {a: (0, 1), b: (0, 1)}, end=end, rtol=rtol)
        case 5:
            power, factor = draw.randint(2, 8), logarithmic(draw, 5, 300)
            rate = -x * (1 + factor * (a * b * c) ** power) + 1
            return alone("product of powers", rate, x, 1, more, end=end, rtol=rtol)
        case 6:
            box = {k: (1.0, float(logarithmic(draw, 10, 300))), a: (0.5, 1.5)}
            rate = -k * (x - sp.cos(a * t))
            return alone("rates over decades", rate, x, 0, box, end=end, rtol=rtol)
        case _:
            rates = [-k * x * y, k * x * y - a * y]
            box = {k: (0.5, 6.0), a: (0.5, 1.5), b: (1e-4, 1e-2)}
            return Case("epidemic", [x, y], rates, [1 - b, b], box, end * 3, rtol, [], [])


@kind
def products(draw: random.Random) -> Case:
    """Products of three to six parameters, large in a corner of the box that few points see."""
    x, y = unknown("x"), unknown("y")
    symbols = sp.symbols("a b c d e f")[: draw.randint(3, 6)]
    sides = [draw.choice([s, s, 1 - s]) for s in symbols]
    product = sp.Mul(*sides) ** draw.choice([1, 1, 2, 4])
    strength, box = logarithmic(draw, 1, 100), dict.fromkeys(symbols, (0.0, 1.0))
    end, rtol = draw.uniform(0.5, 3), 10.0 ** -draw.uniform(2, 6)
    match draw.randrange(6):
        case 0:
            rate = -strength * product * x
        case 1:
            rate = -strength * product * (x - sp.cos(number(draw, 1, 5) * t))
        case 2:
            rate = strength * product - x**3
        case 3:
            rate = -x + 1 + strength * sp.Max(0, sum(sides) - number(draw, 0.6, 0.95) * len(sides))
        case 4:
            rates = [y, -(1 + strength * product) * x]
            return Case("oscillator", [x, y], rates, [1, sp.S.Zero], box, end, rtol, [], [])
        case _:
            rate = number(draw, 0.1, 1.5) * product * (x**2 + symbols[0]) / end
    return alone(f"product of {len(symbols)}", rate, x, 1, box, end=end, rtol=rtol)


@kind
def general(draw: random.Random) -> Case:
    """Rates that do not separate, with what is narrow, kinked or steep inside."""
    x = unknown("x")
    symbols = sp.symbols("a b c")[: draw.randint(1, 3)]
    total = sum(symbols, start=sp.Integer(0))
    at = number(draw, 0.2, 0.8) * len(symbols)
    width = logarithmic(draw, 0.01, 0.5)
    rate = draw.choice(
        [
            -x + sp.Max(0, total - at),
            -x * (1 + total) + sp.exp(-(((total - at) / width) ** 2)),
            -x / (width + sp.Abs(x)) + total,
            -sp.sin(x * (1 + total)) + number(draw, 0.1, 0.9),
            -x + sp.tanh((total * x - at) / width),
            -sp.Abs(x - at) * total + sp.cos(t * (1 + total)),
            -x + sp.Piecewise((1, x < at), (total, True)),
            sp.sqrt(1 + x**2) * (at - total) - x,
            -x + 1 / (1 + ((sp.Mul(*symbols) - at / 2) / width) ** 2),
        ]
    )
    return alone(
        "general",
        rate,
        x,
        number(draw, 0.1, 1),
        dict.fromkeys(symbols, (0.0, 1.0)),
        end=draw.uniform(0.5, 6),
        rtol=10.0 ** -draw.uniform(2, 5),
    )


@kind
def doses(draw: random.Random) -> Case:
    """Jumps of one or two unknowns: doses, resets, functions of the unknowns, narrow ones."""
    x, y = unknown("x"), unknown("y")
    k, d = sp.symbols("k d")
    box = {k: (0.5, 1.5), d: (0.2, 1.2)}
    end = float(logarithmic(draw, 0.5, 20.0))
    coupling = number(draw, -0.5, 0.5)
    rates = draw.choice(
        [
            [-k * x + coupling * y, -y + x / 2],
            [-k * x / (1 + x**2) + coupling * y, -y],
            [y, -k * sp.sin(x) - y / 5],
        ]
    )
    places: list[tuple[sp.Symbol, sp.Expr, sp.Expr]] = []
    jumps: dict[float, dict[sp.Expr, sp.Expr]] = {}
    for _ in range(draw.randint(1, 6)):
        at = round(draw.uniform(0.02, 0.98) * end, 4)
        size = number(draw, 0.3, 1.5)
        width = float(logarithmic(draw, 1e-4, 0.05))
        where = draw.uniform(0.25, 1.15)
        bump = sp.exp(-(((d - where) / width) ** 2))
        window = sp.Piecewise((1, (d > where) & (d < where + width)), (0, True))
        narrow = draw.random() < 0.35
        value = draw.choice(
            [x + d * bump, x + size * window, size * bump]
            if narrow
            else [
                x + d,
                x + size * d / k,
                size,
                size * x,
                x + d * y,
                x**2 / 2 + d / (k + d),
                sp.Max(x, d),
                sp.Abs(x - size),
                x * sp.exp(-x / size),
                sp.sqrt(x**2 + d),
                x + sp.Heaviside(x - size) * (x - size),
            ]
        )
        places += [(d, sp.Float(where), sp.Float(1.5 * width))] if narrow else []
        jumps[at] = {x: value}
        if draw.random() < 0.3:
            jumps[at][y] = draw.choice([x, y + d, y / 2 - x])
    rtol = 10.0 ** -draw.uniform(2, 6)
    name = f"{len(jumps)} jumps"
    start = [number(draw, 0.0, 1.0), d]
    return Case(name, [x, y], rates, start, box, end, rtol, [], places, jumps=jumps)
