"""Quadrature over functions that jump, against closed forms."""

import numpy as np
import pytest

from rankone.solution.statistics.lines import refinements


def average(function, jumps, dimensions, most=256):
    """The average of a function over the unit cube; ``jumps`` are the conditions it has."""

    def label(points):
        none = np.zeros(points.shape[1], dtype=int)
        return sum((2**k * holds for k, holds in enumerate(jumps(*points))), start=none)

    total, weight = 0.0, 0.0
    for lines in refinements(dimensions, most):
        pieces = lines.pieces(lambda *at, lines=lines: label(lines.at(*at)))
        points, weights = lines.rule(pieces, 4)
        total, weight = total + function(*points) @ weights, weight + weights.sum()
    return total / weight


def test_one_coordinate():
    value = average(lambda x: (x > 0.3) * np.exp(x), lambda x: [x > 0.3], 1)
    assert value == pytest.approx(np.e - np.exp(0.3), rel=1e-7)
    assert average(lambda x: np.cos(30 * x), lambda x: [x > 2], 1) == pytest.approx(
        np.sin(30) / 30, abs=1e-6
    )


def test_surfaces_along_axes_and_across():
    def function(x, y):
        return 1.0 * (x > 0.3) + 2.0 * (y > 0.6) + (x < y) * np.exp(x)

    value = average(function, lambda x, y: [x > 0.3, y > 0.6, x < y], 2)
    assert value == pytest.approx(0.7 + 0.8 + np.e - 2.0, abs=1e-6)


@pytest.mark.parametrize(
    ("dimensions", "volume"), [(2, np.pi / 4), (3, np.pi / 6), (4, np.pi**2 / 32)]
)
def test_volume_of_a_ball(dimensions, volume):
    def inside(*x):
        return np.sum(np.square(x), axis=0) < 1.0

    value = average(lambda *x: 1.0 * inside(*x), lambda *x: [inside(*x)], dimensions)
    assert value == pytest.approx(volume, abs=3e-4)
