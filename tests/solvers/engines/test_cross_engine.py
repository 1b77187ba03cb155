"""The cross engine: accuracy on the reference problems, limits, and what its solutions offer."""

from __future__ import annotations

import numpy as np
import pytest

import rankone as ro
from rankone.solvers.engines.engine_options import CrossRecord
from tests.problems import EXAMPLES
from tests.reference.measure import measured_errors
from tests.reference.systems import INDEPENDENT

BARS = [
    ("decay", 1e-6),
    ("linear", 1e-6),
    ("free_fall", 1e-8),
    ("coupled", 1e-3),
    ("coupled", 1e-6),
    ("coupled", 1e-8),
    ("lotka_volterra", 1e-6),
    ("kirchhoff", 1e-4),
    pytest.param("robertson", 1e-4, marks=pytest.mark.slow),
    ("chain", 1e-4),
]


@pytest.mark.parametrize(("name", "rtol"), BARS)
def test_error_is_within_the_tolerance(name, rtol):
    solution = ro.solve(EXAMPLES[name].problem, rtol=rtol, method="cross")
    assert solution.success, solution.message
    assert np.all(measured_errors(solution, INDEPENDENT[name]) <= 5.0 * rtol)


def problem(rate="-k*x", initial="1", box=None, end=1.0):
    return ro.Problem.from_strings(
        {"x": rate}, {"x": initial}, {"k": (1, 2)} if box is None else box, (0, end)
    )


def test_without_parameters():
    solution = ro.solve(problem("-x + sin(t)", box={}, end=3), rtol=1e-6, method="cross")
    assert solution.success
    exact = 0.5 * (3 * np.exp(-2.0) + np.sin(2.0) - np.cos(2.0))
    assert solution["x"](t=2.0) == pytest.approx(exact, abs=1e-6)


def test_a_solution_like_any_other(tmp_path):
    solution = ro.solve(EXAMPLES["coupled"].problem, rtol=1e-5, method="cross")
    solution.save(tmp_path / "coupled.npz")
    again = ro.load(tmp_path / "coupled.npz")
    point = dict.fromkeys(solution.parameters, 0.9)
    np.testing.assert_array_equal(again(0.3, point), solution(0.3, point))
    assert again.history == solution.history
    assert all(isinstance(record, CrossRecord) for record in again.history)
    assert again.metadata.method == "cross"
    assert solution.to_canonical(1e-3)["u1"].success


def test_a_jump_in_time_is_not_smoothed():
    jump = problem("-k*x + Heaviside(t - 0.3)*3")
    solution = ro.solve(jump, rtol=1e-6, method="cross")
    assert solution.success
    t, k = 0.8, 1.7
    exact = np.exp(-k * t) + 3 / k * (1 - np.exp(-k * (t - 0.3)))
    assert solution["x"](t=t, k=k) == pytest.approx(exact, rel=2e-6)


@pytest.mark.parametrize(
    ("options", "status"),
    [
        ({"max_trajectories": 10}, "TRAJECTORY_LIMIT"),
        ({"max_slabs": 1, "time_nodes": 4}, "SLAB_LIMIT"),
        ({"max_rank": 1}, "RANK_LIMIT"),
        ({"max_nodes": 4}, "NODE_LIMIT"),
    ],
)
def test_limits_are_named(options, status):
    solution = ro.solve(
        EXAMPLES["coupled"].problem, rtol=1e-7, method="cross", max_attempts=2, **options
    )
    assert not solution.success
    assert solution.status.name == status
    assert status.partition("_")[0].lower().removesuffix("y") in solution.message


def test_a_blow_up_is_said():
    with pytest.raises(ro.BlowUpError) as caught:
        ro.solve(problem("k*x**2", end=0.9), rtol=1e-4, method="cross")
    assert caught.value.time == pytest.approx(0.5, abs=0.02)
    assert caught.value.solution(t=0.4, k=1.5)[0] == pytest.approx(2.5, rel=1e-3)


def test_the_same_twice():
    compiled = ro.compile(EXAMPLES["kirchhoff"].problem)
    one, two = (compiled.solve(1e-2, method="cross") for _ in range(2))
    point = dict.fromkeys(one.parameters, 0.8)
    np.testing.assert_array_equal(one(0.5, point), two(0.5, point))


def test_the_last_parameter_of_many_is_resolved_at_corners():
    """Its skeleton is chosen at left points that vary in the parameter before it, too."""
    solution = ro.solve(EXAMPLES["kirchhoff"].problem, rtol=1e-4, method="cross")
    assert solution.corner_error < 0.6e-4
