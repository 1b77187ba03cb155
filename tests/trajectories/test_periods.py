"""Periods that repeat, and what looks as if it did."""

import dataclasses

import numpy as np
import pytest

import rankone as ro
from rankone.trajectories.events import periods
from rankone.trajectories.events.event_crossings import Crossings
from rankone.trajectories.events.event_integration import Ahead
from rankone.trajectories.events.event_trajectory import EventTrajectory, Occurrence
from rankone.trajectories.events.markers import ForeseenMarks, _enough_marks
from rankone.trajectories.events.periods import is_autonomous, repeating_from, repeats
from rankone.trajectories.events.sides import follow
from rankone.trajectories.events.stretches import in_stretches, marker_event, timed_events
from rankone.trajectories.integrators.integrator import Spans, Tolerances, joined
from rankone.trajectories.integrators.integrator_choice import integrator_for, span_integrator_for
from rankone.trajectories.system.features import Ending, EventOrder, Marker
from rankone.trajectories.system.system import Clock

END, COUNT = 24.0, 16
ACCURACY = 1e-8
POINTS = np.array([[8.0, 0.9], [10.0, 1.0], [12.0, 1.1]])
PREY = {"x": "x*(1.5 - y)", "y": "-y*(3 - x)"}
START = {"x": "x0", "y": "5*p"}


def system_of(rates=(), start=()):
    """Prey and predators, perhaps with further states."""
    box = {"x0": (8, 12), "p": (0.9, 1.1)}
    return ro.compile(
        ro.Problem.from_strings({**PREY, **dict(rates)}, {**START, **dict(start)}, box, (0, END))
    ).system


def followed(system, accuracy=ACCURACY, repeats_from=8):
    """Trajectories at three points over sixteen crossings of x = 5."""
    timed = timed_events(system, (), (Marker(0, 5.0),))
    order = EventOrder(((0,),) * COUNT, Ending.EVENT)
    marker = Marker(0, 5.0)
    clock = Clock(timed, order, (0.0, END), (), (marker,), True, repeats_from=repeats_from)
    tolerances = Tolerances(accuracy, accuracy * np.ones((system.n_differential, 1)))
    integrator = span_integrator_for(timed)
    return clock, follow(clock, integrator, POINTS, tolerances, COUNT)


def goes_on(clock, trajectories):
    integrator = span_integrator_for(clock.system)
    return repeating_from(clock, integrator, POINTS, trajectories, ACCURACY)


def test_prey_and_predators_go_round_as_if_they_were_integrated():
    system = system_of()
    _, trajectories = followed(system)
    assert all(each.period for each in trajectories)
    assert all(each.paths[-1].end < 0.7 * END for each in trajectories)
    clock, integrated = followed(system, 0.01 * ACCURACY, repeats_from=0)
    assert goes_on(clock, integrated)
    times = np.linspace(0.0, END, 301)
    for there, here in zip(integrated, trajectories, strict=True):
        assert not there.period
        exact, marks = there(times), np.array([mark.time for mark in there.occurrences[:COUNT]])
        sizes = np.abs(exact).max(axis=1, keepdims=True)
        assert (np.abs(here(times) - exact) < 1e-6 * sizes).all()
        found = np.array([mark.time for mark in here.occurrences[:COUNT]])
        np.testing.assert_allclose(found, marks, atol=1e-7)


def test_crossings_of_a_level_are_those_of_any_function():
    """Steps on which a marker is far from its level are left out of the search."""
    system = system_of()
    _, trajectories = followed(system, repeats_from=0)
    paths = [joined(each.paths) for each in trajectories]
    crossings = Crossings(system, paths, POINTS, [{}] * len(paths), 1e-9)
    marker = marker_event(Marker(0, 5.0), "marker")
    function = dataclasses.replace(marker, marker=None)
    for ours, theirs in zip(crossings.of(0, marker), crossings.of(0, function), strict=True):
        assert ours.size > COUNT - 2
        np.testing.assert_allclose(ours, theirs, rtol=1e-12)


def test_quadratic_polynomials_foresee_marks():
    points = np.random.default_rng(3).random((30, 2))
    times = np.stack([1.0 + points[:, 0] ** 2, 5.0 + points[:, 0] * points[:, 1]], axis=1)
    bounds = np.array([[0.0, 1.0], [0.0, 1.0]])
    marks = ForeseenMarks.fitted(bounds, points, times, gap=2.0)
    foreseen = marks(points, 2)
    np.testing.assert_allclose(foreseen.times, times, atol=1e-9)
    assert (foreseen.margins > 0.0).all()
    assert foreseen.missed < 1e-9
    assert marks(points, 1).times.shape == (30, 1)
    assert marks(points, 9).times.shape == (30, 2)


def test_paths_go_from_one_time_between_to_the_next():
    system = system_of()
    tolerances = Tolerances(ACCURACY, ACCURACY * np.ones((2, 1)))
    starts, ends, columns = np.zeros(3), np.array([3.0, 3.5, 4.0]), POINTS.T.copy()
    whole = Spans(starts, system.initial(columns), ends)
    divided = dataclasses.replace(whole, between=np.array([[0.7, 2.0], [0.8, 2.2], [1.0, 2.5]]))
    integrator = span_integrator_for(system)
    paths = integrator.paths(system, POINTS, whole, tolerances)
    parts = integrator.paths(system, POINTS, divided, tolerances)
    for path, part, end, between in zip(paths, parts, ends, divided.between, strict=True):
        assert part.end == end
        assert np.isin(between, part.breaks).all()
        times = np.linspace(0.0, end, 50)
        np.testing.assert_allclose(part(times), path(times), rtol=1e-6)


def test_marks_behind_a_trajectory_are_not_between():
    marks, ends = np.array([[1.0, 2.0], [1.5, 2.5]]), np.array([2.2, 2.8])
    ahead, others = Ahead(marks, ends), np.array([9.0, 9.0])
    told, between = ahead.of([0, 1], np.zeros(2), others)
    np.testing.assert_array_equal(told, ends)
    np.testing.assert_array_equal(between, marks)
    told, between = ahead.of([0, 1], np.array([0.0, 1.6]), others)
    assert between is None
    told, _ = ahead.of([1], np.array([3.0]), np.array([4.0]))
    np.testing.assert_array_equal(told, [4.0])


def test_states_over_stretches_are_in_the_order_of_their_times():
    """Those of later periods, and of times that do not ascend."""
    system = system_of()
    clock, _ = followed(system)
    stretched, points = in_stretches(clock), np.array([[8.0, 0.9], [12.0, 1.1]])
    tolerances = Tolerances(ACCURACY, ACCURACY * np.ones((stretched.n_differential, 1)))
    dense = integrator_for(stretched).run(stretched, points, stretched.horizon, tolerances)
    assert all(each.period for each in dense.trajectories)
    for times in (np.array([0.9, 0.1, 2.5, 1.3]), np.array([9.9, 0.1, 1.7, 7.9, 5.7, 8.3])):
        together = dense(times)
        for k, time in enumerate(times):
            np.testing.assert_allclose(together[:, :, k], dense(time[None])[:, :, 0], rtol=1e-9)
        for m, each in enumerate(dense.trajectories):
            np.testing.assert_allclose(together[:2, m], each(together[2, m]), rtol=1e-9)


@pytest.mark.parametrize(
    ("rate", "start"),
    [
        ("0.3*z", "1e-12*p"),  # grows from nothing
        ("1e-6*x", "1"),  # drifts slowly
        ("1", "1700000000"),  # drifts far from zero
    ],
)
def test_what_changes_slowly_or_is_tiny_does_not_repeat(rate, start):
    _, trajectories = followed(system_of({"z": rate}, {"z": start}))
    assert not any(each.period for each in trajectories)
    assert not any(repeats(each, ACCURACY, 2) for each in trajectories)


@pytest.mark.parametrize(
    "rate",
    [
        *("sin(t)", "exp(-(t - 20)**2)", "Heaviside(t - 20)"),
        *("Piecewise((1, t*x > 300), (0, True))", "t*0 + x"),
    ],
)
def test_rates_that_read_the_time_do_not_repeat(rate):
    system = system_of({"z": rate}, {"z": "0"})
    assert is_autonomous(system) == (rate == "t*0 + x")


def test_trajectories_that_events_may_interrupt_do_not_repeat():
    clock, trajectories = followed(system_of())
    assert goes_on(clock, trajectories)
    assert not goes_on(dataclasses.replace(clock, in_step=False), trajectories)


def test_next_to_an_unstable_state_that_rests_nothing_repeats():
    """u rests in an unstable state, which the least change leaves in 40 periods."""
    system = system_of({"u": "0.3*u*(u - 1)"}, {"u": "1"})
    clock, trajectories = followed(system)
    assert all(repeats(each, ACCURACY, 2) for each in trajectories)
    clock = dataclasses.replace(clock, horizon=(0.0, 10.0 * END))
    assert not goes_on(clock, trajectories)


@pytest.mark.slow
def test_the_check_sees_what_goes_on_wrongly(monkeypatch):
    """u leaves an unstable state late: without the conditions on periods it would not be seen."""
    monkeypatch.setattr(periods, "ROUNDING", np.inf)
    any_growth = dataclasses.replace(periods._REPEATING, most_growth=np.inf)
    monkeypatch.setattr(periods, "_REPEATING", any_growth)
    rates = {**PREY, "u": "0.9*u*(u - 1)"}
    start = {**START, "u": "1 - 1e-9"}
    box = {"x0": (8, 12), "p": (0.9, 1.1)}
    problem = ro.Problem.from_strings(rates, start, box, (0, 30))
    solution = ro.solve(problem, 1e-3, method="cross", effort=0.1)
    assert solution.outcome.timeline is not None
    assert not solution.success
    assert solution.error > 0.1


def test_what_repeats_only_after_the_end_leaves_nothing_out(monkeypatch):
    system = system_of()
    clock, trajectories = followed(system, repeats_from=0)
    assert goes_on(clock, trajectories)
    early = dataclasses.replace(clock, horizon=(0.0, trajectories[0].occurrences[3].time))
    monkeypatch.setattr("rankone.trajectories.events.periods._growth", None)  # no integration
    assert goes_on(early, trajectories) == 0


def marked(*times):
    """A trajectory that passes marks at times."""
    occurrences = [Occurrence(0, time, np.zeros(1), np.zeros(1)) for time in times]
    return EventTrajectory([], 0.0, np.zeros(1), occurrences=occurrences)


@pytest.mark.parametrize(("end", "enough"), [(4.2, 5), (4.4, 5), (4.6, 6), (4.99, 6), (3.99, 5)])
def test_all_pass_the_last_mark_well_after_the_end(end, enough):
    """Two marks in a period of two, and one a little later for the slower trajectory."""
    trajectories = [marked(1, 2, 3, 4, 5, 6, 7), marked(1, 2, 3.1, 4.1, 5.1, 6.1, 7.1)]
    passed = max(sum(mark.time < end for mark in each.occurrences) for each in trajectories)
    assert _enough_marks(trajectories, 2, passed, passed + 2, end) == enough
    assert _enough_marks([*trajectories, marked(1, 2)], 2, passed, passed + 2, end) == passed + 2
