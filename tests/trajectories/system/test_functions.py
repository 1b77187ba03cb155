"""Tables and functions of the user."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
import sympy as sp
from sympy.core.function import AppliedUndef

import rankone as ro
from rankone.problem.functions import nodes_of

t, k = sp.symbols("t k")
x = sp.Function("x")(t)


def square(z):
    return z**2


def twice(z):
    return 2 * z


def forced(f, horizon=(0, 2)):
    return ro.Problem([sp.Eq(x.diff(t), -k * x + f)], (t, *horizon), {k: (0.5, 2)}, {x: 1})


def test_a_table_is_a_function():
    f = ro.table([0, 1, 3], [0, 2, 1], name="load")
    assert str(f(t)) == "load(t)"
    assert f(t) == ro.table(np.array([0, 1, 3]), [0.0, 2.0, 1.0], name="load")(t)
    assert f(t) != ro.table([0, 1, 3], [0, 2, 2], name="load")(t)
    assert float(f(2).evalf()) == 1.5
    assert float(f(t).diff(t).subs(t, 2).evalf()) == -0.5
    assert pickle.loads(pickle.dumps(f(2 * t))) == f(2 * t)


@pytest.mark.parametrize("kind", ["linear", "previous", "cubic"])
@pytest.mark.parametrize("method", ["train", "cross"])
def test_tables_of_time_serve_every_method(kind, method):
    knots, values = [0, 0.3, 0.31, 1.2, 2], [0.0, 1.0, 3.0, -1.0, 0.5]
    compiled = ro.compile(forced(ro.table(knots, values, kind)(t)))
    solution = compiled.solve(1e-5, method=method)
    assert solution.success, solution.message
    again = pickle.loads(pickle.dumps(compiled))
    assert ro.compile(again.problem).source == compiled.source
    if kind != "cubic":
        assert again.system.features.cuts == ((0.0, 0.3, 0.31, 1.2, 2.0), ())


def test_tables_of_parameters_and_unknowns():
    f = ro.table([0, 1, 2, 3], [0, 2, 1, 1], "cubic")
    assert ro.solve(forced(f(k)), 1e-5).success
    solution = ro.solve(forced(f(x)), 1e-4, method="cross")
    assert solution.success


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (([0, 1], [1, 2, 3]), "2 times and 3 values"),
        (([0], [1]), "at least two"),
        (([0, 2, 1], [1, 2, 3]), "do not ascend: 2 is followed by 1"),
        (([0, 1, 1], [1, 2, 3]), "do not ascend"),
        (([0, np.nan], [1, 2]), "times of a table are not finite"),
        (([0, 1], [1, np.inf]), "values of a table are not finite"),
        (([0, 1], ["a", 2]), "values of a table are not finite"),
        (([[0, 1]], [[1, 2]]), "in one row"),
        (([0, 10**400], [1, 2]), "times of a table are not finite"),
        (([0, 1], [1, 2 + 0j]), "values of a table are not finite real"),
        (([0, 1], np.array([1, 2 + 1j])), "values of a table are not finite real"),
        (([0, 1], np.ma.masked_invalid([1, np.nan])), "values of a table are not finite real"),
        (([0, 1, 2], [1e308, -1e308, 1e308], "cubic"), "too large, or its times too close"),
        (([0, 5e-324], [0, 1], "cubic"), "too large, or its times too close"),
        (([0, 5e-324], [0, 1]), "too large, or its times too close"),
        (([-1e308, 1e308], [0, 1], "previous"), "too large"),
        (([0, 1], [1, 2], "spline"), "kind='spline' is unknown.*linear, cubic, previous"),
    ],
)
def test_bad_tables(arguments, message):
    with pytest.raises(ro.ProblemError, match=message):
        ro.table(*arguments)
    with pytest.raises(ro.ProblemError, match="not a name"):
        ro.table([0, 1], [0, 1], name="a b")
    with pytest.raises(ro.ProblemError, match="Python reads the name '\ufb01' as 'fi'"):
        ro.table([0, 1], [0, 1], name="\ufb01")


def test_masked_arrays_without_a_mask_are_data():
    assert float(ro.table([0, 1], np.ma.masked_array([0.0, 2.0]))(0.5).evalf()) == 1.0


@pytest.mark.parametrize(
    ("argument", "message"),
    [
        (t, r"equation 1: `f\(t\)` is a table over \[0, 1\], and `t` leaves it: t in \[0, 2\]"),
        (k, r"k in \[0.5, 2\], outside at k = 1.0"),
        (k - 1, r"`k - 1` leaves it.*outside at k = 0.5, where the argument is -0.5"),
    ],
)
def test_tables_that_are_left(argument, message):
    with pytest.raises(ro.ProblemError, match=message):
        ro.compile(forced(ro.table([0, 1], [0, 1], name="f")(argument)))


def test_functions_of_the_user():
    f = ro.function("square", square, twice)
    compiled = ro.compile(forced(-f(x)))
    reference = ro.solve(forced(-(x**2)), 1e-6)
    for each in (compiled, pickle.loads(pickle.dumps(compiled))):
        solution = each.solve(1e-5, method="cross")
        assert solution.success
        np.testing.assert_allclose(
            solution(t=1.7, k=[0.6, 1.9]), reference(t=1.7, k=[0.6, 1.9]), rtol=1e-4
        )
    np.testing.assert_allclose(compiled.system.jacobian(0.0, [3.0], [1.0]), [[-7.0]])


def test_functions_of_several_arguments():
    f = ro.function("product", np.multiply, [lambda a, b: b, lambda a, b: a])
    system = ro.compile(forced(f(x, sp.sin(x) + k))).system
    assert system.rhs(0.0, [2.0], [1.0])[0] == pytest.approx(-2 + 2 * (np.sin(2) + 1))
    slope = -1 + np.sin(2) + 1 + 2 * np.cos(2)
    assert system.jacobian(0.0, [2.0], [1.0])[0, 0] == pytest.approx(slope)


def test_a_solver_with_a_function_of_the_user_is_not_exported(tmp_path):
    compiled = ro.compile(forced(-ro.function("square", square, twice)(x)))
    with pytest.raises(ro.ExportError, match="function `square` is a Python callable"):
        compiled.export(tmp_path / "solver.py", method="cross")
    with pytest.raises(ro.ExportError, match="method='train' cannot be exported"):
        compiled.export(tmp_path / "solver.py", method="train")
    assert not list(tmp_path.iterdir())


def test_bad_functions():
    def fails(z):
        raise KeyError("no entry")

    with pytest.raises(ro.ProblemError, match=r"function `f` raised KeyError: 'no entry'"):
        ro.compile(forced(ro.function("f", fails, twice)(x)))
    with pytest.raises(ro.ProblemError, match=r"function `f` returned shape \(3,\) for arguments"):
        ro.compile(forced(ro.function("f", lambda z: np.ones(3), twice)(x)))
    for value in (lambda z: z + 0j, lambda z: np.ma.masked_array(z, np.ones_like(z))):
        with pytest.raises(ro.ProblemError, match="function `f` returned complex or masked"):
            ro.compile(forced(ro.function("f", value, twice)(x)))
    with pytest.raises(ro.ProblemError, match="not all callable"):
        ro.function("f", square, 3)
    with pytest.raises(ro.ProblemError, match="not a name"):
        ro.function("1f", square, twice)


def test_functions_may_change_their_arguments():
    def in_place(z):
        z *= z
        return z

    def in_place_slope(z):
        z *= 2
        return z

    system = ro.compile(forced(ro.function("f", in_place, in_place_slope)(x))).system
    state = np.array([[3.0, 4.0]])
    np.testing.assert_array_equal(system.rhs(0.0, state, [1.0])[0], [6.0, 12.0])
    system.jacobian(0.0, state, [1.0])
    np.testing.assert_array_equal(state, [[3.0, 4.0]])


@pytest.mark.parametrize(
    "pair",
    [
        (ro.table([0, 1], [0, 0], name="rain"), ro.table([0, 1], [1, 1], name="rain")),
        (ro.function("q", np.sin, np.cos), ro.function("q", np.cos, np.sinh)),
        (ro.function("q", np.sin, np.cos), ro.function("q_1", np.cos, np.sinh)),
    ],
)
def test_two_of_one_name_are_refused(pair):
    t, k = sp.symbols("t k")
    x = sp.Function("x")(t)
    one, two = pair
    equation = sp.Eq(x.diff(t), -k * one(x) - two(t))
    with pytest.raises(ro.ProblemError, match="names two tables or functions"):
        ro.Problem([equation], (t, 0, 1), {k: (0.5, 1.5)}, {x: 1})


def test_nodes_that_occur_often_are_looked_at_once():
    f, x = sp.Function("f"), sp.Symbol("x")
    expression = x
    for _ in range(24):
        expression = f(expression, expression)
    assert len(nodes_of([expression], AppliedUndef)) == 24
    assert nodes_of([expression, sp.Integer(2)], sp.Symbol, sp.Integer) == {x, 2}
