"""Integrators give the same trajectories at all times and at given ones."""

import numpy as np
import pytest

import rankone as ro
from rankone.support.budget import OutOfBudgetError, OutOfMemoryError, limited
from rankone.trajectories.integrators.integrator import Integrator, Tolerances
from rankone.trajectories.integrators.single import SingleIntegrator
from rankone.trajectories.stacks.stack import StackedIntegrator

POINTS = np.array([[0.5], [1.0], [1.5]])
TOLERANCES = Tolerances(1e-8, np.full((1, 1), 1e-10))


def decay(rate="-k*x"):
    problem = ro.Problem.from_strings({"x": rate}, {"x": "1"}, {"k": (0.5, 1.5)}, (0, 2))
    return ro.compile(problem).system


@pytest.mark.parametrize("integrator", [StackedIntegrator(), StackedIntegrator(stiff=True)])
def test_dense_and_sampled_trajectories_agree(integrator: Integrator):
    times = np.linspace(0.1, 2.0, 7)
    dense = integrator.run(decay(), POINTS, [0.0, 1.0, 2.0], TOLERANCES)
    sampled = integrator.sample(decay(), POINTS, [0.0, 1.0, 2.0], TOLERANCES, times)
    assert dense.end == sampled.end == 2.0
    assert sampled.reached == 7
    np.testing.assert_array_equal(sampled.states, np.moveaxis(dense(times), 2, 0))
    np.testing.assert_allclose(dense(times)[0], np.exp(-POINTS * times), rtol=1e-6)
    np.testing.assert_array_equal(dense.state, sampled.state)


@pytest.mark.parametrize("integrator", [StackedIntegrator(), SingleIntegrator()])
def test_some_trajectories_are_those_of_all(integrator: Integrator):
    dense = integrator.run(decay(), POINTS, [0.0, 1.0, 2.0], TOLERANCES)
    times = np.array([1.7, 0.0, 0.4])
    some = dense.of(slice(1, 3))
    np.testing.assert_allclose(some(times), dense(times)[:, 1:], rtol=1e-15)
    np.testing.assert_array_equal(some.state, dense.state[:, 1:])
    np.testing.assert_array_equal(some.largest, dense.largest[:, 1:])


def test_a_blow_up_ends_all_trajectories():
    sampled = StackedIntegrator().sample(
        decay("k*x**2"), POINTS, [0.0, 2.0], TOLERANCES, np.array([0.3, 1.9])
    )
    assert sampled.reached == 1
    assert sampled.end == pytest.approx(1 / 1.5, rel=1e-6)


def test_a_limit_tells_how_far_an_integration_came():
    with limited(3e6), pytest.raises(OutOfBudgetError) as out:
        StackedIntegrator().run(decay("-100*k*(x - cos(100*t))"), POINTS, [0.0, 2.0], TOLERANCES)
    assert 0.0 < out.value.reached.time < 2.0
    assert out.value.reached.steps > 5


@pytest.mark.parametrize(
    ("rates", "least"),
    [
        ({"x": "-1e6*k*(x - y)", "y": "-y"}, 0.0),
        pytest.param({"x": "k*cos(20*t)*y", "y": "-k*x"}, 0.5, marks=pytest.mark.slow),
    ],
)
def test_a_memory_limit_tells_how_much_all_steps_need(rates, least):
    """In a transient, whose steps are short, no more than what is there."""
    starts = {"x": 0, "y": 1}
    system = ro.compile(ro.Problem.from_strings(rates, starts, {"k": (0.5, 1.5)}, (0, 30))).system
    integrator = StackedIntegrator(stiff=not least)
    whole = integrator.run(system, POINTS, (0.0, 30.0), TOLERANCES)
    total = sum(piece.nbytes for piece in whole.pieces)
    for share in (0.2, 0.3, 0.5, 0.7, 0.9):
        with limited(memory=share * total), pytest.raises(OutOfMemoryError) as caught:
            integrator.run(system, POINTS, (0.0, 30.0), TOLERANCES)
        assert max(share, least) * total < caught.value.needed < 2.0 * total


@pytest.mark.parametrize("stiff", [False, True])
@pytest.mark.parametrize("count", [1, 7, 400])
def test_steps_are_read_together_as_one_by_one(stiff, count):
    """To the last bit, also where a step holds a single time."""
    rates, start = {"x": "x*(1.5 - y)", "y": "-y*(3 - x)"}, {"x": "a", "y": "5"}
    system = ro.compile(ro.Problem.from_strings(rates, start, {"a": (8, 12)}, (0, 6))).system
    points = np.linspace(8.0, 12.0, 7)[:, None]
    dense = StackedIntegrator(stiff=stiff).run(system, points, [0.0, 2.5, 6.0], TOLERANCES)
    times = np.sort(np.random.default_rng(7).random(count)) * 6.0
    ends = [*np.searchsorted(times, dense.times[1:-1]), count]
    parts = zip(dense.pieces, [0, *ends[:-1]], ends, strict=True)
    expected = [piece.at(times[a:b]) for piece, a, b in parts if a < b]
    states = np.moveaxis(dense(times), 2, 0).reshape(count, -1)
    np.testing.assert_array_equal(states, np.concatenate(expected))
