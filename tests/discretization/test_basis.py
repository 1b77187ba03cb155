"""Nodal bases: quadrature, modes, transfer, refinement."""

import numpy as np
import pytest

from rankone.discretization import BASES, ChebyshevBasis, LegendreBasis

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


def test_coarsening_keeps_what_the_spectrum_needs():
    basis = LegendreBasis(0.0, 1.0, 20)
    spectrum = 10.0 ** -np.arange(20.0)
    coarse = basis.coarsened(spectrum, 1e-6)
    assert coarse.degree == 9
    assert basis.coarsened(spectrum, 1e-6, least=12).degree == 12
    assert basis.tail(spectrum) == pytest.approx(np.hypot(1e-18, 1e-19))
