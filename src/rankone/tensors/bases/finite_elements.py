"""Continuous shape functions on an interval: linear, quadratic and spectral elements.

The shape functions of the classic method: Lagrange polynomials at the Gauss-Lobatto points of
each element. Order 1 and 2 are the linear and quadratic finite elements of the slides; one element
of high order is the Legendre spectral basis. Functions are held by their values at the nodes.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.polynomial import legendre as npl

from rankone.support.arrays import Array
from rankone.tensors.bases.basis import LegendreBasis, legendre_values

__all__ = ["LagrangeElements", "lobatto_points"]


def lobatto_points(order: int) -> Array:
    """Gauss-Lobatto points of a polynomial order, in [-1, 1], ascending, shape (order + 1,).

    The ends of the interval and the zeros of P'_order (DLMF 3.5(v)).
    """
    series = np.zeros(order + 1)
    series[order] = 1.0
    slope = npl.legder(series)
    inner = np.sort(npl.legroots(slope).real)
    for _ in range(3):
        inner -= npl.legval(inner, slope) / npl.legval(inner, npl.legder(slope))
    return np.concatenate([[-1.0], inner, [1.0]])


@dataclass(frozen=True)
class LagrangeElements:
    """Continuous, piecewise polynomials of degree ``order`` on equal elements of [lower, upper]."""

    lower: float
    upper: float
    elements: int
    order: int

    @property
    def size(self) -> int:
        """Number of nodes."""
        return self.elements * self.order + 1

    @property
    def width(self) -> float:
        """Length of one element."""
        return (self.upper - self.lower) / self.elements

    @cached_property
    def nodes(self) -> Array:
        """Nodes, ascending, both ends included, shape (size,)."""
        inside = 0.5 * (lobatto_points(self.order)[1:] + 1.0)
        starts = np.arange(self.elements)[:, None]
        return np.concatenate([[self.lower], self.lower + self.width * (starts + inside).ravel()])

    @cached_property
    def _rule(self) -> tuple[Array, Array]:
        """Gauss points in [-1, 1] and weights: products of three shape functions are exact."""
        points, weights = npl.leggauss(self.order + self.order // 2 + 2)
        return points, weights

    @cached_property
    def points(self) -> Array:
        """Quadrature points of all elements, ascending, shape (Q,)."""
        xi, _ = self._rule
        starts = np.arange(self.elements)[:, None]
        return np.asarray(self.lower + self.width * (starts + 0.5 * (xi + 1.0))).ravel()

    @cached_property
    def weights(self) -> Array:
        """Quadrature weights for the integral over the interval, shape (Q,)."""
        _, weights = self._rule
        return np.tile(0.5 * self.width * weights, self.elements)

    @cached_property
    def values(self) -> Array:
        """Shape functions at the quadrature points, shape (Q, size)."""
        polynomials = legendre_values(self._rule[0], self.order + 1)
        return self._scattered(polynomials @ self._to_legendre)

    @cached_property
    def derivatives(self) -> Array:
        """Derivatives of the shape functions at the quadrature points, shape (Q, size)."""
        slopes = np.stack([npl.legder(row) for row in np.eye(self.order + 1)])
        at_points = npl.legval(self._rule[0], slopes.T).T
        normalised = at_points * np.sqrt(2.0 * np.arange(self.order + 1) + 1.0)
        return self._scattered(normalised @ self._to_legendre * (2.0 / self.width))

    def integrated(self, values: Array) -> Array:
        """Integral from ``lower`` to each quadrature point, of functions given there, (Q, R).

        On each element the polynomial through the quadrature points is integrated.
        """
        xi, weights = self._rule
        count = xi.size
        coefficients = np.linalg.inv(npl.legvander(xi, count - 1))
        primitives = np.stack([npl.legint(row, lbnd=-1) for row in np.eye(count)])
        local = 0.5 * self.width * (npl.legval(xi, primitives.T).T @ coefficients)
        pieces = values.reshape(self.elements, count, -1)
        integrals = np.matmul(local, pieces)
        whole = np.tensordot(0.5 * self.width * weights, pieces, axes=([0], [1]))
        integrals[1:] += np.cumsum(whole[:-1], axis=0)[:, None]
        return np.asarray(integrals.reshape(values.shape))

    @property
    def modes(self) -> LegendreBasis:
        """The piecewise Legendre basis that holds the same functions."""
        return LegendreBasis(self.lower, self.upper, self.order + 1, self.elements)

    def to_modes(self, nodal: Array) -> Array:
        """Coefficients of the modes of :attr:`modes` from values at the nodes, (size, R).

        Exact; the shape of the result is (elements, order + 1, R), element after element, on the
        polynomials orthonormal for the uniform probability measure of each element.
        """
        gather = np.arange(self.elements)[:, None] * self.order + np.arange(self.order + 1)
        return np.asarray(np.matmul(self._to_legendre, nodal[gather]))

    @cached_property
    def _to_legendre(self) -> Array:
        """From values at the nodes of one element to its Legendre coefficients."""
        nodal = legendre_values(lobatto_points(self.order), self.order + 1)
        return np.asarray(np.linalg.inv(nodal))

    def _scattered(self, local: Array) -> Array:
        """Repeat a local table (q, order + 1) for every element: (Q, size)."""
        count = len(local)
        table = np.zeros((self.elements, count, self.size))
        for e in range(self.elements):
            table[e, :, e * self.order : (e + 1) * self.order + 1] = local
        return table.reshape(-1, self.size)
