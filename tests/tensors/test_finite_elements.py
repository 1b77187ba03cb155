"""Lagrange elements: quadrature, derivatives, integrals, conversion to piecewise Legendre."""

from __future__ import annotations

import numpy as np
import pytest

from rankone.tensors import LagrangeElements
from rankone.tensors.basis import lobatto_points

SHAPES = [(1, 1), (7, 1), (5, 2), (3, 4), (1, 12)]


@pytest.fixture(params=SHAPES, ids=lambda shape: f"{shape[0]} of order {shape[1]}")
def basis(request: pytest.FixtureRequest) -> LagrangeElements:
    return LagrangeElements(0.5, 2.0, *request.param)


def test_lobatto_points_of_low_order() -> None:
    assert lobatto_points(1) == pytest.approx([-1, 1])
    assert lobatto_points(2) == pytest.approx([-1, 0, 1], abs=1e-15)
    assert lobatto_points(3) == pytest.approx([-1, -(0.2**0.5), 0.2**0.5, 1])


def test_nodes_are_ascending_and_the_functions_cardinal(basis: LagrangeElements) -> None:
    assert basis.nodes[0] == basis.lower
    assert basis.nodes[-1] == pytest.approx(basis.upper, rel=1e-15)
    assert np.all(np.diff(basis.nodes) > 0)
    coefficients = basis.to_modes(np.eye(basis.size)).reshape(-1, basis.size)
    values = basis.modes.modal_values(basis.nodes) @ coefficients / np.sqrt(basis.elements)
    assert values == pytest.approx(np.eye(basis.size), abs=1e-12)


def test_polynomials_of_the_order_are_exact(basis: LagrangeElements) -> None:
    for degree in range(basis.order + 1):
        nodal = basis.nodes**degree
        assert basis.values @ nodal == pytest.approx(basis.points**degree, rel=1e-11)
        slope = degree * basis.points ** max(degree - 1, 0)
        assert basis.derivatives @ nodal == pytest.approx(slope, rel=1e-10, abs=1e-10)


def test_quadrature_is_exact_for_triple_products(basis: LagrangeElements) -> None:
    degree = 3 * basis.order
    exact = (basis.upper ** (degree + 1) - basis.lower ** (degree + 1)) / (degree + 1)
    assert basis.weights @ basis.points**degree == pytest.approx(exact, rel=1e-12)


def test_integral_from_the_start(basis: LagrangeElements) -> None:
    degree = basis.order
    exact = (basis.points ** (degree + 1) - basis.lower ** (degree + 1)) / (degree + 1)
    values = np.stack([basis.points**degree, np.ones(basis.points.size)], axis=1)
    integrals = basis.integrated(values)
    assert integrals[:, 0] == pytest.approx(exact, rel=1e-11)
    assert integrals[:, 1] == pytest.approx(basis.points - basis.lower, rel=1e-12)


def test_the_piecewise_legendre_basis_holds_the_same_function(basis: LagrangeElements) -> None:
    rng = np.random.default_rng(3)
    nodal = rng.standard_normal((basis.size, 2))
    coefficients = basis.to_modes(nodal).reshape(-1, 2) / np.sqrt(basis.elements)
    values = basis.modes.modal_values(basis.points) @ coefficients
    assert values == pytest.approx(basis.values @ nodal, abs=1e-11)


@pytest.mark.parametrize("order", [1, 2])
def test_interpolation_converges_with_the_order_plus_one(order: int) -> None:
    errors = []
    for elements in (8, 16, 32):
        basis = LagrangeElements(0.0, 2.0, elements, order)
        gap = basis.values @ np.exp(basis.nodes) - np.exp(basis.points)
        errors.append(np.sqrt(basis.weights @ gap**2))
    rates = np.log2(np.array(errors[:-1]) / errors[1:])
    assert rates == pytest.approx(order + 1, abs=0.1)
