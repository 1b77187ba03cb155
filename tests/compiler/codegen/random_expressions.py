"""Random expressions as people write them, in kelvin, pascal and years, with exact values.

A template has symbols for its variables and for its numbers, so that the condition with respect
to both is known from mpmath alone.
"""

from __future__ import annotations

import random
from dataclasses import dataclass

import mpmath
import sympy as sp

__all__ = ["Sample", "sample"]

DIGITS = 400
_SMALLEST = mpmath.mpf(10) ** -150
"""What is smaller has squares that are not floating-point numbers."""
_STEP = mpmath.mpf(10) ** -40


@dataclass(frozen=True)
class Sample:
    """An expression of variables, and where they are.

    Attributes
    ----------
    template : Expr
        In the symbols of variables and numbers.
    numbers : dict of Symbol to float
    ranges : dict of Symbol to (float, float)
        For each variable.
    """

    template: sp.Expr
    numbers: dict[sp.Symbol, float]
    ranges: dict[sp.Symbol, tuple[float, float]]

    def expression(self, *, exact: bool) -> sp.Expr:
        """With decimal numbers, or with the fractions that they are."""
        kind = (lambda c: sp.Rational(repr(c))) if exact else sp.Float
        return self.template.xreplace({s: kind(c) for s, c in self.numbers.items()})

    def value(self, point: dict[sp.Symbol, float], *wanted: sp.Symbol) -> tuple:
        """Value and condition of the expression, or of its derivative, at a point."""
        target = self.template.diff(*wanted) if wanted else self.template
        target = target.replace(sp.DiracDelta, lambda *_: sp.S.Zero)  # no point is on a switch
        names = [*point, *self.numbers]
        with mpmath.workdps(DIGITS):
            function = sp.lambdify(names, target, "mpmath")
            at = [mpmath.mpf(v) for v in point.values()]
            at += [mpmath.mpf(repr(c)) for c in self.numbers.values()]
            value = mpmath.mpf(function(*at))
            if abs(value) < _SMALLEST:
                return value, mpmath.inf
            condition = mpmath.mpf(1)
            for i in range(len(at)):
                moved = list(at)
                moved[i] *= 1 + _STEP
                condition += abs(function(*moved) - value) / (_STEP * abs(value))
        return value, condition


def sample(seed: int) -> Sample:
    """The random expression of a seed, with two variables x and y."""
    return _Drawn(seed).sample()


class _Drawn:
    def __init__(self, seed: int) -> None:
        self.draw = random.Random(f"expression {seed}")
        self.numbers: dict[sp.Symbol, float] = {}
        self.variables = [sp.Symbol("x", real=True), sp.Symbol("y", real=True)]
        self.offsets = {v: self.logarithmic(1e-3, 1e6) for v in self.variables}
        self.slopes = {
            v: min(self.logarithmic(1e-3, 1e6), 3.0 * offset) for v, offset in self.offsets.items()
        }

    def sample(self) -> Sample:
        draw = self.draw
        first, second, third = (self.function() for _ in range(3))
        template = draw.choice(
            [
                first,
                first * second,
                first * second + self.number() * third,
                self.number() * first - second / (self.number() + third**2),
                sp.exp(-self.number() * first) * second,
                first / (1 + second**2),
            ]
        )
        ranges = {}
        for v, offset in self.offsets.items():
            reach = draw.choice([1.0, 30.0, 1000.0]) * self.slopes[v]
            ranges[v] = max(offset - reach, 0.1 * offset), offset + min(reach, 3.0 * offset)
        return Sample(template, self.numbers, ranges)

    def logarithmic(self, lower: float, upper: float) -> float:
        value = lower * (upper / lower) ** self.draw.random()
        return float(f"{value:.{self.draw.choice([2, 4, 7])}g}")

    def number(self, value: float | None = None) -> sp.Symbol:
        symbol = sp.Symbol(f"c{len(self.numbers)}", positive=True)
        self.numbers[symbol] = self.logarithmic(0.1, 10.0) if value is None else value
        return symbol

    def function(self) -> sp.Expr:
        """A function of one variable, or of both."""
        draw = self.draw
        v = draw.choice(self.variables)
        offset = self.number(float(f"{self.offsets[v] * draw.uniform(0.9, 1.1):.6g}"))
        z = (v - offset) / self.number(self.slopes[v])
        power = sp.Integer(draw.choice([2, 3, 10, 40, 125, 300]))
        q = v / offset
        return draw.choice(
            [
                lambda: 1 / (1 + sp.exp(z)),
                lambda: sp.exp(z) / (1 + sp.exp(z)),
                lambda: self.number() / (self.number() + self.number() * sp.exp(-z)),
                lambda: 1 / (1 + sp.exp(z)) ** 2,
                lambda: 1 - 1 / (1 + sp.exp(z)),
                lambda: (1 + sp.tanh(z)) / 2,
                lambda: 1 - sp.tanh(z),
                lambda: sp.tanh(z),
                lambda: sp.exp(-(z**2)),
                lambda: sp.exp(z / 1000) - 1,
                lambda: 1 - sp.exp(-q),
                lambda: sp.log(1 + q),
                lambda: sp.log(1 + z**2),
                lambda: sp.log(1 + sp.exp(z)),
                lambda: 1 / (1 + q**power),
                lambda: q**power / (1 + q**power),
                lambda: v / (offset + v),
                lambda: v**2 / (offset**2 + v**2),
                lambda: sp.exp(self.number() * (sp.cos(z) - 1)),
                lambda: sp.sin(q),
                lambda: sp.atan(z),
                lambda: sp.sqrt(1 + z**2),
                lambda: sp.exp(-self.number() / q),
                lambda: sp.erfc(z / 10),
                lambda: sp.Heaviside(v - offset) * z + q,
                lambda: sp.Max(z, 0) + q,
            ]
        )()
