"""Reference trajectories: stacking, stiffness, blow-up, initial values, the error measure."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse
import sympy as sp
from scipy.integrate import solve_ivp
from scipy.stats import poisson

import rankone as ro
from rankone.solvers.march import amplification
from rankone.solvers.request import Check, Domain, SolveRequest
from rankone.solvers.verification import reference, resolution
from rankone.solvers.verification.measure import measure
from rankone.solvers.verification.points import check_points
from rankone.solvers.verification.reference import integrate_reference
from rankone.solvers.verification.reference_set import ReferenceSet
from rankone.solvers.verification.resolution import Resolution
from rankone.support.budget import limited, work_done
from rankone.trajectories.integrators.integrator_choice import WatchedStack
from tests.benchmarks.many_states import truss
from tests.problems import REFERENCE
from tests.reference.published import PUBLISHED

t, k, a = sp.symbols("t k a")
x = sp.Function("x")(t)


def module(name):
    return ro.compile(REFERENCE[name]()).system


def test_check_points_hold_the_centre_all_corners_and_interior_points():
    box = np.array([[0.0, 1.0], [2.0, 4.0]])
    points = check_points(box, 10)
    np.testing.assert_array_equal(points[0], [0.5, 3.0])
    assert {tuple(row) for row in points[1:5]} == {(0, 2), (0, 4), (1, 2), (1, 4)}
    assert len(points) == 15
    assert (points[5:] > box[:, 0]).all()
    assert (points[5:] < box[:, 1]).all()
    assert check_points(np.zeros((0, 2)), 10).shape == (1, 0)
    assert len(check_points(np.tile([0.0, 1.0], (7, 1)), 24)) == 33


def test_stacked_trajectories_equal_single_ones():
    system = module("lotka_volterra")
    points = check_points(np.array(system.box), 3)
    reference = integrate_reference(system, points, (0.0, 2.0), 1e-11)
    times = np.linspace(0.0, 2.0, 9)
    values = reference(times)
    assert values.shape == (2, len(points), 9)
    for j, point in enumerate(points):
        single = solve_ivp(
            lambda t, u: [u[0] * (1.5 - u[1]), -u[1] * (3 - u[0])],
            (0, 2),
            point,
            method="DOP853",
            rtol=1e-11,
            atol=1e-12,
            t_eval=times,
        )
        np.testing.assert_allclose(values[:, j], single.y, rtol=1e-7)


def test_a_stiff_system_is_recognised_and_a_smooth_one_is_not():
    robertson = module("robertson")
    points = check_points(np.array(robertson.box), 2)
    assert integrate_reference(robertson, points, (0.0, 40.0), 1e-6, "stack").stiff
    smooth = module("lotka_volterra")
    points = check_points(np.array(smooth.box), 2)
    assert not integrate_reference(smooth, points, (0.0, 6.0), 1e-9).stiff


def test_the_earliest_blow_up_is_found_with_its_point():
    problem = ro.Problem([sp.Eq(x.diff(t), k * x**2)], (t, 0, 3), {k: (0.2, 0.5)}, {x: 1})
    system = ro.compile(problem).system
    reference = integrate_reference(system, check_points(np.array(system.box), 4), (0.0, 3), 1e-8)
    assert reference.end == pytest.approx(2.0, rel=1e-3)
    assert reference.points[reference.blown] == 0.5


def test_initial_values_are_expressions_of_the_parameters():
    problem = ro.Problem(
        [sp.Eq(x.diff(t), -x)], (t, 0, 1), {k: (1, 2), a: (0, 1)}, {x: 2 * k * a + 1}
    )
    system = ro.compile(problem).system
    values = system.initial(np.array([[1.0, 2.0], [0.5, 0.25]]))
    np.testing.assert_allclose(values, [[2.0, 2.0]])


def test_the_error_measure_sees_an_error_put_in_by_hand():
    solution = ro.solve(REFERENCE["decay"](), rtol=1e-8)
    system = module("decay")
    reference_set = ReferenceSet.of(system, SolveRequest(3e-10, Domain.of(system), Check(5)))
    slabs = list(solution.outcome.slabs)
    assert measure(reference_set, slabs).error < 1e-7
    core = slabs[-1].cores[0].copy()
    core[0, 0] *= 1.0 + 1e-3
    spoiled = slabs[-1].with_first(core)
    assert measure(reference_set, [*slabs[:-1], spoiled]).error > 1e-5


@pytest.mark.parametrize(("rate", "expected"), [(1.0, np.exp(2.0)), (-1.0, 1.0)])
@pytest.mark.parametrize("states", [1, 70])
def test_amplification_of_linear_equations(rate, expected, states):
    rates = {f"x{i}": f"{rate}*x{i}" for i in range(states)}
    problem = ro.Problem.from_strings(rates, dict.fromkeys(rates, "a"), {"a": (1, 2)}, (0, 2))
    system = ro.compile(problem).system
    request = SolveRequest(3e-7, Domain.of(system), Check(2))
    growth = amplification(ReferenceSet.of(system, request))
    assert growth(0.0) == pytest.approx(expected, rel=2e-3 if states == 1 else 0.1)
    assert growth(2.0) == 1.0


@pytest.mark.parametrize("integrator", ["stack", "single"])
def test_a_state_that_falls_to_nothing_and_grows_again_is_resolved(integrator):
    problem = ro.Problem.from_strings({"x": "k*(t - 5)*x"}, {"x": "1"}, {"k": (4, 6)}, (0, 10))
    system = ro.compile(problem).system
    points = np.array([[4.0], [5.0], [6.0]])
    reference = integrate_reference(system, points, (0.0, 10.0), 1e-6, integrator=integrator)
    np.testing.assert_allclose(reference(np.array([10.0]))[0, :, 0], 1.0, rtol=1e-3)


@pytest.mark.slow
def test_a_state_that_falls_below_floating_point_numbers_and_grows_again_is_refused():
    problem = ro.Problem.from_strings({"x": "k*(t - 5)*x"}, {"x": "1"}, {"k": (60, 61)}, (0, 10))
    with pytest.raises(ro.ConvergenceError, match="`x` falls below 1e-250 and may grow again"):
        ro.solve(problem, rtol=1e-3)


@pytest.mark.slow
def test_a_state_that_is_nothing_and_stays_so_beside_one_that_grows_again():
    rates = {"a": "-200*a", "x": "k*(t - 5)*x + 1e-3*a"}
    problem = ro.Problem.from_strings(rates, {"a": "1", "x": "1"}, {"k": (4, 6)}, (0, 10))
    points = np.array([[4.0], [5.0], [6.0]])
    reference = integrate_reference(ro.compile(problem).system, points, (0.0, 10.0), 1e-6)
    at_end = reference(np.array([0.0, 10.0]))[:, :, 1]
    assert (np.abs(at_end[0]) < 1e-250).all()
    np.testing.assert_allclose(at_end[1], 1.0, rtol=0.01)


@pytest.mark.parametrize("rate", ["0", "-on"])
def test_a_latch_that_is_reset_to_zero_is_not_said_to_grow_again(rate):
    """What falls beside it is small, and grows again; the latch cannot."""
    rates = {"on": rate, "x": "k*(t - 5)*x + 0*on"}
    system = ro.compile(
        ro.Problem.from_strings(rates, {"on": "1", "x": "1"}, {"k": (4, 6)}, (0, 10))
    ).system
    times = np.linspace(0.0, 10.0, 65)

    def states(at):
        latch = np.where(at < 2.0, 1.0, 0.0)
        return np.stack([latch, np.exp(2.5 * ((at - 5.0) ** 2 - 25.0))])[:, None]

    class Sampled:
        end, state, largest = 10.0, np.ones((2, 1)), np.ones((2, 1))

        def samples(self, count):
            return [(time, states(np.array([time]))[:, :, 0]) for time in times.tolist()]

        def __call__(self, later):
            return states(later)

    box = Resolution(system, np.full((1, 1), 5.0), 0.0, 10.0, 1e-6, np.ones((2, 1)))
    assert box._grows_again(Sampled())[1, 0]


@pytest.mark.parametrize(
    ("rate", "points"),
    [
        pytest.param("(t - 5)*x", [[0.0, 5.0], [1.0, 5.0]], id="one that is zero all along"),
        pytest.param("-x", [[1.0, 100.0], [1.0, -2.0]], id="one that falls for good"),
    ],
)
def test_a_trajectory_does_not_grow_because_others_do(rate, points):
    problem = ro.Problem.from_strings(
        {"x": f"k*{rate}"}, {"x": "a"}, {"a": (0, 2), "k": (-2, 100)}, (0, 10)
    )
    points = np.array(points)
    reference = integrate_reference(ro.compile(problem).system, points, (0.0, 10.0), 1e-6)
    assert reference.end == 10.0
    exact = [points[0, 0] * np.exp(-1000.0), {5.0: 1.0, -2.0: np.exp(20.0)}[points[1, 1]]]
    found = reference(np.array([10.0]))[0, :, 0]
    np.testing.assert_allclose(found, exact, rtol=1e-3, atol=1e-200)


@pytest.mark.slow
def test_of_several_lost_states_the_one_that_grows_again_is_named():
    rates = {"a": "-200*a", "x": "k*(t - 5)*x"}
    problem = ro.Problem.from_strings(rates, {"a": "1", "x": "1"}, {"k": (60, 61)}, (0, 10))
    with pytest.raises(ro.ConvergenceError, match="`x` falls below 1e-250 and may grow again"):
        integrate_reference(ro.compile(problem).system, np.array([[60.0]]), (0.0, 10.0), 1e-3)


def test_a_state_that_starts_from_zero_is_left_an_absolute_tolerance():
    """It falls far later and grows again; resolved all the way down, it would not begin."""
    rates = {"x": "y*exp(x/(1 + 0.05*x)) - a*x", "y": "-0.01*y*exp(x/(1 + 0.05*x))"}
    problem = ro.Problem.from_strings(rates, {"x": "0", "y": "1"}, {"a": (1.2, 1.8)}, (0, 20))
    system, points = ro.compile(problem).system, np.array([[1.2], [1.5], [1.8]])
    reference = integrate_reference(system, points, (0.0, 20.0), 3e-6, integrator="single")
    assert reference.end == 20.0
    assert (reference.floor[0] > 0.0) & (reference.floor[0] < 1e-12)


@pytest.mark.slow
def test_states_from_zero_that_are_amplified_take_two_integrations(monkeypatch):
    """Each is made by the one before it, so that it is as small at first as steps are short."""
    rates = {
        "a": "-k*a",
        "b": "k*a - b",
        "c": "1e-3*b**2 - c",
        "d": "1e-3*c*b - d",
        "e": "1e-3*d*b + 2*e*(1 - e)",
    }
    initial = {"a": "1", **dict.fromkeys("bcde", "0")}
    problem = ro.Problem.from_strings(rates, initial, {"k": (0.5, 1.5)}, (0, 10))
    system, tolerances = ro.compile(problem).system, []
    run = WatchedStack.run
    monkeypatch.setattr(
        WatchedStack, "run", lambda *given: tolerances.append(given[-1]) or run(*given)
    )
    reference = integrate_reference(system, np.array([[1.0], [0.7]]), (0.0, 10.0), 1e-7)
    assert len(tolerances) == 2
    for j, value in enumerate((1.0, 0.7)):
        alone = solve_ivp(
            lambda t, u, value=value: system.rhs(t, u, [value]),
            (0.0, 10.0),
            [1.0, 0.0, 0.0, 0.0, 0.0],
            method="Radau",
            t_eval=[5.0, 10.0],
            rtol=1e-9,
            atol=1e-60,
        )
        np.testing.assert_allclose(reference(alone.t)[:, j], alone.y, rtol=1e-5)


@pytest.mark.parametrize(("small", "dips"), [([5], False), ([5, 6], True)])
def test_a_state_that_passes_through_zero_is_no_dip(small, dips):
    """What grows by itself has a tolerance of its own where it stays far below what it was."""
    system = ro.compile(ro.Problem.from_strings({"x": "x"}, {"x": "1"}, {}, (0, 90))).system
    times, states = np.linspace(0.0, 90.0, 11), np.ones((11, 1, 1))
    states[small] = 1e-12

    class Sampled:
        end, state, largest = 90.0, np.ones((1, 1)), np.ones((1, 1))

        def samples(self, count):
            return list(zip(times.tolist(), states, strict=True))

        def __call__(self, later):
            return np.ones((1, 1, later.size))

    box = Resolution(system, np.zeros((1, 0)), 0.0, 90.0, 1e-6, np.ones((1, 1)))
    assert box._grows_again(Sampled()).tolist() == [[dips]]


def test_states_are_read_in_blocks_where_they_are_many(monkeypatch):
    """Sizes, dips, slabs and errors are the same however few states are held at once."""
    rhs = {"x": "-k*x", "y": "x - y*y"}
    problem = ro.Problem.from_strings(rhs, {"x": "1", "y": "0"}, {"k": (1, 2)}, (0, 30))
    whole = ro.solve(problem, rtol=1e-4, method="cross")
    monkeypatch.setattr(resolution, "AT_ONCE", 1)
    in_blocks = ro.solve(problem, rtol=1e-4, method="cross")
    assert len(whole.history) == len(in_blocks.history)
    assert whole.history[0].slabs == in_blocks.history[0].slabs > 1
    np.testing.assert_allclose(in_blocks.error, whole.error, rtol=1e-6)


def test_the_end_of_a_long_chain_depends_on_what_is_tiny_early():
    """Each state is a Poisson probability; the last one is 1e-60 and less of the first."""
    n, end, rtol = 100, 4.0, 3e-6
    chain = scipy.sparse.eye(n, k=-1) - scipy.sparse.eye(n)
    box, first = {k: (1, 2)}, {"x0": 1}
    problem = ro.Problem.from_reactions(
        chain, [k] * n, orders="reactants", time=(t, 0, end), parameters=box, initial=first
    )
    rates, times = np.array([[1.5], [1.0], [2.0], [1.2]]), np.linspace(0.0, end, 21)
    states = integrate_reference(ro.compile(problem).system, rates, (0.0, end), rtol)(times)
    exact = poisson.pmf(np.arange(n)[:, None, None], rates * times)
    sizes = exact.max(axis=2, keepdims=True)
    assert np.abs(states / sizes - exact / sizes).max() < 10 * rtol


@pytest.mark.slow
def test_a_few_trajectories_show_the_sizes_of_states_from_zero_before_all(monkeypatch):
    """The stack is integrated once then, and not a second time to tighter tolerances."""
    system = ro.compile(PUBLISHED["pollu"].problem()).system
    domain = Domain.of(system)
    points = check_points(domain.bounds, 150)

    def work():
        with limited(math.inf):
            trajectories = integrate_reference(system, points, domain.horizon, 3e-6)
            return work_done(), trajectories(np.array(domain.horizon[1:]))

    with_pilots, states = work()
    monkeypatch.setattr(reference, "CHECK", replace(reference.CHECK, many_numbers=10**9))
    without, wanted = work()
    assert with_pilots < 0.8 * without
    assert np.all(np.abs(states - wanted) <= 1e-4 * np.abs(wanted).max(axis=1, keepdims=True))


@pytest.mark.slow
def test_states_that_rounding_errors_hide_early_keep_nothing_from_the_end():
    """Bars pass on what a push does to a tower at rest; tolerances like 1e-120 allow no steps."""
    system = ro.compile(truss(4)).system
    points = Domain.of(system).bounds.T
    reference = integrate_reference(system, points, system.horizon, 1e-7)
    assert reference.blown is None
    assert reference.end == system.horizon[1]
    finer = integrate_reference(system, points, system.horizon, 1e-10)
    times = np.linspace(*system.horizon, 9)
    sizes = np.abs(finer(times)).max(axis=(1, 2), keepdims=True)
    assert np.abs((reference(times) - finer(times)) / sizes).max() < 1e-5


@pytest.mark.slow
@pytest.mark.parametrize(("unknowns", "atol"), [(["x0", "x5"], None), (None, 1e-12)])
def test_a_long_chain_from_rest_is_that_of_poisson(unknowns, atol):
    names = [f"x{i}" for i in range(260)]
    rhs = {"x0": "-k*x0"} | {
        name: f"k*{before} - k*{name}" for before, name in itertools.pairwise(names)
    }
    first = dict.fromkeys(names, 0) | {"x0": 1}
    absolute = atol and dict.fromkeys(names, atol)
    problem = ro.Problem.from_strings(rhs, first, {"k": (0.7, 1.4)}, (0, 4), atol=absolute)
    solution = ro.solve(problem, rtol=1e-4, unknowns=unknowns)
    assert solution.success
    times, asked = np.linspace(0, 4, 21), [names.index(name) for name in solution.unknowns]
    exact = [poisson.pmf(np.array(asked)[:, None], k * times) for k in np.linspace(0.7, 1.4, 6)]
    sizes = np.max(np.abs(exact), axis=(0, 2))[:, None] + (atol or 0.0) / 1e-4
    for k, states in zip(np.linspace(0.7, 1.4, 6)[1:-1], exact[1:-1], strict=True):
        assert (np.abs(np.array(solution(times, k=k)) - states) < 1e-4 * sizes).all()


@pytest.mark.slow
def test_products_of_tiny_states_refuse_only_a_solve_that_asks_for_them():
    names = [f"x{i}" for i in range(100)]
    rhs = {name: f"k*x0*({before} - {name})" for before, name in itertools.pairwise(names)}
    rhs["x0"] = f"-k*x0*({' + '.join(names[:-1])})"
    first = dict.fromkeys(names, 0) | {"x0": 1}
    problem = ro.Problem.from_strings(rhs, first, {"k": (0.8, 1.2)}, (0, 0.5))
    with pytest.raises(ro.ConvergenceError, match=r"Problem\(\.\.\., atol="):
        ro.solve(problem, rtol=1e-3)
    assert ro.solve(problem, rtol=1e-3, unknowns=["x0", "x1"]).success
