"""Slabs that resolve functions of time, and piecewise polynomials on them."""

import numpy as np

from rankone.tensors.time_grid import Polynomials, TimeGrid, resolving_breaks


def test_slabs_are_halved_where_functions_are_steep():
    breaks = resolving_breaks(lambda t: np.tanh(50 * (t - 0.3))[None], (0.0, 1.0), 9, 1e-6, 100, 1)
    widths = np.diff(breaks)
    assert breaks[0] == 0.0
    assert breaks[-1] == 1.0
    assert widths.min() < 0.1 < widths.max()
    grid = TimeGrid(breaks, 9)
    assert grid.times.size == 9 * grid.slabs
    assert (
        resolving_breaks(lambda t: np.tanh(50 * (t - 0.3))[None], (0.0, 1.0), 9, 1e-6, 3, 50)
        is None
    )


def test_a_layer_at_the_start_is_seen_between_the_nodes():
    breaks = resolving_breaks(lambda t: np.exp(-1e5 * t)[None], (0.0, 1.0), 12, 1e-4, 100, 100)
    assert breaks[1] < 1e-3


def test_cuts_are_kept():
    breaks = resolving_breaks(lambda t: np.abs(t - 0.3)[None], (0.0, 0.3, 1.0), 6, 1e-8, 10, 10)
    assert breaks == (0.0, 0.3, 1.0)


def test_extremes_crossings_and_integrals_of_polynomials():
    grid = TimeGrid((0.0, 0.4, 1.0, 2.0), 12)
    t = grid.times[:, None]
    functions = Polynomials(grid, np.concatenate([np.sin(3 * t), np.sin(6 * t) - 0.1 * t], axis=1))
    np.testing.assert_allclose(functions.integral(0.4, 2.0)[0], (np.cos(1.2) - np.cos(6)) / 3)
    np.testing.assert_allclose(
        functions.running(0.4)[:, 0], (np.cos(1.2) - np.cos(3 * t[:, 0])) / 3
    )
    np.testing.assert_allclose(functions.maximum()[0], 1.0)
    np.testing.assert_allclose(functions.first_crossing(-1, 1e-9)[0], np.pi / 3)
    np.testing.assert_allclose(functions.duration()[0], np.pi / 3)
    zeros, columns = functions.zeros(4)
    np.testing.assert_allclose(
        zeros[columns == 0], [0.0, np.pi / 3][-(columns == 0).sum() :], atol=1e-9
    )


def test_distances_from_changes_of_a_reduction():
    grid = TimeGrid((0.0, 1.0, 2.0), 14)
    t = grid.times[:, None]
    peaks = np.exp(-((t - 0.5) ** 2) * 9) + 0.9 * np.exp(-((t - 1.5) ** 2) * 9)
    bump = np.exp(-((t - 0.7) ** 2)) - 0.8
    functions = Polynomials(grid, np.concatenate([peaks, bump], axis=1))
    assert 0.05 < functions.gap_of_maxima()[0] < 0.15
    assert functions.gap_of_maxima()[1] == np.inf
    np.testing.assert_allclose(
        functions.distance_from_tangency()[1] * np.abs(bump).max(), 0.2, rtol=0.1
    )
