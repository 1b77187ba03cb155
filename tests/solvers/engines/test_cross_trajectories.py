"""Trajectories of the cross engine: held in a growing basis, each integrated once."""

import numpy as np
import pytest

import rankone as ro
from rankone.solvers.engines.cross_samples import Trajectories
from rankone.solvers.request import Check, Domain, SolveRequest
from rankone.solvers.verification.measure import measured_from
from rankone.solvers.verification.reference_set import ReferenceSet
from rankone.support.budget import OutOfMemoryError, OutOfWorkError, limited, work_done
from rankone.tensors import ChebyshevBasis
from rankone.tensors.cross import Samples
from rankone.tensors.time_grid import TimeGrid
from rankone.trajectories.integrators.integrator import Tolerances
from rankone.trajectories.stacks.stack import StackedIntegrator
from tests.problems import EXAMPLES


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


def test_trajectories_on_lines_are_read_from_the_reference():
    system = ro.compile(EXAMPLES["coupled"].problem).system
    lines = np.array([[0.5, 1.0, 1.0], [1.5, 1.0, 1.0], [1.0, 0.6, 1.2]])
    request = SolveRequest(1e-6, Domain.of(system), Check(24))
    plain, reference_set = ReferenceSet.of(system, request), ReferenceSet.of(system, request, lines)
    np.testing.assert_array_equal(reference_set.lines, lines)
    np.testing.assert_array_equal(plain.interior_points, reference_set.interior_points)
    np.testing.assert_allclose(plain.sizes, reference_set.sizes, rtol=1e-8)  # not those on lines
    assert reference_set.corners == plain.corners == 8
    assert len(reference_set.reference.points) == len(plain.reference.points) + 3

    read = Trajectories(reference_set, TimeGrid((0.0, 0.25, 0.5), 10), 1e-8, 1.0, 10_000)
    columns = read.basis.columns(read(lines))
    assert read.count == 0
    np.testing.assert_allclose(columns, read._integrated(lines), rtol=1e-6, atol=1e-8)
    with limited(memory=8 * columns.size), pytest.raises(OutOfMemoryError):
        read(lines)  # several copies of them while the basis grows
    assert read(lines[:2]).shape[1] == 2
    assert read.count > 0


def test_errors_on_lines_count():
    """A solution that is wrong there alone is not accurate; and nothing is stated unchecked."""
    system = ro.compile(EXAMPLES["coupled"].problem).system
    lines = np.array([[0.5, 1.0, 1.0], [1.5, 1.0, 1.0]])
    reference_set = ReferenceSet.of(system, SolveRequest(1e-6, Domain.of(system), Check(24)), lines)
    errors = np.full((3, len(reference_set.reference.points)), 1e-9)
    errors[1, 9] = 1e-3  # after the centre and eight corners
    measured = measured_from(reference_set, errors, np.zeros(errors.shape[1]))
    assert measured.error == 1e-3
    assert measured.worst == (0.5, 1.0, 1.0)
    assert measured.quantile == 1e-9
    unchecked = ReferenceSet.of(system, SolveRequest(1e-6, Domain.of(system), Check(0)), lines)
    assert len(unchecked.lines) == 0
    assert not unchecked.checked


def test_stiff_trajectories_that_cannot_be_paid_are_not_begun():
    system = ro.compile(EXAMPLES["robertson"].problem).system
    reference_set = ReferenceSet.of(system, SolveRequest(1e-4, Domain.of(system), Check(24)))
    stiff = Trajectories(reference_set, TimeGrid((0.0, 20.0, 40.0), 10), 1e-4, 1.0, 10_000)
    assert stiff.stiff
    points = Domain.of(system).bounds.mean(axis=1) * np.linspace(0.9, 1.1, 800)[:, None]
    with limited() as account:
        stiff(points[:150])
        taken = account.done
    with limited(2.0 * taken):
        with pytest.raises(OutOfWorkError):
            stiff(points)
        assert work_done() == 0.0
        stiff(points[:75])


def test_each_trajectory_is_integrated_once(trajectories):
    bases = [ChebyshevBasis(0.5, 1.5, 4)] * 3
    samples, before = Samples(trajectories, bases), trajectories.count
    indices = np.array([[0, 1, 2], [3, 3, 3], [0, 1, 2]])
    values = samples(indices)
    assert trajectories.count == before + 2
    np.testing.assert_array_equal(values[:, 0], values[:, 2])
    np.testing.assert_array_equal(samples(indices[:2])[: len(values)], values[:, :2])
    assert trajectories.count == before + 2


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
