"""Correlated parameters: a Gaussian copula joins their distributions.

Standard normal numbers z with the correlations given are turned into shares Phi(z) of the
probability of each parameter, and these into its values. The distribution of each parameter alone
stays as it is (Nelsen, An Introduction to Copulas, 2006, section 2.3).
"""

from __future__ import annotations

import itertools
import math
import numbers
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from scipy.special import ndtr, ndtri

from rankone.discretization.coordinates import name_of
from rankone.support.arrays import Array
from rankone.support.errors import OptionError
from rankone.support.spread import spread
from rankone.support.wording import did_you_mean, listing, quote, shown

__all__ = ["Copula", "copula_of"]

_REACH = 6.5
"""Largest normal number of the quadrature; there are 1e-10 beyond."""
_TENSOR = 3
"""Parameters up to which there is a grid."""
_STEPS = (1.0, 0.75, 0.5, 0.35, 0.25, 0.18, 0.125, 0.09, 0.0625)
_MOST, _EVEN = 2**17, 2**14
"""Most points of a grid, and number of evenly spread points."""
_DEFINITE = 1e-10
"""Least eigenvalue of a matrix that is positive definite."""


@dataclass(frozen=True)
class Copula:
    """Correlations of some parameters.

    Attributes
    ----------
    positions : tuple of int
        The parameters that are correlated with some other, ascending.
    matrix : tuple of tuple of float
        Correlations of their normal numbers.
    """

    positions: tuple[int, ...]
    matrix: tuple[tuple[float, ...], ...]

    @cached_property
    def root(self) -> Array:
        """The upper triangle U with U U^T the matrix: the last parameter has a number alone."""
        return np.linalg.cholesky(np.array(self.matrix)[::-1, ::-1])[::-1, ::-1]

    def joined(self, shares: Array) -> Array:
        """Independent shares in [0, 1] of all parameters (d, M), with those here correlated."""
        found = shares.copy()
        own = list(self.positions)
        found[own] = ndtr(self.root @ ndtri(np.clip(shares[own], 1e-300, 1.0 - 2.0**-53)))
        return found

    def rules(self) -> list[tuple[Array, Array]]:
        """Quadratures over the parameters here, finer and finer: shares (k, Q), weights (Q,).

        The trapezoidal rule in independent normal numbers, which converges exponentially for smooth
        functions (Trefethen, "Exactness of quadrature formulas", SIAM Review 64, 2022); one rule of
        evenly spread points for more than three parameters.
        """
        return [(ndtr(self.root @ z), weights) for z, weights in _normal(len(self.positions))]

    def given(self, index: int, value: float) -> list[tuple[Array, Array]]:
        """The same with one of the parameters, by its place here, known by its normal number."""
        matrix = np.array(self.matrix)
        others = [i for i in range(len(matrix)) if i != index]
        slope = matrix[others, index]
        root = np.linalg.cholesky(matrix[np.ix_(others, others)] - np.outer(slope, slope))
        found = []
        for z, weights in _normal(len(others)):
            all_z = np.insert(slope[:, None] * value + root @ z, index, value, axis=0)
            found.append((ndtr(all_z), weights))
        return found


def _normal(count: int) -> list[tuple[Array, Array]]:
    """Quadratures for independent standard normal numbers."""
    if count > _TENSOR:
        shares = spread(_EVEN, count, np.random.default_rng(20144)).T
        return [(ndtri(np.clip(shares, 1e-15, 1.0)), np.full(_EVEN, 1.0 / _EVEN))]
    found = []
    for step in _STEPS:
        line = np.arange(-_REACH, _REACH + 0.5 * step, step)
        if 0.8 * line.size**count > _MOST:
            break
        z = np.stack(np.meshgrid(*[line] * count, indexing="ij")).reshape(count, -1)[::-1]
        squares = np.sum(z**2, axis=0)
        z, squares = z[:, squares <= _REACH**2], squares[squares <= _REACH**2]
        weights = np.exp(-0.5 * squares)
        found.append((z, weights / weights.sum()))
    return found


def copula_of(names: Sequence[str], correlation: Mapping[Any, Any] | None) -> Copula | None:
    """The copula of correlations by pairs of parameters; None if nothing is correlated.

    Raises
    ------
    OptionError
        If a key is no pair of two parameters, a pair is there twice, a number is not inside of
        (-1, 1), or the matrix is not positive definite.
    """
    if not isinstance(correlation, Mapping | None):
        raise OptionError(
            f"correlation={shown(correlation)} is not a mapping from pairs to numbers",
            term=correlation,
            remedy="give {(k, c): 0.6}",
        )
    entries: dict[tuple[int, int], float] = {}
    for key, value in (correlation or {}).items():
        pair = _pair(names, key)
        if pair in entries:
            raise OptionError(
                f"the correlation of {listing(names[i] for i in pair)} is given twice", term=key
            )
        entries[pair] = _number(names, pair, value)
    entries = {pair: value for pair, value in entries.items() if value}
    if not entries:
        return None
    positions = sorted(set(itertools.chain(*entries)))
    matrix = np.eye(len(positions))
    for (i, j), value in entries.items():
        a, b = positions.index(i), positions.index(j)
        matrix[a, b] = matrix[b, a] = value
    if np.linalg.eigvalsh(matrix)[0] < _DEFINITE:
        raise OptionError(
            f"the correlations of {listing(names[i] for i in positions)} contradict each other: "
            "their matrix is not positive definite",
            term=correlation,
            remedy="pairs that are not given have the correlation 0; give all of them, or smaller "
            "numbers",
        )
    return Copula(tuple(positions), tuple(map(tuple, matrix.tolist())))


def _pair(names: Sequence[str], key: Any) -> tuple[int, int]:
    """Positions of two parameters, ascending."""
    if not isinstance(key, tuple | frozenset) or len(key) != 2:
        raise OptionError(
            f"{shown(key)} is not a pair of parameters",
            term=key,
            remedy="give correlation={(k, c): 0.6}",
        )
    found = [name_of(one) for one in key]
    for name in found:
        if name not in names:
            raise OptionError(
                f"there is no parameter {quote(name)}{did_you_mean(name, names)}",
                term=name,
                remedy=f"known are {listing(names)}",
            )
    if found[0] == found[1]:
        raise OptionError(f"{quote(found[0])} is paired with itself", term=key)
    i, j = sorted(map(names.index, found))
    return i, j


def _number(names: Sequence[str], pair: tuple[int, int], value: Any) -> float:
    """A correlation inside of (-1, 1)."""
    real = isinstance(value, numbers.Real) and not isinstance(value, bool)
    if real and -1.0 < float(value) < 1.0:
        return float(value)
    exact = real and math.isclose(abs(float(value)), 1.0)
    raise OptionError(
        f"the correlation of {listing(names[i] for i in pair)} is {shown(value)}, not a number "
        "between -1 and 1",
        term=value,
        remedy="write one parameter by the other in the equations" if exact else None,
    )
