"""Random starts on costs in closed form, whose minima are known."""

import numpy as np
import pytest

from rankone.inference.estimation.least_squares import Expansion, Starts, descents


class Landscape:
    """-2 log L as a sum of squares of the coordinates' own residuals, with many minima."""

    def __init__(self, n):
        self.names = tuple(f"z{i}" for i in range(n))
        self.nested = np.zeros(n, dtype=bool)
        self.best = np.linspace(0.15, 0.85, n)
        self.points = []

    def expanded(self, z):
        self.points.append(z)
        away = z - self.best
        bent = 1.2 * np.sin(9 * np.pi * away)
        residuals = np.concatenate([6.0 * away, bent])
        slopes = [np.full(z.size, 6.0), 1.2 * 9 * np.pi * np.cos(9 * np.pi * away)]
        jacobian = np.concatenate([np.diag(slope) for slope in slopes])
        return Expansion(z, float(residuals @ residuals), residuals, jacobian)


class Hidden(Landscape):
    """A wide basin of cost 16, and a narrow one of cost zero in its flank."""

    def expanded(self, z):
        self.points.append(z)
        wide, narrow = z - 0.2, (z - np.array([0.85, 0.8])) / 0.15
        inside = float(narrow @ narrow) < 1.0
        residuals = np.append(20.0 * narrow, 0.0) if inside else np.append(6.0 * wide, 4.0)
        slope = 20.0 / 0.15 * np.eye(2) if inside else 6.0 * np.eye(2)
        jacobian = np.vstack([slope, np.zeros(2)])
        return Expansion(z, float(residuals @ residuals), residuals, jacobian)


def test_starts_are_apart_so_that_a_wide_basin_does_not_take_them_all():
    ends = [descents(Hidden(2), Starts(starts=10, seed=seed), 10)[0].at.cost for seed in range(4)]
    assert np.sum(np.array(ends) < 1e-3) >= 3


@pytest.mark.parametrize("seed", range(2))
def test_hops_pass_on_what_fits(seed):
    """A coordinate has nine minima, so that six have half a million; the next cost 0.43 each."""
    problem = Landscape(6)
    ways = descents(problem, Starts(starts=20, seed=seed), 10)
    assert ways[0].at.cost < 3.5 * 0.431
    assert len(problem.points) < 1500
    assert len(ways) == 20
