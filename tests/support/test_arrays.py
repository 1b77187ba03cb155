"""Bisection comes to where it should."""

import numpy as np

from rankone.support.arrays import bisected


def test_segments_are_bisected_to_the_border_of_a_disc():
    inside, outside = np.zeros((2, 2)), np.array([[3.0, 0.0], [3.0, 4.0]])
    a, b = bisected(inside, outside, lambda points: np.hypot(*points.T)[:, None] < 1.0, 50)
    np.testing.assert_allclose(a, [[1.0, 0.0], [0.6, 0.8]], atol=1e-14)
    assert (np.hypot(*a.T) < 1.0).all()
    assert (np.hypot(*b.T) >= 1.0).all()


def test_each_interval_is_bisected_to_its_own_root():
    squares = np.array([2.0, 9.0, 0.25])
    low, high = bisected(np.zeros(3), np.full(3, 4.0), lambda x: x * x < squares, 60)
    np.testing.assert_allclose(0.5 * (low + high), [np.sqrt(2.0), 3.0, 0.5], rtol=1e-15)
