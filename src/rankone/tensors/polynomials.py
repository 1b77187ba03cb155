"""Polynomials in all parameters together, fitted to columns by least squares.

For smooth functions of many parameters, polynomials whose degrees in the parameters are bounded in
their weighted sum need far fewer columns than a cross interpolation (Migliorati, Nobile, von
Schwerin & Tempone, Found. Comput. Math. 14 (2014), 419). Points follow the arcsine measure; the
error is that of leaving one column out, which the fit tells without being repeated.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import scipy.linalg

from rankone.support.arrays import MINOR, SEED, Array
from rankone.support.budget import charge
from rankone.support.costs import product
from rankone.tensors.basis import Basis1D
from rankone.tensors.cross import Columns
from rankone.tensors.train import Integers, Train, truncated_svd

LEAST_PARAMETERS = 6
"""Parameters from which on polynomials are tried."""
_MOST_TERMS = 6000
_FIRST_TERMS = 100
_COLUMNS_PER_TERM = 1.5


def fitted(columns: Columns, bases: Sequence[Basis1D], tolerance: float) -> Train | None:
    """A train of polynomials whose root mean square error is within a tolerance.

    Core 0 has coefficients of columns, the others have modes of the bases. None where too many
    terms would be needed.
    """
    sizes = [basis.size for basis in bases]
    terms, ends = ordered_terms(sizes, _MOST_TERMS)
    fit, earlier = _Fit(columns, bases), list[tuple[int, float]]()
    wanted = _FIRST_TERMS
    while True:
        count = min(ends, key=lambda end: abs(math.log(end / wanted)))
        if earlier and count <= earlier[-1][0]:
            return None
        coefficients, error = fit(terms[:count])
        if error <= tolerance:
            return train_of(coefficients, terms[:count], sizes, MINOR * tolerance)
        earlier.append((count, error))
        if _needed(earlier, tolerance) > _MOST_TERMS:
            return None
        wanted = 2 * count


def _needed(fits: Sequence[tuple[int, float]], tolerance: float) -> float:
    """The terms that the first and the last of at least three fits predict for a tolerance."""
    if len(fits) < 3:
        return 0.0
    (fewer, before), (count, error) = fits[0], fits[-1]
    if error >= before:
        return math.inf
    slope = math.log(before / error) / math.log(count / fewer)
    return count * math.exp(math.log(error / tolerance) / slope)


def ordered_terms(sizes: Sequence[int], most: int) -> tuple[Integers, list[int]]:
    """Degrees (terms, d) below the sizes, by their weighted sum; and where equal sums end.

    The weights are one over the sizes, so that parameters which need higher degrees get them.
    """
    waiting: list[tuple[float, tuple[int, ...]]] = [(0.0, (0,) * len(sizes))]
    terms, sums = list[tuple[int, ...]](), list[float]()
    while waiting and len(terms) <= most:
        total, term = heapq.heappop(waiting)
        terms.append(term)
        sums.append(total)
        last = max((j for j, degree in enumerate(term) if degree), default=0)
        for j in range(last, len(sizes)):  # each term has one that comes before it
            if term[j] + 1 < sizes[j]:
                higher = (*term[:j], term[j] + 1, *term[j + 1 :])
                pairs = zip(higher, sizes, strict=True)
                waiting_sum = round(sum(degree / size for degree, size in pairs), 9)
                heapq.heappush(waiting, (waiting_sum, higher))
    ends = [k + 1 for k, (a, b) in enumerate(pairwise(sums)) if b > a]
    if not waiting and len(terms) <= most:
        ends.append(len(terms))
    return np.array(terms, dtype=np.int64), ends


class _Fit:
    """Least squares over columns at random points, of which there are more for more terms."""

    def __init__(self, columns: Columns, bases: Sequence[Basis1D]) -> None:
        self.columns, self.bases = columns, bases
        self.generator = np.random.default_rng(SEED)
        self.values = [np.zeros((0, basis.size)) for basis in bases]
        self.sampled = np.zeros((0, 0))

    def __call__(self, terms: Integers) -> tuple[Array, float]:
        """Coefficients (rank, terms), and the root mean square error of columns left out."""
        self._sample(math.ceil(_COLUMNS_PER_TERM * len(terms)))
        design = np.ones((len(self.sampled), len(terms)))
        for values, degrees in zip(self.values, terms.T, strict=True):
            design *= values[:, degrees]
        count, size = design.shape
        charge(product(count, size, size) + 2.0 * product(count, size, self.sampled.shape[1]))
        factor = scipy.linalg.cholesky(design.T @ design, lower=True)
        right = scipy.linalg.solve_triangular(factor, design.T @ self.sampled, lower=True)
        coefficients = scipy.linalg.solve_triangular(factor, right, lower=True, trans="T")
        leverage = np.square(scipy.linalg.solve_triangular(factor, design.T, lower=True)).sum(0)
        missed = np.linalg.norm(self.sampled - design @ coefficients, axis=1) / (1.0 - leverage)
        return coefficients.T, float(np.sqrt(np.mean(np.square(missed))))

    def _sample(self, count: int) -> None:
        """Take further columns, up to a number of them."""
        before, rank = self.sampled.shape
        shares = self.generator.random((count - before, len(self.bases)))
        points = np.empty_like(shares)
        for j, basis in enumerate(self.bases):
            lower, upper = basis.scaled_edges[[0, -1]]
            places = lower + 0.5 * (upper - lower) * (1.0 - np.cos(np.pi * shares[:, j]))
            inside = np.clip(basis.scale.from_scale(places), basis.lower, basis.upper)
            points[:, j] = inside
            self.values[j] = np.concatenate([self.values[j], basis.modal_values(inside)])
        further = self.columns(points)
        sampled = np.zeros((count, len(further)))
        sampled[:before, :rank], sampled[before:] = self.sampled, further.T
        self.sampled = sampled


def train_of(coefficients: Array, terms: Integers, sizes: Sequence[int], tolerance: float) -> Train:
    """The train of polynomials with coefficients (rank, terms) of degrees (terms, d).

    Up to a tolerance in the root mean square.
    """
    negligible = tolerance / math.sqrt(len(sizes))
    core, weights, rest = truncated_svd(coefficients, negligible, min(coefficients.shape))
    cores, rest = [core], weights[:, None] * rest
    for j, size in enumerate(sizes):
        tails, place = np.unique(terms[:, j + 1 :], axis=0, return_inverse=True)
        unfolded = np.zeros((len(rest), size, len(tails)))
        unfolded[:, terms[:, j], place.ravel()] = rest
        terms = np.concatenate([np.zeros((len(tails), j + 1), dtype=np.int64), tails], axis=1)
        matrix = unfolded.reshape(-1, len(tails))
        if j + 1 == len(sizes):
            cores.append(matrix.reshape(len(rest), size, 1))
            break
        left, weights, right = truncated_svd(matrix, negligible, min(matrix.shape))
        cores.append(left.reshape(len(rest), size, -1))
        rest = weights[:, None] * right
    return Train(tuple(cores))
