"""Conserved sums: linear combinations of states that no rate changes, such as totals of species.

They are looked for in rates at random states. Their coefficients may depend on parameters, as those
of concentrations in compartments of different volumes do. Ratios of small numbers are made exact,
so that a total is kept to the last digit.
"""

from __future__ import annotations

from fractions import Fraction

import numpy as np

from rankone.ir.features import VectorLike
from rankone.ir.system import System
from rankone.support.arrays import Array

_SAMPLES = 8  # Random states for each state
_ZERO = 1e-11  # Singular values of the rates, over the largest, that vanish
_SEED = 1864  # Of the states: the same system always has the same conserved sums
_LARGEST_DENOMINATOR = 120  # Of coefficients that are taken for fractions
_ROUNDING = 1e-9  # Their distance from such a fraction
_UNCHANGED = 1e-12  # Change of a sum by rates, over the sum of their sizes, that is rounding


class ConservedSums:
    """The conserved sums of an autonomous system: ``count`` of them.

    ``exact`` has their coefficients (count, n) where these are the same at all parameters.
    """

    def __init__(self, system: System) -> None:
        self.system = system
        n, samples = system.n_differential, _SAMPLES * (system.n_differential + 1)
        rng = np.random.default_rng(_SEED)
        box = np.asarray(system.box, dtype=float).reshape(-1, 2)
        p = box[:, :1] + (box[:, 1:] - box[:, :1]) * rng.random((len(box), samples))
        size = np.abs(system.initial(p)).max(axis=1, keepdims=True)
        size = np.where(size > 0.0, size, size.max(initial=0.0) or 1.0)
        self._states = size * rng.uniform(0.3, 1.5, (n, samples))
        self._at: dict[bytes, Array] = {}
        everywhere, here = self._kernel(p), self._kernel(np.repeat(p[:, :1], samples, axis=1))
        self.count = len(here)
        self.exact = everywhere if len(everywhere) == self.count else None

    def __call__(self, p: VectorLike) -> Array:
        """The coefficients (count, n, m) at parameters p (d, m); NaN where there are others."""
        points = np.ascontiguousarray(np.asarray(p, dtype=float).T)
        n, m = len(self._states), len(points)
        if self.exact is not None:
            return np.broadcast_to(self.exact[:, :, None], (self.count, n, m))
        return np.moveaxis(np.array([self._coefficients(point) for point in points]), 0, 2)

    def _coefficients(self, point: Array) -> Array:
        """The coefficients (count, n) at a point (d,)."""
        if (key := point.tobytes()) not in self._at:
            kernel = self._kernel(np.repeat(point[:, None], self._states.shape[1], axis=1))
            same = len(kernel) == self.count
            kernel = kernel / np.abs(kernel).max(axis=1, keepdims=True)  # smooth over parameters
            self._at[key] = kernel if same else np.full((self.count, len(self._states)), np.nan)
        return self._at[key]

    def _kernel(self, p: Array) -> Array:
        """What rates at the random states, and as many parameters p (d, samples), leave unchanged.

        Rows (c, n) of coefficients.
        """
        with np.errstate(all="ignore"):
            rates = np.broadcast_to(self.system.rhs(0.0, self._states, p), self._states.shape)
        rates = rates[:, np.isfinite(rates).all(axis=0)]
        n = len(rates)
        if not rates.size:
            return np.zeros((0, n))
        rows = _without_zeros(np.abs(rates).max(axis=1, keepdims=True))
        scaled = rates / rows
        scaled = scaled / _without_zeros(np.abs(scaled).max(axis=0))
        left, singular, _ = np.linalg.svd(scaled)
        rank = int((singular > _ZERO * max(singular[0], 1e-300)).sum())
        kernel = _reduced(left[:, rank:].T / rows.T)
        fractions = _as_fractions(kernel)
        change, sizes = np.abs(fractions @ rates), np.abs(fractions) @ np.abs(rates)
        return fractions if (change <= _UNCHANGED * sizes).all() else kernel


def _without_zeros(sizes: Array) -> Array:
    return np.where(sizes > 0.0, sizes, 1.0)


def _reduced(rows: Array) -> Array:
    """Rows (c, n) that span the same, each with a one where the others have zeros."""
    reduced, columns = np.array(rows), np.ones(rows.shape[1], dtype=bool)
    for i in range(len(reduced)):
        largest = np.abs(reduced[i:]) * columns
        row, column = divmod(int(largest.argmax()), largest.shape[1])
        reduced[[i, i + row]] = reduced[[i + row, i]]
        reduced[i] /= reduced[i, column]
        columns[column] = False
        others = np.arange(len(reduced)) != i
        reduced[others] -= np.outer(reduced[others, column], reduced[i])
    return np.where(np.abs(reduced) > _ROUNDING * np.abs(reduced).max(initial=0.0), reduced, 0.0)


def _as_fractions(rows: Array) -> Array:
    """Rows with entries close to fractions of small numbers made exact, as multiples of integers.

    As they are where some entry is close to none.
    """
    integers = np.array(rows)
    for i, row in enumerate(rows):
        fractions = [Fraction(x).limit_denominator(_LARGEST_DENOMINATOR) for x in row.tolist()]
        if any(abs(f - x) > _ROUNDING for f, x in zip(fractions, row.tolist(), strict=True)):
            return rows
        common = np.lcm.reduce([fraction.denominator for fraction in fractions])
        integers[i] = [float(fraction * int(common)) for fraction in fractions]
    return integers
