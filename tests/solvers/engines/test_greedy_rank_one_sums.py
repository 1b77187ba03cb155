"""Arithmetic of sums of products against full tensors."""

from __future__ import annotations

import numpy as np
import pytest

from rankone.solvers.engines.greedy_operators import RankOneSum

SIZES = (4, 3, 5)


def full(tensor: RankOneSum) -> np.ndarray:
    return np.einsum("ar,br,cr->abc", *tensor.factors)


@pytest.fixture
def pair() -> tuple[RankOneSum, RankOneSum]:
    rng = np.random.default_rng(2)
    a, b = (
        RankOneSum(tuple(rng.standard_normal((size, rank)) for size in SIZES)) for rank in (3, 2)
    )
    return a, b


def test_sums_and_products(pair: tuple[RankOneSum, RankOneSum]) -> None:
    a, b = pair
    assert full(a + b) == pytest.approx(full(a) + full(b))
    assert full(a - b) == pytest.approx(full(a) - full(b))
    assert full(a.times(b)) == pytest.approx(full(a) * full(b))
    assert full(a.times(a)) == pytest.approx(full(a) ** 2)
    assert a.times(a).rank == 6
    assert full(a.scaled(2.0)) == pytest.approx(2 * full(a))
    assert full(RankOneSum.joined([a, b, a], SIZES)) == pytest.approx(2 * full(a) + full(b))
    assert full(RankOneSum.joined([], SIZES)) == pytest.approx(np.zeros(SIZES))


def test_weights_and_matrices(pair: tuple[RankOneSum, RankOneSum]) -> None:
    a, _ = pair
    row = np.arange(3.0)
    assert full(a.weighted([None, row, None])) == pytest.approx(full(a) * row[:, None])
    matrices = [np.random.default_rng(j).standard_normal((2, size)) for j, size in enumerate(SIZES)]
    expected = np.einsum("abc,xa,yb,zc->xyz", full(a), *matrices)
    assert full(a.applied(matrices)) == pytest.approx(expected)


def test_norms_and_inner_products(pair: tuple[RankOneSum, RankOneSum]) -> None:
    a, b = pair
    assert a.norm() == pytest.approx(np.linalg.norm(full(a)))
    assert a.inner(b) == pytest.approx(np.sum(full(a) * full(b)))
    assert a.distance(b) == pytest.approx(np.linalg.norm(full(a) - full(b)))
    assert RankOneSum.zero(SIZES).norm() == 0.0


def test_small_differences_keep_their_digits(pair: tuple[RankOneSum, RankOneSum]) -> None:
    a, b = pair
    moved = a + b.scaled(1e-12)
    assert a.distance(moved) == pytest.approx(1e-12 * b.norm(), rel=1e-3)


def test_a_large_difference_is_never_claimed_smaller_than_rounding() -> None:
    rng = np.random.default_rng(5)
    a = RankOneSum(tuple(rng.standard_normal((size, 90)) for size in SIZES))
    assert 0.0 < a.distance(a) < 1e-6 * a.norm()
