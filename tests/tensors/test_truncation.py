"""Truncated SVD: the dropped part is below the tolerance, the frames are orthonormal."""

from functools import cache

import numpy as np
import pytest

from rankone.tensors.train import truncated_svd


@cache
def decaying(m, n, rate, seed=0):
    rng = np.random.default_rng(seed)
    k = min(m, n)
    left, _ = np.linalg.qr(rng.standard_normal((m, k)))
    right, _ = np.linalg.qr(rng.standard_normal((n, k)))
    matrix = (left * rate ** np.arange(k)) @ right.T
    matrix.flags.writeable = False  # all tests share it
    return matrix


@cache
def singular_values(m, n, rate):
    return np.linalg.svd(decaying(m, n, rate), compute_uv=False)


@pytest.mark.parametrize(("m", "n"), [(20, 30), (300, 280), (500, 120), (90, 400)])
@pytest.mark.parametrize("tolerance", [1e-2, 1e-6, 1e-10])
@pytest.mark.parametrize("hinted", [False, True])
def test_error_is_within_the_tolerance_and_frames_are_orthonormal(m, n, tolerance, hinted):
    matrix = decaying(m, n, 0.5)
    rows = np.linalg.qr(np.random.default_rng(1).standard_normal((n, 10)))[0].T if hinted else None
    left, values, right = truncated_svd(matrix, tolerance, 1000, rows)
    assert np.linalg.norm((left * values) @ right - matrix) <= tolerance * (1 + 1e-6) + 1e-14
    np.testing.assert_allclose(left.T @ left, np.eye(values.size), atol=1e-12)
    np.testing.assert_allclose(right @ right.T, np.eye(values.size), atol=1e-12)
    optimal = np.count_nonzero(
        np.sqrt(np.cumsum(0.25 ** np.arange(min(m, n))[::-1])[::-1]) > tolerance
    )
    assert values.size <= optimal + 2


def test_rank_limit_and_least_rank():
    matrix = decaying(60, 60, 0.9)
    assert truncated_svd(matrix, 1e-12, 7)[1].size == 7
    assert truncated_svd(np.zeros((5, 4)), 1e-3, 7)[1].size == 1


def test_a_full_rank_matrix_with_a_poor_hint_is_still_decomposed():
    matrix = np.random.default_rng(3).standard_normal((150, 150))
    left, values, right = truncated_svd(matrix, 1e-8, 1000, np.eye(150)[:2])
    np.testing.assert_allclose((left * values) @ right, matrix, atol=1e-9)
