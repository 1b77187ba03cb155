"""Train and greedy over the stretches between events at known times."""

from functools import cache

import numpy as np
import pytest

import rankone as ro

RTOL = 1e-4


def problem(rates, initial, parameters, end, **further):
    return ro.Problem.from_strings(rates, initial, parameters, (0, end), **further)


DECAY, RATE, LAG = {"A": "-k*A"}, {"k": (0.2, 0.4)}, {"lag": (1, 2)}
PROBLEMS = {
    "dose": problem(
        DECAY,
        {"A": "0.1"},
        {**RATE, **LAG, "D": (1, 2)},
        6,
        jumps={"lag": {"A": "A + D"}, 3: {"A": "A + 1"}},
    ),
    # for some parameters the second dose comes after the end, and the first one at the start
    "early and late": problem(
        DECAY,
        {"A": "1"},
        {**RATE, "lag": (0, 1)},
        2.5,
        jumps={"lag": {"A": "A + 1"}, "2*lag + 1": {"A": "A/2"}},
    ),
    "infusion": problem(
        {"A": "r*(Heaviside(t - lag) - Heaviside(t - lag - d)) - k*A - 0.1*A**3"},
        {"A": 0},
        {**RATE, **LAG, "r": (1, 2), "d": (1, 1.5)},
        5,
    ),
    "square wave": problem(
        {"A": "Heaviside(sin(w*t)) - k*A"}, {"A": 0}, {**RATE, "w": (2, 2.2)}, 4
    ),
    # the times separate as states, not as expressions
    "root": problem(
        {"A": "t - k*A**2"},
        {"A": 1},
        {**RATE, "a": (1, 2), "b": (0.1, 0.3)},
        3,
        jumps={"sqrt(a + b)": {"A": "A + b"}},
    ),
    "kink": problem({"A": "t*Abs(t - lag) - k*A**2"}, {"A": 1}, {**RATE, **LAG}, 3),
    # functions of time and of an unknown are lifted over stretches
    "lifted": problem(
        {"A": "exp(-t)*Heaviside(t - lag) - k*A/(1 + A)"},
        {"A": 1},
        {**RATE, **LAG},
        4,
        jumps={"lag": {"A": "A + 1"}, "lag + 1": {"A": "A**2"}},
    ),
    # two events at one instant, the second of which reads what the first one made, and an end
    "together": problem(
        {"x": "y", "y": "-w*x"},
        {"x": 1, "y": 0},
        {"w": (2, 3), "a": (0.8, 1.2)},
        3,
        events=[
            {"when": "t - a", "then": {"x": "x**2 + a", "y": 0}, "name": "first"},
            {"when": "2*t - 2*a", "then": {"y": "x"}, "name": "second"},
            {"when": "2*a - t", "terminal": True, "name": "last"},
        ],
    ),
}
STRETCHES = dict(zip(PROBLEMS, (3, 3, 3, 4, 2, 2, 3, 2), strict=True))


def largest_error(name, solution):
    """Over clock times and random parameters, relative to the largest value."""
    asked, rng, error, size = PROBLEMS[name], np.random.default_rng(25), 0.0, 0.0
    times = np.linspace(0.0, 0.997 * float(asked.time[2]), 23)
    box = solution.metadata.box
    for _ in range(4):
        point = dict(zip(map(str, asked.parameters), (rng.uniform(*b) for b in box), strict=True))
        exact, found = asked.trajectory(times, **point), solution(times, **point)
        assert (np.isnan(exact) == np.isnan(found)).all()
        error = max(error, np.nanmax(np.abs(exact - found)))
        size = max(size, np.nanmax(np.abs(exact)))
    return error / size


@cache
def solved(name, method):
    return ro.solve(PROBLEMS[name], RTOL, method=method)


@pytest.mark.slow
@pytest.mark.parametrize("name", PROBLEMS)
def test_train_solves_over_stretches_between_known_times(name):
    solution = solved(name, "train")
    assert solution.success, solution.outcome.message
    assert solution.timeline.stretches == STRETCHES[name]
    assert largest_error(name, solution) < RTOL


@pytest.mark.parametrize(
    "name",
    [
        pytest.param("dose", marks=pytest.mark.slow),
        pytest.param("lifted", marks=pytest.mark.slow),
        "together",
    ],
)
def test_greedy_solves_over_stretches_between_known_times(name):
    solution = solved(name, "greedy")
    assert solution.success, solution.outcome.message
    assert largest_error(name, solution) < RTOL


@pytest.mark.parametrize("method", ["train", "greedy"])
def test_times_and_values_are_those_of_cross(method):
    point = {"k": 0.31, "lag": 1.7, "D": 1.2}
    solution, cross = solved("dose", method), solved("dose", "cross")
    assert solution.method == method
    assert str(solution.timeline) == str(cross.timeline)
    assert solution.event_times("jump_0", **point) == pytest.approx([1.7], abs=6 * RTOL)
    assert solution.time_error < RTOL
    gradient = solution.gradient(t=4, **point)
    assert gradient == pytest.approx(cross.gradient(t=4, **point), abs=20 * RTOL)


def test_a_saved_solution_keeps_its_timeline(tmp_path):
    solution = solved("together", "train")
    loaded = ro.load(solution.save(tmp_path / "u.npz"))
    point = {"w": 2.4, "a": 1.1}
    assert (loaded([0.5, 1.5], **point) == solution([0.5, 1.5], **point)).all()
    assert loaded.end(**point) == pytest.approx(2.2, abs=1e-3)


@pytest.mark.slow
def test_another_box_and_another_end_are_written_anew():
    compiled = ro.compile(PROBLEMS["dose"])
    moved = {"lag": (3.5, 4), "D": (3, 4)}
    solution = compiled.solve(RTOL, method="train", parameters=moved, t_final=5)
    assert solution.success
    point = {"k": 0.3, "lag": 3.8, "D": 3.3}
    times = [3.1, 3.7, 3.9, 4.9]
    exact = compiled.solve(1e-6, parameters=moved, t_final=5)(times, **point)
    assert solution(times, **point) == pytest.approx(exact, rel=RTOL)


def test_times_that_change_their_order_are_refused():
    crossing = problem(
        DECAY,
        {"A": "1"},
        {**RATE, **LAG, "late": (1.5, 3)},
        4,
        jumps={"lag": {"A": "A + 1"}, "late": {"A": "2*A"}},
    )
    with pytest.raises(ro.ConvergenceError, match="same order everywhere"):
        ro.solve(crossing, 1e-3, method="train")


def test_events_of_states_are_left_to_cross():
    event = {"when": "A - 0.5", "direction": "falling", "then": {"A": 1}}
    compiled = ro.compile(problem(DECAY, {"A": "1"}, RATE, 3, events=[event]))
    assert "cross" in compiled.methods["train"]
    for method in ("train", "greedy"):
        with pytest.raises(ro.OptionError, match=r"known times only.*cross"):
            compiled.solve(1e-3, method=method)


def test_what_does_not_separate_over_stretches_is_named():
    forced = problem({"A": "k - abs(A)"}, {"A": 1}, RATE | LAG, 4, jumps={"lag": {"A": "A + 1"}})
    with pytest.raises(ro.SeparationError, match=r"over the stretches between events, .*Abs"):
        ro.solve(forced, 1e-3, method="train")


@pytest.mark.slow
def test_a_march_that_stops_between_events_solves_nothing():
    solution = ro.solve(PROBLEMS["dose"], RTOL, method="train", max_slabs=2)
    assert not solution.success
    assert "limit of time slabs" in solution.outcome.message
    with pytest.raises(ro.EvaluationError, match="nothing was solved"):
        solution(1, k=0.3, lag=1.5, D=1.5)


def test_a_standalone_solver_by_train_is_refused(tmp_path):
    compiled = ro.compile(PROBLEMS["dose"])
    with pytest.raises(ro.ExportError, match="over stretches"):
        compiled.export(tmp_path / "dose.py", method="train")


def test_roots_at_moving_times_are_lifted_rather_than_cut():
    compiled = ro.compile(problem({"A": "-sqrt(k + t)*A"}, {"A": 1}, {"k": (0.5, 1)}, 1))
    assert compiled.system.features.n_moving_cuts
    assert compiled.form_for("train") is compiled.lifted
