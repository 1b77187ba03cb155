"""Roots of functions on [0, 1]."""

import numpy as np
import pytest

from rankone.trajectories.integrators.defects import roots, roots_or_jumps


def test_roots_are_found_in_few_evaluations():
    calls = []

    def functions(x):
        calls.append(1)
        return np.array([np.tanh(30 * (x[0] - 0.3)), x[1] ** 3 - 0.2, np.exp(9 * x[2]) - 40])

    places = roots(functions, functions(np.zeros(3)), functions(np.ones(3)))
    np.testing.assert_allclose(places, [0.3, 0.2 ** (1 / 3), np.log(40) / 9], atol=1e-13)
    assert len(calls) < 20


@pytest.mark.parametrize("slope", [1e3, 1e6, 1e9, 1e15])
def test_roots_are_found_where_functions_are_steep_on_one_side(slope):
    def functions(x):
        height = x - np.array([0.3, 0.7])
        return height * np.where(height * np.array([1.0, -1.0]) > 0.0, slope, 1.0)

    ends = functions(np.zeros(2)), functions(np.ones(2))
    np.testing.assert_allclose(roots(functions, *ends), [0.3, 0.7], atol=1e-13)
    np.testing.assert_allclose(roots_or_jumps(functions, *ends), [0.3, 0.7], atol=1e-13)


def test_places_of_jumps_are_behind_them():
    def steps(x):
        return np.sign(x - np.array([0.3, 0.7])) * np.array([1.0, -1.0])

    places = roots_or_jumps(steps, steps(np.zeros(2)), steps(np.ones(2)))
    assert (places >= [0.3, 0.7]).all()
    np.testing.assert_allclose(places, [0.3, 0.7], atol=1e-13)
