"""Bases of one coordinate: nodal polynomials, elements of them, and Lagrange finite elements.

No derivative in a parameter ever occurs in an ODE system, so collocation at the nodes of a
discrete inner product equals Galerkin projection with that quadrature, and every parameter
operator is diagonal.
"""

from __future__ import annotations

import itertools
import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import ClassVar, Self

import numpy as np
from numpy.polynomial import legendre as npl
from numpy.polynomial.legendre import leggauss
from numpy.typing import NDArray

from rankone.support.arrays import COINCIDENT, TINY, Array
from rankone.tensors.coordinates import IDENTITY, Scale

_NODES_OF_DIGIT = 1.4


def nodes_for(tolerance: float, first: float) -> int:
    """Nodes that resolve a smooth function: ``first`` of them, and some for each digit."""
    return round(first - _NODES_OF_DIGIT * math.log10(tolerance))


def legendre_values(xi: Array, count: int) -> Array:
    """Legendre polynomials on [-1, 1], orthonormal for the uniform probability measure.

    ``sqrt(2 m + 1) P_m(xi)`` for m < ``count`` at points (N,): shape (N, count). By the three-term
    recurrence (DLMF 18.9.1).
    """
    rows = np.empty((count, xi.size))
    rows[0] = 1.0
    rows[1:2] = xi
    degrees = np.arange(count)
    ascending = ((2.0 * degrees + 1.0) / (degrees + 1.0))[:, None] * xi
    for m in range(1, count - 1):
        np.multiply(ascending[m], rows[m], out=rows[m + 1])
        rows[m + 1] -= m / (m + 1) * rows[m - 1]
    rows *= np.sqrt(2.0 * degrees + 1.0)[:, None]
    return rows.T


@lru_cache(maxsize=32)
def legendre_derivative(count: int) -> Array:
    """Coefficients of the derivatives on [-1, 1] of the same polynomials, (count, count).

    Column n holds those of the nth: ``P_n' = sum of (2 k + 1) P_k`` over k = n - 1, n - 3, ...
    """
    degrees = np.arange(count)
    below = degrees[None, :] - degrees[:, None]
    roots = np.sqrt(2.0 * degrees + 1.0)
    return np.where((below > 0) & (below % 2 == 1), np.outer(roots, roots), 0.0)


def chebyshev_values(xi: Array, count: int) -> Array:
    """Chebyshev polynomials on [-1, 1], orthonormal for the arcsine probability measure.

    Shapes as in :func:`legendre_values`; ``sqrt(2) T_m(xi)`` for m > 0.
    """
    rows = np.empty((count, xi.size))
    rows[0] = 1.0
    rows[1:2] = xi
    twice = 2.0 * xi
    for m in range(1, count - 1):
        np.multiply(twice, rows[m], out=rows[m + 1])
        rows[m + 1] -= rows[m - 1]
    rows[1:] *= np.sqrt(2.0)
    return rows.T


def chebyshev_derivative(count: int) -> Array:
    """Coefficients of the derivatives of the polynomials of :func:`chebyshev_values`.

    Column n holds those of the nth: ``T_n' = 2 n (T_{n-1} + T_{n-3} + ...)``, half of T_0.
    """
    degrees = np.arange(count)
    below = degrees[None, :] - degrees[:, None]
    slopes = np.where((below > 0) & (below % 2 == 1), 2.0 * degrees[None, :], 0.0)
    sizes = np.where(degrees == 0, 1.0, np.sqrt(2.0))  # of T_n in the orthonormal ones
    slopes[0] *= 0.5
    return np.asarray(slopes * sizes[None, :] / sizes[:, None])


@dataclass(frozen=True)
class Basis1D(ABC):
    """A nodal basis on [lower, upper] in elements, with a discrete inner product.

    Functions are held by their values at the nodes times the square root of the weights
    ("scaled values"), so that the Euclidean product is the discrete inner product.
    ``degree`` is the number of nodes of an element. Elements are equal, unless they end at
    ``breaks``, which ascend inside of the interval and give the number of elements.

    The modes are polynomials in the coordinate of ``scale``, in which the elements are equal.
    Ends, breaks, edges, nodes and the points of evaluation are values of the parameter.
    """

    lower: float
    upper: float
    degree: int
    elements: int = 1
    breaks: tuple[float, ...] = ()
    scale: Scale = IDENTITY

    kind: ClassVar[str]

    def __post_init__(self) -> None:
        if not self.scale.is_identity and not self.scale.allows(self.lower, self.upper):
            raise ValueError(f"{self.scale} is not finite on {self.lower}, {self.upper}")
        if not len(self.breaks):
            object.__setattr__(self, "breaks", ())
            return
        breaks = tuple(float(point) for point in self.breaks)
        ends = (self.lower, *breaks, self.upper)
        ascending = all(a < b for a, b in itertools.pairwise(ends))
        if not ascending or not all(map(math.isfinite, ends)):
            raise ValueError(f"breaks {breaks} do not ascend inside of {self.lower}, {self.upper}")
        if self.elements not in (1, len(breaks) + 1):
            raise ValueError(f"{len(breaks)} breaks do not make {self.elements} elements")
        object.__setattr__(self, "breaks", breaks)
        object.__setattr__(self, "elements", len(breaks) + 1)

    @staticmethod
    @abstractmethod
    def _rule(count: int) -> tuple[Array, Array]:
        """Nodes in [-1, 1], ascending, and weights of sum one."""

    @staticmethod
    @abstractmethod
    def _values(xi: Array, count: int) -> Array:
        """Values of the polynomials orthonormal under the rule, (N, count)."""

    @staticmethod
    @abstractmethod
    def _slopes(count: int) -> Array:
        """Coefficients of the derivatives of the polynomials on [-1, 1], (count, count)."""

    @property
    def size(self) -> int:
        """Number of nodes."""
        return self.degree * self.elements

    @cached_property
    def edges(self) -> Array:
        """Ends of all elements, ascending, shape (elements + 1,)."""
        if self.breaks:
            return np.array([self.lower, *self.breaks, self.upper])
        if self.scale.is_identity:
            return np.linspace(self.lower, self.upper, self.elements + 1)
        inside = self.scale.from_scale(self.scaled_edges[1:-1])
        return np.array([self.lower, *inside.tolist(), self.upper])

    @cached_property
    def scaled_edges(self) -> Array:
        """The edges in the coordinate of the scale."""
        if self.breaks or self.scale.is_identity:
            return self.scale.to_scale(self.edges)
        start, end = self._scaled_ends
        return np.linspace(start, end, self.elements + 1)

    @cached_property
    def _scaled_ends(self) -> tuple[float, float]:
        """Both ends of the interval in the coordinate of the scale."""
        if self.scale.is_identity:
            return self.lower, self.upper
        start, end = self.scale.to_scale(np.array([self.lower, self.upper])).tolist()
        return start, end

    @cached_property
    def nodes(self) -> Array:
        """Nodes of all elements, ascending, shape (size,)."""
        xi, _ = self._rule(self.degree)
        if self.breaks:
            edges = self.scaled_edges
            widths = np.diff(edges)[:, None]
            nodes = np.asarray(edges[:-1, None] + 0.5 * widths * (xi + 1.0)).ravel()
        else:
            start, end = self._scaled_ends
            width = (end - start) / self.elements
            starts = start + width * np.arange(self.elements)
            nodes = np.asarray(starts[:, None] + 0.5 * width * (xi + 1.0)).ravel()
        if self.scale.is_identity:
            return nodes
        return np.asarray(np.clip(self.scale.from_scale(nodes), self.lower, self.upper))

    @cached_property
    def weights(self) -> Array:
        """Weights of the discrete inner product, of sum one, shape (size,).

        All elements have the same weight: where they are narrow, functions are steep.
        """
        _, weights = self._rule(self.degree)
        return np.asarray(np.tile(weights / self.elements, self.elements))

    @cached_property
    def to_modal(self) -> Array:
        """Orthogonal map from scaled values to coefficients of the modes, (size, size).

        Modes are the orthonormal polynomials of each element, element after element.
        """
        block = _to_modal(type(self), self.degree)
        return block if self.elements == 1 else np.asarray(np.kron(np.eye(self.elements), block))

    def modal_values(self, points: Array) -> Array:
        """Values of the modes at points (N,) of the interval: shape (N, size).

        A break belongs to the later element.
        """
        scaled = self.scale.to_scale(points)
        if self.breaks:
            edges = self.scaled_edges
            element = np.searchsorted(edges[1:-1], scaled, side="right")
            scales = 1.0 / np.diff(edges)
            position = (scaled - edges[element]) * scales[element]
            local = self._values(2.0 * position - 1.0, self.degree)
            return self._spread(local * np.sqrt(self.elements), element)
        start, end = self._scaled_ends
        position = (scaled - start) * (self.elements / (end - start))
        if self.elements == 1:
            return self._values(2.0 * position - 1.0, self.degree)
        element = np.clip(position.astype(int), 0, self.elements - 1)
        local = self._values(2.0 * (position - element) - 1.0, self.degree)
        return self._spread(local * np.sqrt(self.elements), element)

    def modal_slopes(self, points: Array) -> Array:
        """Derivatives of the modes with respect to the parameter at points (N,): (N, size)."""
        slopes = self.modal_values(points) @ self.scaled_derivative
        return slopes if self.scale.is_identity else slopes * self.scale.slope(points)[:, None]

    @cached_property
    def scaled_derivative(self) -> Array:
        """Coefficients of the modes to those of the derivative in the coordinate, (size, size)."""
        block = self._slopes(self.degree)
        scales = 2.0 / np.diff(self.scaled_edges)
        return np.asarray(np.kron(np.diag(scales), block))

    @cached_property
    def derivative(self) -> tuple[Array, Self]:
        """The map (m, size) from coefficients to those of the derivative, and the basis of these.

        With respect to the parameter. In a scale the slope ds/dx multiplies the modes: the basis
        has as many nodes more as this needs to be exact to rounding.
        """
        if self.scale.is_identity:
            return self.scaled_derivative, self
        edges = self.edges
        more = max(self.scale.slope_modes(float(a), float(b)) for a, b in itertools.pairwise(edges))
        basis = replace(self, degree=self.degree + more - 1)
        at_nodes = self.modal_slopes(basis.nodes)
        return basis.to_modal @ (np.sqrt(basis.weights)[:, None] * at_nodes), basis

    def restricted(self, lower: float, upper: float) -> Self:
        """The basis on another interval, with the ends of elements that are inside of it."""
        near = COINCIDENT * (self.upper - self.lower)
        inside = [float(e) for e in self.edges if lower + near < e < upper - near]
        breaks = tuple(inside)
        return replace(self, lower=lower, upper=upper, elements=len(breaks) + 1, breaks=breaks)

    @property
    def middles(self) -> Array:
        """The middle of each element in the coordinate of the scale, (elements,)."""
        edges = self.scaled_edges
        return self.scale.from_scale(0.5 * (edges[:-1] + edges[1:]))

    def _spread(self, local: Array, element: NDArray[np.intp]) -> Array:
        """Values of the modes (N, size) from those of one element for each point."""
        count = len(local)
        spread = np.zeros((count, self.elements, self.degree))
        spread[np.arange(count), element] = local
        return spread.reshape(count, self.size)

    def transfer(self, other: Basis1D) -> Array:
        """Map scaled values on this basis to those on another, (other.size, size)."""
        at_nodes = self.modal_values(other.nodes) @ self.to_modal
        return np.asarray(np.sqrt(other.weights)[:, None] * at_nodes)

    def tail(self, spectrum: Array) -> float:
        """Norm of the two highest modes of each element in a spectrum of mode norms (size,)."""
        top = min(2, self.degree - 1)
        highest = spectrum.reshape(self.elements, self.degree)[:, self.degree - top :]
        return float(np.linalg.norm(highest))

    def relative_spectrum(self, values: Array) -> Array:
        """Size of each mode of functions (rows, size), relative to the largest of its row."""
        spectra = np.abs((values * np.sqrt(self.weights)) @ self.to_modal.T)
        largest = spectra.max(axis=1, keepdims=True, initial=TINY)
        return np.asarray((spectra / largest).max(axis=0))

    def coarsened(self, spectrum: Array, tolerance: float, least: int = 3) -> Self:
        """The smallest basis that keeps a spectrum to ``tolerance``, two modes to spare.

        ``least`` is the smallest degree taken.
        """
        by_degree = np.linalg.norm(spectrum.reshape(self.elements, self.degree), axis=0)
        tails = np.sqrt(np.cumsum(by_degree[::-1] ** 2))[::-1]
        needed = int(np.count_nonzero(tails > tolerance)) + 2
        return replace(self, degree=min(max(needed, least), self.degree))

    def refined(self, largest_degree: int) -> Self:
        """The next finer basis: more nodes, or every element halved once the degree is spent.

        It holds every function of this basis.
        """
        degree = self.degree + max(2, self.degree // 4)
        if degree <= largest_degree:
            return replace(self, degree=degree)
        if self.breaks:
            breaks = np.sort(np.concatenate([self.breaks, self.middles]))
            return replace(self, elements=breaks.size + 1, breaks=tuple(breaks.tolist()))
        return replace(self, elements=2 * self.elements)


@lru_cache(maxsize=64)
def _to_modal(kind: type[Basis1D], degree: int) -> Array:
    """The map :attr:`Basis1D.to_modal` of one element, which all of them share."""
    xi, weights = kind._rule(degree)
    block = (kind._values(xi, degree) * np.sqrt(weights)[:, None]).T
    block.flags.writeable = False
    return np.asarray(block)


class LegendreBasis(Basis1D):
    """Gauss-Legendre nodes: truncation is optimal in the mean square over the interval."""

    kind = "legendre"
    _values = staticmethod(legendre_values)
    _slopes = staticmethod(legendre_derivative)

    @staticmethod
    @lru_cache(maxsize=64)
    def _rule(count: int) -> tuple[Array, Array]:
        xi, weights = leggauss(count)
        return xi, 0.5 * weights


class ChebyshevBasis(Basis1D):
    """Chebyshev-Gauss nodes with equal weights: truncation is nearly uniform over the interval.

    The arcsine measure weighs the ends of the interval more than the mean square does, so that
    the largest error over the box stays close to the root mean square one
    (Trefethen, Approximation Theory and Approximation Practice, ch. 4 and 8).
    """

    kind = "chebyshev"
    _values = staticmethod(chebyshev_values)
    _slopes = staticmethod(chebyshev_derivative)

    @staticmethod
    @lru_cache(maxsize=64)
    def _rule(count: int) -> tuple[Array, Array]:
        xi = -np.cos(np.pi * (np.arange(count) + 0.5) / count)
        return xi, np.full(count, 1.0 / count)


BASES: dict[str, type[Basis1D]] = {cls.kind: cls for cls in (ChebyshevBasis, LegendreBasis)}
"""The bases by name."""


# -----------------------------------------------------------------------------
# Continuous shape functions on an interval: linear, quadratic and spectral elements.
#
# The shape functions of the classic method: Lagrange polynomials at the Gauss-Lobatto points of
# each element. Order 1 and 2 are the linear and quadratic finite elements of the slides; one
# element of high order is the Legendre spectral basis. Functions are held by their values at the
# nodes.


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
