"""Bisection comes to where it should, and points are even in every direction."""

import itertools

import numpy as np
import pytest

from rankone.support.arrays import bisected, spread


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


@pytest.mark.parametrize(("count", "d", "most"), [(24, 2, 0.25), (24, 8, 0.4), (96, 8, 0.17)])
def test_no_oblique_ridge_is_missed(count, d, most):
    """The largest probability between two neighbours along any direction of two coordinates."""
    points = spread(count, d, np.random.default_rng(20140))
    largest = 0.0
    for i, j in itertools.combinations(range(d), 2):
        for angle in np.linspace(0.03, 0.5 * np.pi - 0.03, 61):
            a, b = np.cos(angle), np.sin(angle)
            for other in (points[:, j], 1.0 - points[:, j]):
                x = a * points[:, i] + b * other
                corners = ((x, 1), (x - a, -1), (x - b, -1), (x - a - b, 1))
                below = sum(s * np.maximum(y, 0.0) ** 2 for y, s in corners) / (2 * a * b)
                places = np.sort(np.concatenate([[0.0], below, [1.0]]))
                largest = max(largest, float(np.diff(places).max()))
    assert largest < most
