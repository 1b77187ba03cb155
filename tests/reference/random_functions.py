"""Two hundred random functions of one to ten parameters, as solutions, with their distributions.

Every function is ``x = g(T1 + T2 + ...)``: each term depends on one parameter or on two that no
other term has, all parameters are uniform and independent. So the distribution of the sum is a
convolution of distributions of the terms, that of x follows from it piece by piece where g is
monotonic, and Sobol indices are integrals of g over parts of the sum. Sums, products, exponentials,
sigmoids, ridges oblique to the axes, oscillations, bumps, decay and growth all have this form.

The convolutions are numerical: 2^14 cells of the range of the sum, terms from 2^16 midpoints (2048
by 2048 for two parameters). Probabilities are good to TRUTH; ``test_random_functions.py`` compares
with closed forms and with samples.
"""

from __future__ import annotations

import itertools
import random
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from scipy.signal import fftconvolve

from rankone import Problem
from tests.reference.measure import Array

__all__ = [
    "PROBABILITIES",
    "SEED",
    "TRUTH",
    "RandomFunction",
    "Term",
    "random_functions",
    "snippet",
]

SEED = 51
PROBABILITIES = (0.05, 0.25, 0.5, 0.75, 0.95)
TRUTH = 1e-4
"""Error of probabilities and shares of the variance that are stated here."""
_CELLS = 2**14  # Of the range of the sum
_MIDPOINTS, _OF_TWO = 2**16, 2**11  # Of terms of one parameter, and of two
_NODES = 64  # Of Gauss for each parameter of Sobol indices

_NAMES: dict[str, object] = {
    **{name: getattr(np, name) for name in ("exp", "log", "sqrt", "sin", "cos", "tanh")},
    "atan": np.arctan,
}


def _value(text: str, of: Mapping[str, Array]) -> Array:
    return np.asarray(eval(text, {"__builtins__": {}}, {**_NAMES, **of}), dtype=float)


@dataclass(frozen=True)
class Term:
    """A formula of one parameter or of two."""

    text: str
    parameters: tuple[str, ...]

    def __call__(self, *values: Array) -> Array:
        of = dict(zip(self.parameters, values, strict=True))
        return np.broadcast_to(_value(self.text, of), np.broadcast_shapes(*map(np.shape, values)))


@dataclass(frozen=True, eq=False)
class RandomFunction:
    """A function as the value of the unknown ``x`` at the end of short dynamics.

    Attributes
    ----------
    name, family : str
    box : mapping of str to (float, float)
        Parameters that are in no term change nothing.
    terms : tuple of Term
    outer : str
        The function of the sum ``u``.
    rate, start : str
        The right-hand side of x and its initial value; ``{f}`` stands for the function.
    end : float
    scale : float
        The value of x at the end over the function.
    """

    name: str
    family: str
    box: Mapping[str, tuple[float, float]]
    terms: tuple[Term, ...]
    outer: str
    rate: str = "0"
    start: str = "{f}"
    end: float = 1.0
    scale: float = 1.0

    def problem(self) -> Problem:
        """The problem whose solution is x at the end."""
        inner = " + ".join(f"({term.text})" for term in self.terms)
        f = self.outer.replace("u", f"({inner})")
        rate, start = (text.replace("{f}", f"({f})") for text in (self.rate, self.start))
        return Problem.from_strings({"x": rate}, {"x": start}, dict(self.box), (0.0, self.end))

    def __call__(self, points: Mapping[str, Array]) -> Array:
        """The exact value at points."""
        values = (term(*(points[name] for name in term.parameters)) for term in self.terms)
        return self._of(sum(values))

    def _of(self, u: Array) -> Array:
        return self.scale * _value(self.outer, {"u": u})

    def _nodes(self, name: str, count: int) -> Array:
        lower, upper = self.box[name]
        return lower + (upper - lower) * (np.arange(count) + 0.5) / count

    @cached_property
    def _values(self) -> list[Array]:
        """Values of each term, all equally probable."""
        values = []
        for term in self.terms:
            count = _MIDPOINTS if len(term.parameters) == 1 else _OF_TWO
            axes = [self._nodes(name, count) for name in term.parameters]
            values.append(term(*np.meshgrid(*axes, indexing="ij")))
        return values

    @cached_property
    def _ends(self) -> tuple[float, float]:
        """The least and the largest sum; terms are largest inside or at corners of the box."""
        lower = upper = 0.0
        for term, values in zip(self.terms, self._values, strict=True):
            sides = (self.box[name] for name in term.parameters)
            corners = term(*np.meshgrid(*map(np.array, sides), indexing="ij"))
            lower += min(float(values.min()), float(corners.min()))
            upper += max(float(values.max()), float(corners.max()))
        return lower, upper

    @cached_property
    def _shares(self) -> list[tuple[float, Array]]:
        """Of each term the least value, and probabilities from there on, with the mean kept."""
        shares = []
        for values in self._values:
            least = float(values.min())
            at = (values.ravel() - least) / self._step
            cells = at.astype(int)
            over = at - cells
            count = int(cells.max()) + 2
            of_cells = np.bincount(cells, 1.0 - over, count) + np.bincount(cells + 1, over, count)
            shares.append((least, of_cells / values.size))
        return shares

    @cached_property
    def _step(self) -> float:
        return sum(float(np.ptp(values)) for values in self._values) / _CELLS

    def _sum(self, without: int | None = None) -> tuple[Array, Array]:
        """Values of the sum of the terms but one, on the grid, and their probabilities."""
        least, shares = 0.0, np.ones(1)
        for i, (lower, further) in enumerate(self._shares):
            if i != without:
                least += lower
                shares = np.maximum(fftconvolve(shares, further), 0.0)
        return least + self._step * np.arange(shares.size), shares / shares.sum()

    @cached_property
    def _pieces(self) -> list[tuple[Array, Array]]:
        """Values of x and of the distribution of the sum, where x rises or falls with the sum."""
        u, shares = self._sum()
        edges = np.append(u - 0.5 * self._step, u[-1] + 0.5 * self._step)
        cumulative = np.concatenate([[0.0], np.cumsum(shares)])
        edges = np.clip(edges, *self._ends)
        x = self._of(edges)
        turns = np.flatnonzero(np.diff(np.sign(np.diff(x))[np.diff(x) != 0.0]))
        places = np.flatnonzero(np.diff(x) != 0.0)[turns] + 1
        bounds = [0, *places.tolist(), x.size - 1]
        return [(x[a : b + 1], cumulative[a : b + 1]) for a, b in itertools.pairwise(bounds)]

    @property
    def range(self) -> tuple[float, float]:
        """The least and the largest value."""
        ends = [(piece.min(), piece.max()) for piece, _ in self._pieces]
        return float(min(low for low, _ in ends)), float(max(high for _, high in ends))

    @property
    def breaks(self) -> tuple[float, ...]:
        """Where the density has a pole or may jump: turning points of g, ends of one parameter."""
        ends = [float(x[0]) for x, _ in self._pieces[1:]]
        if len(self.terms) == 1 and len(self.terms[0].parameters) == 1:
            ends += [float(self._pieces[0][0][0]), float(self._pieces[-1][0][-1])]
        return tuple(ends)

    def cdf(self, x: Array) -> Array:
        """The probability of values up to x."""
        total = np.zeros(np.shape(x))
        for values, cumulative in self._pieces:
            if values[-1] >= values[0]:
                total = total + np.interp(x, values, cumulative) - cumulative[0]
            else:
                total = total + cumulative[-1] - np.interp(x, values[::-1], cumulative[::-1])
        return np.clip(total, 0.0, 1.0)

    def quantile(self, q: Array) -> Array:
        """Values at probabilities."""
        x = np.unique(np.concatenate([values for values, _ in self._pieces]))
        return np.interp(q, self.cdf(x), x)

    @cached_property
    def moments(self) -> tuple[float, float]:
        """Mean and variance."""
        u, shares = self._sum()
        x = self._of(u)
        mean = float(shares @ x)
        return mean, float(shares @ (x - mean) ** 2)

    @cached_property
    def sobol(self) -> tuple[Array, Array]:
        """First and total indices, a number for each parameter of the box."""
        first, total = np.zeros((2, len(self.box)))
        mean, variance = self.moments
        names = list(self.box)
        roots, weights = np.polynomial.legendre.leggauss(_NODES)
        weights = 0.5 * weights
        for i, term in enumerate(self.terms):
            rest, shares = self._sum(without=i)
            count = max(1, rest.size // 1024)  # fewer cells for the rest: its mean is kept
            padded = np.pad(shares, (0, -rest.size % count)).reshape(-1, count)
            places = np.pad(rest, (0, -rest.size % count), mode="edge").reshape(-1, count)
            sums = padded.sum(axis=1)
            inside = sums > 0.0
            coarse = (padded * places).sum(axis=1)[inside] / sums[inside]
            sums = sums[inside]
            ends = np.array([self.box[name] for name in term.parameters])
            axes = [0.5 * (a + b) + 0.5 * (b - a) * roots for a, b in ends]
            values = term(*np.meshgrid(*axes, indexing="ij"))
            x = self._of(values[..., None] + coarse)
            if len(axes) == 1:
                j = names.index(term.parameters[0])
                first[j] = weights @ (x @ sums - mean) ** 2
                total[j] = variance - sums @ (weights @ x - mean) ** 2
                continue
            for axis, name in enumerate(term.parameters):
                j = names.index(name)
                over = np.moveaxis(x, axis, 0)
                first[j] = weights @ (np.tensordot(over, weights, (1, 0)) @ sums - mean) ** 2
                others = np.tensordot(weights, over, 1)
                total[j] = variance - weights @ ((others - mean) ** 2 @ sums)
        return first / variance, total / variance


_DECAY = float(np.exp(-1.0))
_DYNAMICS = (
    {},
    {"rate": "-x", "scale": _DECAY},
    {"rate": "{f} - x", "start": "0", "scale": 1.0 - _DECAY},
)


def _rounded(draw: random.Random, lower: float, upper: float, digits: int = 4) -> float:
    return round(draw.uniform(lower, upper), digits)


@dataclass
class _Maker:
    """Random functions, family by family, from one generator."""

    draw: random.Random
    made: list[RandomFunction] = field(default_factory=list)

    def box(self, count: int, lower: float, upper: float, width: float) -> dict:
        """Intervals that start between two numbers, up to a width."""
        box = {}
        for i in range(1, count + 1):
            start = _rounded(self.draw, lower, upper)
            box[f"p{i}"] = (start, round(start + _rounded(self.draw, 0.4 * width, width), 4))
        return box

    def linear(
        self, box: Mapping[str, tuple[float, float]], active: int, size: float
    ) -> tuple[Term, ...]:
        """Terms in ``active`` of the parameters, with a sum of about a range."""
        names = sorted(self.draw.sample(list(box), active), key=lambda name: int(name[1:]))
        weights = [self.draw.choice((-1, 1)) * self.draw.uniform(0.3, 1.0) for _ in names]
        spans = [abs(w) * (box[n][1] - box[n][0]) for w, n in zip(weights, names, strict=True)]
        scale = size / float(np.sqrt(np.sum(np.square(spans))))
        return tuple(
            Term(f"{round(scale * w, 4)}*{n}", (n,)) for w, n in zip(weights, names, strict=True)
        )

    def middle(self, box: Mapping[str, tuple[float, float]], terms: tuple[Term, ...]) -> float:
        """The sum at the centre of the box."""
        at = {name: np.array(0.5 * (a + b)) for name, (a, b) in box.items()}
        return sum(float(term(*(at[name] for name in term.parameters))) for term in terms)

    def add(self, family: str, box: Mapping, terms: tuple[Term, ...], outer: str, **more) -> None:
        name = f"{len(self.made) + 1:03d} {family}, {len(box)}"
        self.made.append(RandomFunction(name, family, box, terms, outer, **more))

    def dynamics(self) -> dict:
        return dict(self.draw.choice(_DYNAMICS))

    def of_linear(self, family: str, count: int, outer: Callable[[str], str], size: float) -> None:
        """Functions of a linear one around its value at the centre, in some of ``count``."""
        box = self.box(count, -1.0, 1.0, 2.0)
        terms = self.linear(box, self.draw.randint((count + 1) // 2, count), size)
        shift = round(self.middle(box, terms) + self.draw.uniform(-0.2, 0.2) * size, 4)
        self.add(family, box, terms, outer(f"(u - ({shift}))"), **self.dynamics())


def _ridges() -> Iterator[tuple[int, dict[str, float]]]:
    """Oblique directions among so many parameters: short dual vectors of additive recurrences."""
    yield 5, {"p2": -0.6396, "p3": 1.0}
    yield 5, {"p3": 0.1, "p5": 1.0}
    yield 7, {"p1": 1.0, "p4": -0.2857}
    yield 8, {"p3": 1.0, "p4": 0.4167}
    yield 8, {"p5": 1.0, "p8": -0.5385}
    yield 8, {"p3": 1.0, "p7": 0.2667}
    yield 10, {"p4": 1.0, "p10": -0.0667}
    yield 2, {"p1": 1.0, "p2": -0.7549}


def random_functions(seed: int = SEED) -> list[RandomFunction]:
    """The two hundred functions; another seed gives others of the same families."""
    make = _Maker(random.Random(seed))
    draw = make.draw
    for count, weights in _ridges():
        box = {f"p{i}": (0.0, 1.0) for i in range(1, count + 1)}
        terms = tuple(Term(f"{weight}*{name}", (name,)) for name, weight in weights.items())
        make.add("oblique ridge", box, terms, "u")
    for i in range(12):
        count = draw.randint(3, 10)
        box = {f"p{i}": (0.0, 1.0) for i in range(1, count + 1)}
        terms = make.linear(box, 2 + i % 2, 1.0)
        make.add("oblique ridge", box, terms, "u", **make.dynamics())
    for i in range(30):
        box = make.box(1 + i % 10, -2.0, 2.0, 3.0)
        make.add("sum", box, make.linear(box, len(box), 2.0), "u", **make.dynamics())
    for i in range(25):
        box = make.box(1 + i % 10, 0.3, 1.5, 1.5)
        most = 1.5 * len(box) ** -0.5  # so that the peak takes more than a few cells of the range
        powers = {name: draw.choice((-1, 1)) * _rounded(draw, 0.2 * most, most) for name in box}
        terms = tuple(Term(f"{power}*log({name})", (name,)) for name, power in powers.items())
        make.add("product of powers", box, terms, "exp(u)", **make.dynamics())
    for i in range(30):
        steep = _rounded(draw, 1.0, 3.0)
        outers = (
            lambda s: f"exp({s})",
            lambda s, steep=steep: f"tanh({steep}*{s})",
            lambda s, steep=steep: f"1/(1 + exp(-{steep}*{s}))",
            lambda s: f"atan(2*{s})",
            lambda s: f"sqrt(3 + {s})",
        )
        make.of_linear("monotonic in a sum", 1 + i % 10, outers[i % 5], 1.0)
    for i in range(25):
        turns = _rounded(draw, 3.0, 9.0)
        make.of_linear("oscillating", 1 + i % 10, lambda s, w=turns: f"sin({w}*{s})", 1.0)
    for i in range(20):
        narrow = _rounded(draw, 2.0, 8.0)
        outers = (
            lambda s, a=narrow: f"exp(-{a}*{s}**2)",
            lambda s, a=narrow: f"1/(1 + {a}*{s}**2)",
        )
        make.of_linear("bump", 1 + i % 8, outers[i % 2], 1.0)
    for i in range(30):
        _add_dynamics(make, i)
    for i in range(20):
        _add_pairs(make, i)
    return make.made


def _add_dynamics(make: _Maker, i: int) -> None:
    """Decay, decay of second order, and logistic growth, each with sums of rates."""
    draw, count = make.draw, 2 + i % 9
    box = make.box(count, 0.4, 0.8, 0.8)
    rates = [f"p{j}" for j in range(1, count)]
    last, end = f"p{count}", _rounded(draw, 0.5, 2.0)
    weights = {name: _rounded(draw, 0.3, 1.0) for name in rates}
    rate = " + ".join(f"{w}*{name}" for name, w in weights.items())
    sign = {0: -1, 1: 1, 2: 1}[i % 3]
    terms = [Term(f"{round(sign * w * end, 10)}*{n}", (n,)) for n, w in weights.items()]
    match i % 3:
        case 0:
            terms.append(Term(f"log({last})", (last,)))
            make.add("decay", box, tuple(terms), "exp(u)", rate=f"-({rate})*x", start=last, end=end)
        case 1:
            terms.append(Term(f"1/{last}", (last,)))
            make.add(
                "decay of second order",
                box,
                tuple(terms),
                "1/u",
                rate=f"-({rate})*x**2",
                start=last,
                end=end,
            )
        case _:
            box[last] = (0.05, round(0.05 + _rounded(draw, 0.1, 0.4), 4))
            terms.append(Term(f"log({last}/(1 - {last}))", (last,)))
            make.add(
                "logistic growth",
                box,
                tuple(terms),
                "1/(1 + exp(-u))",
                rate=f"({rate})*x*(1 - x)",
                start=last,
                end=end,
            )


def _add_pairs(make: _Maker, i: int) -> None:
    """Terms of two parameters that interact, beside linear ones."""
    draw, count = make.draw, 2 + i % 7
    box = make.box(count, 0.3, 1.0, 1.2)
    a, b = "p1", "p2"
    c = _rounded(draw, 0.5, 1.5)
    pairs = (
        f"{c}*{a}*{b}",
        f"{a}/({c} + {b})",
        f"exp(-{c}*{a}*{b})",
        f"sqrt({a}**2 + {c}*{b}**2)",
        f"{a}**{b}",
    )
    terms = [Term(pairs[i % 5], (a, b))]
    if count >= 5 and i % 2:
        terms.append(Term("p3*exp(-p4)", ("p3", "p4")))
    used = {name for term in terms for name in term.parameters}
    rest = {name: interval for name, interval in box.items() if name not in used}
    if rest:
        terms += make.linear(rest, len(rest), 0.8)
    outer = ("u", "exp(-u)", "u")[i % 3]
    make.add("interaction", box, tuple(terms), outer, **make.dynamics())


def snippet() -> RandomFunction:
    """Exponential decay with two parameters; what is asked for is the density at 2."""
    terms = (Term("-2.0*k", ("k",)), Term("log(u0)", ("u0",)))
    box = {"k": (0.5, 1.0), "u0": (0.9, 1.1)}
    return RandomFunction(
        "000 decay of the guide, 2", "decay", box, terms, "exp(u)", "-k*x", "u0", 2.0
    )
