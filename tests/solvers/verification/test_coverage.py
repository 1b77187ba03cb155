"""Points of wide boxes lie in all decades, those of narrow boxes where they always were."""

import numpy as np
import pytest

import rankone as ro
from rankone.solvers.request import Domain
from rankone.solvers.verification.points import Coverage, active_points, check_points
from rankone.support.arrays import spread
from rankone.tensors import ChebyshevBasis
from rankone.tensors.coordinates import Logarithm

WIDE = np.array([[1e-6, 1.0], [1e-2, 1e2]])


def shares_of_decades(points, lower, decades):
    return np.histogram(np.log10(points / lower), bins=decades, range=(0, decades))[0] / len(points)


def test_points_of_wide_boxes_are_in_all_decades_and_in_the_linear_range():
    interior = check_points(WIDE, 96)[5:]
    assert (shares_of_decades(interior[:, 0], 1e-6, 6) > 0.05).all()
    assert (shares_of_decades(interior[:, 1], 1e-2, 4) > 0.08).all()
    for j, upper in enumerate(WIDE[:, 1]):
        quarters = np.histogram(interior[:, j], bins=4, range=(0, upper))[0] / len(interior)
        assert (quarters > 0.09).all()


def test_a_scale_that_was_asked_for_is_followed():
    box = np.array([[1e-3, 10.0], [0.3, 0.7]])
    interior = check_points(box, 96, scales=(Logarithm(), Logarithm()))[5:]
    assert np.abs(shares_of_decades(interior[:, 0], 1e-3, 4) - 0.25).max() < 0.03
    assert abs(np.mean(interior[:, 1] < np.sqrt(0.21)) - 0.5) < 0.03
    centre = check_points(box, 0, scales=(Logarithm(), Logarithm()))
    assert np.allclose(centre, [[0.1, np.sqrt(0.21)]])


def test_narrow_boxes_keep_their_bits():
    box = np.array([[0.5, 5.0], [-1.0, 1.0], [0.0, 1e3]])
    rng = np.random.default_rng(20140)
    shares = np.concatenate([np.full((1, 3), 0.5), spread(24, 3, rng)])
    points = check_points(box, 24)
    expected = box[:, 0] + (box[:, 1] - box[:, 0]) * shares
    assert np.array_equal(np.delete(points, np.s_[1:9], axis=0), expected)


@pytest.mark.parametrize("mixed", [True, False])
def test_shares_reach_both_ends_and_ascend(mixed):
    coverage = Coverage.of_box(WIDE, () if mixed else (Logarithm(), Logarithm()))
    assert coverage.mixed == (mixed, mixed)
    for j, (lower, upper) in enumerate(WIDE):
        line = coverage.line(j, 101)
        assert (line[0], line[-1]) == (lower, upper)
        assert (np.diff(line) > 0).all()
    shares = np.random.default_rng(1).random((50, 2))
    steps = coverage.steps(coverage.points(shares), 1e-6)
    assert np.allclose(steps, coverage.points(shares) * np.log(WIDE[:, 1] / WIDE[:, 0]) * 1e-6)


def test_the_scale_of_a_basis_is_mixed_with_even_points():
    bases = [ChebyshevBasis(1.0, 3.0, 5), ChebyshevBasis(1.0, 20.0, 5, scale=Logarithm())]
    coverage = Coverage.of_bases(bases)
    assert coverage.mixed == (False, True)
    assert 20**0.5 < coverage.points(np.full((1, 2), 0.5))[0, 1] < 10.5


def test_factors_in_the_lowest_decades_have_points():
    """A term that is large below 1e-4 alone is looked at where it is."""
    problem = ro.Problem.from_strings(
        {"x": "exp(-(k/0.00001)**2)*c - x"}, {"x": "0"}, {"k": (1e-6, 1), "c": (1, 2)}, (0, 1)
    )
    system = ro.compile(problem).system
    points = np.concatenate(
        [check_points(np.array(system.box), 96), active_points(system, Domain.of(system))]
    )
    assert np.count_nonzero(points[:, 0] < 2e-5) > 10
