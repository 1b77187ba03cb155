"""Solves whose rates switch over the unknowns, against closed forms and narrow smooth steps."""

import re
from dataclasses import replace

import numpy as np
import pytest
import scipy.integrate
import sympy as sp

import rankone as ro
from rankone.solvers.ways import Engine
from rankone.trajectories.system.verdict import Status
from tests.honesty.cases import unknown

RTOL = 1e-4


def problem(rhs, initial, box, end, **more):
    return ro.Problem.from_strings(rhs, initial, box, (0, end), **more)


def points(box, count=4):
    ends = np.array(list(box.values()), dtype=float)
    return ends[:, 0] + np.ptp(ends, axis=1) * np.random.default_rng(8).random((count, len(ends)))


def smoothed(rates, start, times):
    """A trajectory with a step as narrow as 1e-7 instead of a sign."""
    run = scipy.integrate.solve_ivp(
        rates, (times[0], times[-1]), start, "Radau", times, rtol=1e-8, atol=1e-10
    )
    return run.y


def sign(z):
    return np.tanh(z / 1e-7)


@pytest.mark.slow
def test_a_mass_that_sticks_and_slips():
    box = {"F": (1.6, 1.7), "mu": (0.5, 0.55)}
    stick = problem({"x": "v", "v": "F*cos(t/2) - x - mu*sign(v)"}, {"x": 0, "v": 0.5}, box, 15)
    solution = ro.solve(stick, RTOL)
    assert solution.success
    assert solution.timeline.stretches > 3
    times = np.linspace(0, 15, 80)
    for force, mu in points(box):
        exact = smoothed(
            lambda t, u, f=force, m=mu: [u[1], f * np.cos(t / 2) - u[0] - m * sign(u[1])],
            [0, 0.5],
            times,
        )
        error = np.abs(solution(t=times, F=force, mu=mu) - exact).max(axis=1)
        assert (error <= 3 * RTOL * np.abs(exact).max(axis=1)).all()
    rest = np.abs(solution["v"](t=times, F=1.65, mu=0.52)) < 1e-6
    assert 0 < rest.sum() < times.size  # it rests for a while


def test_an_ideal_relay_slides():
    relay = problem({"x": "-x + 2 - 2*Heaviside(x - c)"}, {"x": 0}, {"c": (0.5, 1)}, 3)
    solution = ro.solve(relay, RTOL)
    assert solution.success
    times = np.linspace(0, 3, 50)
    for (c,) in points({"c": (0.5, 1)}):
        exact = np.minimum(2 - 2 * np.exp(-times), c)  # it is held at c
        np.testing.assert_allclose(solution["x"](t=times, c=c), exact, atol=2 * RTOL)
        (reached,) = solution.event_times("switch_0", c=c)
        assert abs(reached + np.log(1 - c / 2)) < 3 * RTOL


@pytest.mark.slow
def test_no_time_beside_a_crossing_is_left_out():
    clipped = problem(
        {"x": "-x + 3*Max(0, y - c)", "y": "cos(t)"}, {"x": 1, "y": 0}, {"c": (0.4, 0.5)}, 8
    )
    solution = ro.solve(clipped, 1e-6)
    assert solution.success
    for (c,) in points({"c": (0.4, 0.5)}):
        crossings = np.arcsin(c) + np.array([0, np.pi - 2 * np.arcsin(c)])
        times = np.sort(np.concatenate([crossings + d for d in (-1e-9, 0.0, 1e-9, 0.3)]))
        run = clipped.trajectory(times, c=c, rtol=1e-10)
        np.testing.assert_allclose(solution(t=times, c=c), run.values, atol=3e-6)


@pytest.mark.parametrize("markers", ["auto", pytest.param(None, marks=pytest.mark.slow)])
def test_markers_none_keeps_the_clock(markers):
    clipped = problem(
        {"x": "-x + 3*Heaviside(y - c)", "y": "cos(t)"}, {"x": 1, "y": 0}, {"c": (0.4, 0.5)}, 4
    )
    solution = ro.solve(clipped, 1e-3, markers=markers)
    assert (solution.outcome.timeline is None) == (markers is None)


@pytest.mark.parametrize(
    ("rtol", "c", "at_once"), [(1e-5, 0.5, True), (1e-3, 0.5, False), (1e-5, 2, False)]
)
def test_kinks_that_are_crossed_are_held_at_once(rtol, c, at_once, monkeypatch):
    written = []
    as_written = Engine._solve_as_written

    def noted(engine, *arguments):
        written.append(engine.name)
        return as_written(engine, *arguments)

    monkeypatch.setattr(Engine, "_solve_as_written", noted)
    rates = {"x": f"-a*x + Max(0, y - {c})", "y": "cos(t)"}
    solution = ro.solve(problem(rates, {"x": 1, "y": 0}, {"a": (1, 2)}, 2), rtol, method="cross")
    assert solution.success
    assert (not written) == at_once
    assert (solution.outcome.timeline is not None) == at_once


def test_an_order_that_changes_in_the_box_is_solved_over_the_clock():
    two = problem(
        {"x": "-x + Max(0, y - c) + Max(0, y - d)", "y": "cos(t)"},
        {"x": 1, "y": 0},
        {"c": (0.4, 0.6), "d": (0.45, 0.55)},
        3,
    )
    solution = ro.solve(two, 1e-3)
    assert solution.success
    assert solution.outcome.timeline is None


@pytest.mark.slow
def test_a_switch_beside_a_jump_at_a_known_time():
    switched = problem(
        {"x": "-x + Heaviside(y - c)", "y": "-y"},
        {"x": 0, "y": 1},
        {"c": (0.3, 0.4)},
        4,
        jumps={2.0: {"y": "y + 1"}},
    )
    solution = ro.solve(switched, RTOL, effort="low")
    assert solution.success
    assert solution.timeline.stretches == 4
    times = np.linspace(0, 4, 41)
    for (c,) in points({"c": (0.3, 0.4)}):
        exact = switched.trajectory(times, c=c, rtol=1e-10).values
        np.testing.assert_allclose(solution(t=times, c=c), exact, atol=2 * RTOL)


@pytest.mark.parametrize("name", ["switch_0", "side_1"])
def test_names_of_the_user_are_left_alone(name):
    box = {"side_0": (0.8, 1.2)}
    half = ro.Event(unknown("v") - sp.Rational(1, 2), "falling", name=name)
    slide = problem({"v": "-side_0*sign(v)"}, {"v": 1}, box, 2, events=[half])
    solution = ro.solve(slide, RTOL)
    assert solution.success
    assert solution.event_times(name, side_0=1.0) == pytest.approx([0.5], abs=0.1 * RTOL)
    assert solution(t=2.0, side_0=1.0) == pytest.approx([0.0], abs=RTOL)


@pytest.mark.slow
def test_a_switch_at_an_unknown_that_stays_zero():
    """There sign(x) is 0, as it is in SymPy."""
    resting = problem({"x": "-a*x", "y": "sign(x) + a"}, {"x": 0, "y": 0}, {"a": (0.8, 1.2)}, 2)
    solution = ro.solve(resting, RTOL)
    assert solution.success
    np.testing.assert_allclose(solution(t=2.0, a=0.9), [0.0, 1.8], atol=RTOL)


def test_a_system_without_parameters_sticks():
    solution = ro.solve(problem({"v": "-sign(v)"}, {"v": 1}, {}, 2), RTOL)
    assert solution.success
    np.testing.assert_allclose(solution(t=[0.5, 1.5]), [[0.5, 0.0]], atol=RTOL)


@pytest.mark.slow
def test_a_push_ends_a_stick():
    box = {"b": (0.9, 1.1)}
    pushed = problem({"v": "2*Heaviside(t - 2) - b*sign(v)/2 - v"}, {"v": 0.5}, box, 4)
    solution = ro.solve(pushed, RTOL)
    assert solution.success
    moving = (2 - 0.5) * (1 - np.exp(-2.0))
    np.testing.assert_allclose(solution(t=[1.5, 4.0], b=1.0), [[0.0, moving]], atol=RTOL)


def test_a_surface_that_repels_is_left():
    """From t with sin t = -0.2 the surface x = 0 repels, and the drift is upwards."""
    turned = {"x": "-a*sign(x)*sign(y) + 0.3", "y": "cos(t)"}
    box = {"a": (0.9, 1.1)}
    solution = ro.solve(problem(turned, {"x": 0.5, "y": 0.2}, box, 4), RTOL)
    assert solution.success
    late = 4 - (np.pi + np.arcsin(0.2))
    np.testing.assert_allclose(solution["x"](t=[2.0, 4.0], a=1.0), [0.0, 1.3 * late], atol=2e-4)


@pytest.mark.parametrize(
    "rate", ["300*Heaviside(x/a - 0.999999)", "Piecewise((1e5, (x - 0.5)**2 < 1e-10), (0, True))"]
)
@pytest.mark.slow
def test_a_short_visit_of_a_side_is_not_overlooked(rate):
    """The solution is right, or there is none."""
    visited = problem(
        {"x": "v", "v": "-x", "y": rate}, {"x": 0, "v": "a", "y": 0}, {"a": (0.9, 1.1)}, 3
    )
    compiled = ro.compile(visited)
    try:
        solution = compiled.solve(1e-3, effort=0.05)
    except ro.ConvergenceError:
        return
    lengths = np.pi - 2 * np.arcsin(0.999999), 2 * (np.arcsin(0.50001) - np.arcsin(0.49999))
    exact = 300 * lengths[0] if "300" in rate else 1e5 * lengths[1]
    assert not solution.success or solution["y"](t=3.0, a=1.0) == pytest.approx(exact, rel=5e-3)


@pytest.mark.slow
def test_where_it_sticks_in_some_order_the_error_says_why_that_failed():
    """When a mass slips again and sticks again differs inside the box."""
    dragged = {"x": "v", "v": "a*t - x - 0.5*sign(v)"}
    with pytest.raises(ro.BlowUpError, match="between its switches the solve failed: an order"):
        ro.solve(problem(dragged, {"x": 0, "v": 0.2}, {"a": (0.1, 0.3)}, 10), RTOL, effort=0.3)


@pytest.mark.parametrize(
    "bump",
    [
        pytest.param("Max(0, 1 - 1e7*(x - 0.7)**2)", marks=pytest.mark.slow),
        pytest.param(
            "(Abs(1 - 1e7*(x - 0.7)**2) + 1 - 1e7*(x - 0.7)**2)/2", marks=pytest.mark.slow
        ),
        pytest.param(
            "Max(0, 1e7*(x - 0.7 + 1e-7**0.5)*(0.7 + 1e-7**0.5 - x))", marks=pytest.mark.slow
        ),
    ],
)
def test_a_side_as_narrow_as_a_peak_is_not_overlooked(bump):
    """Each of two passes adds 3e3 times the integral of 1 - ((t - t0)/h)**2."""
    rates = {"x": "v", "v": "-x", "y": f"3000*{bump} - k*y"}
    box, times = {"k": (0.2, 0.4)}, np.array([0.5, 1.5, 3.0])
    solution = ro.solve(problem(rates, {"x": 0, "v": 1, "y": 0.5}, box, 3), 1e-3)
    first = np.arcsin(0.7)
    jump = 3e3 * 4 / 3 / np.sqrt(1e7) / np.cos(first)
    exact = 0.5 * np.exp(-0.3 * times)
    for passed in (first, np.pi - first):
        exact += np.where(times > passed, jump * np.exp(-0.3 * (times - passed)), 0.0)
    assert solution.success
    assert solution["y"](times, k=0.3) == pytest.approx(exact, abs=3e-3)


@pytest.mark.slow
def test_a_trajectory_that_blows_up_beyond_a_kink_is_named_as_such():
    """Its last crossing is where the states are no numbers any more."""
    repelled = {"x": "v", "v": "-x - 20*Abs(x - k)**1.5"}
    with pytest.raises(ro.BlowUpError, match="blows up inside the horizon"):
        ro.solve(problem(repelled, {"x": 0, "v": 1}, {"k": (0.3, 0.6)}, 15), RTOL, effort=0.1)


@pytest.mark.slow
def test_a_kick_at_a_known_time_sets_sides_by_the_rates_of_that_time():
    box = {"F": (1.6, 1.7)}
    rates = {"x": "v", "v": "F*sin(t) - x - sign(v)/2"}
    kicked = problem(rates, {"x": 0, "v": 1}, box, 4, jumps={1.5: {"v": "v + F"}})
    solution = ro.solve(kicked, RTOL)
    assert solution.success, solution.message
    before, after = np.linspace(0, 1.5, 11), np.linspace(1.5, 4, 21)
    for (force,) in points(box):

        def rhs(t, u, force=force):
            return u[1], force * np.sin(t) - u[0] - sign(u[1]) / 2

        first = smoothed(rhs, (0, 1), before)
        second = smoothed(rhs, first[:, -1] + [0, force], after)
        wanted = np.hstack([first[:, :-1], second])
        times = np.concatenate([before[:-1], after])
        np.testing.assert_allclose(solution(t=times, F=force), wanted, atol=5 * RTOL)


@pytest.mark.slow
def test_switches_that_accumulate_are_told_and_not_where_steps_stall(monkeypatch):
    """Over clock time steps may stall long before, where it sticks for a moment."""
    rates, start = {"x": "v", "v": "-k*sign(x) - sign(v)/3"}, {"x": 1, "v": 0.1}
    outcome = ro.solve(ro.Problem.from_strings({"x": "-x"}, {"x": 1}, {}, (0, 1))).outcome

    def stalled(self, system, *_):
        return replace(outcome, status=Status.STALLS)

    monkeypatch.setattr(Engine, "_solve_as_written", stalled)
    with pytest.raises(ro.ConvergenceError, match=r"^a trajectory ends at t = .*accumulate"):
        ro.solve(problem(rates, start, {"k": (1, 1.1)}, 9), RTOL, effort=0.1)


GRAZING = {
    "threshold": (
        {"x": "v", "v": "-0.2*v - x + 0.4*Heaviside(x - c)"},
        {"x": 1, "v": 0},
        {"c": (0.3, 1.2)},
        15,
        (),
    ),
    "wall": (
        {"x": "v", "v": "-x + F*sin(1.7*t)"},
        {"x": 0, "v": 0.5},
        {"F": (0.2, 0.9)},
        12,
        [{"when": "x - 1", "direction": "rising", "then": {"v": "-0.7*v"}, "name": "wall"}],
    ),
}
"""Larger parts of these boxes graze a switch or an event."""


def refusal(compiled: ro.CompiledProblem) -> str:
    """Why a solve with a small budget is no success, whether it ends by a limit or raises."""
    try:
        solution = compiled.solve(1e-3, effort=0.1)
    except ro.ConvergenceError as error:
        return str(error)
    assert not solution.success
    return solution.message


@pytest.mark.slow
@pytest.mark.parametrize("name", GRAZING)
def test_a_refusal_where_trajectories_graze_names_a_box_that_works(name):
    *parts, events = GRAZING[name]
    compiled = ro.compile(ro.Problem.from_strings(*parts[:3], (0, parts[3]), events=events))
    message = refusal(compiled)
    assert f"`{'wall' if events else 'switch_0'}`" in message
    assert "not finite" not in message
    found = re.findall(r"`(\w+)` to \[([-+.\de]+), ([-+.\de]+)\]", message)
    assert found
    part = {parameter: (float(lower), float(upper)) for parameter, lower, upper in found}
    assert compiled.solve(1e-3, parameters=part, effort=0.1).success


def filled(k, since):
    """What an inflow of 1, lost at the rate k, adds up to after a time."""
    return -np.expm1(-k * np.maximum(since, 0)) / k


@pytest.mark.parametrize(
    "inflow",
    [
        pytest.param("Heaviside(t - 3) - Heaviside(t - a)", marks=pytest.mark.slow),
        pytest.param(
            "Piecewise((1, t > 3), (0, True)) - Piecewise((1, t >= a), (0, True))",
            marks=pytest.mark.slow,
        ),
        pytest.param("(sign(t - 3) - sign(t - a))/2", marks=pytest.mark.slow),
    ],
)
def test_on_and_off_at_times_whose_order_changes(inflow):
    box = {"a": (2, 4), "k": (0.5, 1)}
    solution = ro.solve(problem({"x": f"{inflow} - k*x"}, {"x": 0}, box, 6), RTOL)
    assert solution.success
    times = np.linspace(0, 6, 41)
    for a, k in points(box, 6):
        exact = filled(k, times - 3) - filled(k, times - a)
        np.testing.assert_allclose(solution["x"](t=times, a=a, k=k), exact, atol=2 * RTOL)


@pytest.mark.parametrize(
    "condition",
    [
        "Abs(t - a) < 1",
        "(t - a)**2 < 1",
        "~(Abs(t - a) >= 1)",
        pytest.param("Not(Or(t <= a - 1, t >= a + 1))", marks=pytest.mark.slow),
        pytest.param("(t > a - 1) & (t < a + 1)", marks=pytest.mark.slow),
        pytest.param("(t - a + 1)*(a + 1 - t) > 0", marks=pytest.mark.slow),
    ],
)
def test_a_pulse_around_a_time_has_one_fate_in_every_spelling(condition):
    box = {"a": (2, 4), "k": (0.5, 1)}
    rate = f"Piecewise((1, {condition}), (0, True)) - k*x"
    solution = ro.solve(problem({"x": rate}, {"x": 0}, box, 8), RTOL)
    assert solution.success
    assert solution.timeline.stretches == 3
    times = np.linspace(0, 8, 41)
    for a, k in points(box):
        exact = filled(k, times - a + 1) - filled(k, times - a - 1)
        np.testing.assert_allclose(solution["x"](t=times, a=a, k=k), exact, atol=2 * RTOL)


@pytest.mark.slow
def test_infusions_of_unknown_lag_and_length_overlap_in_a_part_of_the_box():
    parts = (
        f"Piecewise((100/D, (t > {at} + lag) & (t < {at} + lag + D)), (0, True))" for at in (0, 2)
    )
    rates = {"x": f"{' + '.join(parts)} - (ke + kp)*x + y/2", "y": "kp*x - y/2"}
    box = {"ke": (0.2, 0.4), "kp": (0.3, 0.6), "lag": (0.2, 1), "D": (1, 3)}
    infused = problem(rates, {"x": 0, "y": 0}, box, 10)
    solution = ro.solve(infused, RTOL)
    assert solution.success
    assert len(solution.timeline.branches) > 1
    times = np.linspace(0, 10, 31)
    for values in points(box):
        at = dict(zip(box, values, strict=True))
        exact = infused.trajectory(times, rtol=1e-9, **at).values
        size = np.abs(exact).max(axis=1, keepdims=True)
        assert (np.abs(solution(t=times, **at) - exact) <= 5 * RTOL * size).all()


@pytest.mark.parametrize(
    "goal",
    [
        pytest.param("Piecewise((0, t < 1), (2, True))", marks=pytest.mark.slow),
        pytest.param("2*Heaviside(t - 1)", marks=pytest.mark.slow),
    ],
)
def test_a_stepwise_set_point_within_a_limit(goal):
    """After the step it is full speed to where k*(2 - x) is 1, at once where it is less."""
    box = {"k": (0.5, 2), "x0": (0, 0.5)}
    limited = problem({"x": f"Min(1, k*({goal} - x))"}, {"x": "x0"}, box, 5)
    solution = ro.solve(limited, RTOL)
    assert solution.success
    times = np.linspace(0, 5, 41)
    for k, start in points(box, 8):
        stepped = start * np.exp(-k)
        slow = np.maximum(2 - 1 / k, stepped)
        reach = 1 + slow - stepped
        late = 2 - (2 - slow) * np.exp(-k * (times - reach))
        exact = np.where(times < reach, stepped + times - 1, late)
        exact = np.where(times < 1, start * np.exp(-k * times), exact)
        np.testing.assert_allclose(solution["x"](t=times, k=k, x0=start), exact, atol=4 * RTOL)


@pytest.mark.parametrize(
    "limited",
    [
        pytest.param("Max(-12, Min(12, {v}))", marks=pytest.mark.slow),
        pytest.param("Min(12, Max(-12, {v}))", marks=pytest.mark.slow),
        pytest.param(
            "Piecewise((-12, {v} < -12), (12, {v} > 12), ({v}, True))", marks=pytest.mark.slow
        ),
    ],
)
def test_an_integrator_that_is_wound_back_begins_in_saturation(limited):
    argument = "(Kp*(r - w) + q)"
    u = limited.format(v=argument)
    rates = {"w": f"{u} - w", "q": f"r - w + ({u} - {argument})/Kp"}
    box = {"Kp": (3, 5), "r": (8, 9)}
    wound = problem(rates, {"w": 0, "q": 0}, box, 6)
    solution = ro.solve(wound, RTOL)
    assert solution.success
    times = np.linspace(0, 6, 31)
    for gain, goal in points(box):
        exact = wound.trajectory(times, rtol=1e-9, Kp=gain, r=goal).values
        np.testing.assert_allclose(solution(t=times, Kp=gain, r=goal), exact, atol=20 * RTOL)


@pytest.mark.slow
@pytest.mark.parametrize(
    "rate",
    [
        "Piecewise((0, (Abs(v) > 12) & (e*v > 0)), (e, True))",
        "Piecewise((0, ((v > 12) & (e > 0)) | ((v < -12) & (e < 0))), (e, True))",
    ],
)
def test_the_sign_of_an_error_makes_no_orders_where_it_changes_nothing(rate):
    """It counts while the limit is active alone, and some trajectories overshoot later."""
    rates = {"w": "(10*Max(-12, Min(12, v)) - w)/0.2", "q": rate}
    named = {"e": "r - w", "v": "0.16*e + 0.8*q"}
    stopped = problem(rates, {"w": 0, "q": 0}, {"r": (60, 100)}, 2, definitions=named)
    solution = ro.solve(stopped, RTOL)
    assert solution.success
    assert len(solution.timeline.branches) == 2
    times = np.linspace(0, 2, 31)
    for goal in (74.0, 97.0):

        def motion(t, u, r=goal):
            e = r - u[0]
            v = 0.16 * e + 0.8 * u[1]
            return [(10 * np.clip(v, -12, 12) - u[0]) / 0.2, 0 if abs(v) > 12 and e * v > 0 else e]

        exact = scipy.integrate.solve_ivp(motion, (0, 2), [0, 0], t_eval=times, rtol=1e-8).y
        error = np.abs(solution(t=times, r=goal) - exact).max(axis=1)
        assert (error <= 3 * RTOL * np.abs(exact).max(axis=1)).all()


def test_a_guard_against_a_division_by_zero_at_rest():
    """Until the dose, D and q/D are 0 and 0/0: the guard decides."""
    dose = {"when": "t - 1", "direction": "rising", "then": {"D": "1"}, "name": "dose"}
    rates = {"D": "-k*D", "q": "Piecewise((exp(-q/D)*D, D > 0), (0, True))"}
    box = {"k": (0.5, 2)}
    guarded = problem(rates, {"D": 0, "q": 0}, box, 3, events=[dose])
    solution = ro.solve(guarded, RTOL)
    assert solution.success
    np.testing.assert_array_equal(solution["q"](t=[0, 0.5, 0.99], k=1.0), 0)
    exact = guarded.trajectory([2, 3], k=1.0, rtol=1e-9).values
    np.testing.assert_allclose(solution(t=[2, 3], k=1.0), exact, atol=3 * RTOL)


@pytest.mark.slow
def test_a_switch_of_time_and_parameters_alone_is_no_surface_to_move():
    """Its height does not depend on the state by which trajectories would be moved."""
    rates = {"x": "-x + Heaviside(t*((t - 2)**2 - a))"}
    grazing = problem(rates, {"x": 0}, {"a": (-0.1, 0.1)}, 3)
    solution = ro.solve(grazing, 1e-3, effort=0.1)
    assert not solution.success  # where it is switched off for a while is a root of `a`
    exact = grazing.trajectory([1, 3], a=0.05, rtol=1e-9).values
    np.testing.assert_allclose(solution(t=[1, 3], a=0.05), exact, atol=0.1)


@pytest.mark.parametrize("value", ["exp(-q/D)", "sin(q/D)", "q/D/(1 + q/D)"])
def test_a_guarded_function_need_not_vanish_at_its_guard(value):
    """Its values there are not finite, which says nothing of a kink."""
    rates = {"D": "1 - D", "q": f"k - Piecewise(({value}, D > 0), (0, True))"}
    box = {"k": (1, 2)}
    guarded = problem(rates, {"D": 0.25, "q": 0.1}, box, 2)
    solution = ro.solve(guarded, RTOL)
    assert solution.success
    exact = guarded.trajectory([1, 2], k=1.3, rtol=1e-9).values
    np.testing.assert_allclose(solution(t=[1, 2], k=1.3), exact, atol=3 * RTOL)


@pytest.mark.slow
def test_a_level_that_is_a_case_of_time_is_held_and_left():
    """Fed up to 2, where it slides until the level is 4."""
    rates = {"S": "Piecewise((F, S < Piecewise((2, t < 4), (4, True))), (0, True)) - m*S"}
    box = {"F": (2, 3), "m": (0.2, 0.4)}
    solution = ro.solve(problem(rates, {"S": 0.5}, box, 8), RTOL)
    assert solution.success
    times = np.linspace(0, 8, 41)
    for inflow, loss in points(box):
        full = inflow / loss
        first = full - (full - 0.5) * np.exp(-loss * times)
        second = full - (full - 2) * np.exp(-loss * (times - 4))
        exact = np.where(times < 4, np.minimum(first, 2), np.minimum(second, 4))
        np.testing.assert_allclose(solution["S"](t=times, F=inflow, m=loss), exact, atol=8 * RTOL)
