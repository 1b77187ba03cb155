"""What is narrow and lies across: over the states, along several parameters, at moving times."""

from __future__ import annotations

import random

import sympy as sp

import rankone as ro
from tests.honesty.cases import Case, alone, kind, limit, logarithmic, number, t, unknown

__all__ = ["data", "hidden", "moving", "passages", "peaks", "surfaces"]


@kind
def passages(draw: random.Random) -> Case:
    """A narrow place of the rates over the state that every trajectory passes, and slowly."""
    x, k, a = unknown("x"), *sp.symbols("k a")
    width, at = logarithmic(draw, 1e-7, 0.1), number(draw, 0.2, 0.8)
    scale = draw.choice([sp.S.One, sp.S.One, a])
    z = (scale * x - at) / width
    first = -at / width
    match draw.randrange(5):
        case 0:
            name, shape, area = (
                "Gaussian",
                sp.exp(-(z**2)),
                lambda z: sp.sqrt(sp.pi) / 2 * sp.erf(z),
            )
        case 1:
            name, shape, area = "Lorentz", 1 / (1 + z**2), sp.atan
        case 2:
            name, shape, area = "sech", 1 / sp.cosh(z) ** 2, sp.tanh
        case 3:
            name = "pulse"
            shape = sp.Piecewise((1, (scale * x > at) & (scale * x < at + width)), (0, True))
            area = lambda z: sp.Min(1, sp.Max(0, z))  # noqa: E731
        case _:
            name = "hat"
            shape = sp.Max(0, 1 - sp.Abs(z))
            area = lambda z: sp.Piecewise(  # noqa: E731
                (0, z < -1), ((1 + z) ** 2 / 2, z < 0), (1 - (1 - z) ** 2 / 2, z < 1), (1, True)
            )
    height = number(draw, 0.1, 2) / width
    passed = x + height * k * width / scale * (area(z) - area(first))
    return alone(
        f"{name} {width}",
        1 / (1 + height * k * shape),
        x,
        0,
        {k: (0.5, 1.5), a: (0.8, 1.2)} if scale == a else {k: (0.5, 1.5)},
        end=draw.uniform(1.0, 4.0),
        rtol=10.0 ** -draw.uniform(2, 4),
        passed=passed,
    )


@limit
def hidden(draw: random.Random) -> Case:
    """A passage whose narrow place is in a form that tells nobody where: steps pass over it."""
    x, k = unknown("x"), sp.Symbol("k")
    width, at = logarithmic(draw, 1e-7, 1e-4), number(draw, 0.3, 0.8)
    height, start = number(draw, 0.1, 1) / width, number(draw, 0.05, 0.15)

    def share(x: sp.Expr) -> sp.Expr:
        """The part of the narrow place that is behind, where it is as narrow as here."""
        return at * sp.sqrt(sp.pi) / 2 * sp.erf((x / at - 1) / width)

    passed = x - start + height * k * width * (share(x) - share(start))
    rate = 1 / (1 + height * k * sp.exp(-(x / at + at / x - 2) / width**2))
    box = {k: (0.5, 1.5)}
    return alone("hidden", rate, x, start, box, end=2.0, rtol=1e-3, passed=passed)


@kind
def surfaces(draw: random.Random) -> Case:
    """A plane, a ring or a curved surface across two or three parameters."""
    x = unknown("x")
    a, b, c = symbols = sp.symbols("a b c")
    width, middle = logarithmic(draw, 1e-4, 0.2), number(draw, 0.3, 0.7)
    match draw.randrange(5):
        case 0:
            distance, place, half, d = a * b - middle / 2, middle / 2 / b, width / b, 2
        case 1:
            distance, place, half, d = a + b - 2 * middle, 2 * middle - b, width, 2
        case 2:
            square = middle**2 / 4
            root = sp.sqrt(square - (b - 0.5) ** 2)
            distance, place, d = (a - 0.5) ** 2 + (b - 0.5) ** 2 - square, 0.5 + root, 2
            half = width / (2 * root)
        case 3:
            distance, place, half, d = a * b * c - middle / 4, middle / 4 / b / c, width / b / c, 3
        case _:
            distance, place, half, d = a + b - c - middle / 2, middle / 2 + c - b, width, 3
    z = distance / width
    shape = draw.choice([sp.exp(-(z**2)), 1 / (1 + z**2), sp.tanh(z), sp.Max(0, 1 - sp.Abs(z))])
    rate = draw.choice([-x * (1 + shape) + 1, -x + shape, -x + 1 + a * shape * x / 2])
    return alone(
        f"surface {width} of {d}",
        rate,
        x,
        draw.choice([0, 1]),
        dict.fromkeys(symbols[:d], (0.0, 1.0)),
        end=draw.uniform(0.5, 4.0),
        rtol=10.0 ** -draw.uniform(2, 5),
        places=[(a, place, 3 * half)],
    )


@kind
def peaks(draw: random.Random) -> Case:
    """Several narrow peaks, over one parameter each, alone or multiplied."""
    x = unknown("x")
    symbols = sp.symbols("a b c")[: draw.randint(1, 3)]
    places, shapes = [], []
    for _ in range(draw.randint(2, 5)):
        k, at = draw.choice(symbols), number(draw, 0.05, 0.95)
        width = logarithmic(draw, 0.003, 0.05)
        shapes.append(sp.exp(-(((k - at) / width) ** 2)) * number(draw, 0.3, 2))
        places.append((k, at, 3 * width))
    total = sum(shapes) if draw.random() < 0.5 else sum(shapes[2:], shapes[0] * (1 + shapes[1]))
    rest = sum(symbols, start=sp.Integer(1))
    return alone(
        f"{len(shapes)} peaks over {len(symbols)}",
        draw.choice([-x + total + rest, -x * (1 + total) + rest]),
        x,
        0,
        dict.fromkeys(symbols, (0.0, 1.0)),
        end=draw.uniform(0.5, 3.0),
        rtol=10.0 ** -draw.uniform(2, 5),
        places=places,
    )


@kind
def moving(draw: random.Random) -> Case:
    """Pulses and steps at times that depend on a parameter."""
    x, k = unknown("x"), sp.Symbol("k")
    end = float(logarithmic(draw, 1.0, 100.0))
    width = sp.Float(f"{end * 10 ** draw.uniform(-6, -1):.4g}")
    at = k * sp.Float(f"{end * draw.uniform(0.2, 0.6):.4g}")
    z = (t - at) / width
    cuts = [at, at + width]
    match draw.randrange(5):
        case 0:
            shape = sp.Heaviside(t - at) * sp.Heaviside(at + width - t) / width
        case 1:
            shape = sp.Piecewise((1 / width, (t > at) & (t < at + width)), (0, True))
        case 2:
            shape = sp.exp(-(z**2)) / width
            cuts = [at - 5 * width, at, at + 5 * width]
        case 3:
            shape, cuts = sp.Heaviside(t - at) / end, [at]
        case _:
            shape, cuts = sp.Abs(t - at) / end**2, [at]
    return alone(
        f"moving {float(width) / end:.1e}",
        -x / end + shape,
        x,
        1,
        {k: (0.5, 1.5)},
        end=end,
        rtol=10.0 ** -draw.uniform(2, 4),
        cuts=cuts,
    )


@kind
def data(draw: random.Random) -> Case:
    """Tables of the time, of a parameter, or of the unknown, with a peak among the data."""
    x, k = unknown("x"), sp.Symbol("k")
    end = draw.uniform(1.0, 6.0)
    number_of = draw.randint(4, 40)
    values = [draw.uniform(-0.2, 0.2) for _ in range(number_of)]
    values[draw.randrange(number_of)] += draw.choice([1.0, 3.0])
    what = draw.choice(["t", "k", "x"])
    lower, upper = {"t": (0.0, end), "k": (0.0, 1.0), "x": (-20.0, 20.0)}[what]
    points = [lower + (upper - lower) * i / (number_of - 1) for i in range(number_of)]
    table = ro.table(points, values, name="given")
    rate = -x + (1 + k) * table({"t": t, "k": k, "x": x}[what])
    cuts = points if what == "t" else []
    rtol = 10.0 ** -draw.uniform(2, 4)
    return alone(f"table of {what}", rate, x, k, {k: (0.0, 1.0)}, end=end, rtol=rtol, cuts=cuts)
