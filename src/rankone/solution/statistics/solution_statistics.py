"""Statistics of states at given times, and how certain shares of the variance are."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple, TypeVar

import numpy as np

from rankone.solution.statistics.moments import ConditionalMoments, HigherMoments, TrainMoments
from rankone.support.arrays import ACCUMULATED, Array, Labelled, Table, Variables
from rankone.support.budget import StepReport
from rankone.support.errors import quote, warn
from rankone.tensors.joint_distribution import SETS, JointDistribution, share_of
from rankone.tensors.slab import SlabTrain

_Moments = TypeVar("_Moments")


class Effect(NamedTuple):
    """Means given one parameter, (states, points, times), and what is known of their errors.

    ``half_widths`` are those of 95 %, and ``relative`` is the largest in standard deviations.
    ``running`` is the least share of the trajectories that have not ended.
    """

    means: Array
    half_widths: Array
    relative: float = 0.0
    running: float = 1.0


def quiet(done: int, total: int) -> None:
    """Ignore progress."""


def warn_of_ends(running: float) -> None:
    """Warn if some trajectories alone still run at some time."""
    if running < 1.0:
        warn(
            f"statistics are over the trajectories that are still running: {100 * running:.3g} % "
            "of the box at the latest time",
            remedy="ask for earlier times, or for what is left by `end`",
        )


POINTS_AT_ONCE = 2**14  # Points that are evaluated together, to bound memory
_SLABS_REMEMBERED = 4  # Latest slabs whose moments may serve a later slab that shares their cores
# Spread over error above which the error changes shares of the variance by 4 % at most
_CLEAR_RATIO = 5.0


@dataclass(frozen=True, repr=False)
class Sobol(Labelled):
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
        Share that remains if all other parameters are known.
    second : ndarray (unknowns, parameters, parameters, times)
        Share of the interaction of two parameters, beyond what they explain alone; symmetric, with
        zeros for a parameter and itself.
    first_half_width, total_half_width, second_half_width : ndarray
        Half-widths of 95 % of each index: what the measured error of the solution may change it by,
        and with events the error of the points.
    """

    parameters: tuple[str, ...]
    unknowns: tuple[str, ...]
    times: Array
    first: Array
    total: Array
    second: Array
    first_half_width: Array
    total_half_width: Array
    second_half_width: Array

    def _table(self) -> Table:
        """Shares at the times, or at the first, the middle and the last of many."""
        timeless = self.first.ndim < 3
        count = 1 if timeless else self.first.shape[2]
        chosen = range(count) if count <= 3 else (0, count // 2, count - 1)
        at = [""] if timeless else [f" at {self.times[k]:.4g}" for k in chosen]
        header = ["unknown", "parameter", *(f"{of}{t}" for t in at for of in ("first", "total"))]
        rows = []
        for i, unknown in enumerate(self.unknowns):
            for j, parameter in enumerate(self.parameters):
                shares = np.stack([self.first[i, j], self.total[i, j]]).reshape(2, count)
                cells = [f"{share:.3f}" for k in chosen for share in shares[:, k]]
                rows.append([unknown, parameter, *cells])
        many = "" if len(chosen) == count else f" at {count} times"
        widest = max(
            float(np.nanmax(width, initial=0.0))
            for width in (self.first_half_width, self.total_half_width)
        )
        title = f"Sobol indices of {', '.join(self.unknowns)}{many}"
        return Table(title, header, rows, [f"each to {widest:.1g} or better, at 95 %"], labels=2)

    def _variables(self) -> Variables:
        axes = ("unknown", "parameter", "time")[: self.first.ndim]
        pairs = ("unknown", "parameter", "other", "time")[: self.second.ndim]
        labels = {"unknown": list(self.unknowns), "parameter": list(self.parameters)}
        labels["other"] = list(self.parameters)
        clock = {"time": self.times} if "time" in axes else {}
        arrays = {
            "first": (axes, self.first),
            "total": (axes, self.total),
            "second": (pairs, self.second),
            "first_half_width": (axes, self.first_half_width),
            "total_half_width": (axes, self.total_half_width),
            "second_half_width": (pairs, self.second_half_width),
        }
        return Variables(arrays, {**labels, **clock})


@dataclass(frozen=True, repr=False)
class MainEffects(Labelled):
    """Means of the unknowns given one parameter.

    Attributes
    ----------
    parameters, unknowns : tuple of str
    times : ndarray
        As they were given; none if nothing depends on time.
    values : dict of str to ndarray (count,)
        Values of each parameter, from one end of its interval to the other.
    means : dict of str to ndarray (unknowns, count, *shape of the times)
    half_widths : dict of str to ndarray (unknowns, count, *shape of the times)
        Half-widths of 95 % of the means, zero where nothing is sampled.
    """

    parameters: tuple[str, ...]
    unknowns: tuple[str, ...]
    times: Array
    values: dict[str, Array]
    means: dict[str, Array]
    half_widths: dict[str, Array]

    @property
    def _stacked(self) -> tuple[Array, Array]:
        """Values (parameters, count) and means (parameters, unknowns, count, times)."""
        if not self.parameters:
            return np.zeros((0, 0)), np.zeros((0, len(self.unknowns), 0, 0))
        values = np.stack([self.values[name] for name in self.parameters])
        means = np.stack([self.means[name] for name in self.parameters])
        return values, means.reshape(*means.shape[:3], -1)

    def _table(self) -> Table:
        """Means at the ends of each interval and in its middle, at the first and the last time."""
        values, means = self._stacked
        count, clock = values.shape[1], self.times.ravel()
        chosen = list(dict.fromkeys((0, count // 2, count - 1)))
        rows = []
        for i, unknown in enumerate(self.unknowns):
            for j, parameter in enumerate(self.parameters):
                for k in dict.fromkeys((0, means.shape[-1] - 1)):
                    pairs = zip(values[j, chosen], means[j, i, chosen, k], strict=True)
                    cells = [f"{mean:.5g} at {value:.4g}" for value, mean in pairs]
                    when = f"{clock[k]:.4g}" if clock.size else ""
                    rows.append([unknown, parameter, when, *cells])
        header = ["unknown", "parameter", "time", "lower", "middle", "upper"]
        if len(chosen) < 3:
            header.remove("middle")
        summary = f"Means of {', '.join(self.unknowns)} given one parameter"
        return Table(summary, header, rows, labels=2)

    def _variables(self) -> Variables:
        values, means = self._stacked
        axes: tuple[str, ...] = ("parameter", "unknown", "position", "time")
        labels: dict[str, Any] = {
            "parameter": list(self.parameters),
            "unknown": list(self.unknowns),
            "position": np.linspace(0.0, 1.0, values.shape[1]),
            "time": self.times.ravel(),
        }
        if not self.times.size:
            axes, means = axes[:3], means[..., 0]
            del labels["time"]
        spread = (slice(None), None, slice(None), None)[: means.ndim]
        every = np.broadcast_to(values[spread], means.shape)
        return Variables({"mean": (axes, means), "value": (axes, every)}, labels)


@dataclass(frozen=True)
class VarianceParts:
    """The variances (states, times) of states, and their parts of first order, total and second.

    ``parts`` are (states, parameters, times), the last (states, parameters, parameters, times), and
    ``half_widths`` those of 95 % of their shares, times the variance. ``doubts`` are sentences.
    """

    variance: Array
    parts: tuple[Array, Array, Array]
    half_widths: tuple[Array, Array, Array]
    doubts: tuple[str, ...] = ()


class Statistics:
    """Moments of the states ``rows`` of consecutive slabs.

    Means, covariances and points know correlations; other statistics need independence. ``report``
    is called while statistics that take points are computed.
    """

    report: StepReport = staticmethod(quiet)

    def __init__(
        self, slabs: Sequence[SlabTrain], rows: Sequence[int], parameters: JointDistribution
    ) -> None:
        self.slabs, self.rows, self.parameters = slabs, list(rows), parameters
        self._starts = np.array([slab.start for slab in slabs[1:]])

    @cached_property
    def _moments(self) -> list[TrainMoments]:
        moments = TrainMoments if self.parameters.copula is None else ConditionalMoments
        return self._of_slabs(lambda slab: moments(slab, self.parameters))

    def _of_slabs(self, moments_of: Callable[[SlabTrain], _Moments]) -> list[_Moments]:
        """Moments of each slab; those that share their cores share them."""
        latest: list[tuple[SlabTrain, _Moments]] = []
        moments = []
        for slab in self.slabs:
            shared = next((m for other, m in latest if slab.shares_parameters(other)), None)
            if shared is None:
                shared = moments_of(slab)
                latest = [*latest[1 - _SLABS_REMEMBERED :], (slab, shared)]
            moments.append(shared)
        return moments

    def mean(self, times: Array) -> Array:
        """Means, (states, times)."""
        return self._gathered(times, self._moments, lambda rows, moments: rows @ moments.mean)

    def covariance(self, times: Array) -> Array:
        """Covariances, (states, states, times)."""
        covariances = self._covariances(times, lambda moments: moments.covariance)
        return np.asarray(covariances[0])

    def variance(self, times: Array) -> Array:
        """Variances, (states, times)."""
        return self._squares(times, lambda moments: moments.covariance)[:, 0]

    def root_mean_squares(self, times: Array) -> Array:
        """Sizes of the states, (states, times)."""
        return np.hypot(self.mean(times), np.sqrt(self.variance(times)))

    def first(self, times: Array) -> Array:
        """Variances of the means given one parameter, (states, parameters, times)."""
        return self._squares(times, lambda moments: moments.first)

    def total(self, times: Array) -> Array:
        """Means of the variance over one parameter, (states, parameters, times)."""
        return self._squares(times, lambda moments: moments.total)

    def first_covariances(self, times: Array) -> Array:
        """Covariances of the means given one parameter, (parameters, states, states, times)."""
        return self._covariances(times, lambda moments: moments.first)

    def total_covariances(self, times: Array) -> Array:
        """Means of the covariance over one parameter, (parameters, states, states, times)."""
        return self._covariances(times, lambda moments: moments.total)

    def second(self, times: Array) -> Array:
        """Variances of interactions, (states, parameters, parameters, times)."""
        count = len(self.parameters.measures)
        variances = np.zeros((len(self.rows), count, count, times.size))
        i, j = np.triu_indices(count, 1)
        pairs = self._squares(times, lambda moments: moments.second)
        variances[:, i, j] = variances[:, j, i] = pairs
        return variances

    def variance_parts(self, times: Array, count: int | None, report: StepReport) -> VarianceParts:
        """The variance and its parts; ``count`` is of points where any are taken."""
        shares = self.first(times), self.total(times), self.second(times)
        first, total, second = map(np.zeros_like, shares)
        return VarianceParts(self.variance(times), shares, (first, total, second))

    def effect(self, times: Array, j: int, points: Array) -> Effect:
        """Means given one parameter at some of its values."""
        means = self.main_effect(times, j, points)
        return Effect(means, np.zeros_like(means))

    def main_effect(self, times: Array, j: int, points: Array) -> Array:
        """Means given one parameter, (states, points, times)."""

        def of_slab(rows: Array, moments: TrainMoments) -> Array:
            return (rows @ moments.main_effect(j, points)).swapaxes(1, 2)

        return self._gathered(times, self._moments, of_slab)

    def higher(self, times: Array, central: bool, tolerance: float) -> Array:
        """Root mean squares, and third and fourth moments over their powers, (3, states, times).

        Where nothing but rounding varies these are NaN.
        """
        slab_moments = self._of_slabs(
            lambda slab: HigherMoments(slab, self.parameters, central, tolerance)
        )

        def of_slab(rows: Array, moments: HigherMoments) -> Array:
            return moments(rows.reshape(-1, rows.shape[2])).reshape(3, *rows.shape[:2])

        table = self._gathered(times, slab_moments, of_slab)
        firsts = (slab.cores[0][self.rows] for slab in self.slabs)
        pairs = zip(slab_moments, firsts, strict=True)
        sizes = np.max([moments.sizes(first) for moments, first in pairs], axis=0)
        still = table[0] <= ACCUMULATED * sizes[:, None]
        table[1:, still] = np.nan
        return table

    def quantiles(self, times: Array, probabilities: Array, count: int) -> tuple[Array, Array]:
        """Quantiles of values at evenly spread points, (probabilities, states, times).

        After them the half-widths of 95 % of their probabilities, of the same shape.
        """
        points = self.parameters.sets_of_points(count)
        both = self.over_points(times, points, lambda states: quantiles_of(states, probabilities))
        return both[0], both[1]

    def at_points(self, time: float, points: Array, row: int) -> Array:
        """One state at one time and points (d, N), NaN where it has ended."""
        return self.over_points(np.array([time]), points, lambda states: states[0], [row])[:, 0]

    def over_points(
        self,
        times: Array,
        points: Array,
        of: Callable[[Array], Array],
        rows: Sequence[int] | None = None,
    ) -> Array:
        """A function of values (states, points) of arrays of numbers, (..., times).

        The values are NaN at points that have ended. ``rows`` selects other states than the
        statistics have.
        """
        rows = self.rows if rows is None else list(rows)
        owner = np.searchsorted(self._starts, times, side="right")
        columns: list[Array] = [np.empty(0)] * times.size
        products, latest = np.zeros((0, 0)), None
        for k in np.unique(owner):
            slab = self.slabs[k]
            if latest is None or not slab.shares_parameters(latest):
                starts = range(0, points.shape[1], POINTS_AT_ONCE)
                blocks = (points[:, start : start + POINTS_AT_ONCE] for start in starts)
                products, latest = np.hstack([slab.over_parameters(b) for b in blocks]), slab
            for i in np.flatnonzero(owner == k):
                columns[i] = of(slab.on_grid(times[i : i + 1], products)[rows, :, 0])
        if not columns:
            shape = of(np.zeros((len(rows), points.shape[1]))).shape
            return np.empty((*shape, 0))
        return np.stack(columns, axis=-1)

    def _squares(self, times: Array, matrices: Callable[[TrainMoments], Array]) -> Array:
        """``a(t) P a(t)^T`` for several matrices, (states, matrices, times)."""

        def of_slab(rows: Array, moments: TrainMoments) -> Array:
            n, count, rank = rows.shape
            flat = rows.reshape(-1, rank)
            squares = np.einsum("pnr,nr->pn", flat @ matrices(moments), flat)
            squares = np.maximum(squares, 0.0)  # negative by rounding alone
            return np.asarray(squares.reshape(len(squares), n, count).swapaxes(0, 1))

        return self._gathered(times, self._moments, of_slab)

    def _covariances(self, times: Array, matrices: Callable[[TrainMoments], Array]) -> Array:
        """``a(t) P a(t)^T`` for several matrices and all states, (matrices, states, states, times).

        A row a(t) stands for each state.
        """

        def of_slab(rows: Array, moments: TrainMoments) -> Array:
            by_time = rows.swapaxes(0, 1)
            products = by_time @ matrices(moments)[:, None] @ by_time.swapaxes(1, 2)
            return np.asarray(np.moveaxis(products, 1, 3))

        return self._gathered(times, self._moments, of_slab)

    def _gathered(
        self,
        times: Array,
        slab_moments: Sequence[_Moments],
        of_slab: Callable[[Array, _Moments], Array],
    ) -> Array:
        """A function of rows (states, times, r_1) and moments of their slab, (..., times)."""
        owner = np.searchsorted(self._starts, times, side="right")
        table = np.empty(0)
        for k in np.unique(owner) if times.size else [0]:
            here = owner == k
            columns = of_slab(self.slabs[k].in_time(times[here])[self.rows], slab_moments[k])
            if not table.ndim > 1:
                table = np.empty((*columns.shape[:-1], times.size))
            table[..., here] = columns
        return table


def quantiles_of(states: Array, probabilities: Array) -> Array:
    """Quantiles of states (rows, N), and half-widths of their probabilities, (2, P, rows)."""
    sets = np.sort(states.reshape(len(states), SETS, -1), axis=2)  # NaN come last
    runs = np.isfinite(states[0])
    values = np.quantile(states[:, runs], probabilities, axis=1)
    below = np.array(
        [
            [np.searchsorted(own, column, side="right") for own in of_sets]
            for of_sets, column in zip(sets, values.T, strict=True)
        ],
        dtype=float,
    )
    running = runs.reshape(SETS, -1).sum(axis=1)
    *_, half_widths = share_of(below.transpose(2, 0, 1), running)
    return np.stack([values, half_widths])


def changed_shares(shares: Array, ratio: Array) -> Array:
    """By how much an error changes shares of the variance at most.

    ``ratio`` is the error over the standard deviation. By the triangle inequality the root of a
    part and that of the variance change by the error at most.
    """
    largest = (np.sqrt(np.maximum(shares, 0.0)) + ratio) / (1.0 - ratio)
    return np.asarray(np.minimum(largest**2, 1.0) - np.minimum(shares, 1.0))


def doubtful_shares(
    unknowns: Sequence[str], times: Array, spread: Array, sizes: Array, errors: Array
) -> Iterator[str]:
    """For each unknown a sentence on times at which its shares of the variance are not certain.

    ``spread`` (unknowns, times) are standard deviations over the box; an unknown that does not vary
    at all does not count. ``sizes`` and ``errors`` are largest values and absolute errors. Times
    are NaN where nothing depends on time.
    """
    for name, row, size, error in zip(unknowns, spread, sizes, errors, strict=True):
        varies = row > ACCUMULATED * size
        hidden = varies & (row <= error)
        vague = varies & (row > error) & (row < _CLEAR_RATIO * error)
        if hidden.any():
            yield (
                f"the Sobol indices of {quote(name)} are NaN{when(times[hidden])}: its spread "
                f"over the box, {row[hidden].max():.2g}, is below the error of the solution, "
                f"{error:.2g}"
            )
        if vague.any():
            yield (
                f"the Sobol indices of {quote(name)} are uncertain{when(times[vague])}: its "
                f"spread over the box is {row[vague].min():.2g}, and the error of the solution "
                f"{error:.2g}"
            )


def when(times: Array) -> str:
    """Some times, by their ends."""
    if np.isnan(times).any():
        return ""
    if times.size == 1:
        return f" at t = {times[0]:.4g}"
    return f" at {times.size} times between t = {times.min():.4g} and {times.max():.4g}"
