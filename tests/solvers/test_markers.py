"""Solves of oscillators over stretches between markers."""

import tracemalloc

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import rankone as ro

PREY = {"x": "x*(1.5 - y)", "y": "-y*(3 - x)"}
BOX = {"x0": (8, 12), "y0": (4, 6)}


def problem(end, **more):
    return ro.Problem.from_strings(PREY, {"x": "x0", "y": "y0"}, BOX, (0, end), **more)


def against_trajectories(solution, made, times, count=3):
    """The largest error over the largest value, of each unknown."""
    ends = np.array(list(solution.parameters.values()))
    shares = np.random.default_rng(4).random((count, len(ends)))
    errors, sizes = [], []
    for point in ends[:, 0] + np.ptp(ends, axis=1) * shares:
        named = dict(zip(solution.parameters, point, strict=True))
        exact = made.trajectory(times, rtol=1e-10, **named).values
        errors.append(np.abs(solution(t=times, **named) - exact).max(axis=1))
        sizes.append(np.abs(exact).max(axis=1))
    return np.max(errors, axis=0) / np.max(sizes, axis=0)


@pytest.mark.slow
def test_markers_of_the_user_keep_ranks_low():
    made = problem(12)
    solution = ro.solve(made, 1e-4, markers=["x - 3"])
    assert solution.success
    assert solution.rank < 20
    assert "marker_0" in str(solution.timeline)
    errors = against_trajectories(solution, made, np.linspace(0, 12, 201))
    assert (errors < 3e-4).all()
    marks = solution.event_times("marker_0", x0=9.0, y0=5.0)
    states = solution(t=marks[np.isfinite(marks)], x0=9.0, y0=5.0)
    np.testing.assert_allclose(states[0], 3.0, atol=2e-3)


@pytest.mark.slow
def test_events_that_change_nothing_bring_trajectories_in_step():
    """Whatever function of the states they are of; samples go on as over their last period."""
    made = problem(24, events=[{"when": "x*y - 3", "name": "mark"}])
    compiled = ro.compile(made)
    assert compiled.system.separated
    assert compiled.automatic == ("cross",)
    solution = compiled.solve(1e-4)
    assert solution.success
    assert solution.rank < 20
    errors = against_trajectories(solution, made, np.linspace(0, 24, 401))
    assert (errors < 3e-4).all()
    with pytest.raises(ro.OptionError, match="known times only"):
        compiled.solve(1e-4, method="train")


@pytest.mark.slow
def test_an_oscillator_over_twenty_periods():
    made = problem(60)
    solution = ro.solve(made, 1e-4)
    assert solution.success
    assert solution.rank <= 30
    assert solution.timeline.stretches > 30
    errors = against_trajectories(solution, made, np.linspace(0, 60, 801))
    assert (errors < 3e-4).all()


def test_a_short_horizon_stays_with_the_clock():
    assert ro.solve(problem(3), 1e-3).outcome.timeline is None


@pytest.mark.parametrize("markers", ["x - 3", [], ["z - 3"], 3, ["x +"]])
def test_what_is_no_marker_is_refused(markers):
    with pytest.raises(ro.OptionError, match="markers="):
        ro.solve(problem(3), 1e-3, markers=markers)


def test_markers_that_nothing_crosses_are_named():
    decay = ro.Problem.from_strings({"x": "-k*x"}, {"x": 1}, {"k": (0.5, 1)}, (0, 3))
    with pytest.warns(ro.RankoneWarning, match="no trajectory crosses zero in `x - 5`"):
        solution = ro.solve(decay, 1e-4, markers=["x - 5", "x - 0.5"])
    assert solution.success


@pytest.mark.slow
def test_a_relaxation_oscillator_is_solved_with_few_ranks():
    """Also where its stiffness grows."""
    rates = {"x": "v", "v": "m*(1 - x**2)*v - x", "m": "0.01*a"}
    box = {"a": (3, 5), "b": (1, 2)}
    made = ro.Problem.from_strings(rates, {"x": "b", "v": 0, "m": "a"}, box, (0, 60))
    solution = ro.solve(made, 1e-4)
    assert solution.success
    assert solution.rank <= 35
    assert len(solution.timeline.events) == 1
    errors = against_trajectories(solution, made, np.linspace(0, 60, 801))
    assert (errors < 3e-4).all()


@pytest.mark.slow
def test_a_front_that_comes_once_has_a_stretch_before_and_one_behind_it():
    flame = ro.Problem.from_strings(
        {"y": "k*(y**2 - y**3)"}, {"y": "d"}, {"d": (0.002, 0.003), "k": (0.9, 1.1)}, (0, 800)
    )
    solution = ro.solve(flame, 1e-4)
    assert solution.success
    assert solution.rank <= 20
    assert solution.timeline.stretches == 2
    errors = against_trajectories(solution, flame, np.linspace(0, 800, 801))
    assert (errors < 3e-4).all()


@pytest.mark.slow
def test_a_stiff_oscillator_that_jumps_once_or_twice_is_solved():
    rates = {"x": "v", "v": "30*(1 - x**2)*v - w*x"}
    made = ro.Problem.from_strings(rates, {"x": 2, "v": 0}, {"w": (0.8, 1.2)}, (0, 55))
    solution = ro.solve(made, 1e-4)
    assert solution.success
    assert solution.rank <= 20
    errors = against_trajectories(solution, made, np.linspace(0, 55, 2001))
    assert (errors < 3e-4).all()


@pytest.mark.slow
def test_jumps_of_a_stiff_oscillator_are_right_within():
    """At the steps of an accurate trajectory, most of which are within its jumps."""
    rates = {"x": "v", "v": "mu*(1 - x**2)*v - w*x"}
    box = {"mu": (90, 110), "w": (0.9, 1.1)}
    made = ro.Problem.from_strings(rates, {"x": 2, "v": 0}, box, (0, 110))
    solution = ro.solve(made, 1e-4)
    assert solution.success
    assert solution.rank <= 30
    for mu, w in ((92.0, 0.93), (108.0, 1.08)):
        exact = solve_ivp(
            lambda t, u, mu=mu, w=w: [u[1], mu * (1 - u[0] ** 2) * u[1] - w * u[0]],
            (0, 110),
            [2.0, 0.0],
            method="LSODA",
            rtol=1e-12,
            atol=1e-14,
        )
        errors = np.abs(solution(t=exact.t, mu=mu, w=w) - exact.y).max(axis=1)
        assert (errors < 1e-4 * np.abs(exact.y).max(axis=1)).all()


@pytest.mark.slow
def test_slow_trajectories_cross_markers_after_the_end():
    """Between one and three spikes of calcium before it (Goldbeter, Dupont & Berridge 1990)."""
    pump, release = "65*z**2/(1 + z**2)", "vm*y**2/(4 + y**2)*z**4/(0.9**4 + z**4)"
    rates = {
        "z": f"1 + 7.3*beta - {pump} + {release} + y - 10*z",
        "y": f"{pump} - {release} - y",
    }
    box = {"beta": (0.35, 0.5), "vm": (400, 600)}
    made = ro.Problem.from_strings(rates, {"z": 0.1, "y": 1.5}, box, (0, 2))
    solution = ro.solve(made, 1e-4)
    assert solution.success
    assert solution.rank <= 25
    errors = against_trajectories(solution, made, np.linspace(0, 2, 801))
    assert (errors < 3e-4).all()


def growth(end, x0=(1e-3, 0.1), **more):
    """A culture that uses up its food, sooner or later, and is inhibited by much of it."""
    uptake = "0.5*s/(ks + s + s**2/ki)"
    return ro.Problem.from_strings(
        {"x": f"{uptake}*x", "s": f"-2*{uptake}*x"},
        {"x": "x0", "s": "10"},
        {"ks": (0.05, 5), "ki": (2, 200), "x0": x0},
        (0, end),
        **more,
    )


@pytest.mark.slow
def test_a_front_that_many_meet_after_the_horizon_is_a_marker():
    made = growth(30)
    solution = ro.solve(made, 1e-3)
    assert solution.success
    assert solution.rank < 40
    assert solution.timeline.stretches == 2
    errors = against_trajectories(solution, made, np.linspace(0, 30, 301), count=6)
    assert (errors < 3e-3).all()
    last = solution.event_times("marker_0", ks=5.0, ki=2.0, x0=1e-3)
    assert np.isnan(last).all()  # it comes three horizons later
    assert np.isfinite(solution.event_times("marker_0", ks=0.05, ki=200.0, x0=0.1)).all()


@pytest.mark.slow
def test_crossings_are_looked_for_only_where_their_paths_fit():
    """Paths of a hundred trajectories of fifty states take more than the solve."""
    rates = {f"x{i}": f"k*x{i - 1} - (k + c)*x{i}" if i else "-k*x0" for i in range(50)}
    initial = {name: "1" if name == "x0" else "0" for name in rates}
    compiled = ro.compile(
        ro.Problem.from_strings(rates, initial, {"k": (7, 14), "c": (1, 2)}, (0, 2))
    )
    compiled.solve(1e-1, check=8)  # imports
    tracemalloc.start()
    solution = compiled.solve(1e-3, max_memory="50MB", method="cross")
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert solution.success, solution.message
    assert peak < 1.2 * 50e6


@pytest.mark.slow
def test_what_is_steep_between_markers_alone_is_no_jump():
    """Next to a Hopf point the first marker differs over the box, and the states do not."""
    rates = {"x": "-x + 0.08*y + x**2*y", "y": "b - 0.08*y - x**2*y"}
    box = {"b": (0.5, 0.7), "a": (0.5, 1)}
    selkov = ro.Problem.from_strings(rates, {"x": "a", "y": 1}, box, (0, 200))
    solution = ro.solve(selkov, 1e-4, effort=0.05, method="cross")
    assert solution.status is ro.Status.WORK_LIMIT
    assert "jump" not in solution.message
