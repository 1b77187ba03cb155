"""Nodal bases: quadrature, modes, transfer, refinement."""

import numpy as np
import pytest

from rankone.tensors import BASES, ChebyshevBasis, LegendreBasis

KINDS = list(BASES.values())


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("elements", [1, 3])
def test_weights_sum_to_one_and_modes_are_orthogonal(kind, elements):
    basis = kind(-1.0, 4.0, 6, elements)
    assert basis.weights.sum() == pytest.approx(1.0)
    identity = basis.to_modal @ basis.to_modal.T
    np.testing.assert_allclose(identity, np.eye(basis.size), atol=1e-14)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("elements", [1, 4])
def test_polynomials_are_reproduced_everywhere(kind, elements):
    basis = kind(0.5, 3.0, 5, elements)
    points = np.concatenate([np.random.default_rng(0).uniform(0.5, 3.0, 40), [0.5, 3.0]])
    scaled = (basis.nodes**4 - basis.nodes) * np.sqrt(basis.weights)
    values = basis.modal_values(points) @ (basis.to_modal @ scaled)
    np.testing.assert_allclose(values, points**4 - points, rtol=1e-12, atol=1e-12)


def test_legendre_weights_integrate_polynomials_exactly():
    basis = LegendreBasis(1.0, 3.0, 4)
    mean = basis.weights @ basis.nodes**7
    assert mean == pytest.approx((3.0**8 - 1.0) / 8.0 / 2.0, rel=1e-14)


def test_chebyshev_coefficients_of_a_pole_decay_at_the_rate_of_its_ellipse():
    basis = ChebyshevBasis(1.0, 10.0, 40)
    spectrum = np.abs(basis.to_modal @ (np.sqrt(basis.weights) / basis.nodes))
    slope = np.polyfit(np.arange(5, 30), np.log(spectrum[5:30]), 1)[0]
    pole = 11.0 / 9.0
    assert np.exp(-slope) == pytest.approx(pole + np.sqrt(pole**2 - 1.0), rel=1e-3)


@pytest.mark.parametrize("kind", KINDS)
def test_transfer_to_a_finer_basis_and_back_is_the_identity(kind):
    coarse = kind(0.0, 1.0, 5)
    fine = coarse.refined(largest_degree=40)
    assert fine.size > coarse.size
    there_and_back = fine.transfer(coarse) @ coarse.transfer(fine)
    np.testing.assert_allclose(there_and_back, np.eye(5), atol=1e-13)


def test_refinement_splits_the_interval_once_the_degree_is_spent():
    basis = ChebyshevBasis(0.0, 1.0, 20)
    finer = basis.refined(largest_degree=20)
    assert (finer.degree, finer.elements) == (20, 2)


@pytest.mark.parametrize("degree", [5, 20])
def test_a_finer_basis_holds_every_function_of_the_coarser(degree):
    basis = ChebyshevBasis(0.0, 1.0, degree)
    finer = basis.refined(largest_degree=20)
    there_and_back = finer.transfer(basis) @ basis.transfer(finer)
    np.testing.assert_allclose(there_and_back, np.eye(degree), atol=1e-12)


def test_elements_resolve_a_kink_that_one_polynomial_does_not():
    points = np.linspace(-1.0, 1.0, 101)

    def error(basis):
        scaled = np.abs(basis.nodes) * np.sqrt(basis.weights)
        values = basis.modal_values(points) @ (basis.to_modal @ scaled)
        return np.abs(values - np.abs(points)).max()

    assert error(ChebyshevBasis(-1.0, 1.0, 4, 2)) < 1e-13
    assert error(ChebyshevBasis(-1.0, 1.0, 8, 1)) > 1e-2


# --- elements of unequal size ------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
def test_unequal_elements_sum_to_one_and_are_orthonormal(kind):
    basis = kind(-1.0, 4.0, 6, breaks=(-0.9, 0.5, 3.0))
    assert (basis.elements, basis.size) == (4, 24)
    np.testing.assert_array_equal(basis.edges, [-1.0, -0.9, 0.5, 3.0, 4.0])
    np.testing.assert_allclose(basis.weights.reshape(4, 6).sum(axis=1), 0.25, rtol=1e-14)
    assert basis.weights.sum() == pytest.approx(1.0)
    assert np.all(np.diff(basis.nodes) > 0)
    inside = basis.nodes.reshape(4, 6)
    assert np.all((inside > basis.edges[:-1, None]) & (inside < basis.edges[1:, None]))
    np.testing.assert_allclose(basis.to_modal @ basis.to_modal.T, np.eye(24), atol=1e-14)
    at_nodes = basis.modal_values(basis.nodes) * np.sqrt(basis.weights)[:, None]
    np.testing.assert_allclose(at_nodes, basis.to_modal.T, atol=1e-13)
    np.testing.assert_allclose(at_nodes.T @ at_nodes, np.eye(24), atol=1e-13)


@pytest.mark.parametrize("kind", KINDS)
def test_unequal_elements_reproduce_a_polynomial_on_each(kind):
    breaks = (0.6, 1.7)
    basis = kind(0.5, 3.0, 5, breaks=breaks)
    rng = np.random.default_rng(0)
    points = np.concatenate([rng.uniform(0.5, 3.0, 40), [0.5, 0.6, 1.7, 3.0]])
    pieces = rng.standard_normal((3, 5))

    def function(x):
        element = np.searchsorted(breaks, x, side="right")
        return np.sum(pieces[element] * x[:, None] ** np.arange(5), axis=1)

    scaled = function(basis.nodes) * np.sqrt(basis.weights)
    values = basis.modal_values(points) @ (basis.to_modal @ scaled)
    np.testing.assert_allclose(values, function(points), rtol=1e-11, atol=1e-11)


@pytest.mark.parametrize("kind", KINDS)
def test_equal_breaks_are_equal_elements(kind):
    equal, broken = kind(0.0, 1.0, 5, 4), kind(0.0, 1.0, 5, 4, (0.25, 0.5, 0.75))
    points = np.random.default_rng(0).uniform(0.0, 1.0, 50)
    for name in ("edges", "nodes", "weights", "to_modal"):
        ours, theirs = getattr(broken, name), getattr(equal, name)
        np.testing.assert_allclose(ours, theirs, atol=1e-15)
    np.testing.assert_allclose(broken.modal_values(points), equal.modal_values(points), atol=1e-13)


def test_a_break_resolves_a_kink_anywhere():
    kink = 0.317
    points = np.linspace(-1.0, 1.0, 101)

    def error(basis):
        scaled = np.abs(basis.nodes - kink) * np.sqrt(basis.weights)
        values = basis.modal_values(points) @ (basis.to_modal @ scaled)
        return np.abs(values - np.abs(points - kink)).max()

    assert error(ChebyshevBasis(-1.0, 1.0, 4, breaks=(kink,))) < 1e-13
    assert error(ChebyshevBasis(-1.0, 1.0, 4, 2)) > 1e-2


def test_transfer_between_different_breaks():
    coarse = ChebyshevBasis(0.0, 1.0, 5, breaks=(0.2,))
    equal = LegendreBasis(0.0, 1.0, 5, 2)
    union = LegendreBasis(0.0, 1.0, 6, breaks=(0.2, 0.5))
    for basis in (coarse, equal):
        there_and_back = union.transfer(basis) @ basis.transfer(union)
        np.testing.assert_allclose(there_and_back, np.eye(basis.size), atol=1e-12)
    scaled = coarse.nodes**3 * np.sqrt(coarse.weights)
    wanted = equal.nodes**3 * np.sqrt(equal.weights)
    np.testing.assert_allclose(coarse.transfer(equal) @ scaled, wanted, atol=1e-13)


def test_refinement_with_breaks_is_of_the_degree_and_then_of_every_element():
    basis = ChebyshevBasis(0.0, 1.0, 8, breaks=(0.2, 0.25))
    finer = basis.refined(largest_degree=10)
    assert (finer.degree, finer.breaks) == (10, basis.breaks)
    finest = finer.refined(largest_degree=10)
    assert (finest.degree, finest.elements) == (10, 6)
    np.testing.assert_allclose(finest.breaks, [0.1, 0.2, 0.225, 0.25, 0.625], rtol=1e-15)
    assert {*basis.breaks} < {*finest.breaks}
    there_and_back = finest.transfer(finer) @ finer.transfer(finest)
    np.testing.assert_allclose(there_and_back, np.eye(finer.size), atol=1e-12)


def test_coarsening_and_tail_with_breaks():
    basis = LegendreBasis(0.0, 1.0, 20, breaks=(0.3,))
    spectrum = np.tile(10.0 ** -np.arange(20.0), 2)
    coarse = basis.coarsened(spectrum, 1e-6)
    assert (coarse.degree, coarse.breaks) == (9, (0.3,))
    assert basis.tail(spectrum) == pytest.approx(np.sqrt(2.0) * np.hypot(1e-18, 1e-19))


@pytest.mark.parametrize(
    ("breaks", "elements"),
    [
        ((0.0,), 1),
        ((1.0,), 1),
        ((-0.5,), 1),
        ((0.5, 0.5), 1),
        ((0.6, 0.5), 1),
        ((float("nan"),), 1),
        ((float("inf"),), 1),
        ((0.5,), 3),
        ((0.5, 0.6), 2),
    ],
)
def test_breaks_that_do_not_fit_are_refused(breaks, elements):
    with pytest.raises(ValueError, match="breaks"):
        ChebyshevBasis(0.0, 1.0, 5, elements, breaks)


def test_breaks_may_be_given_as_an_array():
    basis = ChebyshevBasis(0.0, 1.0, 5, breaks=np.array([0.25, 0.5]))
    assert basis == ChebyshevBasis(0.0, 1.0, 5, 3, (0.25, 0.5))
    assert ChebyshevBasis(0.0, 1.0, 5, breaks=[]) == ChebyshevBasis(0.0, 1.0, 5)
    assert hash(basis) == hash(ChebyshevBasis(0.0, 1.0, 5, 3, (0.25, 0.5)))


def test_coarsening_keeps_what_the_spectrum_needs():
    basis = LegendreBasis(0.0, 1.0, 20)
    spectrum = 10.0 ** -np.arange(20.0)
    coarse = basis.coarsened(spectrum, 1e-6)
    assert coarse.degree == 9
    assert basis.coarsened(spectrum, 1e-6, least=12).degree == 12
    assert basis.tail(spectrum) == pytest.approx(np.hypot(1e-18, 1e-19))
