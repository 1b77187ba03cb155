"""Skeletons: their error is below the tolerance, they are small, and so are their coefficients."""

import numpy as np
import pytest

from rankone.tensors.train import skeleton_of
from tests.tensors.test_truncation import decaying, singular_values


def remainder(matrix, skeleton):
    return matrix - matrix[:, skeleton.columns] @ skeleton.coefficients


@pytest.mark.parametrize(("m", "n"), [(20, 30), (300, 280), (900, 120), (90, 400), (700, 600)])
@pytest.mark.parametrize("tolerance", [1e-2, 1e-4, 1e-6, 1e-10])
@pytest.mark.parametrize("expected", [4, 20, 60])
def test_the_error_is_near_the_tolerance_and_the_rank_near_the_least(m, n, tolerance, expected):
    matrix = decaying(m, n, 0.5)
    skeleton = skeleton_of([matrix], tolerance, 1000, expected)
    missed = np.linalg.norm(remainder(matrix, skeleton))
    assert missed <= 3.0 * tolerance
    assert skeleton.missed(matrix) == pytest.approx(missed, abs=1e-14)
    values = singular_values(m, n, 0.5)
    least = np.count_nonzero(np.sqrt(np.cumsum(values[::-1] ** 2)[::-1]) > tolerance)
    assert skeleton.rank <= least + 5
    assert np.abs(skeleton.coefficients).max() <= 1.1
    chosen = skeleton.coefficients[:, skeleton.columns]
    np.testing.assert_allclose(chosen, np.eye(skeleton.rank), atol=1e-9)


def test_a_rank_far_above_the_expected_one_is_found():
    matrix = decaying(600, 500, 0.95)
    skeleton = skeleton_of([matrix], 1e-7, 1000, 3)
    assert np.linalg.norm(remainder(matrix, skeleton)) <= 5e-7
    full = np.random.default_rng(3).standard_normal((150, 150))
    assert skeleton_of([full], 1e-8, 1000, 3).rank == 150
    assert skeleton_of([full], 1e-8, 7, 3).rank == 7


def test_a_matrix_of_zeros_has_a_skeleton():
    skeleton = skeleton_of([np.zeros((40, 9))], 1e-9, 100, 3)
    assert skeleton.rank == 1
    assert np.isfinite(skeleton.coefficients).all()
    assert skeleton.missed(np.zeros((5, 9))) == 0.0


@pytest.mark.parametrize("m", [60, 900])
def test_all_matrices_count(m):
    """The second one has rows that the first one lacks, and rows stand for those of both."""
    generator = np.random.default_rng(4)
    first, second = (
        generator.standard_normal((m, 8)) @ x for x in np.eye(120)[:16].reshape(2, 8, 120)
    )
    one = skeleton_of([first], 1e-8, 100, 8)
    assert one.missed(second) == pytest.approx(np.linalg.norm(second))
    both = skeleton_of([first, second], 1e-8, 100, 8)
    assert max(both.missed(first), both.missed(second)) < 1e-8
    rows = one.rows_of([first])
    np.testing.assert_allclose(rows.T @ rows, first.T @ first, atol=1e-9)
    later = skeleton_of([rows, second], 1e-8, 100, 8)
    assert max(later.missed(first), later.missed(second)) < 1e-8
