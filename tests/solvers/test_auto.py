"""``method="auto"``, the limits of a solve, and how one that will not come to an end ends."""

from __future__ import annotations

import pytest

import rankone as ro
from rankone.support.budget import NORMAL
from tests.problems import EXAMPLES

LORENZ = ro.Problem.from_strings(
    {"x": "10*(y - x)", "y": "x*(r - z) - y", "z": "x*y - 8*z/3"},
    {"x": "1", "y": "1", "z": "20"},
    {"r": (26, 30)},
    (0, 20),
)


def test_the_default_says_which_engine_it_was():
    solution = ro.solve(EXAMPLES["lotka_volterra"].problem, rtol=1e-5)
    assert solution.success
    assert solution.method == "cross"


def test_the_next_engine_is_tried_where_the_first_one_fails():
    compiled = ro.compile(EXAMPLES["coupled"].problem)
    solution = compiled.solve(1e-6, max_nodes=5, max_attempts=1)
    assert not solution.success
    other = {"cross": "train", "train": "cross"}[solution.method]
    assert solution.message.startswith(f"{solution.method}: the")
    assert f". Also tried {other}: the" in solution.message
    assert solution.error == min(
        compiled.solve(1e-6, method=m, max_nodes=5, max_attempts=1).error
        for m in ("cross", "train")
    )


@pytest.mark.parametrize(
    "method",
    [
        "auto",
        pytest.param("train", marks=pytest.mark.slow),
        *(pytest.param(m, marks=pytest.mark.slow) for m in ("cross", "greedy")),
    ],
)
def test_a_budget_of_work_holds(method):
    effort = 0.03
    solution = ro.solve(LORENZ, rtol=1e-5, method=method, effort=effort, integrator="stack")
    assert not solution.success
    assert solution.status is ro.Status.WORK_LIMIT
    assert "the budget of work was reached" in solution.message
    assert "raise effort" in solution.message
    assert list(solution.work) == ["reference", "march", "check"]
    assert sum(solution.work.values()) < 1.2 * effort * NORMAL


def test_a_time_limit_holds():
    solution = ro.solve(LORENZ, rtol=1e-5, max_seconds=0.5)
    assert solution.status is ro.Status.TIME_LIMIT
    assert "max_seconds" in solution.message


def test_no_time_at_all():
    solution = ro.solve(LORENZ, rtol=1e-5, max_seconds=0)
    assert solution.status is ro.Status.TIME_LIMIT
    with pytest.raises(ro.EvaluationError, match="nothing was solved"):
        solution(t=0.0, r=27.0)


@pytest.mark.parametrize("wrong", [-1, "5", float("nan"), True])
def test_wrong_limits(wrong):
    with pytest.raises(ro.OptionError, match="max_seconds"):
        ro.solve(EXAMPLES["decay"].problem, max_seconds=wrong)


@pytest.mark.parametrize("wrong", [0, -1, "huge", float("nan"), True])
def test_wrong_efforts(wrong):
    with pytest.raises(ro.OptionError, match="effort"):
        ro.solve(EXAMPLES["decay"].problem, effort=wrong)
