"""Trajectories integrated one by one, and the change to them where a stack stalls."""

import os
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import rankone as ro
from rankone.solvers.verification.points import check_points
from rankone.solvers.verification.reference import integrate_reference
from rankone.support.budget import OutOfBudgetError, limited, work_done
from rankone.trajectories.integrators.integrator import Tolerances
from rankone.trajectories.integrators.integrator_choice import explicit_steps, integrator_for
from rankone.trajectories.integrators.single import SingleIntegrator
from rankone.trajectories.stacks.stack import StackedIntegrator

POINTS = np.array([[0.5], [1.0], [1.5]])
TOLERANCES = Tolerances(1e-8, np.full((1, 1), 1e-10))
HORIZON = [0.0, 2.0]


def system_of(rates, initial, box, end, **further):
    problem = ro.Problem.from_strings(rates, initial, box, (0, end), **further)
    return ro.compile(problem).system


def decay(rate="-k*x", **further):
    return system_of({"x": rate}, {"x": "1"}, {"k": (0.5, 1.5)}, 2, **further)


def van_der_pol(mu, end):
    return system_of(
        {"x": "y", "y": "mu*(1 - x**2)*y - x"},
        {"x": "x0", "y": "0"},
        {"x0": (1.8, 2.2), "mu": (0.9 * mu, 1.1 * mu)},
        end,
    )


def test_dense_and_sampled_trajectories_are_exact():
    times = np.linspace(0.1, 2.0, 7)
    exact = np.exp(-POINTS * times)
    dense = SingleIntegrator().run(decay(), POINTS, HORIZON, TOLERANCES)
    sampled = SingleIntegrator().sample(decay(), POINTS, HORIZON, TOLERANCES, times)
    assert dense.end == sampled.end == 2.0
    assert sampled.reached == 7
    np.testing.assert_allclose(dense(times)[0], exact, rtol=1e-8)
    np.testing.assert_allclose(np.moveaxis(sampled.states, 0, 2)[0], exact, rtol=1e-8)
    np.testing.assert_allclose(dense.state[0], exact[:, -1], rtol=1e-8)
    np.testing.assert_allclose(dense.largest[0], np.ones(3), rtol=1e-2)


def test_steps_as_polynomials_are_as_accurate_as_their_ends():
    system = system_of({"x": "w*y", "y": "-w*x"}, {"x": "1", "y": "0"}, {"w": (1, 9)}, 5)
    points = np.array([[1.0], [9.0]])
    tolerances = Tolerances(1e-9, np.full((2, 1), 1e-11))
    times = np.linspace(0.0, 5.0, 999)
    dense = SingleIntegrator().run(system, points, [0.0, 5.0], tolerances)
    np.testing.assert_allclose(dense(times)[0], np.cos(points * times), atol=1e-8)


def test_jumps_reset_states():
    system = decay(jumps={1: {"x": "x + 1"}})
    times = np.array([0.5, 1.0, 1.5])
    before = np.exp(-POINTS[:, 0])
    expected = [np.exp(-0.5 * POINTS[:, 0]), before + 1, (before + 1) * np.exp(-0.5 * POINTS[:, 0])]
    dense = SingleIntegrator().run(system, POINTS, [0.0, 1.0, 2.0], TOLERANCES)
    np.testing.assert_allclose(dense(times)[0].T, expected, rtol=1e-8)
    stacked = StackedIntegrator().sample(system, POINTS, [0.0, 1.0, 2.0], TOLERANCES, times)
    sampled = SingleIntegrator().sample(system, POINTS, [0.0, 1.0, 2.0], TOLERANCES, times)
    np.testing.assert_allclose(sampled.states, stacked.states, rtol=1e-7)


@pytest.mark.parametrize(
    ("rate", "end"),
    [("k*x**2", 1 / 1.5), ("-k/x", 0.5 / 1.5), ("-k*sqrt(x - 0.5)/(x - 0.5)**2", None)],
)
def test_the_first_trajectory_to_end_ends_all(rate, end):
    """A pole, a border of the domain in finite time, and one where the rate is infinite."""
    system = decay(rate)
    times = np.linspace(0.05, 1.95, 39)
    stacked = StackedIntegrator().sample(system, POINTS, HORIZON, TOLERANCES, times)
    sampled = SingleIntegrator().sample(system, POINTS, HORIZON, TOLERANCES, times)
    dense = SingleIntegrator().run(system, POINTS, HORIZON, TOLERANCES)
    end = stacked.end if end is None else end
    assert sampled.end == pytest.approx(end, rel=1e-5)
    assert dense.end == pytest.approx(end, rel=1e-5)
    assert sampled.reached == stacked.reached == np.searchsorted(times, end)
    reached = sampled.states[: sampled.reached]
    np.testing.assert_allclose(reached, stacked.states[: stacked.reached], rtol=1e-4)


def test_a_limit_tells_how_far_an_integration_came():
    system = decay("-100*k*(x - cos(100*t))")
    with limited(3e6), pytest.raises(OutOfBudgetError) as out:
        SingleIntegrator().run(system, POINTS, HORIZON, TOLERANCES)
    assert 0.0 <= out.value.reached.time <= 2.0


@pytest.mark.parametrize("width", [1e-2, 1e-3])
def test_a_narrow_pulse_over_the_states_is_seen(width):
    """x crosses the pulse at 1, which turns it by an angle that is known exactly."""
    system = system_of(
        {"x": "1", "y": f"k*exp(-((x - 1)/{width})**2)/{width}"},
        {"x": "0", "y": "0"},
        {"k": (0.5, 1.5)},
        2,
    )
    tolerances = Tolerances(1e-7, np.full((2, 1), 1e-9))
    for looks in (True, False):
        dense = SingleIntegrator(looks).run(system, POINTS, HORIZON, tolerances)
        expected = POINTS[:, 0] * np.sqrt(np.pi)
        np.testing.assert_allclose(dense.state[1], expected, rtol=1e-5)
    sampled = SingleIntegrator().sample(system, POINTS, HORIZON, tolerances, np.array([1.9]))
    np.testing.assert_allclose(sampled.states[0, 1], expected, rtol=1e-5)


def test_both_sides_of_a_narrow_peak_are_seen():
    """Attempts that LSODA refuses fall within peaks that its next, longer way steps over."""
    rates = {"x": "y", "y": "50*exp(-((x - 1/2)/1e-3)**2) - k*x"}
    system = system_of(rates, {"x": "1", "y": "0"}, {"k": (3, 5)}, 6)
    points = np.array([[3.06], [4.0]])
    reference = integrate_reference(system, points, (0.0, 6.0), 3e-5, "single")
    tolerances = Tolerances(1e-9, np.full((2, 1), 1e-11), longest_step=1e-3)
    exact = SingleIntegrator().run(system, points, [0.0, 6.0], tolerances)
    times = np.linspace(0.0, 6.0, 61)
    np.testing.assert_allclose(reference(times), exact(times), atol=1e-4)


def test_integrations_that_crawl_behind_a_jump_begin_anew():
    """LSODA took steps of 1e-7 from one of the jumps on; where depends on rounding."""
    system = system_of({"x": "a - floor(x)/20"}, {"x": "1/20"}, {"a": (1, 1.1)}, 6)
    points = np.array([[1.0270638550445057], [1.0516043479840205], [1.0737167501139422]])
    tolerances = Tolerances(1e-7, np.full((1, 1), 1e-9))
    with limited(4e8, np.inf):
        dense = SingleIntegrator().run(system, points, [0.0, 6.0], tolerances)
        sampled = SingleIntegrator().sample(system, points, [0.0, 6.0], tolerances, np.array([6.0]))
    np.testing.assert_allclose(dense.state[0], [_climbed(a, 6.0) for a in points[:, 0]], rtol=1e-5)
    np.testing.assert_allclose(sampled.states[0, 0], dense.state[0], rtol=1e-5)


def _climbed(a, end):
    """How far x comes, at a speed that falls by 1/20 at each whole number."""
    now, x = 0.0, 0.05
    while True:
        speed = a - np.floor(x) / 20
        reached = now + (np.floor(x) + 1.0 - x) / speed
        if reached > end:
            return x + speed * (end - now)
        now, x = reached, np.floor(x) + 1.0


@pytest.mark.slow
def test_a_stack_that_stalls_goes_on_as_single_trajectories():
    system = van_der_pol(1000, 2000)
    points = check_points(np.array(system.box), 12)
    work = {}
    for integrator in ("auto", "stack", "single"):
        with limited():
            before = work_done()
            reference = integrate_reference(system, points, (0, 2000), 1e-4, integrator)
            work[integrator] = work_done() - before
        assert reference.end == 2000
        assert reference.integrator == ("single" if integrator == "auto" else integrator)
    assert work["auto"] < work["stack"]
    # the stack that is given up, and pilots, cost less than single trajectories from the start
    assert work["auto"] < 2.0 * work["single"]


def test_smooth_stacks_pay_nothing():
    system = van_der_pol(1, 5)
    points = check_points(np.array(system.box), 48)
    work = []
    for integrator in ("auto", "stack"):
        with limited():
            before = work_done()
            reference = integrate_reference(system, points, (0, 5), 1e-8, integrator)
            work.append(work_done() - before)
        assert reference.integrator == "stack"
    assert work[0] == work[1]


def test_the_choice_is_the_same_each_time():
    system = van_der_pol(50, 60)
    points = check_points(np.array(system.box), 8)
    tolerances = Tolerances(1e-6, np.full((2, 1), 1e-8))
    times = np.linspace(1.0, 59.0, 30)
    first, second = (
        integrator_for(system).sample(system, points, [0.0, 60.0], tolerances, times)
        for _ in range(2)
    )
    assert first.integrator == second.integrator
    np.testing.assert_array_equal(first.states, second.states)


@pytest.mark.parametrize("method", ["cross", "train", "greedy"])
def test_solutions_by_single_trajectories(method):
    problem = ro.Problem.from_strings({"x": "-k*x"}, {"x": "1"}, {"k": (0.5, 1.5)}, (0, 2))
    solution = ro.solve(problem, rtol=1e-5, method=method, integrator="single")
    assert solution.success
    assert {record.integrator for record in solution.history} == {"single"}
    assert solution.outcome.measured.integrator == "single"
    assert solution.outcome.measured.method == "LSODA"


def test_an_unknown_integrator():
    with pytest.raises(ro.OptionError, match="integrator='twice' is unknown"):
        ro.solve(ro.Problem.from_strings({"x": "-x"}, {"x": "1"}, {}, (0, 2)), integrator="twice")


@pytest.mark.slow
def test_exported_solvers_integrate_trajectories_alone(tmp_path):
    """Their right-hand side is rewritten for floats as it is in the library."""
    problem = ro.Problem.from_strings({"x": "-k*x + sin(x)"}, {"x": "1"}, {"k": (0.5, 1.5)}, (0, 2))
    ro.compile(problem).export(tmp_path / "solver.py")
    script = """
import sys
import solver
solution = solver.solve(1e-4, integrator="single")
assert solution.success
assert {record.integrator for record in solution.outcome.history} == {"single"}
(scalar,) = (m for name, m in sys.modules.items() if name.endswith("integrators.lsoda"))
assert scalar.scalar_rates(solver.SYSTEM) is not None
"""
    without_rankone = {"PYTHONPATH": str(tmp_path), "PATH": os.environ["PATH"]}
    subprocess.run([sys.executable, "-c", script], env=without_rankone, cwd=tmp_path, check=True)


def test_stacks_as_small_as_the_pilots_are_not_watched():
    system, work = van_der_pol(100.0, 60.0), {}
    tolerances = Tolerances(1e-5, np.full((2, 1), 1e-7))
    for integrator in ("stack", "auto"):
        chosen = integrator_for(system, integrator)
        with limited() as account:
            chosen.run(system, np.array([[2.0, 100.0]] * 3), [0.0, 60.0], tolerances)
            work[integrator] = account.done
    assert work["auto"] == work["stack"] > 3e6


def test_steps_tell_those_of_explicit_ones():
    system = system_of({"x": "w*y", "y": "-w*x"}, {"x": "1", "y": "0"}, {"w": (1, 9)}, 5)
    tolerances, points = Tolerances(1e-7, np.full((2, 1), 1e-9)), np.array([[1.0], [9.0]])
    dense = {
        integrator: integrator_for(system, integrator).run(system, points, [0.0, 5.0], tolerances)
        for integrator in ("stack", "single")
    }
    assert dense["single"].steps == max(path.steps for path in dense["single"].paths)
    stack, single = (explicit_steps(system, dense[each], 1e-7) for each in ("stack", "single"))
    whole = replace(system, terms=())  # leaves the series for DOP853
    explicit = StackedIntegrator().run(whole, points, [0.0, 5.0], tolerances)
    assert (dense["stack"].method, explicit.method) == ("Taylor", "DOP853")
    assert explicit_steps(whole, explicit, 1e-7) == explicit.steps
    assert 0.3 * explicit.steps < stack < explicit.steps
    assert 0.5 * explicit.steps < single < 2.0 * explicit.steps


@pytest.mark.parametrize("integrator", ["stack", pytest.param("single", marks=pytest.mark.slow)])
def test_a_state_leaves_zero_where_its_jacobian_is_infinite(integrator):
    """Newton's correction vanishes there, whatever the rate is."""
    rate, end = "-k*sqrt(x) + 0.01*exp(-t)", 3.0
    problem = ro.Problem.from_strings({"x": rate}, {"x": "0"}, {"k": (0.5, 1)}, (0, end))
    solution = ro.solve(problem, 1e-4, integrator=integrator)
    assert solution.success
    alone = solve_ivp(
        lambda t, x: -0.7 * np.sqrt(np.maximum(x, 0.0)) + 0.01 * np.exp(-t),
        (0.0, end),
        [0.0],
        method="LSODA",
        t_eval=[0.1, 1.0],
        rtol=1e-8,
        atol=1e-14,
    )
    largest = 3.2e-4
    np.testing.assert_allclose(solution(t=alone.t, k=0.7), alone.y, atol=2e-4 * largest)
