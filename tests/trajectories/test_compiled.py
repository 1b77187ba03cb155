"""Trajectories by compiled Taylor series agree with others, or are left to them."""

import pickle
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from threading import Barrier

import numpy as np
import pytest
import sympy as sp
from scipy.special import erf

import rankone as ro
from rankone.support.budget import OutOfWorkError, limited
from rankone.trajectories.integrators.compiled_series import CompiledIntegrator
from rankone.trajectories.integrators.integrator import Tolerances
from rankone.trajectories.integrators.integrator_choice import (
    SamplingChoice,
    explicit_steps,
    integrator_for,
)
from rankone.trajectories.integrators.series import (
    has_series,
    order_of,
    taylor_integrator,
    with_compiled_rates,
)
from rankone.trajectories.stacks.stack import StackedIntegrator
from tests.honesty.cases import t
from tests.problems import GENERAL, REFERENCE

pytest.importorskip("heyoka", reason='compiled trajectories need heyoka: pip install ".[fast]"')

RELATIVE = 1e-8
K = {"k": (0.5, 1.5)}


def system_of(rates, starts, box=None, end=2, **more):
    return ro.compile(ro.Problem.from_strings(rates, starts, box or {}, (0, end), **more)).system


def points_of(system, count=9):
    lower, upper = np.array(system.box).reshape(-1, 2).T
    return np.random.default_rng(4).uniform(lower, upper, (count, len(lower)))


def edges_of(system):
    start, end = system.horizon
    return [start, *(t for t in system.jumps.times if start < t < end), end]


def tolerances(system, points, relative=RELATIVE, negligible=1e-7):
    sizes = np.abs(system.initial(points.T)).max(axis=1, keepdims=True)
    sizes[sizes == 0.0] = sizes.max() or 1.0
    return Tolerances(relative, negligible * relative * sizes)


def compiled_integrator(system):
    integrator = integrator_for(system, "compiled", accuracy=RELATIVE)
    assert isinstance(integrator, CompiledIntegrator)
    return integrator


def run(system, points, relative=RELATIVE):
    made = tolerances(system, points, relative)
    return compiled_integrator(system).run(system, points, edges_of(system), made)


EXACT = {
    "decay": ({"x": "-k*x"}, {"x": "1"}, lambda t, k: np.exp(-k * t)),
    "sine": ({"x": "k*cos(k*t)"}, {"x": "0"}, lambda t, k: np.sin(k * t)),
    "rational": ({"x": "1/(1 + x)"}, {"x": "k"}, lambda t, k: np.sqrt((1 + k) ** 2 + 2 * t) - 1),
    "exponential": ({"x": "exp(-x)"}, {"x": "log(k)"}, lambda t, k: np.log(t + k)),
    "nothing": ({"x": "0"}, {"x": "k"}, lambda t, k: k + 0 * t),
    "constant": ({"x": "k"}, {"x": "0"}, lambda t, k: k * t),
    "number": (
        {"x": "sqrt(2)*x*erf(2)"},
        {"x": "k"},
        lambda t, k: k * np.exp(np.sqrt(2) * erf(2) * t),
    ),
}


@pytest.mark.parametrize(("rates", "starts", "exact"), EXACT.values(), ids=EXACT)
def test_exact_solutions(rates, starts, exact):
    system = system_of(rates, starts, K)
    points, times = points_of(system), np.linspace(0.0, 2.0, 23)
    dense = run(system, points)
    assert dense.integrator == "compiled"
    expected = exact(times, points)
    assert np.abs(dense(times)[0] - expected).max() < 1e-7
    assert dense.state[0] == pytest.approx(expected[:, -1], abs=1e-7)
    assert dense.last[0] == pytest.approx(expected[:, -1], abs=1e-7)
    made = tolerances(system, points)
    integrator = compiled_integrator(system)
    sampled = integrator.sample(system, points, edges_of(system), made, times)
    assert (sampled.integrator, sampled.reached) == ("compiled", times.size)
    assert np.abs(sampled.states[:, 0].T - expected).max() < 1e-7


@pytest.mark.parametrize("name", ["lotka_volterra", "kirchhoff", "coupled", "doses"])
def test_the_same_as_stacks(name):
    problem = REFERENCE[name]() if name in REFERENCE else GENERAL[name].problem
    system = ro.compile(problem).system
    points, edges = points_of(system), edges_of(system)
    made = tolerances(system, points)
    dense = run(system, points)
    stacked = StackedIntegrator().run(system, points, edges, made)
    assert dense.integrator == "compiled"
    times = np.linspace(*system.horizon, 37)
    sizes = stacked.largest.max(axis=1)[:, None, None]
    assert np.abs((dense(times) - stacked(times)) / sizes).max() < 100 * RELATIVE
    assert dense.largest == pytest.approx(stacked.largest, rel=0.2)
    for time, states in dense.samples(5):
        assert np.abs(states - dense(np.array([time]))[:, :, 0]).max() == 0.0
    sampled = compiled_integrator(system).sample(system, points, edges, made, times)
    stacked_samples = StackedIntegrator().sample(system, points, edges, made, times)
    difference = (sampled.states - stacked_samples.states) / sizes[:, :, 0]
    assert np.abs(difference).max() < 100 * RELATIVE


def test_a_state_may_be_tiny_beside_others():
    rates = {"x": "x*(1 - x/1000)", "y": "2*y*(1 - y)", "z": "-x*z"}
    system = system_of(rates, {"x": "1", "y": "1e-12*k", "z": "1"}, {"k": (1, 2)}, 18)
    points = points_of(system)
    dense = run(system, points)
    start = 1e-12 * points[:, 0]
    expected = 1.0 / (1.0 + (1.0 - start) / start * np.exp(-36.0))
    assert dense.state[1] == pytest.approx(expected, rel=1e-6)


def test_blow_up_is_told_by_others():
    system = system_of({"x": "x**2"}, {"x": "k"}, K)
    points = np.array([[0.3], [1.0], [0.25]])
    dense = run(system, points)
    assert dense.integrator != "compiled"
    assert dense.end == pytest.approx(1.0, abs=1e-3)
    times = np.linspace(0.0, 2.0, 9)
    made = tolerances(system, points)
    sampled = compiled_integrator(system).sample(system, points, edges_of(system), made, times)
    assert sampled.integrator != "compiled"
    assert sampled.reached < times.size


def test_stiff_systems_are_left_to_implicit_steps():
    system = ro.compile(REFERENCE["robertson"]()).system
    points = points_of(system, 3)
    dense = run(system, points, 1e-6)
    assert dense.method in ("Radau", "LSODA")


def test_what_hides_between_the_ends_of_steps_is_not_missed():
    peak = system_of({"x": "1", "y": "100*k*exp(-((x - 1)*200)**2)"}, {"x": "0", "y": "1"}, K, 3)
    assert not has_series(peak)
    system = replace(peak, features=replace(peak.features, n_peaks=0))
    assert has_series(system)
    made = Tolerances(3e-6, np.full((2, 1), 1e-12), 0.3)
    stack = StackedIntegrator(looks_anywhere=True)
    dense = CompiledIntegrator(stack, 3e-6).run(system, points_of(system, 97), [0.0, 3.0], made)
    assert dense.integrator == "stack"


UNKNOWN = {
    "absolute": "Abs(x)",
    "piecewise": "Piecewise((x, x < 1), (1, True))",
    "largest": "Max(x, t)",
    "whole": "floor(4*x)",
    "special": "x + gamma(x + 1)",
    "singular": "sqrt(x)",
}


@pytest.mark.parametrize("rate", UNKNOWN.values(), ids=UNKNOWN)
def test_what_heyoka_does_not_have(rate):
    system = system_of({"x": f"k*({rate})"}, {"x": "1"}, K)
    assert not has_series(system)
    chosen = integrator_for(system, "compiled", accuracy=RELATIVE)
    assert not isinstance(chosen, CompiledIntegrator)


def test_a_function_of_the_user_is_not_looked_into():
    square = ro.function("square", lambda x: x**2, lambda x: 2 * x)
    x = sp.Function("x")(t)
    problem = ro.Problem(
        equations=[sp.Eq(x.diff(t), -square(x))], time=(t, 0, 1), parameters={}, initial={x: 1}
    )
    assert not has_series(ro.compile(problem).system)


def test_the_user_is_told_what_is_not_compiled():
    problem = ro.Problem.from_strings({"x": "-k*Abs(x)"}, {"x": "1"}, {"k": (1, 2)}, (0, 1))
    with pytest.warns(ro.RankoneWarning, match="integrator='compiled' does not serve"):
        solution = ro.solve(problem, 1e-4, integrator="compiled")
    assert solution.success
    assert solution.history[-1].integrator == "stack"


@pytest.mark.parametrize("method", ["cross", "train"])
def test_solutions_agree(method):
    compiled = ro.compile(REFERENCE["lotka_volterra"]())
    fast = compiled.solve(1e-5, method=method, integrator="compiled")
    slow = compiled.solve(1e-5, method=method, integrator="stack")
    assert fast.success
    assert {record.integrator for record in fast.history} == {"compiled"}
    assert {record.integrator for record in slow.history} == {"stack"}
    grid = {"t": np.linspace(0, 6, 61)[:, None], "x0": np.linspace(8, 12, 9), "y0": 4.5}
    assert np.abs(fast(grid) - slow(grid)).max() < 2e-5 * np.abs(slow(grid)).max()


def test_each_trajectory_is_its_own():
    """Whoever else is in the batch, and whatever was integrated before."""
    system = ro.compile(REFERENCE["kirchhoff"]()).system
    points, edges = points_of(system, 11), edges_of(system)
    times, made = np.linspace(0.0, 1.0, 7), tolerances(system, points)
    integrator = compiled_integrator(system)
    states = integrator.sample(system, points, edges, made, times).states
    other = pickle.loads(pickle.dumps(integrator))
    some = other.sample(system, points[2:7], edges, made, times).states
    assert (some == states[:, :, 2:7]).all()


def test_work_is_counted_once_and_limited():
    system = ro.compile(REFERENCE["kirchhoff"]()).system
    points = points_of(system, 200)
    work = edges_of(system), tolerances(system, points)

    def counted():
        with limited() as account:
            for _ in range(2):
                compiled_integrator(system).run(system, points, *work)
                yield account.done

    (first, second), (again, _) = counted(), counted()
    assert first == again
    assert 0.0 < second - first < 0.7 * first
    integrator = compiled_integrator(system)
    with pytest.raises(OutOfWorkError) as out, limited(2e5):
        integrator.run(system, points, *work)
    assert out.value.reached.time == 0.0
    with pytest.raises(OutOfWorkError), limited(2e5):
        integrator.sample(system, points, *work, np.linspace(0.1, 1.0, 5))


def test_a_budget_that_ends_within_a_batch_is_no_reason_for_another_integrator():
    system = system_of({"x": "300*k*y", "y": "-300*k*x"}, {"x": "1", "y": "0"}, K)
    points = points_of(system, 4)
    work = edges_of(system), tolerances(system, points), np.linspace(0.5, 2.0, 4)
    series = CompiledIntegrator(None, RELATIVE)  # nothing else could take over
    with limited() as account:
        assert series.sample(system, points, *work).integrator == "compiled"
    for share in (0.3, 0.6, 0.9):
        with pytest.raises(OutOfWorkError), limited(share * account.done):
            series.sample(system, points, *work)


def test_each_thread_keeps_its_integrators():
    system = system_of({"x": "-k*x"}, {"x": "1"}, K)
    threads = 20
    barrier = Barrier(threads)

    def compiled_twice(_):
        first = taylor_integrator(system, 4)
        barrier.wait()
        return first, taylor_integrator(system, 4)

    with ThreadPoolExecutor(threads) as executor:
        pairs = list(executor.map(compiled_twice, range(threads)))
    assert all(first is second for first, second in pairs)
    assert len({id(first) for first, _ in pairs}) == threads


def choice_for(name, **counts):
    system = ro.compile(REFERENCE[name]()).system
    return SamplingChoice(system, "auto", "auto", "stack", 3e-7, 24, **counts)


def option_for(choice, tolerance=9e-6, m=400, times=22):
    return choice.at_times(times, tolerance, m)


def record(choice, taken="stack", slower=1.0):
    """As many trajectories as :func:`option_for` asks for, ``slower`` than predicted."""
    choice.record(taken, 400, slower * choice._next[0])


def test_compiled_trajectories_are_taken_where_their_savings_pay():
    choice = choice_for("lotka_volterra")
    assert option_for(choice) == "auto"
    record(choice)
    assert option_for(choice) == "auto"
    record(choice, slower=100.0)
    assert option_for(choice) == "compiled"
    record(choice, "compiled")
    assert option_for(choice) == "compiled"
    record(choice)
    assert option_for(choice) == "stack"
    record(choice, slower=1e3)
    assert option_for(choice) == "stack"
    asked = replace(choice_for("lotka_volterra"), option="stack")
    option_for(asked)
    record(asked, slower=1e3)
    assert option_for(asked) == "auto"


def test_rates_are_compiled_where_stacks_are_large():
    choice = choice_for("kirchhoff")
    assert option_for(choice, m=50) == "auto"
    record(choice, slower=0.1)
    chosen = option_for(choice, m=4000)
    assert integrator_for(choice.system, chosen, accuracy=RELATIVE).stack.compiled
    record(choice, "compiled", slower=100.0)
    assert option_for(choice, m=50) == chosen
    assert option_for(replace(choice_for("kirchhoff"), integrator="compiled"), m=1000) == chosen


def test_steps_of_either_series_tell_those_of_dop853():
    system = ro.compile(REFERENCE["kirchhoff"]()).system
    points = points_of(system)
    work = points, edges_of(system), tolerances(system, points)
    whole = replace(system, terms=())  # leaves the series for DOP853
    expected = StackedIntegrator().run(whole, *work).steps
    for dense in (run(system, points), StackedIntegrator().run(system, *work)):
        assert dense.method == "Taylor"
        assert 0.4 * expected < explicit_steps(system, dense, RELATIVE) < 2.5 * expected


def test_compiled_rates_save_nothing_where_stacks_take_series():
    choice = choice_for("chain")
    option_for(choice, m=1000)
    generated, fast = choice._next
    assert generated == fast > 0.0


RATES = {
    "kirchhoff": lambda: ro.compile(REFERENCE["kirchhoff"]()).system,
    "doses": lambda: ro.compile(GENERAL["doses"].problem).system,
    "time": lambda: system_of({"x": "cos(k*t)*exp(-x)", "y": "1", "z": "0"}, START, K),
    "parameters": lambda: system_of({"x": "k", "y": "erf(k)*y", "z": "z"}, START, K),
}
START = {"x": "k", "y": "1", "z": "k**2"}


@pytest.mark.parametrize("system", RATES.values(), ids=RATES)
def test_stacks_with_compiled_rates_are_the_same(system):
    system = system()
    points, edges = points_of(system, 21), edges_of(system)
    times, made = np.linspace(*system.horizon, 17), tolerances(system, points)
    stack = StackedIntegrator()
    generated = stack.sample(system, points, edges, made, times)
    fast = replace(stack, compiled=True).sample(system, points, edges, made, times)
    assert (generated.integrator, fast.integrator) == ("stack", "compiled")
    sizes = np.abs(generated.states).max(axis=(0, 2))[:, None]
    sizes[sizes == 0.0] = 1.0
    assert np.abs((fast.states - generated.states) / sizes).max() < RELATIVE


def test_compiled_rates_take_any_shape():
    system = RATES["time"]()
    rates, p = with_compiled_rates(system).rhs, points_of(system, 5).T
    u = np.random.default_rng(2).uniform(0.5, 1.5, (3, 4, 5))
    times = np.linspace(0.0, 1.0, 4)[:, None]
    assert (rates(times, u, p[:, None]) == system.rhs(times, u, p[:, None])).all()
    for k, time in enumerate(times[:, 0]):
        expected = system.rhs(time, u[:, k], p)
        assert rates(time, u[:, k], p) == pytest.approx(expected, rel=1e-14)


def test_compiled_rates_that_are_not_finite_end_trajectories_alike():
    system = system_of({"x": "x**2"}, {"x": "k"}, K)
    points = np.array([[0.3], [1.0], [0.25]])
    times, made = np.linspace(0.0, 2.0, 9), tolerances(system, points)
    fast = StackedIntegrator(compiled=True).sample(system, points, edges_of(system), made, times)
    assert (
        fast.reached
        == StackedIntegrator().sample(system, points, edges_of(system), made, times).reached
    )
    assert fast.end == pytest.approx(1.0, abs=1e-3)


def test_small_solves_are_not_compiled():
    assert ro.solve(REFERENCE["decay"](), 1e-4, method="cross").history[-1].integrator == "stack"
    solution = ro.solve(REFERENCE["chain"](), 1e-3, method="cross", integrator="compiled")
    assert solution.success
    assert solution.history[-1].integrator == "compiled"


def test_threads_give_the_same_bits():
    compiled = ro.compile(REFERENCE["chain"]())
    options = {"method": "cross", "integrator": "compiled"}
    alone = compiled.solve(1e-3, **options)
    with ThreadPoolExecutor(2) as executor:
        shared = compiled.solve(1e-3, **options, executor=executor)
    assert alone.history[-1].integrator == shared.history[-1].integrator == "compiled"
    assert (alone.work, alone.nodes) == (shared.work, shared.nodes)
    point = dict.fromkeys(compiled.system.parameters, 0.9)
    assert (alone(t=2.0, **point) == shared(t=2.0, **point)).all()


def test_orders():
    assert [order_of(tolerance) for tolerance in (0.1, 1e-3, 1e-6, 1e-9, 1e-15)] == [
        3,
        5,
        8,
        12,
        19,
    ]
