"""States that are numerically zero do not hold up an integration, and none that matters is one."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import rankone as ro
from rankone.solvers.verification.reference import integrate_reference
from rankone.trajectories.stacks.stack import _Stack

CONSERVED = {
    "a": "-100*k*a*x/(1 + x) + 30*b + 0.3*c",
    "b": "100*k*a*x/(1 + x) - 30*b - b*c/(7 + c)",
    "c": "b*c/(7 + c) - 0.3*c",
    "x": "1e4*(a/3 - x)",
}
"""Stiff kinetics in which a + b + c stays what it was, except for rounding."""
LEFT = "(a + b + c - 1003.3)"
STARTS = {"a": "1000", "b": "0", "c": "3.3", "x": "17"}


def compiled(rates, starts, end, box):
    return ro.compile(ro.Problem.from_strings(rates, starts, box, (0, end)))


def reference(problem, points, rtol=3e-7):
    with np.errstate(all="ignore"):
        return integrate_reference(problem.system, points, problem.system.horizon, rtol)


@pytest.mark.parametrize(
    ("rates", "start"),
    [
        ({"z": f"{LEFT} - z"}, "0"),
        ({"z": f"{LEFT}**2 - z"}, "0"),
        ({"z": f"1e-10*{LEFT}*x - 1e-3*z*x", "y": "z*x - 5*y"}, "0"),
    ],
    ids=["rounding", "its square", "and what it drives"],
)
def test_rounding_errors_are_not_followed(monkeypatch, rates, start):
    """Who follows them makes steps of 1e-18, and takes that for a blow-up."""
    steps = []
    original = _Stack._steps
    monkeypatch.setattr(
        _Stack,
        "_steps",
        lambda self, method, recorder, give_up: original(
            self, method, recorder, lambda *step: steps.append(step) or give_up(*step)
        ),
    )
    starts = {**STARTS, **dict.fromkeys(rates, start)}
    problem = compiled(CONSERVED | rates, starts, 240, {"k": (0.5, 1)})
    trajectories = reference(problem, np.array([[0.75], [0.5], [1.0]]))
    assert trajectories.blown is None
    assert trajectories.zero.tolist() == [False] * 4 + [True] * len(rates)
    assert len(steps) < 600
    others = np.array([1000.0, 380.0, 716.0, 73.0])
    alone = reference(compiled(CONSERVED, STARTS, 240, {"k": (0.5, 1)}), np.array([[0.75]]))
    times = np.linspace(0, 240, 7)
    difference = trajectories(times)[:4, 0] - alone(times)[:, 0]
    assert np.abs(difference / others[:, None]).max() < 3e-6


def test_a_difference_above_rounding_is_not_zero():
    rates = {"a": "k*(b - a)", "b": "k*(a - b)", "z": "a - b - z"}
    starts = {"a": "1000.0001", "b": "1000", "z": "0"}
    trajectories = reference(compiled(rates, starts, 5, {"k": (0.5, 1.5)}), np.array([[0.8]]))
    assert not trajectories.zero.any()
    times = np.linspace(0, 5, 9)
    exact = 1e-4 * (np.exp(-times) - np.exp(-1.6 * times)) / 0.6
    assert np.abs(trajectories(times)[2, 0] - exact).max() < 1e-4 * exact.max()


def test_a_solution_says_what_is_numerically_zero():
    rates = {"a": "-k*a + 3*b", "b": "k*a - 3*b", "z": "a + b - 300.7 - z"}
    starts = {"a": "300.7", "b": "0", "z": "0"}
    solution = compiled(rates, starts, 5, {"k": (0.5, 1)}).solve(1e-4, method="cross")
    assert solution.success
    assert "`z` is numerically zero" in solution.message
    assert np.abs(solution["z"](t=[1, 5], k=0.7)).max() < 1e-10
    decay = np.exp(-3.7 * np.array([0.3, 4.0]))
    exact = 300.7 * (3 + 0.7 * decay) / 3.7
    assert solution["a"](t=[0.3, 4.0], k=0.7) == pytest.approx(exact, rel=3e-4)


BIG = {"x": "k*(1000 - x)", "y": "1e3*(x - y)"}
BIG_STARTS = {"x": "1000", "y": "900"}
MATTERS = {
    "Robertson": (
        {"x": "-0.04*k*x + 1e4*y*z", "y": "0.04*k*x - 1e4*y*z - 3e7*y**2", "z": "3e7*y**2"},
        {"x": "1", "y": "0", "z": "0"},
        40,
    ),
    "unstable": (BIG | {"z": "5*k*z*(1 - z)"}, BIG_STARTS | {"z": "1e-20"}, 12),
    "seed": (BIG | {"z": "5*k*z*(1 - z) + 1e-23*x"}, BIG_STARTS | {"z": "0"}, 12),
    "catalyst": ({"x": "-1e23*k*z*x", "z": "1e-23 - z"}, {"x": "1000", "z": "1e-23"}, 5),
    "tiny": (BIG | {"z": "1e-26*x - k*z"}, BIG_STARTS | {"z": "0"}, 5),
    "constants": (
        {"a": "0*a", "b": "0*b", "z": "5*k*z + a - b"},
        {"a": "1000", "b": "1000", "z": "1e-23"},
        2,
    ),
}


@pytest.mark.parametrize(
    ("rates", "starts", "end"),
    [
        pytest.param(*case, marks=pytest.mark.slow if n == "seed" else ())
        for n, case in MATTERS.items()
    ],
    ids=MATTERS,
)
def test_no_state_that_matters_is_numerically_zero(rates, starts, end):
    """Each to its own relative accuracy, against SciPy."""
    problem = compiled(rates, starts, end, {"k": (0.5, 1.5)})
    trajectories = reference(problem, np.array([[1.0], [0.8]]))
    assert not trajectories.zero.any()
    times = np.linspace(0, end, 9)
    exact = solve_ivp(
        lambda t, u: problem.system.rhs(t, u[:, None], np.array([[0.8]]))[:, 0],
        (0, end),
        [float(value) for value in starts.values()],
        method="Radau",
        rtol=1e-9,
        atol=1e-40,
        t_eval=times,
    ).y
    sizes = np.abs(exact).max(axis=1, keepdims=True)
    assert np.abs((trajectories(times)[:, 1] - exact) / sizes).max() < 1e-4
