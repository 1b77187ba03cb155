"""The first-order system: orders reduced, masses inverted, and how it is shown."""

from __future__ import annotations

import pytest
import sympy as sp

from rankone.compiler.passes import FirstOrderSystem, first_order
from rankone.problem.problem import Problem

t, k = sp.symbols("t k")
x, y = sp.Function("x")(t), sp.Function("y")(t)
dx, dy = x.diff(t), y.diff(t)


def system(equations, parameters=None, initial=None) -> FirstOrderSystem:
    box = {k: (1, 2)} if parameters is None else parameters
    return first_order(Problem(equations, (t, 0, 1), box, {x: 1} if initial is None else initial))


def test_expressions_vanish():
    assert system([dx + k * x]).rhs == (-k * x,)


def test_numeric_mass_matrix_is_inverted_exactly():
    f = system([sp.Eq(0.1 * dx + 0.2 * dy, k * x), sp.Eq(dx - dy, y)], initial={x: 1, y: 2})
    expected = sp.Matrix([[0.1, 0.2], [1, -1]]).inv() * sp.Matrix([k * x, y])
    for found, wanted in zip(f.rhs, expected, strict=True):
        assert sp.expand(found - wanted).subs({k: 1.3, x: 0.7, y: -0.4}) == pytest.approx(0)
    assert not sp.Tuple(*f.rhs).atoms(sp.Float)
    assert f.origins == (None, None)


def test_symbolic_mass_matrix():
    equations = [sp.Eq(k * dx + dy, x), sp.Eq(dx + k * dy, y)]
    f = system(equations, parameters={k: (2, 3)}, initial={x: 1, y: 2})
    assert sp.cancel(f.rhs[0] - (k * x - y) / (k**2 - 1)) == 0
    assert sp.cancel(f.rhs[1] - (k * y - x) / (k**2 - 1)) == 0


def test_permuted_equations_remember_their_number():
    f = system([sp.Eq(x + 2 * dy, 0), sp.Eq(k * dx, y)], initial={x: 1, y: 2})
    assert [s.expression for s in f.states] == [y, x]
    assert f.origins == (1, 2)


def test_higher_order_states():
    equations = [sp.Eq(x.diff(t, 3), -k * y), sp.Eq(y.diff(t, 2), dx)]
    f = system(equations, initial={x: 1, dx: 2, x.diff(t, 2): 3, y: 4, dy: k})
    assert [(state.name, state.role.value) for state in f.states] == [
        ("x", "unknown"),
        ("y", "unknown"),
        ("x_t", "derivative"),
        ("y_t", "derivative"),
        ("x_tt", "derivative"),
    ]
    assert [state.expression for state in f.states] == [x, y, dx, dy, x.diff(t, 2)]
    x_t, y_t, x_tt = f.functions[2:]
    assert f.rhs == (x_t, y_t, x_tt, x_t, -k * y)
    assert list(f.initial) == [1, 4, 2, k, 3]


def test_derivatives_of_expressions_are_carried_out():
    assert system([sp.Eq(sp.Derivative(k * x, t), 1)]).rhs == (1 / k,)


def test_parameters_with_assumptions():
    positive = sp.Symbol("k", positive=True)
    assert system([sp.Eq(dx, -positive * x)], parameters={positive: (1, 2)}).rhs == (-positive * x,)


def test_text():
    f = system([sp.Eq(x.diff(t, 2), -k * x)], initial={x: 1, dx: k})
    assert repr(f).splitlines() == [
        "First-order system: 2 states, 1 parameter",
        "  dx/dt = x_t",
        "  dx_t/dt = -k*x",
        "  x(0) = 1, x_t(0) = k",
    ]
    assert r"\frac{d x_{t}}{d t} &= - k x" in f._repr_latex_()
