"""Generated functions rewritten for floats."""

import numpy as np
import pytest
import sympy as sp

import rankone as ro
from rankone.trajectories.integrators.lsoda import scalar_rates

EXPRESSIONS = [
    *("exp(-k*x)", "log(x)", "sqrt(x)", "sin(x)*cos(t)*tan(k)", "sinh(x) + cosh(x) + tanh(x)"),
    *("asin(x/9)", "acos(x/9)", "atan(x)", "atan2(x, k)", "asinh(x)", "acosh(1 + x)", "atanh(x/9)"),
    *("Abs(x - 1)", "floor(3*x)", "ceiling(3*x)", "sign(x - 1)", "Heaviside(x - 1)", "Mod(x, k)"),
    *("Max(x, k, 1)", "Min(x, k, 1)", "sinc(x)", "x**k", "x**(3/2)", "x**-2", "x**3", "k**x"),
    *("erf(x)", "gamma(x)", "besselj(0, x)", "airyai(x)", "LambertW(x)", "loggamma(x)"),
    "Piecewise((x, x > 1), (k, True))",
    "Piecewise((x, (x > 1) & (k < 1)), (k, (x < 0.5) | (k > 1)), (0, True))",
]


T, K = sp.symbols("t k", real=True)
X = sp.Function("x", real=True)(T)


def system_of(rate):
    rate = sp.sympify(rate, {"x": X, "t": T, "k": K})
    return ro.compile(
        ro.Problem([sp.Eq(X.diff(T), rate)], (T, 0, 2), {K: (0.5, 1.5)}, {X: 1})
    ).system


@pytest.mark.parametrize("expression", EXPRESSIONS)
def test_floats_and_arrays_give_the_same(expression: str):
    system = system_of(f"-k*x + {expression}")
    rates = scalar_rates(system)
    assert rates is not None
    for t, x, k in np.random.default_rng(7).uniform(0.1, 2.0, (20, 3)):
        expected = system.rhs(t, np.array([x]), np.array([k]))
        np.testing.assert_allclose(rates(float(t), [float(x)], [float(k)]), expected, rtol=1e-13)


def test_branches_that_are_not_selected_are_not_evaluated():
    rates = scalar_rates(system_of("Piecewise((1/x, x > 0), (exp(-1000*x), x < -1), (k, True))"))
    assert rates(0.0, [0.0], [0.7]) == [0.7]


def test_what_is_not_finite_raises():
    for rate, x in (("exp(1000*x)", 1.0), ("k/x", 0.0), ("log(x)", -1.0), ("x**k", -1.0)):
        with pytest.raises((ArithmeticError, ValueError)):
            scalar_rates(system_of(rate))(0.0, [x], [0.7])


@pytest.mark.slow
def test_sums_of_many_terms():
    states = [f"s{i}" for i in range(60)]
    chain = " + ".join(f"{i + 1}*k*{name}**2" for i, name in enumerate(states))
    problem = ro.Problem.from_strings(
        {name: f"exp(-{name}) - 1e-4*({chain})" if name == "s7" else f"-{name}" for name in states},
        dict.fromkeys(states, "1"),
        {"k": (0.5, 1.5)},
        (0, 1),
    )
    system = ro.compile(problem).system
    start = np.linspace(0.0, 1.0, 60)
    expected = system.rhs(0.0, start, np.array([0.9]))
    np.testing.assert_allclose(scalar_rates(system)(0.0, start.tolist(), [0.9]), expected, 1e-13)


def test_constants_are_read_by_name():
    problem = ro.Problem.from_strings(
        {"x": "-k*x/m"}, {"x": "1"}, {"k": (0.5, 1.5)}, (0, 1), constants={"m": 3.0}
    )
    for mass in (3.0, 2.0):
        system = ro.compile(problem.set(m=mass)).system
        assert scalar_rates(system)(0.0, [2.0], [0.9]) == pytest.approx([-1.8 / mass], rel=1e-15)


def test_functions_of_the_user_are_not_called_with_floats():
    bump = ro.function("bump", lambda s: np.exp(-(s**2)), lambda s: -2 * s * np.exp(-(s**2)))
    assert scalar_rates(system_of(-K * bump(X))) is None


@pytest.mark.parametrize("kind", ["linear", "previous", "cubic"])
def test_tables_of_floats_are_those_of_arrays(kind):
    table = ro.table([-1, 0.1, 0.4, 1.3, 2.5], [0.3, 2, -1, 0.7, 5], kind)
    system = ro.compile(
        ro.Problem([sp.Eq(X.diff(T), table(X) - K)], (T, 0, 0.1), {K: (0.5, 1.5)}, {X: 1})
    ).system
    rates = scalar_rates(system)
    for x in (*np.linspace(-1, 2.5, 36), -1.001, 2.5001, 2.5 + 1e-10, -1 - 1e-10):
        (expected,) = system.rhs(0.0, np.array([x]), np.array([1.0]))
        np.testing.assert_allclose(rates(0.0, [float(x)], [1.0]), expected, rtol=1e-13, atol=1e-15)
