"""Functions of one coordinate on their interval."""

from __future__ import annotations

import pytest
import sympy as sp

import rankone as ro
from rankone.problem.expressions.admissible import defect, sign, zero
from rankone.problem.forms import Coordinate

k = sp.Symbol("k")


def on(lower: float, upper: float) -> Coordinate:
    return Coordinate("k", k, lower, upper)


@pytest.mark.parametrize(
    "function",
    [
        k**7 - 3,
        1 / (1 + k**2),
        1 / (k - 3),
        sp.exp(-(k**2)),
        sp.sqrt(1 - k),
        sp.log(2 + k),
        sp.Abs(k),
        sp.tan(k),
        sp.Heaviside(k),
        sp.gamma(k + 2),
        sp.Piecewise((1 / k, k > 0.1), (0, True)),
        sp.asin(k),
    ],
)
def test_sound(function):
    assert defect(function, on(-1, 1)) is None


@pytest.mark.parametrize(
    ("function", "message"),
    [
        (1 / k, "is not finite at k = 0"),
        (1 / (k - sp.Float(0.3333)), "is not finite at k = 0.3333"),
        (1 / (k - sp.Float(0.123456)) ** 2, "is not finite at k = 0.123456"),
        (1 / (k**2 - sp.Float(0.6) * k + sp.Float(0.09)), "is not finite at k = 0.3"),
        (1 / sp.sin(3 * k + 1), "is not finite at k = -0.333333"),
        (sp.sqrt(k), "is not real at k = -1"),
        (sp.log(k + 1), "is not finite at k = -1"),
        (sp.log(sp.Abs(k - sp.Float(0.2))), "is not finite at k = 0.2"),
        (sp.asin(2 * k), "is not real at k = -1"),
        (sp.cot(k), "is not finite at k = 0"),
        (sp.exp(1000 * k), "is not finite"),
        (sp.Function("g")(k), "cannot be evaluated numerically"),
    ],
)
def test_defects(function, message):
    assert message in defect(function, on(-1, 1))


def test_signs():
    assert sign(k, on(0, 1)) == 1
    assert sign(-k, on(0, 1)) == -1
    assert sign(k, on(-1, 1)) == 0
    assert sign(sp.exp(k) - 2, on(0, 1)) == 0


def test_zeros():
    assert zero(k - sp.Rational(1, 3), on(-1, 1)) == pytest.approx(1 / 3)
    assert zero((k - sp.Rational(1, 3)) ** 2, on(-1, 1)) == pytest.approx(1 / 3)
    assert zero(1 + k**2, on(-1, 1)) is None
    assert zero(k**2, on(-1, 1)) == 0
    assert zero(sp.Integer(2), on(-1, 1)) is None
    assert zero(sp.sign(k - sp.Rational(1, 3)), on(-1, 1)) is None


def test_a_steep_logistic_has_no_pole():
    problem = ro.Problem.from_strings(
        {"x": "1/(1 + exp(-80*(c - 0.738))) - x"}, {"x": 0}, {"c": (0, 1)}, (0, 2)
    )
    assert ro.solve(problem, rtol=1e-3).success
