"""Fields that events reset or end, against trajectories of all entries."""

import numpy as np
import pytest
import scipy.sparse as ss
import sympy as sp

import rankone as ro

N = 24
t, k, q = sp.symbols("t k q")
u = ro.field("u", N)
x = sp.Function("x")(t)
LAPLACE = ss.csr_array(
    ss.diags_array([1.0, -2, 1], offsets=[-1, 0, 1], shape=(N, N)) * (N + 1) ** 2
)
MEAN = ro.apply(np.full((1, N), 1.0 / N), u)
POINT = {"k": 1.05, "q": 2.4}
TIMES = np.linspace(0.0, 0.2, 21)
RTOL = 1e-3


def problem(events=None, **further):
    rates = {u: k * ro.apply(LAPLACE, u) + q * x, x: -x}
    box = {k: (0.8, 1.2), q: (2, 3)}
    return ro.Problem(rates, (t, 0, 0.2), box, {u: 0, x: 1}, events=events, **further)


CASES = {
    "reset": problem(
        [ro.Event(MEAN - 0.04, "rising", then={u: u / 2 + u**2 + 0.01 * q, x: x / 2}, name="hit")]
    ),
    "jumps": problem(jumps={0.1: {x: x + 1}, q / 50: {u: 0}}),
    "mark": problem([ro.Event(MEAN - 0.04, name="hit"), ro.Event(x - 0.9, then={x: 1})]),
    "terminal": problem([ro.Event(MEAN - 0.04, "rising", terminal=True, name="hit")]),
}


@pytest.fixture(scope="module")
def solved():
    return {name: ro.solve(each, rtol=RTOL, method="reduced") for name, each in CASES.items()}


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_fields_are_those_of_all_entries(solved, name):
    solution, scales = solved[name], solved[name].modes.scales
    exact = CASES[name].trajectory(TIMES, **POINT)
    assert solution.success, solution.message
    values = solution(t=TIMES, **POINT)
    assert (np.isnan(values) == np.isnan(exact.values)).all()
    difference = np.nanmax(np.abs(values - exact.values), axis=1)
    assert difference[:N].max() < RTOL * scales[0]
    assert difference[N] < RTOL * scales[1]
    for event, times in exact.events.items():
        assert solution.event_times(event, **POINT) == pytest.approx(times, abs=RTOL * 0.2)


@pytest.mark.slow
def test_terminal_events_end_the_field(solved):
    solution = solved["terminal"]
    end = solution.end(**POINT)
    assert solution(t=end - 1e-9, **POINT)[:N].mean() == pytest.approx(0.04, rel=1e-3)
    assert np.isnan(solution(t=end + 1e-4, **POINT)).all()
    assert "ends it" in str(solution.timeline)


@pytest.mark.slow
def test_the_message_has_the_error_of_times(solved):
    assert "times of events within" in solved["reset"].message


@pytest.mark.slow
def test_outputs_follow_the_events(solved):
    solution = solved["reset"]
    output = solution.output({"mean": MEAN, "x": x})
    assert output.success
    values = solution(t=TIMES, **POINT)
    expected = [values[:N].mean(axis=0), values[N]]
    assert output(t=TIMES, **POINT) == pytest.approx(np.array(expected), abs=1e-5)
    assert output.event_times("hit", **POINT) == solution.event_times("hit", **POINT)


@pytest.mark.slow
def test_solutions_with_events_are_saved(solved, tmp_path):
    solution = solved["reset"]
    again = ro.load(solution.save(tmp_path / "u.npz"))
    assert again.success
    assert (again(t=TIMES, **POINT) == solution(t=TIMES, **POINT)).all()
    assert again.event_times("hit", **POINT) == solution.event_times("hit", **POINT)


@pytest.mark.slow
def test_events_that_only_some_trajectories_meet():
    """The order changes inside the box: branches, or a refusal that says so, but nothing wrong."""
    event = ro.Event(x - ro.apply(np.full((1, N), 8.0 / N), u), "falling", then={u: 0}, name="hit")
    some = problem([event])
    solution = ro.solve(some, rtol=RTOL, method="reduced")
    for point in ({"k": 0.82, "q": 2.9}, {"k": 1.18, "q": 2.1}):
        exact = some.trajectory(TIMES, **point)
        times = solution.event_times("hit", **point)
        met = times[np.isfinite(times)]
        assert met == pytest.approx(exact.events["hit"], abs=RTOL * 0.2)
        near = np.abs(TIMES[:, None] - exact.events["hit"]).min(axis=1, initial=1.0) < RTOL * 0.2
        difference = np.abs(solution(t=TIMES, **point) - exact.values)[:N, ~near].max()
        assert difference < RTOL * solution.modes.scales[0]
