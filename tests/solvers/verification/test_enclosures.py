"""Enclosures hold what functions do between samples, and doubt what samples do not tell."""

import numpy as np
import pytest
import sympy as sp

import rankone as ro
from rankone.solvers.verification.enclosures.enclosure import Enclosure
from rankone.solvers.verification.enclosures.generated import UnsuitableError, enclosed
from rankone.trajectories.integrators.integrator import NODES

FUNCTIONS = [
    "exp(x)",
    "exp(x) - 1",
    "log(3 + x)",
    "log(1 + exp(x))",
    "sin(3*x)",
    "cos(x)",
    "cos(x) - 1",
    "tan(x/2)",
    "tanh(x)",
    "sinh(x)",
    "cosh(x)",
    "atan(x)",
    "asinh(x)",
    "asin(x/3)",
    "acos(x/3)",
    "atanh(x/3)",
    "acosh(4 + x)",
    "erf(x)",
    "erfc(x)",
    "sqrt(3 + x)",
    "(3 + x)**2.5",
    "(3 + x)**(-2.5)",
    "x**2",
    "x**3",
    "x**9",
    "x**10",
    "1/(3 + x)",
    "1/(1 + exp(-9*x))",
    "1/(1 + x**2)",
    "Abs(x)",
    "Max(x, 1 - x)",
    "Min(x, 0)",
    "sign(x)",
    "floor(2*x)",
    "ceiling(x)",
    "Mod(x, 1)",
    "Heaviside(x)",
    "Piecewise((x, x > 1), (2 - x**2, x < -1), (3, True))",
    "x*exp(-x**2)",
    "sin(x)*cos(x)/(2 + sin(x))",
    "2**x",
    "x**k + (3 + x)**k",
    "besselj(1, 3*x)",
    "besselk(0, 3 + x)",
    "airyai(2*x)",
    "Si(5*x)",
    "expint(1, 3.5 + 3*x)",
    "gamma(3 + x)",
    "gamma(x)",
    "digamma(x)",
]
"""Functions of x on (-2.9, 2.9), with a parameter k."""


NESTED = "1 - (x - 0.3)**2"
"""A power of powers, a peak of width 1e-7; a number between keeps the powers apart."""
for _ in range(16):
    NESTED = f"(({NESTED})**8 + k*1e-30)"


UNKNOWN_IN_TEXT = ("bessel", "airy", "Si(", "expint", "digamma", "polygamma")


def rates(text):
    if not any(name in text for name in UNKNOWN_IN_TEXT):
        problem = ro.Problem.from_strings({"x": text}, {"x": "0.5"}, {"k": (1.9, 2.1)}, (0, 1))
        return ro.compile(problem).system.rhs
    t, k = sp.symbols("t k")
    x = sp.Function("x")(t)
    rate = sp.Eq(x.diff(t), sp.sympify(text, {"x": x, "k": k}))
    problem = ro.Problem([rate], (t, 0, 1), {k: (1.9, 2.1)}, {x: sp.Rational(1, 2)})
    return ro.compile(problem).system.rhs


@pytest.mark.parametrize("text", FUNCTIONS)
def test_enclosures_hold_all_values(text):
    function = rates(text)
    generator = np.random.default_rng(5)
    widths = 10.0 ** generator.uniform(-4, 0.7, 400)
    start = generator.uniform(-2.9, 2.9 - widths)
    k = generator.uniform(1.9, 2.1, 400)
    x = Enclosure.of_samples(start + widths * NODES[:, None], 0.0)
    with np.errstate(all="ignore"):
        (row,) = enclosed(function)(Enclosure.of(0.0), [x], [Enclosure.of(k)])
        exact = function(0.0, [start + widths * np.linspace(0, 1, 301)[:, None]], [k])[0]
    low, high = row.range()
    finite = np.isfinite(exact)
    rounding = 1e-12 * (1.0 + np.abs(exact))
    assert ((exact >= low - rounding) & (exact <= high + rounding))[finite].all()
    in_doubt = np.zeros(400) if row.doubt is None else np.broadcast_to(row.doubt, 400)
    suggested = np.array(
        [np.polyfit(2 * NODES - 1, values, 6) for values in np.broadcast_to(row.values, (7, 400)).T]
    ).T
    curve = np.array([np.polyval(suggested, 2 * s - 1) for s in np.linspace(0, 1, 301)])
    off = np.nan_to_num(np.abs(exact - curve).max(axis=0))
    spread = np.ptp(np.nan_to_num(exact), axis=0)
    assert (off <= 2.5 * in_doubt + 0.2 * spread + 1e-9).all()


@pytest.mark.parametrize(
    "text",
    [
        "exp(-((x - 0.3)/1e-9)**2)",
        "1/(1 + ((x - 0.3)/1e-9)**2)",
        "((x - 0.3)/1e-9)**2/(exp((x - 0.3)/1e-9) + exp(-(x - 0.3)/1e-9) - 1)",
        "tanh(1e9*(x - 0.3)) - tanh(1e9*(x - 0.3) - 1)",
        "exp(-1e12*(x/0.3 + 0.3/x - 2))",
        "Max(0, 1 - Abs((x - 0.3)/1e-9))",
        "Piecewise((1, Abs(x - 0.3) < 1e-9), (0, True))",
        "sin(pi*(x + 0.2))**10**14",
        "exp(-exp(((x - 0.3)/1e-9)**2))",
        "besselk(0, 1 + ((x - 0.3)/1e-9)**2)",
        "2*expint(1, 1 + ((x - 0.3)/1e-9)**2)",
        "1e-9*gamma(x - 1.3)",
        "1e-9*digamma(x - 3.3)",
        "1e-9*polygamma(1, x - 2.3)",
        "powers",
    ],
)
def test_what_is_narrow_is_in_doubt_where_it_is(text):
    text = NESTED if text == "powers" else text
    x = Enclosure.of_samples(np.array([0.1, 0.28]) + 0.04 * NODES[:, None], 0.0)
    with np.errstate(all="ignore"):
        (row,) = enclosed(rates(text))(Enclosure.of(0.0), [x], [Enclosure.of(2.0)])
    assert row.doubt is not None
    away, there = row.doubt
    assert there > 0.3
    assert away < 1e-3


def test_differences_of_large_smooth_functions_are_not_in_doubt():
    x = Enclosure.of_samples(np.array([[0.3]]) + 0.1 * NODES[:, None])
    (row,) = enclosed(rates("1e12*(exp(x) - sin(x) - 1/(2 + x))"))(
        Enclosure.of(0.0), [x], [Enclosure.of(2.0)]
    )
    assert row.doubt is None


def test_array_code_is_not_enclosed():
    def helper(x):
        return x

    namespace = {"helper": helper}
    exec("def rhs(t, u, p):\n    return helper(u)", namespace)
    with pytest.raises(UnsuitableError):
        enclosed(namespace["rhs"])


@pytest.mark.parametrize("above", ["x", "x*(2 + k)", "sin(x)"])
def test_a_zero_that_numerator_and_denominator_share_hides_nothing(above):
    x = Enclosure.of_samples(0.02 * (NODES - 0.37)[:, None])

    def doubt(numerator):
        function = enclosed(rates(f"{numerator}/(exp(x) - 1)"))
        (row,) = function(Enclosure.of(0.0), [x], [Enclosure.of(2.0)])
        return 0.0 if row.doubt is None else row.doubt.max()

    with np.errstate(all="ignore"):
        assert doubt(above) < 1e-8
        for beside in (1e-9, 1e-6, 1e-4, 1e-2):
            assert doubt(f"({above} + {beside})") > beside
