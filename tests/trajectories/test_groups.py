"""Reference trajectories in groups: as accurate as in one stack, and the same with any workers."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from inspect import isfunction

import numpy as np
import pytest

import rankone as ro
from rankone.solvers.verification.reference import integrate_reference
from rankone.support.budget import OutOfMemoryError, limited
from rankone.trajectories.integrators import integrator_choice
from rankone.trajectories.integrators import workers as groups
from rankone.trajectories.integrators.integrator import Tolerances
from rankone.trajectories.integrators.single import SingleIntegrator
from rankone.trajectories.integrators.workers import (
    GroupedStacks,
    GroupedTrajectories,
    SinglesOnWorkers,
    Workers,
    open_workers,
)
from rankone.trajectories.stacks.stack import StackedIntegrator

MANY = 210  # States from which a stack is divided into groups
POINTS = np.linspace([1.0, 0.5], [2.0, 1.5], 70)
TOLERANCES = Tolerances(1e-9, np.array([[1e-12]]))


def ring(rate="k*(x{0} - x{1}) - m*x{1}", states=MANY):
    """Compartments in a ring that lose what they hold."""
    rates = {f"x{i}": rate.format((i - 1) % states, i) for i in range(states)}
    starts = {name: f"{1 + i % 3}" for i, name in enumerate(rates)}
    box = {"k": (1, 2), "m": (0.5, 1.5)}
    box = {name: ends for name, ends in box.items() if name in rate}
    return ro.Problem.from_strings(rates, starts, box, (0, 1))


@pytest.fixture(scope="module", autouse=True)
def _small_groups():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(groups, "_STACK_STATES", 5000)
        yield


@pytest.fixture(scope="module")
def system():
    return ro.compile(ring()).system


@pytest.fixture(scope="module")
def dense(system):
    grouped = GroupedStacks(StackedIntegrator(), Workers(system))
    return grouped.run(system, POINTS, (0.0, 1.0), TOLERANCES)


def test_groups_are_as_accurate_as_one_stack(system, dense):
    stack = StackedIntegrator().run(system, POINTS, (0.0, 1.0), TOLERANCES)
    assert isinstance(dense, GroupedTrajectories)
    assert len(dense.groups) > 1
    assert (dense.start, dense.end) == (stack.start, stack.end)
    times = np.array([0.9, 0.0, 0.33, 1.0])
    np.testing.assert_allclose(dense(times), stack(times), rtol=1e-7)
    for name in ("state", "last"):
        np.testing.assert_allclose(getattr(dense, name), getattr(stack, name), rtol=1e-7)
    assert (dense.largest >= np.maximum(dense.early, np.abs(dense.state))).all()
    for time, states in dense.samples(5):
        np.testing.assert_allclose(states, stack(np.array([time]))[:, :, 0], rtol=1e-7)


@pytest.mark.parametrize("some", [slice(3), slice(30, 50), slice(69, None), slice(None)])
def test_some_of_the_trajectories(dense, some):
    times = np.linspace(0.0, 1.0, 4)
    part = dense.of(some)
    rounding = 1e-13 * np.abs(dense(times)).max()
    np.testing.assert_allclose(part(times), dense(times)[:, some], rtol=0.0, atol=rounding)
    assert np.array_equal(part.state, dense.state[:, some])


@pytest.mark.slow
def test_a_group_that_ends_ends_all():
    """The states near a pole, as one stack has them."""
    system = ro.compile(ring("k*x{1}**2")).system
    grouped = GroupedStacks(StackedIntegrator(), Workers(system))
    dense = grouped.run(system, POINTS[:, :1], (0.0, 1.0), TOLERANCES)
    pole = 1.0 / (3.0 * POINTS[:, 0].max())
    assert dense.end == pytest.approx(pole, rel=1e-6)
    assert min(group.end for group in dense.groups[:-1]) > dense.end
    assert np.isfinite(dense.state).all()
    k, start = POINTS[:20, 0], np.array([1.0, 2.0, 3.0])[:, None]
    expected = start / (1.0 - start * k * dense.end)
    np.testing.assert_allclose(dense.state[:3, :20], expected, rtol=1e-4)
    np.testing.assert_allclose(dense.last[:3, :20], expected, rtol=1e-4)


class Recording(ThreadPoolExecutor):
    """Keeps the names of the functions that it calls for trajectories."""

    def __init__(self, workers):
        super().__init__(workers)
        self.names = []

    def submit(self, function, *arguments):
        self.names += [each.__name__ for each in arguments if isfunction(each)]
        return super().submit(function, *arguments)


def bits(reference):
    times = np.linspace(reference.start, reference.end, 9)
    return reference(times).tobytes(), reference.end


@pytest.mark.parametrize(
    ("problem", "integrator", "name"),
    [
        (ring(), "auto", "_stacked"),
        (ring(states=3), "single", "_singles"),
        # ends where its rates do
        pytest.param(ring("-k/x{1}", 3), "single", "_singles", marks=pytest.mark.slow),
    ],
)
def test_workers_integrate_the_same_reference(problem, integrator, name):
    system = ro.compile(problem).system
    points = POINTS[:, : len(system.parameters)]
    points = points[::3] if integrator == "single" else points
    common = system, points, system.horizon, 1e-6, integrator
    alone = bits(integrate_reference(*common))
    for count in (1, 3):
        with Recording(count) as executor, open_workers(system, executor) as workers:
            assert bits(integrate_reference(*common, workers)) == alone
        assert name in executor.names


@pytest.mark.slow
def test_stalled_stacks_go_on_as_single_trajectories_on_workers():
    """Each trajectory jumps at its own time."""
    problem = ro.Problem.from_strings(
        {"x": "-x + tanh(1e4*(t - k))"}, {"x": "m"}, {"k": (1, 2), "m": (0.5, 1.5)}, (0, 3)
    )
    system = ro.compile(problem).system
    points = np.stack([np.linspace(1.0, 2.0, 150), np.full(150, 1.0)], axis=1)
    common = system, points, system.horizon, 1e-6
    alone = integrate_reference(*common)
    assert alone.integrator == "single"
    with Recording(2) as executor, open_workers(system, executor) as workers:
        assert bits(integrate_reference(*common, workers=workers)) == bits(alone)
    assert "_singles" in executor.names


def test_single_trajectories_of_another_system_stay_here(system):
    other = ro.compile(ring(states=2)).system
    with Recording(1) as executor, open_workers(system, executor) as workers:
        single = SinglesOnWorkers(SingleIntegrator(), workers)
        dense = single.run(other, POINTS, (0.0, 1.0), TOLERANCES)
    expected = SingleIntegrator().run(other, POINTS, (0.0, 1.0), TOLERANCES)
    assert np.array_equal(dense.state, expected.state)
    assert not executor.names


def test_what_workers_send_counts_as_memory(system, dense):
    """Each group fits, and all together do not."""
    each = [sum(piece.nbytes for piece in group.pieces) for group in dense.groups]
    for memory, fits in ((1.1 * sum(each), True), (0.8 * sum(each), False)):
        with ThreadPoolExecutor(2) as executor, open_workers(system, executor) as workers:
            grouped = GroupedStacks(StackedIntegrator(), workers)
            refused = nullcontext() if fits else pytest.raises(OutOfMemoryError)
            with limited(memory=memory), refused:
                grouped.run(system, POINTS, (0.0, 1.0), TOLERANCES)


def test_groups_that_fit_tell_what_all_need(system, dense):
    """Those that are integrated tell it, and not the first steps of the next one."""
    each = [sum(piece.nbytes for piece in group.pieces) for group in dense.groups]
    for memory in (1.2 * each[0], 1.8 * each[0], 0.9 * sum(each)):
        grouped = GroupedStacks(StackedIntegrator(), Workers(system))
        with limited(memory=memory), pytest.raises(OutOfMemoryError) as caught:
            grouped.run(system, POINTS, (0.0, 1.0), TOLERANCES)
        assert caught.value.limit == memory
        assert 0.7 * sum(each) < caught.value.needed < 1.3 * sum(each)


@pytest.mark.slow
def test_outputs_that_lose_digits_are_integrated_again_on_workers():
    """Their reference is finer than that of the states."""
    problem = ro.Problem.from_strings(
        {"x": "-k*x", "y": "-k*y"}, {"x": 1, "y": 0.999}, {"k": (1, 2)}, (0, 1)
    )
    names = []
    for formula in ("x + y", "x - y"):
        options = {"outputs": {"q": formula}, "unknowns": ["x"], "integrator": "single"}
        with Recording(2) as executor:
            there = ro.solve(problem, 1e-6, **options, executor=executor)
        here = ro.solve(problem, 1e-6, **options)
        times = np.linspace(0, 1, 9)
        assert np.array_equal(there(times, k=1.3), here(times, k=1.3))
        names.append(executor.names.count("_singles"))
    assert names[1] > names[0] > 0


def dripping(states):
    """A ring into which something is poured when the first compartment is nearly empty."""
    pour = {"when": "x0 - 0.8", "direction": "falling", "then": {"x0": "x0 + 1"}}
    rates = {f"x{i}": f"-k*(1 + {i}/{states})*x{i}*m" for i in range(states)}
    box = {"k": (1, 2), "m": (0.5, 1.5)}
    return ro.Problem.from_strings(rates, dict.fromkeys(rates, 1), box, (0, 0.8), events=[pour])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("states", "integrator"),
    [(2, "single"), (70, "auto")],
    ids=["alone", "stacks of many states"],
)
def test_references_with_events_are_followed_in_groups(states, integrator, monkeypatch):
    monkeypatch.setattr(groups, "_STACK_STATES", 20 * states)
    monkeypatch.setattr(integrator_choice, "_MOST_SINGLE_STATES", 64)
    options = {"integrator": integrator, "check": 40}
    compiled = ro.compile(dripping(states))
    here = compiled.solve(1e-3, **options)
    times, point = np.linspace(0, 0.8, 9), {"k": 1.3, "m": 0.9}
    with Recording(2) as executor:
        there = compiled.solve(1e-3, **options, executor=executor)
    assert here.success
    assert there(times, **point).tobytes() == here(times, **point).tobytes()
    assert there.errors == here.errors
    assert executor.names.count("_followed") > 1
    exact = np.exp(-1.3 * 0.9 * times)  # poured at 0.8, where the trajectory is continued from 1.8
    poured = np.log(1 / 0.8) / (1.3 * 0.9)
    exact = np.where(times >= poured, 1.8 * np.exp(-1.3 * 0.9 * (times - poured)), exact)
    np.testing.assert_allclose(there["x0"](times, **point), exact, atol=5e-3)


@pytest.mark.slow
def test_an_error_of_a_group_with_events_is_that_of_this_process():
    """A trajectory that is not finite further on is named by the same point."""
    stop = {"when": "x - 2", "then": {"x": "x"}, "direction": "rising"}
    problem = ro.Problem.from_strings(
        {"x": "k/(1.6 - x)"}, {"x": "1"}, {"k": (0.05, 0.2)}, (0, 1), events=[stop]
    )
    messages = []
    for executor in (None, 2):
        with nullcontext() if executor is None else Recording(2) as given:
            with pytest.raises(ro.RankoneError) as caught:
                ro.solve(problem, 1e-3, integrator="single", executor=given)
            messages.append(str(caught.value))
    assert messages[0] == messages[1]
