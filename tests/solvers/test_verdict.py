"""What a failure says: the worst unknown, the stage, the budget, rates that switch to and fro."""

import pytest
import sympy as sp

import rankone as ro
from rankone.solvers.attempts import error_notes, unknowns_notes
from rankone.solvers.outcome import Measured
from rankone.trajectories.system.verdict import (
    Budget,
    ReferenceLimit,
    Remedy,
    Status,
    UndecidedOrder,
    Verdict,
)

t, a, b = sp.symbols("t a b")
x, y = (sp.Function(name)(t) for name in "xy")

STATES = ("x", "x_t", "y", "y_t")
WORK = {"reference": 2e9, "samples": 7e9, "ranks": 1e9, "check": 1e7}


def verdict(errors, status=Status.TOLERANCE, counted=None, corners=()):
    measured = Measured(errors, corners, 96, "DOP853", counted=counted)
    notes = error_notes(1e-5, measured, STATES)
    if status is Status.TOLERANCE:
        notes += [*unknowns_notes(1e-5, measured, STATES), *Budget.of(WORK, 2e10)]
    return str(Verdict(status, None, (*notes, Remedy("narrow the box"))))


def test_the_worst_unknown_is_named_and_those_that_are_accurate():
    message = verdict((1e-6, 2e-6, 3e-6, 4e-4))
    assert "measured error 4.0e-04 in `y_t`, asked 1.0e-05" in message
    assert "`x`, `x_t` and `y` are within it: unknowns=['x', 'x_t', 'y'] asks" in message
    assert message.endswith("; narrow the box")


def test_unknowns_that_do_not_count_are_not_named():
    message = verdict((1e-6, 1.0, 3e-4, 1.0), counted=(0, 2))
    assert "measured error 3.0e-04 in `y`" in message
    assert "`x` is within it" in message
    assert "x_t" not in message


def test_the_shares_of_the_budget():
    took = "the reference trajectories took 10 % of the budget, samples 35 %, ranks 5 %; narrow"
    assert took in verdict((1e-3,) * 4)


def test_attempts_beyond_their_budget_have_shares_of_all_of_their_work():
    (note,) = Budget.of({"reference": 1e9, "samples": 3e9}, 1e9)
    assert dict(note.shares) == {"reference": 0.25, "samples": 0.75}


def test_a_success_says_no_more_than_its_error():
    message = verdict((1e-6,) * 4, Status.CONVERGED)
    assert message == f"{Status.CONVERGED.value}: 1.0e-06 of 1.0e-05; narrow the box"
    message = verdict((1e-6,) * 4, Status.CONVERGED, corners=(1e-4,) * 4)
    assert "in the interior of the box: 1.0e-06 of 1.0e-05 (up to 1.0e-04 at" in message


def test_one_unknown_fails_alone():
    rates = {"x": "v", "v": "-x*k", "y": "exp(-((k - 1.3)*1e3)**2)"}
    initial = {"x": "1", "v": "0", "y": "1"}
    problem = ro.Problem.from_strings(rates, initial, {"k": (1, 2)}, (0, 5))
    solution = ro.solve(problem, 1e-4, method="train", effort=0.01)
    assert not solution.success
    assert " in `y`, asked 1.0e-04" in solution.message
    assert "`x` and `v` are within it: unknowns=['x', 'v'] asks" in solution.message
    assert "of the budget" in solution.message


def test_nothing_was_interpolated_yet():
    rates = {"x": "cos(a*b*c*t + d*x)"}
    box = dict.fromkeys("abcd", (0, 3))
    solution = ro.solve(ro.Problem.from_strings(rates, {"x": "0"}, box, (0, 3)), effort=0.01)
    assert "rank 1: nothing was interpolated yet" in solution.message
    assert "samples" in solution.message
    assert solution.message.endswith("raise effort")


@pytest.mark.slow
def test_coulomb_friction_names_the_term():
    rates = {"x": "v", "v": "sin(t) - x - mu*sign(v)"}
    problem = ro.Problem.from_strings(rates, {"x": "1", "v": "0"}, {"mu": (0.4, 0.5)}, (0, 2))
    assert ro.solve(problem, 1e-3).success
    with pytest.raises(ro.BlowUpError, match="the rate of `v` switches to and fro") as caught:
        ro.solve(problem, 1e-3, markers=None)
    message = str(caught.value)
    assert "near t = " in message
    assert "the term `-mu*sign(v)` in equation 2 switches at `v` = 0" in message
    assert "`tanh(v/w)`" in message
    assert caught.value.solution.status is Status.SWITCHES


def test_a_thermostat_that_takes_all_of_the_budget():
    rates = {"T": "p*Heaviside(20 - T) - 0.1*(T - 10)"}
    problem = ro.Problem.from_strings(rates, {"T": "19"}, {"p": (2, 3)}, (0, 20))
    solution = ro.solve(problem, 1e-3, effort=0.006)
    assert "where the rate of `T` switches to and fro" in solution.message
    assert "; the reference trajectories took " in solution.message
    assert "in equation 1 switches at" in solution.message


@pytest.mark.parametrize(
    ("rate", "boundary", "smooth"),
    [
        ("Abs(x - y) + a", "x - y", "`sqrt((x - y)**2 + w**2)`"),
        pytest.param(
            "Min(1, Max(a, y))",
            "a - y",
            "`(a + y + sqrt((a - y)**2 + w**2))/2`",
            marks=pytest.mark.slow,
        ),
        ("Max(0, y) + a", "y", "`(y + sqrt(y**2 + w**2))/2`"),
        ("Min(a, y)", "a - y", "`(a + y - sqrt((a - y)**2 + w**2))/2`"),
    ],
)
def test_a_kink_that_takes_all_of_the_budget_is_named(rate, boundary, smooth):
    rates = {"x": "y", "y": f"{rate} - 3*x"}
    box = {"a": (0.1, 0.4), "b": (-2, 2)}
    problem = ro.Problem.from_strings(rates, {"x": "1", "y": "b"}, box, (0, 10))
    solution = ro.solve(problem, 1e-8, effort=0.002)
    assert not solution.success
    assert f"in equation 2 switches at `{boundary}` = 0" in solution.message
    assert smooth in solution.message


@pytest.mark.parametrize(
    ("term", "where"),
    [
        pytest.param(
            sp.floor(2 * x + a), "wherever `a + 2*x` is a whole number", marks=pytest.mark.slow
        ),
        pytest.param(sp.Mod(x, b), "wherever `x/b` is a whole number", marks=pytest.mark.slow),
        (
            ro.table([-9, -5, -1, 0, 1, 5, 9], [0, 1, 0, 1, 0, 1, 0])(x),
            "at `x` = -9, -5, -1, 0, 1, 5 and 1 more",
        ),
    ],
)
def test_a_staircase_that_takes_all_of_the_budget_is_named(term, where):
    equations = [x.diff(t) - y, y.diff(t) - term + 3 * x]
    box = {a: (0.1, 0.4), b: (0.5, 2)}
    problem = ro.Problem(equations, (t, 0, 10), box, {x: 1 + a, y: b})
    solution = ro.solve(problem, 1e-8, effort=0.002)
    assert not solution.success
    assert f"in equation 2 switches {where}" in solution.message
    assert solution.message.endswith("in the same order, or smooth the switches")


def test_a_reference_without_a_step_is_said():
    """A budget that ends before the first step tells no time."""
    assert str(Verdict(Status.WORK_LIMIT, ReferenceLimit(0.0, 0))) == (
        "the budget of work was reached before the reference trajectories could begin"
    )
    assert "at t = 0.5 after 7 steps" in str(Verdict(Status.WORK_LIMIT, ReferenceLimit(0.5, 7)))


def test_the_share_of_the_box_that_is_undecided():
    message = str(Verdict(Status.TOLERANCE, UndecidedOrder(1.0), (Remedy("narrow the box"),)))
    assert message == (
        "in 100 % of the box it is undecided in which order events come, and values are NaN; "
        "narrow the box"
    )
