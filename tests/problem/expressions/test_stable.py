"""Stable forms have the value of what they are written for."""

import mpmath
import numpy as np
import pytest
import sympy as sp

from rankone.problem.expressions.stable import NUMPY, stable

x, y, a = sp.symbols("x y a", real=True)


@pytest.mark.parametrize(
    ("expression", "wanted"),
    [
        (1 / (1 + sp.exp(x)), "expit(-x)"),
        (sp.exp(x) / (1 + sp.exp(x)), "expit(x)"),
        (1 - sp.tanh(x), "2*expit(-2*x)"),
        (sp.exp(x) - 1, "expm1(x)"),
        (sp.log(1 + x), "log1p(x)"),
        (1 - sp.cos(x), "-cosm1(x)"),
        (sp.log(1 + sp.exp(x)), "logaddexp(0, x)"),
        (a * x / (x + y), "a*fraction(x, y)"),
        (x**60 / y**60, "scaled_power(x/y, 60)"),
        (1 / (1 + a * sp.exp(x)), "1/(a*exp(x) + 1)"),  # a may be negative
    ],
)
def test_forms(expression, wanted):
    assert str(stable(expression)) == wanted


@pytest.mark.parametrize(
    "expression",
    [
        1 - sp.tanh(x) + 2 / (1 + sp.exp(2 * x)),  # two terms become the same one
        1 - 1 / (1 + sp.exp(-x)) + 1 / (1 + sp.exp(x)),
        1 - sp.erf(x) + sp.erfc(x),
        sp.exp(a * 10**20 + x) / (1 + sp.exp(a * 10**20)),
        sp.exp(2 * x + y) / (1 + sp.exp(x)) ** 3,
        sp.log(sp.exp(-3 * x) + 2 * sp.exp(y)),
        x**2 * y / (x**2 + y) ** 2,
        (1 + x) ** sp.Rational(1, 3) - 1,
        y - y * sp.cosh(x),
        (x / 310) ** 125 / (1 + (x / 310) ** 125) ** 2,
    ],
)
def test_values(expression):
    written = stable(expression)
    function = sp.lambdify([x, y, a], written, [NUMPY, "numpy", "scipy"])
    for at in ((0.3, 0.7, 1e-20), (1.9, 0.2, -1e-20), (0.01, 2.5, 0.0)):
        with mpmath.workdps(60):
            values = dict(zip((x, y, a), map(sp.Float, map(repr, at)), strict=True))
            exact = float(expression.evalf(40, subs=values))
        assert float(function(*at)) == pytest.approx(exact, rel=1e-12), at


@pytest.mark.parametrize("exponent", [-5, -4, -2, -1, 2, 3, 4, 7, 30, 101])
@pytest.mark.parametrize("at", [-2.4, -1.3, -1.0000001, -0.4, -1e-9, 1e-12, 0.6])
def test_whole_powers_less_one(exponent, at):
    written = stable(a * (1 + x) ** exponent - a)
    function = sp.lambdify([x, a], written, [NUMPY, "numpy", "scipy"])
    with mpmath.workdps(60):
        exact = 3 * ((1 + mpmath.mpf(at)) ** exponent - 1)
    assert float(function(at, 3.0)) == pytest.approx(float(exact), rel=1e-12)
    if exponent > 0:
        slope = sp.lambdify([x, a], written.diff(x), [NUMPY, "numpy", "scipy"])
        assert float(slope(-1.0, 3.0)) == 0.0


def test_no_overflow():
    written = stable(sp.exp(x) / (1 + sp.exp(x)) + sp.log(1 + sp.exp(y)))
    function = sp.lambdify([x, y], written, [NUMPY, "numpy", "scipy"])
    assert function(np.array([2000.0]), np.array([3000.0])) == pytest.approx([3001.0])
