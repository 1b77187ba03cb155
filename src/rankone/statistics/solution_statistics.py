"""Statistics of all states at given times."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from rankone.arrays import Array
from rankone.coordinates import name_of
from rankone.errors import OptionError
from rankone.solvers.reference import spread
from rankone.statistics.measures import Measure
from rankone.statistics.moments import TrainMoments
from rankone.tensors.slab import SlabTrain
from rankone.wording import did_you_mean, listing, quote

__all__ = ["Sobol", "Statistics", "measures_of"]


@dataclass(frozen=True)
class Sobol:
    """Variance-based sensitivities as functions of time.

    Where the variance vanishes they are not defined (NaN).

    Attributes
    ----------
    parameters, unknowns : tuple of str
    times : ndarray (times,)
        Without any, if nothing depends on time, the shapes below end before them.
    first : ndarray (unknowns, parameters, times)
        Share of the variance that one parameter explains alone.
    total : ndarray (unknowns, parameters, times)
        Share that is left if all others are known.
    second : ndarray (unknowns, parameters, parameters, times)
        Share of the interaction of two parameters, beyond what they explain alone; symmetric, with
        zeros for a parameter and itself.
    """

    parameters: tuple[str, ...]
    unknowns: tuple[str, ...]
    times: Array
    first: Array
    total: Array
    second: Array


def measures_of(
    names: Sequence[str],
    box: Sequence[tuple[float, float]],
    under: Mapping[Any, Any] | None,
    usual: Mapping[str, Any],
) -> list[Measure]:
    """The measure of each parameter: as given, the usual one, or else uniform.

    Raises
    ------
    OptionError
        If there is no such parameter, or a distribution does not fit its interval.
    """
    given: dict[str, Any] = {}
    if not isinstance(under, Mapping | None):
        raise OptionError(
            f"under={under!r} is not a mapping from parameters to distributions", term=under
        )
    for key, distribution in (under or {}).items():
        name = name_of(key)
        if name not in names:
            raise OptionError(
                f"there is no parameter {quote(name)}{did_you_mean(name, names)}",
                term=name,
                remedy=f"known are {listing(names)}",
            )
        if name in given:
            raise OptionError(f"{quote(name)} is given twice", term=name)
        given[name] = distribution
    return [
        Measure(name, lower, upper, given.get(name, usual.get(name)))
        for name, (lower, upper) in zip(names, box, strict=True)
    ]


class Statistics:
    """Moments of the states of consecutive slabs.

    Parameters
    ----------
    slabs : sequence of SlabTrain
    rows : sequence of int
        The states that are asked for.
    measures : sequence of Measure
    """

    def __init__(
        self, slabs: Sequence[SlabTrain], rows: Sequence[int], measures: Sequence[Measure]
    ) -> None:
        self.slabs, self.rows, self.measures = slabs, list(rows), measures
        self._starts = np.array([slab.start for slab in slabs[1:]])

    @cached_property
    def _moments(self) -> list[TrainMoments]:
        """Of each slab; those that share their cores share them."""
        known: list[tuple[SlabTrain, TrainMoments]] = []
        found = []
        for slab in self.slabs:
            same = (moments for other, moments in known if slab.shares_parameters(other))
            moments = next(same, None)
            if moments is None:
                moments = TrainMoments(slab.cores[1:], slab.bases, self.measures)
                known = [*known[-3:], (slab, moments)]
            found.append(moments)
        return found

    def mean(self, times: Array) -> Array:
        """Means, (states, times)."""
        return self._gathered(times, lambda rows, moments: rows @ moments.mean)

    def covariance(self, times: Array) -> Array:
        """Covariances, (states, states, times)."""

        def of_slab(rows: Array, moments: TrainMoments) -> Array:
            parts = rows, moments.covariance[0], rows
            return np.asarray(np.einsum("ntr,rs,mts->nmt", *parts, optimize=True))

        return self._gathered(times, of_slab)

    def variance(self, times: Array) -> Array:
        """Variances, (states, times)."""
        return self._squares(times, lambda moments: moments.covariance)[:, 0]

    def first(self, times: Array) -> Array:
        """Variances of the means given one parameter, (states, parameters, times)."""
        return self._squares(times, lambda moments: moments.first)

    def total(self, times: Array) -> Array:
        """Means of the variance over one parameter, (states, parameters, times)."""
        return self._squares(times, lambda moments: moments.total)

    def second(self, times: Array) -> Array:
        """Variances of interactions, (states, parameters, parameters, times)."""
        count = len(self.measures)
        found = np.zeros((len(self.rows), count, count, times.size))
        i, j = np.triu_indices(count, 1)
        found[:, i, j] = found[:, j, i] = self._squares(times, lambda moments: moments.second)
        return found

    def quantiles(self, times: Array, probabilities: Array, count: int) -> Array:
        """Quantiles of values at evenly spread points, (probabilities, states, times)."""
        generator = np.random.default_rng(20144)
        shares = spread(count, len(self.measures), generator).T
        points = np.array([m.sample(row) for m, row in zip(self.measures, shares, strict=True)])
        points = points.reshape(len(self.measures), count)
        owner = np.searchsorted(self._starts, times, side="right")
        found = np.empty((probabilities.size, len(self.rows), times.size))
        carry, last = np.zeros((0, 0)), None
        for k in np.unique(owner):
            slab = self.slabs[k]
            if last is None or not slab.shares_parameters(last):
                carry, last = slab.over_parameters(points), slab
            for place in np.flatnonzero(owner == k):
                values = slab.on_grid(times[place : place + 1], carry)[self.rows, :, 0]
                found[:, :, place] = np.quantile(values, probabilities, axis=1)
        return found

    def _squares(self, times: Array, matrices: Callable[[TrainMoments], Array]) -> Array:
        """``a(t) P a(t)^T`` for several matrices, (states, matrices, times)."""

        def of_slab(rows: Array, moments: TrainMoments) -> Array:
            n, count, rank = rows.shape
            flat = rows.reshape(-1, rank)
            values = np.einsum("pnr,nr->pn", flat @ matrices(moments), flat)
            values = np.maximum(values, 0.0)  # but for rounding it is
            return np.asarray(values.reshape(len(values), n, count).swapaxes(0, 1))

        return self._gathered(times, of_slab)

    def _gathered(self, times: Array, of_slab: Callable[[Array, TrainMoments], Array]) -> Array:
        """What is found on each slab for its times, (..., times)."""
        owner = np.searchsorted(self._starts, times, side="right")
        found = np.empty(0)
        for k in np.unique(owner) if times.size else [0]:
            here = owner == k
            rows = self.slabs[k].in_time(times[here])[self.rows]
            values = of_slab(rows, self._moments[k])
            if not found.ndim > 1:
                found = np.empty((*values.shape[:-1], times.size))
            found[..., here] = values
        return found
