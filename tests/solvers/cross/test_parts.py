"""Parts of the cross engine: time grids, sampled trajectories, skeletons, numbers of nodes."""

from __future__ import annotations

import numpy as np
import pytest

import rankone as ro
from rankone.discretization import ChebyshevBasis
from rankone.discretization.time_grid import TimeGrid, resolving_breaks
from rankone.ir.domain import Domain
from rankone.ir.request import Check, SolveRequest
from rankone.solvers.cross.trajectories import Trajectories
from rankone.tensors.adaptive import needed
from rankone.tensors.cross import Samples, _skeleton, interpolate, left_points
from rankone.trajectories.integrator import Tolerances
from rankone.trajectories.stacks import StackedIntegrator
from rankone.verification.measure import ReferenceSet
from tests.problems import EXAMPLES


def test_slabs_are_halved_where_functions_are_steep():
    breaks = resolving_breaks(lambda t: np.tanh(50 * (t - 0.3))[None], (0.0, 1.0), 9, 1e-6, 100)
    widths = np.diff(breaks)
    assert breaks[0] == 0.0
    assert breaks[-1] == 1.0
    assert widths.min() < 0.1 < widths.max()
    grid = TimeGrid(breaks, 9)
    assert grid.times.size == 9 * grid.slabs
    assert resolving_breaks(lambda t: np.tanh(50 * (t - 0.3))[None], (0.0, 1.0), 9, 1e-6, 3) is None


def test_a_layer_at_the_start_is_seen_between_the_nodes():
    breaks = resolving_breaks(lambda t: np.exp(-1e5 * t)[None], (0.0, 1.0), 12, 1e-4, 100)
    assert breaks[1] < 1e-3


def test_cuts_are_kept():
    breaks = resolving_breaks(lambda t: np.abs(t - 0.3)[None], (0.0, 0.3, 1.0), 6, 1e-8, 10)
    assert breaks == (0.0, 0.3, 1.0)


@pytest.fixture(scope="module")
def trajectories():
    system = ro.compile(EXAMPLES["coupled"].problem).system
    reference_set = ReferenceSet.of(system, SolveRequest(1e-6, Domain.of(system), Check(24)))
    return Trajectories(reference_set, TimeGrid((0.0, 0.25, 0.5), 10), 1e-8, 1.0, 10_000)


def test_trajectories_are_held_in_a_growing_basis(trajectories):
    points = np.random.default_rng(0).uniform(0.5, 1.5, (40, 3))
    first = trajectories(points[:20])
    second = trajectories(points[20:])
    assert len(second) >= len(first)
    basis = trajectories.basis.vectors
    np.testing.assert_allclose(basis.T @ basis, np.eye(basis.shape[1]), atol=1e-10)
    states = trajectories.states(second)
    exact = trajectories._integrated(points[20:])
    np.testing.assert_allclose(
        basis[:, : len(second)] @ second, exact, atol=5e-8 * np.linalg.norm(exact, axis=0).max()
    )
    assert states.shape == (3, 20, 20)


def test_each_trajectory_is_integrated_once(trajectories):
    bases = [ChebyshevBasis(0.5, 1.5, 4)] * 3
    samples, before = Samples(trajectories, bases), trajectories.count
    indices = np.array([[0, 1, 2], [3, 3, 3], [0, 1, 2]])
    values = samples(indices)
    assert trajectories.count == before + 2
    np.testing.assert_array_equal(values[:, 0], values[:, 2])
    np.testing.assert_array_equal(samples(indices[:2])[: len(values)], values[:, :2])
    assert trajectories.count == before + 2


def test_skeletons_interpolate_with_small_coefficients():
    rows = np.linalg.qr(np.random.default_rng(1).standard_normal((200, 12)))[0].T
    skeleton, coefficients = _skeleton(rows)
    np.testing.assert_allclose(rows[:, skeleton] @ coefficients, rows, atol=1e-12)
    np.testing.assert_allclose(coefficients[:, skeleton], np.eye(12), atol=1e-10)
    assert np.abs(coefficients).max() <= 1.1


class Separable:
    """Samples of sum_r a_r(i) b_r(j) c_r(k), of rank 3."""

    def __init__(self, sizes):
        generator = np.random.default_rng(2)
        self.first = generator.standard_normal((5, 3))
        self.factors = [generator.standard_normal((size, 3)) for size in sizes]

    def __call__(self, indices):
        products = np.ones((len(indices), 3))
        for factor, column in zip(self.factors, indices.T):
            products *= factor[column]
        return self.first @ products.T


@pytest.mark.parametrize("sizes", [(5, 6, 4), (20, 20, 20), (9, 9, 9, 9, 9)])
def test_a_tensor_of_low_rank_is_found_exactly(sizes):
    samples, bases = Separable(sizes), [ChebyshevBasis(0.0, 1.0, size) for size in sizes]
    train, limited = interpolate(samples, bases, left_points(sizes, 9, 0), 1e-12, 50)
    assert not limited
    train = train.rounded(1e-10)
    assert train.ranks == (3,) * len(sizes)
    unscaled = train.unscaled([basis.weights for basis in bases])
    indices = np.stack([np.random.default_rng(3).integers(0, n, 30) for n in sizes], axis=1)
    np.testing.assert_allclose(
        train.first @ unscaled.at_indices(indices), samples(indices), atol=1e-9
    )


@pytest.mark.parametrize("ratio", [0.2, 0.5, 0.8])
def test_the_number_of_nodes_is_predicted(ratio):
    spectrum = ratio ** np.arange(200.0)
    wanted = np.count_nonzero(spectrum > 1e-6)
    assert abs(needed(spectrum[:12], 1e-6) - min(wanted, 36)) <= 6


def test_the_worst_trajectory_sets_the_steps():
    """One oscillation among many trajectories at rest is as accurate as alone."""
    problem = ro.Problem.from_strings(
        {"x": "w*y", "y": "-w*x"}, {"x": "1", "y": "0"}, {"w": (0.001, 30)}, (0, 5)
    )
    system = ro.compile(problem).system
    points = np.full((400, 1), 0.001)
    points[7] = 30.0

    tolerances = Tolerances(1e-8, np.full((2, 1), 1e-10))
    trajectories = StackedIntegrator().run(system, points, [0.0, 5.0], tolerances)
    assert trajectories.state[0, 7] == pytest.approx(np.cos(150.0), abs=2e-6)
