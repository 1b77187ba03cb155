"""Ends of profiles, of a cost in closed form."""

import math

import numpy as np
import pytest

from rankone.inference.calibration.trajectory_likelihood import _end
from rankone.inference.estimation.least_squares import Expansion


class Quadratic:
    """Of two parameters around the middle, with standard deviation 0.05; none above a place."""

    names = ("a", "b")
    quantile = 2.0

    def __init__(self, last):
        self.last = last

    def rise(self, at):
        return 2.0

    def variance(self, at):
        return 1.0

    def expanded(self, z, held=None):
        residuals = (z - 0.5) / 0.05
        cost = 0.5 * float(residuals @ residuals) if z[0] <= self.last else math.inf
        return Expansion(z, cost, residuals, np.eye(2) / 0.05)


@pytest.mark.parametrize(("last", "end", "told"), [(1.0, 0.6, True), (0.55, 0.55, False)])
def test_an_end_where_trajectories_fail_is_not_told_by_the_data(last, end, told):
    problem = Quadratic(last)
    best = problem.expanded(np.array([0.5, 0.5]))
    found = _end(problem, best, 0.05**2 * np.eye(2), (0, 1.0), best, [best])
    assert found.z == pytest.approx(end, abs=2e-3)
    assert found.other is not told
