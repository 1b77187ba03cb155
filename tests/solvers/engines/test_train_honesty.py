"""Cases in which a solve could be silently wrong: it must be right, or say that it is not."""

from functools import partial

import numpy as np
import pytest

import rankone as ro

solve = partial(ro.solve, method="train")


def problem(rhs, initial, parameters, time):
    return ro.Problem.from_strings(rhs=rhs, initial=initial, parameters=parameters, time=time)


@pytest.mark.parametrize("width", [0.1, 0.02])
def test_a_short_pulse_is_not_stepped_over(width):
    pulse = f"-k*x + 10*Heaviside(t - 5)*Heaviside({5 + width} - t)"
    solution = solve(problem({"x": pulse}, {"x": 1}, {"k": (0.1, 1)}, (0, 24)), rtol=1e-4)
    assert solution.success
    k = np.linspace(0.1, 1, 7)
    exact = np.exp(-8 * k) + 10 / k * (np.exp(-k * (3 - width)) - np.exp(-3 * k))
    np.testing.assert_allclose(solution["x"](t=8.0, k=k), exact, atol=5e-4)


def test_a_narrow_peak_in_time_is_not_stepped_over():
    peak = "-k*x + 100*exp(-((t - 50)/0.01)**2)"
    solution = solve(problem({"x": peak}, {"x": 1}, {"k": (0.1, 1)}, (0, 100)), rtol=1e-4)
    assert solution.success
    area = np.sqrt(np.pi)
    expected = area * np.exp(-0.5)
    assert solution["x"](t=55.0, k=0.1) == pytest.approx(expected + np.exp(-5.5), abs=1e-3)


@pytest.mark.parametrize(
    "rhs",
    ["-x + exp(-100000*(k - 0.3017)**2)", "-x + Abs(k - 0.3017)*0.01", "-x*Max(k, 0.2)"],
)
def test_an_unresolved_function_of_a_parameter_is_noticed(rhs):
    solution = solve(problem({"x": rhs}, {"x": 1}, {"k": (-1, 1)}, (0, 3)), rtol=1e-6)
    assert not solution.success
    assert solution.error > 1e-6


def test_errors_are_relative_to_interior_values_however_large_the_corners():
    names = "abcd"
    solution = solve(
        problem({"x": "(a + b + c + d)*x"}, {"x": 1}, dict.fromkeys(names, (0, 1)), (0, 7)),
        rtol=1e-3,
    )
    points = dict(zip(names, np.random.default_rng(0).random((4, 256))))
    exact = np.exp(7 * sum(points.values()))
    error = np.abs(solution["x"](t=7.0, **points) - exact).max() / exact.max()
    assert solution.success
    assert error <= 5e-3


@pytest.mark.parametrize(
    ("count", "rtol"), [(8, 1e-3), (8, 1e-5), pytest.param(12, 1e-3, marks=pytest.mark.slow)]
)
def test_many_equations_with_a_parameter_each(count, rtol):
    """Nothing in the initial values hints at any of the dependences."""
    states, rates = [f"x{i}" for i in range(count)], [f"k{i}" for i in range(count)]
    solution = solve(
        problem(
            {x: f"-{k}*{x}" for x, k in zip(states, rates)},
            dict.fromkeys(states, 1),
            dict.fromkeys(rates, (0.5, 1)),
            (0, 1),
        ),
        rtol=rtol,
    )
    assert solution.success, solution.message
    point = np.random.default_rng(1).uniform(0.5, 1, (count, 50))
    values = solution(1.0, dict(zip(rates, point)))
    assert np.abs(values - np.exp(-point)).max() <= 5 * rtol


def test_an_oscillator_over_many_periods_and_a_wide_box():
    """The parameter interval is split on the way; what was resolved before must survive."""
    solution = solve(
        problem({"x": "v", "v": "-k*x"}, {"x": 1, "v": 0}, {"k": (1, 100)}, (0, 10)), rtol=1e-6
    )
    assert solution.success, solution.message
    k = np.linspace(1, 100, 301)
    np.testing.assert_allclose(solution["x"](t=10.0, k=k), np.cos(10 * np.sqrt(k)), atol=5e-6)


@pytest.mark.slow
def test_a_hopeless_growth_ends_soon_and_says_so():
    """Corner values exceed interior ones by thirty orders of magnitude."""
    rhs = {"x": "40*a*b*c*d*e*f*x"}
    solution = solve(problem(rhs, {"x": 1}, dict.fromkeys("abcdef", (-1, 1)), (0, 2)), rtol=1e-3)
    assert not solution.success
    assert len(solution.history) < 1000
