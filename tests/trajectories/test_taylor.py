"""Taylor steps of stacks: against closed forms and SciPy, and where they are not taken."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import rankone as ro
from rankone.trajectories.integrators.integrator import Spans, Tolerances
from rankone.trajectories.stacks import stack as stacks
from rankone.trajectories.stacks import taylor
from rankone.trajectories.stacks.stack import StackedIntegrator, StackedTrajectories
from rankone.trajectories.stacks.taylor import TaylorSeries
from rankone.trajectories.system.system import System

CASES = {
    "linear": ({"x": "a*x - y", "y": "x - b*y"}, {"x": "1", "y": "b"}, 4.0),
    "constant": ({"x": "a", "y": "b*x"}, {"x": "0", "y": "0"}, 3.0),
    "quadratic": ({"x": "x*(1.5 - y)", "y": "-a*y*(b - x)"}, {"x": "2", "y": "1"}, 6.0),
    "cubic": ({"x": "a*y", "y": "-b*x**3 - x*y**2 + 0.3"}, {"x": "1", "y": "0"}, 5.0),
    "quartic": ({"x": "1 + a*x**4 - x**2*y*x", "y": "b*x*y"}, {"x": "0", "y": "1"}, 0.6),
}
BOX = {"a": (0.5, 1.0), "b": (0.6, 0.9)}


def system_of(rates: dict[str, str], initial: dict[str, str], end: float, **more: object) -> System:
    problem = ro.Problem.from_strings(rates, initial, BOX, (0, end), **more)
    return ro.compile(problem).system


def trajectories(
    system: System, points: np.ndarray, tolerance: float, floor: float = 1e-3
) -> StackedTrajectories:
    absolute = np.full((system.n_differential, 1), floor * tolerance)
    edges = [0.0, *system.jumps.inside(*system.horizon), system.horizon[1]]
    return StackedIntegrator().run(system, points, edges, Tolerances(tolerance, absolute))


def points_of(count: int) -> np.ndarray:
    return np.random.default_rng(3).uniform([0.5, 0.6], [1.0, 0.9], (count, 2))


@pytest.mark.parametrize("tolerance", [1e-6, 1e-10])
@pytest.mark.parametrize("case", CASES)
def test_the_trajectories_are_those_of_scipy(case, tolerance):
    rates, initial, end = CASES[case]
    system, points = system_of(rates, initial, end), points_of(5)
    dense = trajectories(system, points, tolerance)
    assert dense.method == "Taylor"
    times = np.sort(np.random.default_rng(4).uniform(0.0, end, 30))
    states, slow = dense(times), np.stack([path(times) for path in dense.paths], axis=1)
    for k, point in enumerate(points):
        exact = solve_ivp(
            lambda t, u, p=point: system.rhs(t, u[:, None], p[:, None])[:, 0],
            (0.0, end),
            system.initial(point[:, None])[:, 0],
            "DOP853",
            times,
            rtol=1e-12,
            atol=1e-14,
        ).y
        size = np.abs(exact).max()
        assert np.abs(states[:, k] - exact).max() < 10.0 * tolerance * size
        assert np.abs(slow[:, k] - exact).max() < 10.0 * tolerance * size


def test_coefficients_of_exponentials_are_those_of_the_series():
    system = system_of({"x": "a*x"}, {"x": "1"}, 1.0)
    series = TaylorSeries.of(system, np.array([[0.5, 1.0], [0.6, 0.7]]))
    powers = series.coefficients(np.ones((1, 2)), 2.0, 5)[:, 0]
    factorials = np.array([1.0, 1.0, 2.0, 6.0, 24.0, 120.0])
    assert np.allclose(powers[:, 0], 1.0 / factorials, rtol=1e-14)
    assert np.allclose(powers[:, 1], 2.0 ** np.arange(6) / factorials, rtol=1e-14)


def test_affine_rates_take_few_steps_of_a_higher_order(monkeypatch):
    """The steps of an exponential grow with the order, which saves more than each step costs."""
    system = system_of({"x": "5*y", "y": "a - 5*x - 0.1*b*y"}, {"x": "1", "y": "0"}, 12.0)
    costs = []
    for ratio in (taylor._SERIES.affine_orders, 1.0):
        monkeypatch.setattr(taylor, "_SERIES", replace(taylor._SERIES, affine_orders=ratio))
        dense = trajectories(system, points_of(4), 1e-6)
        assert dense.method == "Taylor"
        costs.append(dense.steps * (dense.pieces[0].order + 8))
    assert costs[0] < 0.75 * costs[1]


@pytest.mark.parametrize("products", [False, True])
def test_only_rates_without_products_are_affine(products):
    power = 2 if products else 1
    system = system_of({"x": "a - 5*x", "y": f"x - b*y**{power}"}, {"x": "1", "y": "0"}, 1.0)
    order = trajectories(system, points_of(2), 1e-6).pieces[0].order
    assert order == taylor.taylor_order(1e-6, affine=not products)


@pytest.mark.parametrize("tolerance", [1e-5, 1e-9, 1e-12])
def test_rates_whose_coefficients_vanish_by_symmetry(tolerance):
    """Three of four coefficients are zero at the start, whatever the order."""
    system = system_of({"x": "1 + x**4"}, {"x": "0"}, 1.0)
    dense = trajectories(system, points_of(2), tolerance)
    assert dense.method == "Taylor"
    exact = solve_ivp(lambda t, x: 1.0 + x**4, (0, 1), [0.0], "DOP853", rtol=1e-13, atol=1e-15)
    assert abs(dense.state[0, 0] - exact.y[0, -1]) < 10.0 * tolerance


def test_a_trajectory_ends_at_its_pole():
    system = system_of({"x": "x**2"}, {"x": "a"}, 3.0)
    dense = trajectories(system, np.array([[0.5, 0.6], [0.8, 0.6]]), 1e-9)
    assert dense.method == "Taylor"
    assert dense.end == pytest.approx(1.25, rel=1e-9)
    assert dense.state[0, 1] > 1e9


def test_states_are_reset_in_between():
    system = system_of({"x": "-a*x"}, {"x": "1"}, 2.0, jumps={1.0: {"x": "x + 1"}})
    points = points_of(3)
    dense = trajectories(system, points, 1e-10)
    assert dense.method == "Taylor"
    a = points[:, 0]
    assert np.allclose(dense.state[0], (np.exp(-a) + 1.0) * np.exp(-a), rtol=1e-9)
    assert np.allclose(dense(np.array([0.5]))[0, :, 0], np.exp(-0.5 * a), rtol=1e-9)


def test_stiff_systems_are_left_to_radau():
    system = system_of({"x": "-2000*a*(x - y**2)", "y": "-b*y"}, {"x": "2", "y": "1"}, 5.0)
    dense = trajectories(system, points_of(3), 1e-7)
    assert dense.method == "Radau"
    exact = np.exp(-0.9 * 5.0) ** 2
    assert np.allclose(trajectories(system, np.array([[1.0, 0.9]]), 1e-7).state[0], exact, 1e-2)


def test_a_decay_with_few_steps_left_is_not_begun_anew_by_radau():
    problem = ro.Problem.from_strings({"x": "-k*(x - 1)"}, {"x": "0"}, {"k": (25, 30)}, (0, 6))
    points, edges = np.array([[25.0], [30.0]]), [0.0, 6.0]
    system, tolerances = ro.compile(problem).system, Tolerances(1e-5, 1e-9)
    dense = StackedIntegrator().run(system, points, edges, tolerances)
    assert (dense.method, dense.avoided) == ("Taylor", 0.0)
    assert dense.steps < 30
    times = np.array([0.02, 6.0, 0.3, 0.02])
    exact = 1.0 - np.exp(-points * times)
    np.testing.assert_allclose(dense(times)[0], exact, rtol=0.0, atol=1e-5)
    part = dense.of(slice(1, 2))
    for (time, states), (_, some) in zip(dense.samples(8), part.samples(8), strict=True):
        np.testing.assert_allclose(states[0], 1.0 - np.exp(-points[:, 0] * time), atol=1e-5)
        np.testing.assert_allclose(some[:, 0], states[:, 1], atol=1e-12)


def test_a_smooth_decay_is_not_stiff():
    system = system_of({"x": "-20*a*x"}, {"x": "1"}, 6.0)
    dense = trajectories(system, points_of(3), 1e-8, floor=1e-60)
    assert dense.method == "Taylor"
    assert dense.steps > 10  # stability is looked at by then


def test_rates_that_the_terms_do_not_tell_are_integrated_as_they_are():
    system = system_of({"x": "-a*x"}, {"x": "1"}, 1.0)
    doubled = replace(system, rhs=lambda t, u, p: 2.0 * system.rhs(t, u, p))
    points = points_of(3)
    dense = trajectories(doubled, points, 1e-9)
    assert dense.method == "DOP853"
    assert np.allclose(dense.state[0], np.exp(-2.0 * points[:, 0]), rtol=1e-7)


def test_functions_of_time_and_others_are_left_to_runge_and_kutta():
    for rate in ("-a*x + cos(t)", "-a*sin(x)", "-a*x**5"):
        system = system_of({"x": rate}, {"x": "1"}, 1.0)
        assert trajectories(system, points_of(3), 1e-9).method == "DOP853"


def test_long_steps_show_what_short_ones_show():
    """A state that starts from zero is looked at before it has grown, whatever the steps are."""
    system = system_of({"x": "a", "y": "x + b*y"}, {"x": "0", "y": "0"}, 30.0)
    dense = trajectories(system, points_of(3), 1e-9)
    assert dense.method == "Taylor"
    assert dense.early[1].max() < 1e-4 * dense.largest[1].max()
    times = [time for time, _ in dense.samples(20)]
    assert len(times) >= 20
    assert np.all(np.diff(times) > 0.0)
    assert times[-1] > 0.9 * 30.0


@pytest.mark.parametrize("tolerance", [1e-8, 1e-12])
def test_paths_follow_long_steps_within_the_tolerance(tolerance):
    """A path has polynomials of degree six, and a step of high order needs several of them."""
    system = system_of({"x": "a*y", "y": "-a*x"}, {"x": "0", "y": "1"}, 10.0)
    (point,) = points = np.array([[0.9, 0.7]])
    dense = trajectories(system, points, tolerance)
    assert dense.method == "Taylor"
    times = np.linspace(0.0, 10.0, 2001)
    missed = dense.paths[0](times)[0] - np.sin(point[0] * times)
    assert np.abs(missed).max() < 5.0 * tolerance


def test_spans_of_their_own_are_taken_by_taylor_steps(monkeypatch):
    system, points = system_of(*CASES["quadratic"]), points_of(3)
    starts, ends = np.array([0.0, 0.3, 1.0]), np.array([2.0, 5.0, 1.5])
    states = np.array([[2.0, 1.5, 3.0], [1.0, 2.0, 0.5]])
    tolerances = Tolerances(1e-9, np.full((2, 1), 1e-12))
    monkeypatch.setattr(stacks, "StackedDOP853", lambda *_, **__: pytest.fail("DOP853 is taken"))
    paths = StackedIntegrator().paths(system, points, Spans(starts, states, ends), tolerances)
    for k, path in enumerate(paths):
        times = np.linspace(starts[k], ends[k], 50)
        exact = solve_ivp(
            lambda t, u, p=points[k]: system.rhs(t, u[:, None], p[:, None])[:, 0],
            (starts[k], ends[k]),
            states[:, k],
            "DOP853",
            times,
            rtol=1e-12,
            atol=1e-14,
        ).y
        np.testing.assert_allclose(path(times), exact, rtol=2e-7, atol=1e-8)


def test_a_decay_that_lasts_is_left_to_radau_at_once(monkeypatch):
    """Not one that is over soon: explicit steps grow as it slows down."""
    counts = []
    step = stacks.StackedTaylor.step
    monkeypatch.setattr(stacks.StackedTaylor, "step", lambda self: counts.append(1) or step(self))
    lasting = {"x": "-a*(x - y**2)", "y": "-b*y**2"}
    system = system_of(lasting, {"x": "2", "y": "1"}, 1e6)
    assert trajectories(system, points_of(3), 1e-7).method == "Radau"
    assert len(counts) <= 30
    counts.clear()
    system = system_of({"x": "-a*x**3", "y": "-b*y"}, {"x": "1e4", "y": "1"}, 2.0)
    assert trajectories(system, points_of(3), 1e-7).method == "Taylor"
