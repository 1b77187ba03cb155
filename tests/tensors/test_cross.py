"""Cross interpolation: skeletons, trains through samples, and adaptive numbers of nodes."""

import numpy as np
import pytest

from rankone.tensors import ChebyshevBasis
from rankone.tensors import train as skeleton
from rankone.tensors.adaptive import (
    AdaptiveInterpolation,
    InterpolationLimits,
    KnownElements,
    Tightening,
    needed,
)
from rankone.tensors.cross import GrowingBasis, batched, interpolate, left_points


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
    left = batched(left_points(sizes, 9, 0), 6)
    train, limited = interpolate(samples, bases, left, 1e-12, 50)
    assert not limited
    train = train.rounded(1e-10)
    assert train.ranks == (3,) * len(sizes)
    unscaled = train.unscaled([basis.weights for basis in bases])
    indices = np.stack([np.random.default_rng(3).integers(0, n, 30) for n in sizes], axis=1)
    np.testing.assert_allclose(
        train.first @ unscaled.at_indices(indices), samples(indices), atol=1e-9
    )


@pytest.mark.parametrize("count", [20, 200, 600])
def test_the_first_left_points_are_corners_and_the_others_are_even(count):
    points = left_points((300, 20), count, 0)[1][:, 0]
    for k in (16, 150, 300):
        gaps = np.diff(np.unique(points[:k]))
        assert gaps.max() < 3.2 * 300 / min(k, count)
    if count < 300:
        assert set(points[:2]) == {0, 299}
    else:
        assert np.array_equal(np.sort(points), np.arange(300))


def test_many_left_points_begin_with_corners():
    points = left_points((9, 9, 9, 9, 9), 160, 0)[-1]
    at_corners = np.isin(points, [0, 8]).all(axis=1)
    assert at_corners[:20].sum() == 16
    assert len(np.unique(points[at_corners][:16], axis=0)) == 16
    assert np.ptp(points[at_corners][:6], axis=0).min() == 8  # on both sides of every parameter


def test_a_front_across_two_parameters_is_found_by_few_batches():
    size = 200
    bases = [ChebyshevBasis(0.0, 1.0, size)] * 2
    x, sampled = bases[0].nodes, set[int]()

    def front(indices):
        sampled.update((indices[:, 0] * size + indices[:, 1]).tolist())
        return np.tanh(20.0 * (x[indices[:, 0]] + x[indices[:, 1]] - 1.0))[None, :]

    left = batched(left_points((size, size), size, 0), 12, 18, 27, 40, 60, 90, 135)
    train, _ = interpolate(front, bases, left, 1e-7, size)
    assert len(sampled) < 0.9 * size**2
    unscaled = train.unscaled([basis.weights for basis in bases])
    indices = np.random.default_rng(1).integers(0, size, (4000, 2))
    assert np.abs(train.first @ unscaled.at_indices(indices) - front(indices)).max() < 1e-5


def test_left_points_are_taken_until_further_ones_add_nothing():
    sizes = (20, 20, 20)
    samples, bases = Separable(sizes), [ChebyshevBasis(0.0, 1.0, size) for size in sizes]
    sampled = []

    def noted(indices):
        sampled.append(len(indices))
        return samples(indices)

    interpolate(noted, bases, batched(left_points(sizes, 12, 0), *range(2, 12, 2)), 1e-12, 50)
    # at each bond of 20 nodes the second batch is enough; both are sampled in one call
    assert sampled[:2] == [4 * 20, 4 * 20 * 3]

    needy = np.zeros((1, 20, 20, 20))  # each left point sees a direction that no other has
    needy[0, np.arange(20), np.arange(20), np.arange(20)] = 1.0
    diagonal = [
        [np.stack([k, k], axis=1)[:, :b] for k in np.split(np.arange(20), 10)] for b in (1, 2)
    ]
    train, _ = interpolate(
        lambda i: needy[:, *i.T], bases, [[np.zeros((1, 0), dtype=int)], *diagonal], 1e-12, 50
    )
    assert train.ranks[2] == 20


def test_few_sums_of_rows_are_taken_where_ranks_grow_ever_less(monkeypatch):
    """Ranks 12, 24, 30 and 32: growth by 2 and then by 1.25 tells that it ends."""
    size, sums = 14, []
    combined, generator = skeleton._combined, np.random.default_rng(6)
    outer = generator.standard_normal((12, 32))
    factors = [
        generator.standard_normal((size, rank))[:, np.minimum(np.arange(32), rank - 1)]
        for rank in (32, 32, 30, 24, 12)
    ]

    def samples(indices):
        rows = [factor[row] for factor, row in zip(factors, indices.T, strict=True)]
        return outer @ np.prod(rows, axis=0).T

    def noted(matrices, count):
        sums.append(count)
        return combined(matrices, count)

    monkeypatch.setattr(skeleton, "_combined", noted)
    left = batched(left_points((size,) * 5, 30, 0), 20)
    train, _ = interpolate(samples, [ChebyshevBasis(0.0, 1.0, size)] * 5, left, 1e-9, 100)
    assert train.ranks[1:] == (32, 30, 24, 12)
    assert len(sums) == 4  # enough at once at each bond
    assert 32 < sums[3] < 2 * 32


@pytest.mark.parametrize("ratio", [0.2, 0.5, 0.8])
def test_the_number_of_nodes_is_predicted(ratio):
    spectrum = ratio ** np.arange(200.0)
    wanted = np.count_nonzero(spectrum > 1e-6)
    assert abs(needed(spectrum[:12], 1e-6) - min(wanted, 36)) <= 6


def test_a_growing_basis_holds_columns_to_the_tolerance():
    generator = np.random.default_rng(4)
    space = generator.standard_normal((60, 5))
    basis, columns = GrowingBasis(60), space @ generator.standard_normal((5, 40))
    first = basis.coefficients(columns[:, :10], 1e-8)
    assert 5 <= len(first) < 10
    assert len(basis.coefficients(columns, 1e-8)) == len(first)
    np.testing.assert_allclose(basis.columns(first), columns[:, :10], atol=1e-8)


def test_a_growing_basis_holds_the_few_columns_that_many_others_do_not_span():
    generator = np.random.default_rng(5)
    columns = generator.standard_normal((300, 8)) @ generator.standard_normal((8, 2000))
    columns[:, [3, 1501]] = generator.standard_normal((300, 2))
    basis = GrowingBasis(300)
    coefficients = basis.coefficients(columns, 1e-8)
    assert 10 <= len(coefficients) <= 12
    np.testing.assert_allclose(basis.columns(coefficients), columns, atol=1e-8)
    gram = basis.vectors.T @ basis.vectors
    np.testing.assert_allclose(gram, np.eye(len(gram)), atol=1e-12)


@pytest.mark.parametrize("count", [60, 400])
def test_a_growing_basis_resolves_what_rounding_errors_of_products_hide(count):
    generator = np.random.default_rng(0)
    left, _ = np.linalg.qr(generator.standard_normal((200, 12)))
    columns = left * 10.0 ** -np.arange(12) @ generator.standard_normal((12, count))
    basis = GrowingBasis(200)
    coefficients = basis.coefficients(columns, 1e-8)
    np.testing.assert_allclose(
        basis.vectors.T @ basis.vectors, np.eye(len(coefficients)), atol=1e-12
    )
    assert np.linalg.norm(columns - basis.columns(coefficients)) < 1e-8
    assert len(coefficients) <= 12


@pytest.mark.parametrize("count", [3, 40])
def test_a_growing_basis_of_zeros_holds_one_vector(count):
    basis = GrowingBasis(6)
    assert basis.coefficients(np.zeros((6, count)), 1e-8).shape == (1, count)


def adapted(function, box, target, attempts=6, borders=()):
    """Bases and largest error at random points after some attempts."""
    limits = InterpolationLimits(ChebyshevBasis, 400, 60)
    tightening = Tightening(settled_growth=1.2, power=1.0, smallest=0.05, largest=0.5)
    adaptive = AdaptiveInterpolation(box, limits, target, tightening)
    points = np.random.default_rng(5).uniform(*np.transpose(box), (400, len(box)))
    elements = [KnownElements(borders), *[KnownElements()] * (len(box) - 1)]
    for _ in range(attempts):
        train, _ = adaptive.interpolate(lambda p: function(p)[None], lambda _: elements)
        columns = np.ones((1, len(points)))
        cores = zip(train.cores[:0:-1], adaptive.bases[::-1], points.T[::-1], strict=True)
        for core, basis, row in cores:
            columns = np.einsum("rms,pm,sp->rp", core, basis.modal_values(row), columns)
        errors = np.abs((train.first @ columns)[0] - function(points))
        if errors.max() <= target:
            break
        adaptive.steep = adaptive.doubtful = points[np.argsort(-errors)[:7]]
        adaptive.refine(errors.max())
    return adaptive.bases, errors.max()


def test_smooth_functions_take_one_element_and_few_nodes():
    bases, error = adapted(lambda p: 1 / (2 + p[:, 0] + p[:, 1] * p[:, 2]), [(0, 1)] * 3, 1e-6)
    assert error <= 1e-6
    assert [basis.elements for basis in bases] == [1, 1, 1]
    assert max(basis.size for basis in bases) < 20


@pytest.mark.parametrize(("ratio", "tightened"), [(5.0, False), (100.0, True)])
def test_an_error_that_the_highest_modes_do_not_explain_tightens_the_tolerances(ratio, tightened):
    limits = InterpolationLimits(ChebyshevBasis, 400, 60)
    adaptive = AdaptiveInterpolation([(0, 1)] * 2, limits, 1e-6, Tightening(1.2, 1.0, 0.05, 0.5))

    def columns(p):
        return np.tanh(20 * (p[:, 0] + p[:, 1] - 1))[None]

    adaptive.interpolate(columns, lambda _: [KnownElements()] * 2)
    largest = max(b.tail(s) for b, s in zip(adaptive.bases, adaptive.spectra, strict=True))
    assert largest > 1e-6  # more nodes are on the way in any case
    adaptive.refine(ratio * largest)
    assert (adaptive.level < 1e-6) == tightened


def test_a_steep_function_of_one_parameter_takes_elements():
    bases, error = adapted(lambda p: np.tanh(300 * (p[:, 0] - 0.3)), [(0, 1)], 1e-5)
    assert error <= 1e-5
    assert bases[0].elements > 3


def test_elements_begin_at_a_known_kink():
    def kinked(points):
        return np.abs(points[:, 0] - 0.3) * np.exp(points[:, 1])

    bases, error = adapted(kinked, [(0, 1), (0, 1)], 1e-8, borders=(0.3,))
    assert error <= 1e-8
    assert bases[0].breaks == (0.3,)
    assert bases[1].elements == 1


def test_a_box_without_parameters_is_one_column():
    limits = InterpolationLimits(ChebyshevBasis, 400, 60)
    adaptive = AdaptiveInterpolation([], limits, 1e-6, Tightening(1.0, 1.0, 0.05, 0.5))
    train, limited = adaptive.interpolate(lambda p: np.full((3, len(p)), 2.0), lambda _: [])
    assert not limited
    assert adaptive.bases == ()
    np.testing.assert_array_equal(train.first, np.full((3, 1), 2.0))


def test_a_basis_that_spans_its_columns_gets_no_rounding_errors():
    """What is left of a single column is rounding: normalised, it would be the column again."""
    columns = np.array([[1.0], [-1.0], [1.0]])
    basis = GrowingBasis(3)
    coefficients = basis.coefficients(columns, 1e-10)
    np.testing.assert_allclose(basis.columns(coefficients), columns, atol=1e-14)
    np.testing.assert_allclose(
        basis.vectors.T @ basis.vectors, np.eye(basis.vectors.shape[1]), atol=1e-12
    )
