"""Statistics of fields from those of their coefficients.

An entry is a row of modes times the coefficients. Its mean is that row times their means, and every
part of its variance the quadratic form of that row with a matrix of the coefficients. No matrix of
entries by entries is formed.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rankone.solution.statistics.over_box import (
    Quantiles,
    StatisticsOverBox,
    Times,
    checked_probabilities,
)
from rankone.solution.statistics.solution_statistics import changed_shares, quantiles_of
from rankone.support.arrays import ACCUMULATED, AT_ONCE, Array, Labelled, Table, Variables
from rankone.support.errors import EvaluationError, OptionError, did_you_mean, listing, quote
from rankone.support.options import checked_count
from rankone.tensors.coordinates import name_of
from rankone.tensors.joint_distribution import Correlations, Under

_MOST_COVARIANCES = 10**8  # Numbers of a matrix of covariances, 0.8 GB


@dataclass(frozen=True, repr=False)
class FieldSobol(Labelled):
    """Variance-based sensitivities of the entries of a field as functions of time.

    Where an entry varies by less than the measured error of its field, they are NaN.

    Attributes
    ----------
    name : str
        The unknown.
    parameters : tuple of str
    positions : ndarray of int
        Which entries these are, in the shape that they were chosen in.
    times : ndarray (times,)
        Without any, if nothing depends on time, the shapes below end before them.
    first : ndarray (*shape of the entries, parameters, times)
        Share of the variance that one parameter explains alone.
    total : ndarray (*shape of the entries, parameters, times)
        Share that remains if all other parameters are known.
    variance : ndarray (*shape of the entries, times)
    first_half_width, total_half_width : ndarray
        What the measured error of the field may change the indices by.
    """

    name: str
    parameters: tuple[str, ...]
    positions: NDArray[np.intp]
    times: Array
    first: Array
    total: Array
    variance: Array
    first_half_width: Array
    total_half_width: Array

    def over_entries(self) -> tuple[Array, Array]:
        """Shares of the sum of the variances of all entries, (parameters, times) each.

        They are NaN where entries whose own shares are not known have half of the sum or more.
        """
        weights = np.nan_to_num(self.variance).reshape(self.positions.size, 1, -1)
        shape = self.first.shape[self.positions.ndim :]

        def mean(shares: Array) -> Array:
            flat = shares.reshape(len(weights), len(self.parameters), -1)
            counted = np.where(np.isnan(flat), 0.0, weights)
            with np.errstate(invalid="ignore"):
                means = (np.nan_to_num(flat) * counted).sum(axis=0) / weights.sum(axis=0)
            unknown = counted.sum(axis=0) <= 0.5 * weights.sum(axis=0)
            return np.where(unknown, np.nan, means).reshape(shape)

        return mean(self.first), mean(self.total)

    def _table(self) -> Table:
        """Shares of the sum of the variances at the first and the last time."""
        both = [each.reshape(len(self.parameters), -1) for each in self.over_entries()]
        count = both[0].shape[1] if self.parameters else 1
        chosen = dict.fromkeys((0, count - 1))
        at = [f" at {self.times[k]:.4g}" if self.times.size else "" for k in chosen]
        header = ["parameter", *(f"{of}{when}" for when in at for of in ("first", "total"))]
        rows = [
            [name, *(f"{share[j, k]:.3f}" for k in chosen for share in both)]
            for j, name in enumerate(self.parameters)
        ]
        count = self.positions.size
        which = "all its entries" if count > 1 else f"entry {self.positions.ravel()[0]}"
        title = f"Sobol indices of {self.name}, shares of the variance of {which}"
        return Table(title, header, rows)

    def _variables(self) -> Variables:
        axes = ("entry", "parameter", "time") if self.times.size else ("entry", "parameter")
        labels = {"entry": self.positions.ravel(), "parameter": list(self.parameters)}
        clock = {"time": self.times} if self.times.size else {}

        def flat(array: Array) -> Array:
            return array.reshape(self.positions.size, *array.shape[self.positions.ndim :])

        arrays = {
            "first": (axes, flat(self.first)),
            "total": (axes, flat(self.total)),
            "variance": (axes[:1] + axes[2:], flat(self.variance)),
            "first_half_width": (axes, flat(self.first_half_width)),
            "total_half_width": (axes, flat(self.total_half_width)),
        }
        return Variables(arrays, {**labels, **clock})


class SobolByUnknown(dict[str, FieldSobol]):
    """Sobol indices for each unknown, by its name or its symbol."""

    def __missing__(self, unknown: object) -> FieldSobol:
        name = name_of(unknown)
        if isinstance(unknown, str) or name not in self:
            raise EvaluationError(
                f"no unknown {quote(name)}{did_you_mean(name, self)}; there are indices of "
                f"{listing(self)}",
                term=unknown,
            )
        return self[name]


def variances(weights: Array, covariance: Array) -> Array:
    """The diagonal (m, ...) of ``W C W^T`` for W (m, r) and covariances C (r, r, ...)."""
    stacked = covariance.reshape(*covariance.shape[:2], -1)
    diagonal = np.empty((len(weights), stacked.shape[2]))
    for k in range(stacked.shape[2]):
        diagonal[:, k] = np.einsum("mi,mi->m", weights @ stacked[:, :, k], weights)
    shape = covariance.shape[2:]
    return np.maximum(diagonal, 0.0).reshape(len(weights), *shape)  # negative by rounding alone


def covariances(weights: Array, covariance: Array) -> Array:
    """``W C W^T`` (m, m, ...) for few entries; an EvaluationError for many."""
    count = math.prod(covariance.shape[2:]) * len(weights) ** 2
    if count > _MOST_COVARIANCES:
        raise EvaluationError(
            f"covariances of {len(weights)} entries with each other are {count:.2g} numbers",
            remedy="choose entries, solution[u][[3, 17]].cov(t), or ask for .var(t)",
        )
    pairs = np.einsum("mi,ij...,nj->mn...", weights, covariance, weights, optimize=True)
    return np.asarray(pairs)


@dataclass(frozen=True, eq=False)
class EntryStatistics:
    """Statistics of some entries of an unknown that take more than means and covariances.

    ``own`` are its coefficients among the unknowns of their solution, ``weights`` (m, r) the modes
    at the entries, and ``error`` the absolute error of the field.
    """

    coefficients: StatisticsOverBox
    own: slice
    weights: Array
    error: float

    def sobol(
        self, t: Times, under: Under, correlation: Correlations
    ) -> tuple[Array, Array, Sequence[Array]]:
        """Times (times,), variances (m, times), and indices with their half-widths.

        The last are ``first, total, first_half_width, total_half_width``, (m, parameters, times)
        each; without times if nothing depends on time.
        """
        statistics = self.coefficients._statistics(under, correlation)
        statistics.parameters.require_independent(
            "Sobol indices are not defined for correlated parameters: their shares of the variance "
            "overlap",
            remedy="leave out the correlation (correlation={} if the problem has it)",
        )
        checked = self.coefficients._times(t)
        if checked.ndim > 1:
            raise OptionError("times have more than one dimension", term=t, remedy="give a list")
        times = np.atleast_1d(checked)
        own = (self.own, self.own)
        variance = variances(self.weights, statistics.covariance(times)[own])
        shares = [self._shares(statistics.first_covariances(times), variance)]
        shares.append(self._shares(statistics.total_covariances(times), variance))
        arrays = [index for index, _ in shares] + [width for _, width in shares]
        if t is None:
            return np.empty(0), variance[..., 0], [array[..., 0] for array in arrays]
        return times, variance, arrays

    def _shares(self, parts: Array, variance: Array) -> tuple[Array, Array]:
        """Indices of covariances (parameters, R, R, times), and their half-widths."""
        shares = np.empty((len(self.weights), len(parts), variance.shape[-1]))
        for j, part in enumerate(parts):
            shares[:, j] = variances(self.weights, part[self.own, self.own])
        spread = np.sqrt(variance)
        error = max(np.nan_to_num(self.error), ACCUMULATED * spread.max(initial=0.0))
        with np.errstate(all="ignore"):
            shares /= np.where(spread > error, variance, np.nan)[:, None]
            ratio = (error / spread)[:, None]
            return shares, changed_shares(shares, np.broadcast_to(ratio, shares.shape))

    def quantiles(
        self, q: ArrayLike, t: Times, under: Under, correlation: Correlations, count: int
    ) -> Quantiles:
        """Quantiles (*shape of q, m, *shape of t) with half-widths."""
        probabilities = checked_probabilities(q)
        count = checked_count("count", count, 1, 3 * len(self.weights))
        statistics = self.coefficients._statistics(under, correlation)
        points = statistics.parameters.sets_of_points(count)
        rows = np.array(self.coefficients.metadata.unknown_rows)[self.own]
        flat = probabilities.ravel()

        def of(states: Array) -> Array:
            blocks = [quantiles_of(block @ states, flat) for block in self._blocks(points.shape[1])]
            return np.concatenate(blocks, axis=2)

        def of_times(times: Array) -> Array:
            return statistics.over_points(times, points, of, rows.tolist())

        both = self.coefficients._at(t, of_times)
        table, half_width = both.reshape(2, *probabilities.shape, *both.shape[2:])
        return Quantiles(table, half_width)

    def _blocks(self, points: int) -> Iterator[Array]:
        """Rows of the weights whose values at all points fit in memory together."""
        step = max(AT_ONCE // points, 1)
        starts = range(0, max(len(self.weights), 1), step)
        return (self.weights[start : start + step] for start in starts)
