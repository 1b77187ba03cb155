"""Operations on trains."""

from __future__ import annotations

import numpy as np
import pytest

from rankone.tensors.train import Train


def dense(train):
    """All entries of a train."""
    full = train.first
    for core in train.cores[1:]:
        full = np.tensordot(full, core, 1)
    return full[..., 0]


def smooth(ranks=(9, 7, 4)):
    """A train whose entries fall with the degree and along the ranks."""
    rng = np.random.default_rng(5)
    cores = []
    for left, size, right in zip((3, *ranks), (8, 7, 6, 5), (*ranks, 1)):
        falling = 10.0 ** -(np.arange(size)[:, None] + 0.5 * np.arange(right))
        cores.append(rng.standard_normal((left, size, right)) * falling)
    return Train(tuple(cores))


def test_orthonormal_rows_of_the_same_train():
    train = smooth().right_orthonormal()
    np.testing.assert_allclose(dense(train), dense(smooth()), atol=1e-13)
    for core in train.cores[1:]:
        rows = core.reshape(len(core), -1)
        np.testing.assert_allclose(rows @ rows.T, np.eye(len(core)), atol=1e-13)


@pytest.mark.parametrize("tolerance", [1e-2, 1e-5, 1e-8])
def test_thinned_is_the_same_within_the_tolerance(tolerance):
    train = smooth().thinned(tolerance)
    change = np.linalg.norm(dense(train) - dense(smooth()))
    assert 0.005 * tolerance <= change <= tolerance
    assert all(a <= b for a, b in zip(train.ranks, smooth().ranks))


@pytest.mark.parametrize("tolerance", [1e-2, 1e-5, 1e-8])
def test_truncated_and_rounded_trains_are_within_the_tolerance(tolerance):
    exact = smooth()
    truncated, change = exact.right_orthonormal().truncated(tolerance)
    rounded, norms = exact.rounded_with_norms(tolerance)
    assert change <= tolerance
    distance = np.linalg.norm(dense(truncated) - dense(exact))
    assert change == pytest.approx(distance, rel=1e-3, abs=1e-13)
    assert np.linalg.norm(dense(rounded) - dense(exact)) <= tolerance
    assert all(a <= b for a, b in zip(rounded.ranks, exact.ranks, strict=True))
    first = rounded.first.reshape(-1, rounded.ranks[0])
    for ours, theirs in zip(norms, rounded.with_first(first).mode_norms(), strict=True):
        np.testing.assert_allclose(ours, theirs, atol=tolerance)
    for core in rounded.cores[1:]:
        rows = core.reshape(len(core), -1)
        np.testing.assert_allclose(rows @ rows.T, np.eye(len(core)), atol=1e-13)


def test_a_wider_frame_keeps_the_train():
    rng = np.random.default_rng(7)
    probes = [0.1 * rng.standard_normal(shape) for shape in ((2, 7, 2), (2, 6, 2), (2, 5, 1))]
    train = smooth().widened(probes)
    np.testing.assert_allclose(dense(train), dense(smooth()), atol=1e-6)
    assert train.ranks > smooth().right_orthonormal().ranks


def test_entries_at_indices_and_norms_of_modes():
    train = smooth().right_orthonormal()
    indices = np.array([[0, 1, 2], [6, 5, 4]])
    exact = dense(train)[..., indices[:, 0], indices[:, 1], indices[:, 2]]
    np.testing.assert_allclose(train.first @ train.at_indices(indices), exact, atol=1e-13)
    norms = train.with_first(train.first.reshape(-1, train.ranks[0])).mode_norms()
    for j, axis in enumerate((2, 3, 4)):
        others = tuple(k for k in range(5) if k != axis)
        np.testing.assert_allclose(norms[j], np.sqrt((dense(train) ** 2).sum(axis=others)))


def test_thinned_keeps_fewer_entries_the_coarser():
    entries = [sum(map(np.count_nonzero, smooth().thinned(10.0**-k).cores)) for k in (2, 5, 8)]
    full = sum(core.size for core in smooth().cores)
    assert entries[0] < entries[1] < entries[2] < 0.8 * full


def test_thinned_trains_without_parameters_or_values():
    core = np.array([[[1.0], [1e-3]], [[2.0], [0.0]]])
    np.testing.assert_array_equal(Train((core,)).thinned(0.0).first, core)
    np.testing.assert_array_equal(
        Train((core,)).thinned(1e-2).first, [[[1.0], [0.0]], [[2.0], [0.0]]]
    )
    zeros = Train((np.zeros((2, 3, 2)), np.zeros((2, 4, 1))))
    np.testing.assert_array_equal(dense(zeros.thinned(1e-3)), 0.0)
