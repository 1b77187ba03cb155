"""Staircases and tables of unknowns, written as steps and kinks at the levels that are reached."""

import numpy as np
import pytest
import sympy as sp

import rankone as ro
from rankone.compiler.passes.over_stretches import by_levels, levelled
from rankone.compiler.passes.switches import MOST_LEVELS

t, k = sp.symbols("t k")
x, y = sp.Function("x")(t), sp.Function("y")(t)
POINTS, HEIGHTS = [-2, -0.5, 0.25, 0.6, 0.8, 1, 1.5, 3], [0, 1, -1, 0.5, 3, 2.1, 1.9, 0]
LINES, STEPS = ro.table(POINTS, HEIGHTS), ro.table(POINTS, HEIGHTS, "previous")


def values(expression, at):
    return sp.lambdify(x, expression.replace(sp.Heaviside, _step), "numpy")(at)


def _step(argument, *_):
    return sp.Piecewise((1, argument >= 0), (0, True))


@pytest.mark.parametrize(
    "function",
    [
        sp.floor(3 * x),
        sp.ceiling(x + 0.3),
        sp.frac(2 * x),
        sp.Mod(x, sp.Rational(2, 5)),
        sp.Mod(-x, 1),
        LINES(x),
        STEPS(x / 2),
        sp.floor(2 * LINES(x)) - x * STEPS(x),
    ],
)
def test_sums_have_the_values_of_functions_at_the_levels_that_are_reached(function):
    at = np.linspace(-0.9, 1.4, 231) + 1e-3
    reached = {}
    for argument in levelled([function]):
        heights = values(argument, at)
        reached[argument] = heights.min(), heights.max()
    written = by_levels(function, reached)
    assert not written.has(sp.floor, sp.ceiling, sp.frac, sp.Mod)
    np.testing.assert_allclose(values(written, at), values(function, at), rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("function", [sp.floor(x), LINES(x), STEPS(x)])
def test_beyond_the_levels_that_are_written_there_is_no_value(function):
    written = by_levels(function, {x: (0.3, 0.7)})
    lower, upper = (0, 1) if isinstance(function, sp.floor) else (0.25, 0.8)
    near = np.array([lower + 0.1, upper - 0.1])
    np.testing.assert_allclose(values(written, near), values(function, near))
    assert np.isnan(values(written, np.array([lower - 0.1, upper + 0.1]))).all()


def test_functions_of_time_and_splines_have_no_levels():
    spline = ro.table(POINTS, HEIGHTS, "cubic")
    assert levelled([sp.floor(t) + LINES(k) + spline(x)]) == []


def problem(rate, other=-y, start=(0.2, 1), end=3, c=(0.9, 1.1)):
    equations = [sp.Eq(x.diff(t), rate), sp.Eq(y.diff(t), other)]
    return ro.Problem(equations, (t, 0, end), {k: c}, {x: start[0], y: start[1]})


def test_there_is_a_switch_for_each_level_that_is_reached():
    listed = str(ro.compile(problem(1 - x, k * x * sp.floor(4 * x) - y)).features)
    surfaces = {line.split(": ")[1] for line in listed.splitlines() if line.startswith("switch_")}
    reached = {f"4*x - {level} = 0" for level in (1, 2, 3)}  # x grows from 0.2 to 0.96
    assert reached <= surfaces
    assert len(surfaces) <= len(reached) + 4


def test_of_a_long_staircase_no_switches_are_held():
    long = ro.compile(problem(-x + sp.floor(y), 20 * k, end=MOST_LEVELS / 20 + 1))
    assert "switch_0" not in str(long.features)


def test_switches_of_one_function_ascend_with_its_levels():
    gears = ro.table([-1, 7, 12, 18, 90], [4, 2, 1.5, 1, 1], "previous")
    listed = str(ro.compile(problem(20 * k * gears(x - y) / 3, -y)).features)
    assert [line for line in listed.splitlines() if line.startswith("switch_")] == [
        "switch_0: x - y + 1 = 0",
        *(f"switch_{i}: x - y - {speed} = 0" for i, speed in enumerate((7, 12, 18), 1)),
        "switch_4: -x + y + 90 = 0",
    ]


def test_levels_that_are_held_are_not_listed_twice():
    table = ro.table([-3.3, 0.1, 0.7, 4.4], [1, 3, 2, 2.5])
    listed = str(ro.compile(problem(k * table(x * 0.9) / 3, -y)).features)
    assert "switch_" in listed
    assert "where" not in listed
