"""Events along full trajectories of fields, where they are known in closed form."""

import numpy as np
import pytest
import sympy as sp

import rankone as ro
from rankone.compiler.field_lowering import field_system
from rankone.trajectories.fields.field_steps import EndsEarlyError
from rankone.trajectories.fields.field_trajectories import FieldIntegration, field_trajectory

N = 5
t, k = sp.symbols("t k")
u = ro.field("u", N)
x, y = sp.Function("x")(t), sp.Function("y")(t)
ROW = np.full((1, N), 1.0 / N)
MEAN = ro.apply(ROW, u)
WEIGHTS = np.arange(N) - 2.0


def trajectory(rates, initial, events, end=1.0, beside=0.0, tolerance=1e-9, **further):
    box = {k: (0.5, 2.0)}
    problem = ro.Problem(rates, (t, 0, end), box, initial, events=events, **further)
    system = field_system(problem)
    sizes = np.ones(len(system.unknowns))
    point = np.array([1.0])
    return field_trajectory(system, point, sizes, tolerance, 1e-11, beside=beside)


def times(course, event=0):
    return [each.time for each in course.occurred if each.event == event]


def last(course):
    return course.states[0].at(slice(-1, None))[:, 0]


def test_a_functional_resets_the_field():
    """The mean is exp(t), is halved at each 2, and each entry goes with it."""
    event = ro.Event(MEAN - 2, "rising", then={u: u / 2})
    course = trajectory({u: k * u + 0 * x, x: 0}, {u: 1 + ro.apply(WEIGHTS, 1), x: 0}, [event], 2)
    assert times(course) == pytest.approx([np.log(2.0), 2.0 * np.log(2.0)], abs=1e-7)
    assert last(course) == pytest.approx((1.0 + WEIGHTS) * np.exp(2.0) / 4.0, rel=1e-6)
    assert course.end == 2.0
    assert np.count_nonzero(np.diff(course.times) == 0.0) == 2


def test_nonlinear_resets_are_exact_at_all_entries():
    event = ro.Event(MEAN - 2, "rising", then={u: sp.exp(-u) + ro.apply(WEIGHTS, k)})
    course = trajectory({u: k}, {u: 0.5}, [event], 2)
    assert times(course) == pytest.approx([1.5], abs=1e-9)
    assert last(course) == pytest.approx(np.exp(-2.0) + WEIGHTS + 0.5, abs=1e-7)


def test_a_terminal_event_ends_it():
    course = trajectory({u: k}, {u: 0.5}, [ro.Event(MEAN - 1, terminal=True)])
    assert course.end == pytest.approx(0.5, abs=1e-9)
    assert course.times[-1] == course.end
    assert last(course) == pytest.approx(np.ones(N), abs=1e-8)


def test_marks_do_not_interrupt():
    rates, initial = {u: y + 0 * k, y: -x * k, x: y}, {u: 0, x: 0, y: 1}
    plain = trajectory(rates, initial, None, 10)
    marked = trajectory(rates, initial, [ro.Event(MEAN, "falling"), ro.Event(MEAN)], 10)
    assert times(marked) == pytest.approx([np.pi, 3.0 * np.pi], abs=1e-6)
    assert times(marked, 1) == pytest.approx([np.pi, 2.0 * np.pi, 3.0 * np.pi], abs=1e-6)
    assert (marked.times == plain.times).all()


def test_a_start_on_the_surface_is_no_crossing():
    for start in (0.0, 0.1 + 0.2 - 0.3):
        events = [ro.Event(x, then={x: 0}), ro.Event(MEAN - 1, then={u: 0})]
        course = trajectory({u: k, x: k}, {u: 1, x: start}, events)
        assert course.occurred == ()


def test_a_reset_on_to_the_surface_is_left_to_both_sides():
    """A ball of unit bounces: no second event where it leaves the floor."""
    events = [ro.Event(x, "falling", then={x: 0, y: -y})]
    course = trajectory({u: k, x: y, y: -2}, {u: 0, x: 1, y: 0}, events, 6)
    assert times(course) == pytest.approx([1.0, 3.0, 5.0], abs=1e-7)


def test_resets_set_off_other_events():
    """The reset of u takes x across its surface, at the same instant."""
    events = [
        ro.Event(MEAN - 1, "rising", then={u: 0, x: x + 2}),
        ro.Event(x - 1, "rising", then={x: -5}),
    ]
    course = trajectory({u: k, x: 0}, {u: 0.5, x: 0}, events)
    assert times(course) == times(course, 1) == [pytest.approx(0.5, abs=1e-9)]
    assert course.states[1].at(slice(-1, None)) == pytest.approx(-5.0)


def test_jumps_at_known_times_are_met_exactly():
    jumps = {0.3: {u: u + 1}, k / 2: {u: 2 * u}, 0: {u: 3}}
    course = trajectory({u: 0 * k}, {u: 0}, None, jumps=jumps)
    assert sorted(each.time for each in course.occurred) == [0.0, 0.3, 0.5]
    assert last(course) == pytest.approx(np.full(N, 8.0))


def test_events_of_one_instant_follow_the_list():
    events = [ro.Event(t - k / 2, then={u: u + 1}), ro.Event(t - k / 2, then={u: 3 * u})]
    assert last(trajectory({u: 0 * k}, {u: 1}, events)) == pytest.approx(np.full(N, 6.0))


def test_states_beside_jumps_are_kept():
    event = ro.Event(MEAN - 1, "rising", then={u: 0})
    course = trajectory({u: k}, {u: 0.5}, [event], beside=1e-3)
    (instant,) = times(course)
    assert np.abs(course.times - (instant - 1e-3)).min() < 1e-14
    assert np.abs(course.times - (instant + 1e-3)).min() < 1e-14


@pytest.mark.parametrize("tolerance", [1e-6, 1e-9, 1e-12])
def test_a_reset_that_keeps_the_surface_is_one_event(tolerance):
    """One entry of an oscillator falls through zero, and the velocity is halved there."""
    first = np.eye(1, N)
    events = [ro.Event(ro.apply(first, u), "falling", then={y: y / 2})]
    rates = {u: y + k - 1, y: -k * ro.apply(first, u)}
    course = trajectory(rates, {u: 1, y: 0}, events, 9, tolerance=tolerance)
    assert times(course) == pytest.approx([np.pi / 2, np.pi * 5 / 2], abs=1e3 * tolerance)


def test_finer_steps_tell_events_apart():
    """Eight bounces before they accumulate at 3, which coarse steps pass over."""
    events = [ro.Event(x, "falling", then={x: 0, y: -y / 2})]
    rates, start = {u: k, x: y, y: -2}, {u: 0, x: 1, y: 0}
    problem = ro.Problem(rates, (t, 0, 2.99), {k: (0.5, 2.0)}, start, events=events)
    system, point, sizes = field_system(problem), np.array([1.0]), np.ones(3)
    with pytest.raises(EndsEarlyError):
        field_trajectory(system, point, sizes, 1e-5, 1e-9)
    (course,) = FieldIntegration(system, sizes, 1e-5, 1e-9).trajectories(point[None])
    bounces = 3.0 - 2.0 * 0.5 ** np.arange(8)
    assert times(course) == pytest.approx(bounces, abs=1e-3)


@pytest.mark.parametrize("tolerance", [1e-5, 1e-7, 1e-9])
def test_events_that_accumulate_are_told(tolerance):
    """No ball falls through the floor, however small its bounces become."""
    events = [ro.Event(x, "falling", then={x: 0, y: -y / 2})]
    with pytest.raises(EndsEarlyError) as ended:
        trajectory({u: k, x: y, y: -2}, {u: 0, x: 1, y: 0}, events, 6, tolerance=tolerance)
    assert ended.value.accumulate
    assert 2.9 < ended.value.time < 3.0
