"""The module of a system that does not separate, against SymPy and finite differences."""

from __future__ import annotations

import numpy as np
import pytest
import sympy as sp
from scipy import special
from scipy.interpolate import CubicSpline

import rankone as ro
from rankone.compiler.codegen.layout import load_module
from rankone.compiler.codegen.module import general_source
from rankone.compiler.passes import first_order

t, k, m, p = sp.symbols("t k m p")
x, y = sp.Function("x")(t), sp.Function("y")(t)
TABLES = {
    kind: ro.table([-5, 0.1, 0.9, 2, 5], [1, -1, 0.5, 0.2, 3], kind, name=kind)
    for kind in ("linear", "cubic", "previous")
}


def generated(f, g=0, initial=1, box=None):
    """The module of x' = f, y' = g."""
    box = {k: (0.5, 2), m: (0.5, 2), p: (0.3, 2.7)} if box is None else box
    start = initial if isinstance(initial, sp.Expr) else sp.Integer(initial)
    used = {s: bounds for s, bounds in box.items() if (f + g + start).free_symbols & {s}}
    problem = ro.Problem(
        [sp.Eq(x.diff(t), f), sp.Eq(y.diff(t), g)], (t, 0, 1), used, {x: initial, y: 1}
    )
    return load_module(general_source(first_order(problem)), "generated"), list(used)


def points(n, seed=0):
    rng = np.random.default_rng(seed)
    return rng.uniform(0.05, 1.0, 9), rng.uniform(0.3, 1.9, (2, 9)), rng.uniform(0.5, 2.0, (n, 9))


SMOOTH = [
    sp.sin(x),
    k * sp.exp(-x * y),
    sp.sqrt(x + y),
    1 / x,
    1 / (k + x**2),
    x**p,
    x**p / (k**p + x**p),
    (x * y) ** 2.5,
    k**x,
    sp.tanh(x - y),
    sp.log(x) * x,
    sp.erf(k * x),
    sp.erfc(x),
    sp.gamma(x + 1),
    sp.loggamma(x),
    sp.digamma(x),
    sp.besselj(1, k * x),
    sp.airyai(x),
    sp.Ei(x),
    sp.LambertW(x * y),
    sp.sinc(x),
    sp.atan2(y, x),
    sp.sec(x / 2),
    sp.cos(k * t) * x,
    x / (k + m),
    sp.exp(-k * t),
    TABLES["cubic"](x),
    TABLES["cubic"](t * k) * x,
]
KINKED = [
    sp.Abs(x - y),
    x * sp.Abs(x - 1),
    sp.Abs(x - y) ** p * sp.sign(x - y),
    sp.Max(x, y, k),
    sp.Min(x**2, y),
    sp.Heaviside(x - y) * x,
    sp.sign(x - 1) * y,
    sp.floor(4 * x) * x,
    sp.Mod(x, sp.Rational(1, 3)) * y,
    sp.frac(3 * x) * y,
    sp.Piecewise((x**2, x < y), (k * y, (x > 1) & (y < 1)), (sp.sin(x), True)),
    TABLES["linear"](x),
    TABLES["previous"](x) * x,
]


@pytest.mark.parametrize("f", [*SMOOTH, *KINKED], ids=str)
def test_rhs_and_jacobian(f):
    system, names = generated(f)
    when, u, q = points(len(names))
    a, b = sp.symbols("a b", real=True)
    replaced = f.xreplace({x: a, y: b})
    wanted = sp.lambdify([t, a, b, *names], replaced, ["numpy", "scipy"])(when, *u, *q)
    np.testing.assert_allclose(system.rhs(when, u, q)[0], wanted, rtol=1e-12)
    step = 1e-6
    slopes = [
        (system.rhs(when, u + step * e[:, None], q) - system.rhs(when, u - step * e[:, None], q))
        / (2 * step)
        for e in np.eye(2)
    ]
    found = system.jacobian(when, u, q)
    assert found.shape == (2, 2, 9)
    np.testing.assert_allclose(found, np.swapaxes(slopes, 0, 1), rtol=1e-5, atol=1e-6)


def test_arguments_broadcast():
    system, names = generated(sp.sin(k * x) * sp.exp(-t * y), m * sp.Abs(x))
    when, u, q = points(len(names))
    full = system.rhs(when, u, q)
    one = [system.rhs(when[i], list(u[:, i]), tuple(q[:, i])) for i in range(9)]
    np.testing.assert_array_equal(np.transpose(one), full)
    wide = system.rhs(when[:, None, None], u[:, :4, None], q[:, None, :3])
    assert wide.shape == (2, 9, 4, 3)
    np.testing.assert_array_equal(wide[:, 5, 2, 1], system.rhs(when[5], u[:, 2], q[:, 1]))
    assert system.jacobian(when[:, None, None], u[:, :4, None], q[:, None, :3]).shape[2:] == (
        9,
        4,
        3,
    )


def test_powers_are_differentiated_where_the_base_vanishes():
    system, _ = generated(x**p / (1 + x**p), sp.Abs(y) ** p * sp.sign(y))
    slopes = system.jacobian(0.0, np.zeros(2), [2.5])
    np.testing.assert_array_equal(slopes, np.zeros((2, 2)))


def test_initial_values():
    system, _ = generated(sp.sin(k * x), initial=sp.exp(-k * m) / (k + m))
    q = np.array([[0.5, 1.0], [2.0, 0.7]])
    np.testing.assert_allclose(system.initial(q)[0], np.exp(-q[0] * q[1]) / (q[0] + q[1]))
    assert system.initial((0.5, 2.0)).shape == (2,)
    alone, _ = generated(sp.sin(x))
    assert alone.initial(np.zeros((0, 7))).shape == (2, 7)
    assert alone.initial(()).shape == (2,)


def test_known_functions_of_one_coordinate_are_listed():
    f = sp.Heaviside(t - 0.3) * sp.sin(x) + sp.Piecewise((x, t < 0.6), (sp.exp(x / k), True))
    system, _ = generated(f + TABLES["linear"](2 * t) * sp.sqrt(x))
    at = np.array([0.1, 0.5, 0.9])
    rows = {tuple(row) for row in system.time_factors(at)}
    assert {(0.0, 1.0, 1.0), (1.0, 1.0, 0.0)} <= rows
    np.testing.assert_array_equal(system.parameter_factors(0, at), [np.ones(3), 1 / at])
    assert system.features.cuts[0] == (-2.5, 0.05, 0.3, 0.45, 0.6, 1.0, 2.5)


def test_tables_are_interpolated_as_documented():
    points = np.array([-5, 0.1, 0.9, 2, 5])
    values = np.array([1, -1, 0.5, 0.2, 3])
    at = np.linspace(-5, 5, 41)
    linear, cubic, previous = (
        sp.lambdify(k, TABLES[kind](k))(at) for kind in ("linear", "cubic", "previous")
    )
    np.testing.assert_allclose(linear, np.interp(at, points, values))
    np.testing.assert_allclose(cubic, CubicSpline(points, values)(at))
    np.testing.assert_allclose(previous, values[np.searchsorted(points, at, side="right") - 1])
    outside = sp.lambdify(k, TABLES["linear"](k))(np.array([-5.1, 5.1]))
    assert np.isnan(outside).all()


def test_the_text_is_that_of_an_expert():
    problem = ro.Problem.from_strings(
        {"theta": "w", "w": "-g*sin(theta) - c*w"},
        {"theta": "a", "w": 0},
        {"g": (9, 10), "c": (0.1, 0.3), "a": (0.1, 2.5)},
        (0, 3),
    )
    source = ro.compile(problem).source
    assert "    w' = -c*w - g*sin(theta)\n" in source
    assert "out[1] = -c * w - g * np.sin(theta)  # w'" in source
    assert "out[1, 0] = -g * np.cos(theta)  # d(w')/dtheta" in source
    assert "SEPARATED = False" in source


def test_names_of_parameters_and_modules_do_not_clash():
    special_, np_ = sp.symbols("special np")
    box = {special_: (0.5, 2), np_: (0.5, 2)}
    system, _ = generated(sp.erf(special_ * x) + np_ * sp.sin(x), box=box)
    value = system.rhs(0.0, [0.3, 1.0], [0.7, 2.0])[0]
    assert value == pytest.approx(special.erf(0.21) + 2 * np.sin(0.3))


@pytest.mark.parametrize(
    ("f", "message"),
    [
        (sp.lowergamma(x, k), "equation 1: x': the function `lowergamma` in .* cannot be written"),
        (sp.DiracDelta(x), "equation 1: `DiracDelta.* is at a time that depends on `x\\(t\\)`"),
        (sp.besselj(x, k), "equation 1: the derivative of `besselj` in .* argument .* not known"),
        (sp.Function("g")(k) * sp.sin(x), "`g\\(k\\)`"),
    ],
)
def test_functions_that_cannot_be_evaluated(f, message):
    with pytest.raises(ro.ProblemError, match=message):
        generated(f)
