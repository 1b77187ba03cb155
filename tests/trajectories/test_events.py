"""Events against exact solutions, for stacks and for single trajectories."""

from dataclasses import replace

import numpy as np
import pytest
import sympy as sp

import rankone as ro
from rankone.support.budget import OutOfWorkError, limited
from rankone.trajectories.events.event_integration import integrate_to_events
from rankone.trajectories.events.event_trajectory import MOST_ROUNDS
from rankone.trajectories.integrators.integrator import Tolerances
from rankone.trajectories.integrators.integrator_choice import span_integrator_for
from rankone.trajectories.system.features import SystemEvent

INTEGRATORS = ["stack", "single", "auto"]


def system_of(rates, initial, box, end, **further):
    return ro.compile(ro.Problem.from_strings(rates, initial, box, (0, end), **further)).system


def trajectories(system, points, events, integrator, edges=None, rtol=1e-10):
    n = system.n_differential
    tolerances = Tolerances(rtol, np.full((n, 1), 1e-2 * rtol))
    chosen = span_integrator_for(system, integrator)
    edges = edges or list(system.horizon)
    with_events = replace(system, events=tuple(events))
    return integrate_to_events(chosen, with_events, np.array(points), edges, tolerances)


def ball(end):
    """A ball that falls from the height h with g = 2."""
    return system_of({"y": "v", "v": "-2 + 0*y"}, {"y": "h", "v": "0"}, {"h": (0.5, 2.0)}, end)


def bounce(e):
    return SystemEvent(lambda t, u, p: u[0], -1, lambda t, u, p: np.stack([0.0 * u[0], -e * u[1]]))


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_a_bouncing_ball(integrator):
    heights, e = [1.0, 0.64, 1.44], 0.8
    results = trajectories(ball(4.0), [[h] for h in heights], [bounce(e)], integrator)
    for h, each in zip(heights, results, strict=True):
        first = np.sqrt(h)  # h = g t**2 / 2
        gaps = first * np.array([1.0, *(2 * e**k for k in range(1, 12))])
        exact = np.cumsum(gaps)
        exact = exact[exact < 4.0]
        np.testing.assert_allclose(each.times_of(0), exact, rtol=1e-9)
        after = each.occurrences[0].after
        np.testing.assert_allclose(after, [0.0, e * 2 * first], atol=1e-9)
        assert each.end == 4.0
        top = exact[0] + first * e  # the highest place after the first bounce
        np.testing.assert_allclose(each(np.array([top]))[0], h * e**2, rtol=1e-8)


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_a_marker_is_passed_in_its_direction_alone(integrator):
    system = system_of({"x": "w*y", "y": "-w*x"}, {"x": "0", "y": "1"}, {"w": (1, 3)}, 10)
    markers = [SystemEvent(lambda t, u, p: u[0] - 0.5, d) for d in (1, -1, 0)]
    for w, each in zip(
        (1.0, 2.5), trajectories(system, [[1.0], [2.5]], markers, integrator), strict=True
    ):
        turns = 2 * np.pi * np.arange(10)
        rising, falling = (np.pi / 6 + turns) / w, (5 * np.pi / 6 + turns) / w
        both = np.sort(np.concatenate([rising, falling]))
        for event, exact in enumerate((rising, falling, both)):
            np.testing.assert_allclose(each.times_of(event), exact[exact < 10], rtol=1e-8)


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_a_terminal_event_ends_each_trajectory_at_its_time(integrator):
    system = system_of({"x": "-k*x"}, {"x": "1"}, {"k": (0.5, 2)}, 2)
    half = SystemEvent(lambda t, u, p: u[0] - 0.5, terminal=True)
    rates = np.array([[0.2], [0.5], [2.0]])
    slow, middle, fast = trajectories(system, rates, [half], integrator)
    assert (slow.end, slow.ends) == (2.0, False)
    for k, each in ((0.5, middle), (2.0, fast)):
        assert each.ends
        assert each.end == pytest.approx(np.log(2) / k, rel=1e-9)
        np.testing.assert_allclose(each(np.array([0.9 * each.end, 1.9]))[0, 1], np.nan)


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_resets_depend_on_time_and_parameters(integrator):
    """A dose of the size k*t whenever x falls to 1/2."""
    system = system_of({"x": "-x"}, {"x": "k"}, {"k": (1, 2)}, 3)
    dose = SystemEvent(lambda t, u, p: u[0] - 0.5, -1, lambda t, u, p: u + p * t)
    (each,) = trajectories(system, [[1.0]], [dose], integrator)
    times, x = [np.log(2.0)], 0.5 + np.log(2.0)
    while (later := times[-1] + np.log(2 * x)) < 3:
        times.append(later)
        x = 0.5 + later
    np.testing.assert_allclose(each.times_of(0), times, rtol=1e-9)
    np.testing.assert_allclose(each.state, x * np.exp(times[-1] - 3), rtol=1e-8)


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_events_and_jumps_at_known_times(integrator):
    system = system_of({"x": "-k"}, {"x": "1"}, {"k": (1, 2)}, 3, jumps={1: {"x": "x + 1"}})
    zero = SystemEvent(lambda t, u, p: u[0], -1, lambda t, u, p: u + 0.75)
    (each,) = trajectories(system, [[2.0]], [zero], integrator, [0.0, 1.0, 3.0])
    # 1 to 0 at 0.5, 0.75 to 0 at 0.875, 0.5 at 1, 1.5 to 0 at 1.75, then every 0.375
    exact = [0.5, 0.875, 1.75, 2.125, 2.5, 2.875]
    np.testing.assert_allclose(each.times_of(0), exact, rtol=1e-9)
    np.testing.assert_allclose(each.state, 0.5, rtol=1e-8)


@pytest.mark.parametrize("restitution", [0.3, 0.5, 0.8])
@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_events_that_accumulate_end_a_trajectory(integrator, restitution):
    """Bounces shrink to nothing at sqrt(h) (1 + e)/(1 - e); the ball never passes the floor."""
    rest = (1 + restitution) / (1 - restitution)
    (each,) = trajectories(ball(2 * rest), [[1.0]], [bounce(restitution)], integrator)
    assert each.stuck
    assert each.ends
    assert each.end == pytest.approx(rest, rel=1e-6)
    assert each(np.linspace(0.0, each.end, 999))[0].min() >= -1e-9


def test_bursts_that_come_sooner_and_sooner_do_not_accumulate():
    """Each rise of x is slower than the burst that ends it, and both are shorter than before."""
    rates = {"x": "k*(1 + t)*(1 + 1e8*m)", "m": "0"}
    system = system_of(rates, {"x": 0, "m": 0}, {"k": (1, 2)}, 5.9)
    bursts = [
        SystemEvent(lambda t, u, p: u[0] - 1, 1, lambda t, u, p: np.stack([u[0], 1 + 0 * u[1]])),
        SystemEvent(lambda t, u, p: u[0] - 2, 1, lambda t, u, p: 0 * u),
    ]
    (each,) = trajectories(system, [[1.0]], bursts, "stack")
    assert not each.stuck
    exact = np.sqrt(1 + 2 * np.arange(1, 24)) - 1  # t + t^2/2 is a whole number
    np.testing.assert_allclose(each.times_of(0), exact, rtol=1e-6)


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_events_at_one_instant_without_end_end_a_trajectory(integrator):
    system = system_of({"x": "k"}, {"x": "0"}, {"k": (1, 2)}, 1)
    flips = [
        SystemEvent(lambda t, u, p: u[0] - 0.5, 1, lambda t, u, p: u - 1.0),
        SystemEvent(lambda t, u, p: u[0] + 0.2, -1, lambda t, u, p: u + 1.0),
    ]
    (each,) = trajectories(system, [[1.0]], flips, integrator)
    assert each.stuck
    assert each.rounds == MOST_ROUNDS
    assert each.end == pytest.approx(0.5, rel=1e-9)


@pytest.mark.parametrize("integrator", ["stack", "single"])
def test_events_at_one_instant_are_applied_in_their_order(integrator):
    system = system_of({"x": "k", "y": "k"}, {"x": "0", "y": "0"}, {"k": (1, 2)}, 1)
    swaps = [
        SystemEvent(lambda t, u, p: u[0] - 0.5, 1, lambda t, u, p: np.stack([u[1] - 1, u[1]])),
        SystemEvent(lambda t, u, p: u[1] - 0.5, 1, lambda t, u, p: np.stack([u[0], u[0] - 2])),
    ]
    (each,) = trajectories(system, [[1.0]], swaps, integrator)
    assert [o.event for o in each.occurrences] == [0, 1]
    np.testing.assert_allclose(each.occurrences[0].after, [-0.5, -2.5], atol=1e-9)


@pytest.mark.parametrize("direction", [0, 1, -1])
@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_a_function_that_is_not_a_number_is_no_event(integrator, direction):
    """x falls from 1 to -1; log(x + 0.5) is zero at 1/2 and not a number below -1/2."""
    system = system_of({"x": "-k"}, {"x": "1"}, {"k": (0.5, 2)}, 2)
    event = SystemEvent(lambda t, u, p: np.log(u[0] + 0.5), direction, terminal=True)
    (each,) = trajectories(system, [[1.0]], [event], integrator)
    exact = [0.5] if direction != 1 else []
    np.testing.assert_allclose(each.times_of(0), exact, rtol=1e-9)
    assert each.end == pytest.approx(0.5 if exact else 2.0)


def work_of(*arguments):
    with limited() as account:
        outcome = trajectories(*arguments)
        return account.done, outcome


@pytest.mark.parametrize("integrator", ["stack", "single"])
def test_markers_are_recorded_along_one_integration(integrator):
    system = system_of({"x": "w*y", "y": "-w*x"}, {"x": "0", "y": "1"}, {"w": (1, 3)}, 20)
    points = [[1.0 + 0.2 * k] for k in range(8)]
    plain, _ = work_of(system, points, [], integrator)
    marker = SystemEvent(lambda t, u, p: u[0] - 0.5)
    marked, outcome = work_of(system, points, [marker], integrator)
    assert sum(each.times_of(0).size for each in outcome) > 60
    assert marked < 1.5 * plain


@pytest.mark.parametrize("integrator", ["stack", "single"])
def test_a_reset_costs_about_as_much_as_the_time_since_the_last(integrator):
    """x is set back from 1 to 0 every 1/k: ten events of what is integrated once without."""
    system = system_of(
        {"x": "k", "y": "8*pi*z", "z": "-8*pi*y"},
        {"x": "0", "y": "1", "z": "0"},
        {"k": (1, 3)},
        5,
    )
    plain, _ = work_of(system, [[2.0]], [], integrator)
    back = SystemEvent(
        lambda t, u, p: u[0] - 1.0, 1, lambda t, u, p: np.stack([0.0 * u[0], *u[1:]])
    )
    reset, (each,) = work_of(system, [[2.0]], [back], integrator)
    np.testing.assert_allclose(each.times_of(0)[:9], np.arange(1, 10) / 2, rtol=1e-8)
    assert reset < 8.0 * plain


@pytest.mark.parametrize("integrator", ["stack", "single"])
def test_a_budget_that_ends_tells_a_time(integrator):
    heights = [[0.5 + 0.2 * k] for k in range(3)]
    events = [bounce(1.0)]
    all_work, _ = work_of(ball(6.0), heights, events, integrator)
    with pytest.raises(OutOfWorkError) as out, limited(0.7 * all_work):
        trajectories(ball(6.0), heights, events, integrator)
    assert 1.0 < out.value.reached.time < 6.0
    assert out.value.reached.steps > 0


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_events_within_a_long_step_are_found(integrator):
    """Nothing but the event varies: the whole horizon is a step or two."""
    system = system_of({"x": "0*k"}, {"x": "k"}, {"k": (1, 2)}, 30)
    event = SystemEvent(lambda t, u, p: np.sin(3 * t) - 0.8, 1, lambda t, u, p: u + 1)
    (each,) = trajectories(system, [[1.5]], [event], integrator)
    first = np.arcsin(0.8) / 3
    exact = np.arange(first, 30, 2 * np.pi / 3)
    np.testing.assert_allclose(each.times_of(0), exact, rtol=1e-9)


@pytest.mark.parametrize("dip", [1e-2, 1e-4, 1e-5])
def test_a_surface_that_is_dipped_into(dip):
    """x = (t - 1.234)**2 - dip is below zero for a short time within a step."""
    system = system_of({"x": "2*(t - 1.234)"}, {"x": f"1.234**2 - {dip} + 0*k"}, {"k": (1, 2)}, 3)
    marker = SystemEvent(lambda t, u, p: u[0])
    (each,) = trajectories(system, [[1.5]], [marker], "single")
    exact = 1.234 + np.sqrt(dip) * np.array([-1, 1])
    np.testing.assert_allclose(each.times_of(0), exact, rtol=1e-5)


@pytest.mark.parametrize("integrator", ["single", "auto"])
def test_a_small_bounce_within_a_long_step_is_met(integrator):
    """After the first bounce the ball is up for 2e-4, and integrated for about one."""
    (each,) = trajectories(ball(2.0), [[1.0]], [bounce(1e-4)], integrator)
    assert each.times_of(0)[:2] == pytest.approx([1.0, 1.0002], rel=1e-8)


def full(direction, then):
    return SystemEvent(lambda t, u, p: u[0] - 2.0, direction, then)


@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize("direction", [1, 0])
@pytest.mark.parametrize("level", [None, 2.0], ids=["stays", "reset"])
def test_a_trajectory_that_stays_on_the_surface_of_its_event(level, direction, integrator):
    def then(t, u, p):
        return np.stack([u[0] if level is None else np.full_like(u[0], level), 0.0 * u[1]])

    rates = np.array([0.1234, 0.3, 0.77, 1.0])
    for sign, start, side in [(1.0, 1.0, direction), (-1.0, 3.0, -direction)]:
        system = system_of(
            {"v": f"{sign}*on*f", "on": "0"},
            {"v": str(start), "on": "1"},
            {"f": (0.1, 1.0)},
            20.0,
        )
        with limited(3e8):
            results = trajectories(system, rates[:, None], [full(side, then)], integrator)
        for rate, each in zip(rates, results, strict=True):
            np.testing.assert_allclose(each.times_of(0), [1.0 / rate], rtol=1e-9)
            assert each.end == 20.0
            np.testing.assert_allclose(each.state, [2.0, 0.0], rtol=1e-9)


@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize(("begins", "turn", "count"), [(2, 1, 0), (1, -1, 0), (1, 1, 1)])
def test_a_surface_on_which_a_trajectory_stayed_before_it_leaves(begins, turn, count, integrator):
    """It is crossed where the trajectory leaves it for the other side, if it came from one."""
    system = system_of({"x": "0*k"}, {"x": "2 + 1e-16*k"}, {"k": (1, 2)}, 20.0)

    def when(t, u, p):
        came = (begins - 2.0) * np.exp(-8.0 * p[0] * t)
        return (u[0] + came + turn * np.maximum(0.0, t - 10.0)) * np.cos(1e-16 * t) - 2.0

    for direction in (1, 0):
        [each] = trajectories(system, [[1.5]], [SystemEvent(when, direction)], integrator)
        times = each.times_of(0)
        assert times.size == count
        np.testing.assert_allclose(times, 10.0, atol=1e-2)


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_a_ball_that_is_thrown_from_a_floor_far_from_zero_comes_back(integrator):
    system = system_of({"y": "v", "v": "-2 + 0*y"}, {"y": "3", "v": "s"}, {"s": (1, 2)}, 4.0)
    landed = SystemEvent(
        lambda t, u, p: u[0] - 3.0, -1, lambda t, u, p: np.stack([u[0], -0.5 * u[1]])
    )
    [each] = trajectories(system, [[1.0]], [landed], integrator)
    np.testing.assert_allclose(each.times_of(0)[:4], [1.0, 1.5, 1.75, 1.875], rtol=1e-8)
    rest = SystemEvent(landed.when, -1, lambda t, u, p: np.stack([u[0], 0.0 * u[1]]))
    if integrator == "stack":  # at rest on it
        [each] = trajectories(system, [[1.0]], [rest], integrator)
        assert each.stuck
        np.testing.assert_allclose(each.times_of(0), 1.0, rtol=1e-6)


def test_a_tank_that_fills_until_it_is_full_is_solved():
    t, f = sp.symbols("t f")
    v, on = (sp.Function(name)(t) for name in ("v", "on"))
    problem = ro.Problem(
        equations=[sp.Eq(v.diff(t), on * f), sp.Eq(on.diff(t), 0)],
        time=(t, 0, 10),
        parameters={f: (0.15, 0.2)},
        initial={v: 1, on: 1},
        events=[ro.Event(v - 2, "rising", then={on: 0}, name="full")],
    )
    solution = ro.solve(problem, rtol=1e-4, max_seconds=60)
    assert solution.success
    np.testing.assert_allclose(solution.event_times("full", f=0.16), [6.25], rtol=1e-4)
    np.testing.assert_allclose(solution(9, f=0.16), [2.0, 0.0], atol=1e-4)
