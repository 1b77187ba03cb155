"""Statistics of all states at given times."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, TypeVar

import numpy as np

from rankone.discretization import Basis1D
from rankone.discretization.coordinates import name_of
from rankone.statistics.conditional import ConditionalMoments
from rankone.statistics.copula import Copula
from rankone.statistics.higher import HigherMoments
from rankone.statistics.measures import Measure
from rankone.statistics.moments import TrainMoments
from rankone.support.arrays import Array
from rankone.support.errors import OptionError
from rankone.support.spread import spread
from rankone.support.wording import did_you_mean, listing, quote
from rankone.tensors.slab import SlabTrain

__all__ = ["Sobol", "Statistics", "measures_of"]

_Made = TypeVar("_Made")

_BLOCK = 2**14
"""Points that are evaluated at once."""
_CONSTANT = 1e-13
"""Standard deviation, relative to the size of a state, below which it is rounding."""


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
        Measure(name, lower, upper, given.get(name, usual.get(name)), name not in given)
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
    copula : Copula, optional
        Of parameters that are correlated; means, covariances and points know it.
    """

    def __init__(
        self,
        slabs: Sequence[SlabTrain],
        rows: Sequence[int],
        measures: Sequence[Measure],
        copula: Copula | None = None,
    ) -> None:
        self.slabs, self.rows, self.measures = slabs, list(rows), measures
        self.copula = copula
        self._starts = np.array([slab.start for slab in slabs[1:]])

    @cached_property
    def _moments(self) -> list[TrainMoments]:
        """Of each slab; those that share their cores share them."""
        copula = self.copula
        if copula is None:
            return self.of_slabs(lambda slab: TrainMoments(*self._train(slab)))
        return self.of_slabs(lambda slab: ConditionalMoments(*self._train(slab), copula))

    def _train(self, slab: SlabTrain) -> tuple[Sequence[Array], Sequence[Basis1D], list[Measure]]:
        return slab.cores[1:], slab.bases, list(self.measures)

    def of_slabs(self, make: Callable[[SlabTrain], _Made]) -> list[_Made]:
        """What is made of each slab; those that share their cores share it."""
        known: list[tuple[SlabTrain, _Made]] = []
        found = []
        for slab in self.slabs:
            same = [made for other, made in known if slab.shares_parameters(other)]
            made = same[0] if same else make(slab)
            if not same:
                known = [*known[-3:], (slab, made)]
            found.append(made)
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

        def of(values: Array) -> Array:
            return np.quantile(values, probabilities, axis=1)

        return self.over_points(times, self.points(count), of)

    def points(self, count: int, seed: int = 20144) -> Array:
        """Evenly spread values of the parameters, (parameters, count)."""
        generator = np.random.default_rng(seed)
        return self.at_shares(spread(count, len(self.measures), generator).T)

    def at_shares(self, shares: Array) -> Array:
        """Values of the parameters at independent shares of their probability, (d, count)."""
        if self.copula is not None:
            shares = self.copula.joined(shares)
        points = [m.sample(row) for m, row in zip(self.measures, shares, strict=True)]
        return np.array(points).reshape(len(self.measures), shares.shape[1])

    def over_points(
        self,
        times: Array,
        points: Array,
        of: Callable[[Array], Array],
        rows: Sequence[int] | None = None,
    ) -> Array:
        """A function of values (states, points) of arrays of numbers, (..., times).

        ``rows`` are other states than those that are asked for.
        """
        rows = self.rows if rows is None else list(rows)
        owner = np.searchsorted(self._starts, times, side="right")
        found = np.empty((*of(np.zeros((len(rows), points.shape[1]))).shape, times.size))
        carry, last = np.zeros((0, 0)), None
        for k in np.unique(owner):
            slab = self.slabs[k]
            if last is None or not slab.shares_parameters(last):
                parts = (points[:, i : i + _BLOCK] for i in range(0, points.shape[1], _BLOCK))
                carry, last = np.hstack([slab.over_parameters(part) for part in parts]), slab
            for place in np.flatnonzero(owner == k):
                found[..., place] = of(slab.on_grid(times[place : place + 1], carry)[rows, :, 0])
        return found

    def higher(self, times: Array, central: bool, tolerance: float) -> Array:
        """Root mean squares, and third and fourth moments over their powers, (3, states, times).

        Where nothing but rounding varies these are NaN.
        """
        makers = self.of_slabs(lambda slab: HigherMoments(*self._train(slab), central, tolerance))

        def of_slab(rows: Array, moments: HigherMoments) -> Array:
            return moments(rows.reshape(-1, rows.shape[2])).reshape(3, *rows.shape[:2])

        found = self.gathered(times, makers, of_slab)
        firsts = (slab.cores[0][self.rows] for slab in self.slabs)
        pairs = zip(makers, firsts, strict=True)
        sizes = np.max([moments.sizes(first) for moments, first in pairs], axis=0)
        still = found[0] <= _CONSTANT * sizes[:, None]
        found[1:, still] = np.nan
        return found

    def main_effect(self, times: Array, j: int, points: Array) -> Array:
        """Means given one parameter, (states, points, times)."""

        def of_slab(rows: Array, moments: TrainMoments) -> Array:
            return (rows @ moments.main_effect(j, points)).swapaxes(1, 2)

        return self._gathered(times, of_slab)

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
        return self.gathered(times, self._moments, of_slab)

    def gathered(
        self,
        times: Array,
        of_slabs: Sequence[_Made],
        found_of: Callable[[Array, _Made], Array],
    ) -> Array:
        """What is found of rows (states, times, r_1) and of what is made of their slabs."""
        owner = np.searchsorted(self._starts, times, side="right")
        found = np.empty(0)
        for k in np.unique(owner) if times.size else [0]:
            here = owner == k
            rows = self.slabs[k].in_time(times[here])[self.rows]
            values = found_of(rows, of_slabs[k])
            if not found.ndim > 1:
                found = np.empty((*values.shape[:-1], times.size))
            found[..., here] = values
        return found
