"""Operations on trains."""

from __future__ import annotations

import numpy as np
import pytest

from rankone.tensors.train import right_orthonormal, thinned


def dense(cores):
    """All entries of a train."""
    full = cores[0]
    for core in cores[1:]:
        full = np.tensordot(full, core, 1)
    return full[..., 0]


def smooth(ranks=(9, 7, 4)):
    """A train whose entries fall with the degree and along the ranks."""
    rng = np.random.default_rng(5)
    cores = []
    for left, size, right in zip((3, *ranks), (8, 7, 6, 5), (*ranks, 1)):
        falling = 10.0 ** -(np.arange(size)[:, None] + 0.5 * np.arange(right))
        cores.append(rng.standard_normal((left, size, right)) * falling)
    return cores


def test_orthonormal_rows_of_the_same_train():
    cores = right_orthonormal(smooth())
    np.testing.assert_allclose(dense(cores), dense(smooth()), atol=1e-13)
    for core in cores[1:]:
        rows = core.reshape(len(core), -1)
        np.testing.assert_allclose(rows @ rows.T, np.eye(len(core)), atol=1e-13)


@pytest.mark.parametrize("tolerance", [1e-2, 1e-5, 1e-8])
def test_thinned_is_the_same_within_the_tolerance(tolerance):
    cores = thinned(smooth(), tolerance)
    change = np.linalg.norm(dense(cores) - dense(smooth()))
    assert 0.005 * tolerance <= change <= tolerance
    assert all(a.shape[0] <= b.shape[0] for a, b in zip(cores, smooth()))


def test_thinned_keeps_fewer_entries_the_coarser():
    entries = [sum(map(np.count_nonzero, thinned(smooth(), 10.0**-k))) for k in (2, 5, 8)]
    full = sum(core.size for core in smooth())
    assert entries[0] < entries[1] < entries[2] < 0.8 * full


def test_thinned_trains_without_parameters_or_values():
    core = np.array([[[1.0], [1e-3]], [[2.0], [0.0]]])
    np.testing.assert_array_equal(thinned([core], 0.0)[0], core)
    np.testing.assert_array_equal(thinned([core], 1e-2)[0], [[[1.0], [0.0]], [[2.0], [0.0]]])
    zeros = [np.zeros((2, 3, 2)), np.zeros((2, 4, 1))]
    np.testing.assert_array_equal(dense(thinned(zeros, 1e-3)), 0.0)
