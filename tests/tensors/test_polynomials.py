"""Least squares in polynomials of many parameters together."""

import itertools

import numpy as np
import pytest

from rankone.tensors.basis import ChebyshevBasis, LegendreBasis
from rankone.tensors.polynomials import fitted, ordered_terms, train_of

BOX = (0.5, 2.0)


def values(train, bases, points):
    """The columns (rank, m) that a train gives at points (m, d)."""
    right = np.ones((1, len(points)))
    for core, basis, places in zip(train.cores[:0:-1], bases[::-1], points.T[::-1], strict=True):
        right = np.einsum("rms,nm,sn->rn", core, basis.modal_values(places), right)
    return train.first @ right


def smooth(points):
    weights = np.linspace(0.2, 1.0, points.shape[1])
    return np.stack([np.exp(-points @ weights / 7.0), 1.0 / (1.0 + points @ weights)])


def inside(count, d):
    return BOX[0] + np.diff(BOX) * np.random.default_rng(3).random((count, d))


def test_terms_ascend_in_their_weighted_sum():
    sizes = np.array([3, 5, 4])
    terms, ends = ordered_terms(sizes.tolist(), 1000)
    sums = (terms / sizes).sum(axis=1)
    assert sorted(map(tuple, terms)) == sorted(itertools.product(*map(range, sizes)))
    assert (np.diff(sums) > -1e-9).all()
    assert ends == [*(np.flatnonzero(np.diff(sums) > 1e-9) + 1), len(terms)]


@pytest.mark.parametrize("kind", [ChebyshevBasis, LegendreBasis])
def test_a_train_of_known_coefficients_is_the_polynomial(kind):
    bases = [kind(*BOX, size) for size in (3, 4, 3)]
    terms, _ = ordered_terms([3, 4, 3], 1000)
    coefficients = np.random.default_rng(0).standard_normal((2, len(terms)))
    points = inside(20, 3)
    modal = [b.modal_values(p) for b, p in zip(bases, points.T, strict=True)]
    products = np.prod([m[:, degrees] for m, degrees in zip(modal, terms.T, strict=True)], axis=0)
    train = train_of(coefficients, terms, [3, 4, 3], 1e-12)
    assert np.allclose(values(train, bases, points), coefficients @ products.T)


@pytest.mark.parametrize("tolerance", [1e-3, 1e-5])
def test_smooth_columns_are_fitted_to_a_tolerance_with_few_of_them(tolerance):
    bases, asked = [ChebyshevBasis(*BOX, 6) for _ in range(7)], []

    def columns(points):
        asked.append(len(points))
        return smooth(points)

    train, points = fitted(columns, bases, tolerance), inside(300, 7)
    missed = np.linalg.norm(values(train, bases, points) - smooth(points), axis=0)
    assert np.sqrt(np.mean(missed**2)) <= tolerance
    assert sum(asked) < 0.02 * 6**7


def test_columns_that_are_not_smooth_are_given_up():
    bases = [ChebyshevBasis(*BOX, 6) for _ in range(7)]
    assert fitted(lambda p: np.abs(p - 1.1).sum(axis=1)[None], bases, 1e-8) is None


def test_columns_whose_number_of_coefficients_grows():
    bases = [ChebyshevBasis(*BOX, 4) for _ in range(6)]
    held = iter(range(1, 100))

    def columns(points):
        more = np.zeros((next(held), len(points)))
        return np.concatenate([points.sum(axis=1)[None], more])

    train = fitted(columns, bases, 1e-9)
    points = inside(10, 6)
    assert np.allclose(values(train, bases, points)[0], points.sum(axis=1))
