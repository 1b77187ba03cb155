"""Averages along lines of states that are steep on their smooth pieces."""

import numpy as np
import pytest

import rankone as ro
from rankone.solution.statistics.lines import MOMENTS, LineAverages
from rankone.support.errors import RankoneWarning


class Spikes:
    """One state with spikes of a width across the diagonals of a unit square, in two pieces."""

    def __init__(self, width, jump=2.0):
        self.width, self.jump = width, jump

    def deciders(self, points):
        return points[:1]

    def smooth_pieces(self, times, deciders):
        return (deciders > 0.5).astype(int)

    def curves(self, times, points, rows):
        return self.exact(*points)[None, None]

    def exact(self, x, y):
        return np.exp(-((np.sin(np.pi * (3 * x + y)) / self.width) ** 2)) + self.jump * (x > 0.5)


def variance(states, weights):
    apart = states - (states @ weights)[:, None]
    values = apart**2 @ weights
    return values, values


def of(spikes):
    averages = LineAverages(spikes, np.array([0]))
    table, share = averages(np.array([1.0]), 2, lambda points: points, variance, MOMENTS)
    assert share == [1.0]
    return table[0, 0]


@pytest.mark.parametrize("width", [0.5, 0.2])
def test_spikes_are_resolved(width):
    spikes = Spikes(width)
    grid = (np.arange(1000) + 0.5) / 1000
    exact = spikes.exact(*np.meshgrid(grid, grid)).var()
    assert of(spikes) == pytest.approx(exact, rel=1e-3)


def test_what_is_not_resolved_is_told():
    with pytest.warns(RankoneWarning, match="have settled"):
        of(Spikes(0.002, jump=0.0))


@pytest.mark.slow
def test_a_long_oscillation():
    """Spikes of predators and prey, far out of phase, against a fine grid of the same solution."""
    problem = ro.Problem.from_strings(
        {"x": "x*(1.5 - y)", "y": "-y*(3 - x)"},
        time=(0, 60),
        parameters={"x0": (8, 12), "y0": (4, 6)},
        initial={"x": "x0", "y": "y0"},
    )
    solution = ro.solve(problem, rtol=1e-4)
    assert solution.timeline.stretches > 30
    middles = (np.arange(300) + 0.5) / 300
    x0, y0 = np.meshgrid(8 + 4 * middles, 4 + 2 * middles)
    table = solution(t=59.9, x0=x0.ravel(), y0=y0.ravel())
    np.testing.assert_allclose(solution.mean(59.9), table.mean(axis=1), rtol=1e-3)
    np.testing.assert_allclose(solution.std(59.9), table.std(axis=1), rtol=1e-3)
    by_y0 = table.reshape(2, 300, 300).var(axis=1).mean(axis=1) / table.var(axis=1)
    indices = solution.sobol(59.9, count=2**16)
    assert (indices.total_half_width[:, 1, 0] <= 5e-3).all()
    np.testing.assert_allclose(indices.total[:, 1, 0], by_y0, atol=1e-2)


def test_few_points_tell_the_shares_of_the_variance():
    dose = {"when": "t - a", "direction": "rising", "then": {"x": "x + b"}, "name": "dose"}
    problem = ro.Problem.from_strings(
        {"x": "-x/2"}, {"x": 1}, {"a": (1, 2), "b": (0.5, 1.5)}, (0, 4), events=[dose]
    )
    solution = ro.solve(problem, 1e-4)
    times = np.array([1.3, 1.7, 2.5, 4.0])
    pictured = solution._first_and_total(times, solution._statistics())
    sobol = solution.sobol(times)
    np.testing.assert_allclose(pictured, [sobol.first, sobol.total], atol=2e-2)


@pytest.mark.slow
def test_sobol_indices_of_a_jump_that_most_parameters_move():
    dose = {"when": "t - a*m", "direction": "rising", "then": {"x": "x + b"}, "name": "dose"}
    box = {"k": (0.2, 0.6), "a": (1, 3), "b": (0.5, 2), "m": (0.5, 1.5)}
    problem = ro.Problem.from_strings({"x": "-k*x"}, {"x": 1}, box, (0, 4), events=[dose])
    solution, time = ro.solve(problem, 1e-4), 2.6
    middles = (np.arange(40) + 0.5) / 40
    k, a, b, m = np.meshgrid(
        *(low + (high - low) * middles for low, high in box.values()), indexing="ij"
    )
    x = np.exp(-k * time) + np.where(time >= a * m, b * np.exp(-k * (time - a * m)), 0.0)
    others = [tuple({0, 1, 2, 3} - {j}) for j in range(4)]
    indices = solution.sobol(time)
    first = np.array([x.mean(axis=other).var() for other in others]) / x.var()
    np.testing.assert_allclose(indices.first[0, :, 0], first, atol=1e-2)
    total = np.array([x.var(axis=j).mean() for j in range(4)]) / x.var()
    np.testing.assert_allclose(indices.total[0, :, 0], total, atol=1e-2)
