"""Tests of paths that are read one by one and together."""

import numpy as np
import pytest

from rankone.trajectories.integrators.integrator import NODES, Path, Paths


def _states(times):
    return np.stack([times**2 - times, 1.0 + 0.5 * times**6, np.ones_like(times)])


def _paths(counts):
    generator = np.random.default_rng(3)
    for steps in counts:
        breaks = np.concatenate([[0.0], np.sort(generator.random(steps - 1)), [1.0]])
        within = breaks[:-1, None] + np.diff(breaks)[:, None] * NODES
        yield Path(breaks, np.moveaxis(_states(within), 0, 2), _states(np.ones(1))[:, 0])


@pytest.mark.parametrize("count", [1, 7, 300, 20_000])
def test_few_and_many_times_are_read_alike(count):
    paths = list(_paths([1, 2, 40]))
    times = np.random.default_rng(4).random((3, count))
    times[0, 0], times[2, -1] = 0.0, paths[2].breaks[5]
    together = Paths.of(paths)
    states = together(times)
    assert states.shape == (3, 3, count)
    np.testing.assert_allclose(states, _states(times), rtol=0, atol=1e-13)
    for k, path in enumerate(paths):
        np.testing.assert_allclose(states[:, k], path(times[k]), rtol=0, atol=1e-13)


def test_a_time_between_two_steps_belongs_to_the_second():
    nodal = np.repeat(np.array([1.0, 2.0, 3.0])[:, None, None], NODES.size, axis=1)
    path = Path(np.array([0.0, 1.0, 2.0, 3.0]), nodal, np.array([3.0]))
    for count in (1, 2, 100):  # looked up by bisection, and path by path
        times = np.tile([1.0], (2, count))
        assert Paths.of([path, path])(times) == pytest.approx(2.0)
        assert Paths.of([path, path])(times + 2.0) == pytest.approx(3.0)


@pytest.mark.parametrize("states", [1, 3, 12])
def test_coefficients_of_few_and_many_states_are_alike(states):
    generator = np.random.default_rng(5)
    nodal = generator.random((11, NODES.size, states))
    path = Path(np.linspace(0.0, 1.0, 12), nodal, nodal[-1, -1])
    expected = path.coefficients.swapaxes(1, 2)
    together = Paths.of([path]).coefficients
    assert together.shape == (NODES.size, states, 11)
    assert together.flags.c_contiguous
    np.testing.assert_allclose(together, expected, rtol=0, atol=1e-13)
