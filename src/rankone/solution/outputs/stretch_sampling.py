"""Values of quantities of a solution with events, over the stretches between them."""

from __future__ import annotations

import copy
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from rankone.compiler.codegen.layout import Border, Kind, Quantities, Reduction
from rankone.solution.outputs.sampling import Sampler
from rankone.support.arrays import Array
from rankone.support.budget import charge
from rankone.support.costs import CALL
from rankone.tensors.evaluator import TrainEvaluator
from rankone.tensors.slab import differentiated
from rankone.tensors.time_grid import Polynomials, TimeGrid
from rankone.tensors.timeline_evaluator import TimelineEvaluator
from rankone.trajectories.system.timeline import CLOCK_STATES

_PLACE_COST, _SOURCE_COST = 160, 40  # Operations of a place on a stretch, and of a source there
_NUMBER_COST = 20  # Operations of a number of the functions of clock time
# Why an occurrence does not come before the end, and what tells its time where it does
_FEWER = (
    ": fewer of these events come before the end there than elsewhere in the box",
    ", or take `solution.event_times(...)` at points",
)


class StretchSampler(Sampler):
    """Quantities on a grid over pseudo-time: stretch i is [i, i + 1].

    For reductions stretches end with the horizon at the latest, so that those behind it have no
    length. Functions of time are held over whole stretches, and behind them the clock and the
    length of the stretch. The times of events are known to ``time_error``.
    """

    def __init__(
        self,
        evaluator: TimelineEvaluator,
        parameters: Sequence[str],
        quantities: Quantities,
        grid: TimeGrid,
        rtol: float,
        time_error: float,
    ) -> None:
        super().__init__(evaluator.slabs, parameters, quantities, grid, rtol)
        self.evaluator, self.rtol, self.time_error = evaluator, rtol, time_error
        self._trains = {order: TrainEvaluator(slabs) for order, slabs in self._orders.items()}
        self._clock_row = len(evaluator.slabs[0].cores[0]) - CLOCK_STATES
        free = {s.parameter for s in quantities.sources if s.parameter is not None}
        self._slopes = {j: TrainEvaluator(differentiated(evaluator.slabs, j)) for j in free}
        if free and 1 not in self._trains:
            self._trains[1] = TrainEvaluator([slab.derivative() for slab in evaluator.slabs])
        self._late = 0.0
        self._bordered = (np.empty(0),) * 3
        self._read_whole = np.empty(0), grid, np.empty(0)

    @property
    def span(self) -> tuple[float, float]:
        return self.evaluator.horizon

    def holds(self, points: Array) -> NDArray[np.bool_]:
        return self.evaluator.holds(np.ascontiguousarray(points.T))

    def clock(self, times: Array, points: Array) -> Array:
        return self._clock(np.broadcast_to(times[:, None], (times.size, len(points))), points)

    def _quantities(self, points: Array, sources: Array, shifts: Array | None) -> Array:
        sampled = super()._quantities(points, sources, shifts)
        if self.quantities.timeless:
            return sampled
        *_, clock, length = self._whole(points)
        return np.concatenate([sampled, clock[None], length[None]])

    def _kept(
        self, times: Array, sources: Array, points: Array, shifts: Array | None
    ) -> tuple[Array, Array]:
        if self.quantities.timeless:
            return times, sources
        *_, clock, _ = self._whole(points)
        whole = self._whole_sources(points)
        return clock, whole if shifts is None else whole + shifts[:, None, None]

    def _whole_sources(self, points: Array) -> Array:
        """Sources (sources, T, m) on the grid over whole stretches."""
        before, grid, sources = self._read_whole
        if points is not before or self.grid is not grid:  # a chunk needs them several times
            stretch, share, _, length = self._whole(points)
            sources = self._read(stretch, share, length, points)
            self._read_whole = points, self.grid, sources
        return sources

    def _whole(self, points: Array) -> tuple[NDArray[np.intp], Array, Array, Array]:
        """Stretches, shares, clock times and lengths (T, m) on the grid over whole stretches."""
        borders, _ = self._borders(points)
        times = np.broadcast_to(self.grid.times[:, None], (self.grid.times.size, len(points)))
        stretch = self._place(times)
        begin = np.take_along_axis(borders, stretch, axis=0)
        length = np.take_along_axis(borders, stretch + 1, axis=0) - begin
        share = times - stretch
        return stretch, share, begin + share * length, length

    def at_clock(self, times: Array, points: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Quantities (quantities, T, m) at clock times (T,), and where they count (T, m).

        They do not where the solution has ended, nor closer to a border than its error.
        """
        borders, _ = self._borders(points)
        at = np.broadcast_to(times[:, None], (times.size, len(points)))
        stretch = (borders[1:-1, None] <= at).sum(axis=0)
        begin = np.take_along_axis(borders, stretch, axis=0)
        length = np.take_along_axis(borders, stretch + 1, axis=0) - begin
        share = (at - begin) / np.where(length != 0.0, length, 1.0)
        clock, on_grid = self.clock(self.grid.times, points), self.sources(points)
        with np.errstate(all="ignore"):
            integrands = self.quantities.integrands(clock, on_grid, points.T)
            reduced = [
                self._running(reduction, points, None, stretch + share)
                if reduction.kind is Kind.RUNNING
                else self._reduced(reduction, integrands[reduction.integrand], points, None)
                for reduction in self.quantities.reductions
            ]
            sources = self._read(stretch, share, length, points)
            quantities = self.quantities.values(at, sources, points.T, reduced)
        away = np.abs(at - borders[1:-1, None]).min(axis=0, initial=np.inf) >= self._least_distance
        held = np.array([np.broadcast_to(each, at.shape) for each in quantities])
        return held, away & (at <= borders[-1])

    @property
    def _least_distance(self) -> float:
        """How far from a border of stretches values are compared at least."""
        start, end = self.evaluator.horizon
        return self.rtol * (end - start) + 2.0 * self.time_error

    def moved(self, points: Array) -> Array | None:
        later = copy.copy(self)  # without workers, who have the times as they are
        later._late = self.time_error
        return later(points)

    def _borders(self, points: Array) -> tuple[Array, Array]:
        """Clock times (stretches + 1, m) of borders, and the same within the horizon."""
        if points is not self._bordered[0]:  # a chunk needs them several times
            borders = self.evaluator.borders(np.ascontiguousarray(points.T))
            within = np.minimum(borders, self.evaluator.horizon[1]) if self._ends else borders
            self._bordered = points, borders, within
        return self._bordered[1:]

    @property
    def _ends(self) -> bool:
        """Whether stretches end with the horizon: other functions are held over whole ones."""
        return bool(self.quantities.reductions)

    def _place(self, times: Array) -> NDArray[np.intp]:
        """The stretch of each pseudo-time."""
        last = round(self.evaluator.slabs[-1].end) - 1
        return np.asarray(np.clip(np.floor(times), 0, last).astype(np.intp))

    def _clock(self, times: Array, points: Array) -> Array:
        """Clock times at pseudo-times (T, m)."""
        _, within = self._borders(points)
        stretch = self._place(times)
        begin = np.take_along_axis(within, stretch, axis=0)
        end = np.take_along_axis(within, stretch + 1, axis=0)
        return np.asarray(begin + (times - stretch) * (end - begin))

    def _states(self, times: Array, points: Array) -> Array:
        """Sources at pseudo-times (T, m): shape (sources, T, m)."""
        borders, within = self._borders(points)
        stretch = self._place(times)
        # behind the horizon the states are those at its end
        if self._ends:
            met = (within[1:-1] < self.evaluator.horizon[1]).sum(axis=0)
            stretch = np.minimum(stretch, met)
        begin = np.take_along_axis(borders, stretch, axis=0)
        length = np.take_along_axis(borders, stretch + 1, axis=0) - begin
        share = (self._clock(times, points) - begin) / np.where(length != 0.0, length, 1.0)
        ends = np.take_along_axis(within, stretch + 1, axis=0)
        whole = (ends == begin + length) & (length != 0.0) & (stretch == self._place(times))
        return self._read(stretch, np.where(whole, times - stretch, share), length, points)

    def _read(self, stretch: NDArray[np.intp], share: Array, length: Array, points: Array) -> Array:
        """Sources in stretches, at shares of them."""
        count = len(self.quantities.sources)
        charge(20 * CALL + (_PLACE_COST + count * _SOURCE_COST) * stretch.size)
        last = np.nextafter(stretch + 1.0, 0.0)
        pseudo = np.clip(stretch + share, stretch, last)
        columns = np.ascontiguousarray(points.T)
        sources = np.empty((count, *pseudo.shape))
        lengths = np.where(length != 0.0, length, np.inf)
        kinds: dict[tuple[int, int | None], list[int]] = {}
        for i, source in enumerate(self.quantities.sources):
            kinds.setdefault((source.order, source.parameter), []).append(i)
        for (order, j), chosen in kinds.items():
            rows = np.array([self.quantities.sources[i].row for i in chosen])
            if j is None:
                sources[chosen] = self._trains[order].curves(pseudo, columns, rows) / lengths**order
                continue
            # at a fixed time the pseudo-time moves with the parameter: dt = 0
            slopes = self._slopes[j].curves(pseudo, columns, np.append(rows, self._clock_row))
            rates = self._trains[1].curves(pseudo, columns, rows) / lengths
            sources[chosen] = slopes[:-1] - rates * slopes[-1]
        return sources

    def _sources(self, times: Array, points: Array) -> Array:
        if times is self.grid.times and not self._ends:
            return self._whole_sources(points).copy()
        return self._states(np.broadcast_to(times[:, None], (times.size, len(points))), points)

    def _paired(self, times: Array, points: Array) -> Array:
        return np.asarray(self._states(times[None], points)[:, 0])

    def _paired_clock(self, times: Array, points: Array) -> Array:
        return np.asarray(self._clock(times[None], points)[0])

    def _reduced(
        self, reduction: Reduction, integrand: Array, points: Array, shifts: Array | None
    ) -> Array:
        shape = self.grid.times.size, len(points)
        integrand = np.broadcast_to(integrand, shape)
        _, within = self._borders(points)
        lengths = np.diff(within, axis=0)
        each = np.take_along_axis(
            lengths, self._place(np.broadcast_to(self.grid.times[:, None], shape)), axis=0
        )
        if reduction.kind is Kind.INSTANT:
            return self._at_instant(reduction, points, shifts)
        if reduction.kind is Kind.RUNNING:
            return self._running(reduction, points, shifts)
        if reduction.kind is Kind.INTEGRAL:
            self._check_finite(reduction.text, integrand, points)
            functions = Polynomials(self.grid, integrand * each)
            ends = (
                self._limit(limit, reduction, points) for limit in (reduction.end, reduction.start)
            )
            upper, lower = (functions.until(end) for end in ends)
            return np.asarray(upper - lower)
        if reduction.kind is Kind.DURATION:
            self._check_finite(reduction.text, integrand, points)
            return self._duration(integrand, lengths)
        reduced = super()._reduced(reduction, integrand, points, shifts)
        if reduction.kind is Kind.CROSSING:
            return np.asarray(self._clock(reduced[None], points)[0])
        return reduced

    def _running(
        self, reduction: Reduction, points: Array, shifts: Array | None, ends: Array | None = None
    ) -> Array:
        """Integrals over whole stretches up to all places of the grid, or to ``ends`` (T, m)."""
        clock, sources = self._kept(np.empty(0), np.empty(0), points, shifts)
        integrand = self.quantities.integrands(clock, sources, points.T)[reduction.integrand]
        *_, length = self._whole(points)
        integrand = np.broadcast_to(integrand, length.shape)
        self._check_finite(reduction.text, integrand, points)
        functions = Polynomials(self.grid, integrand * length)
        begin = functions.until(self._limit(reduction.start, reduction, points))
        if ends is None:
            return functions.running(self.grid.breaks[0]) - begin
        return np.array([functions.until(each) for each in ends]) - begin

    def _duration(self, integrand: Array, lengths: Array) -> Array:
        """For how long functions (T, m) are positive: stretch after stretch."""
        total, breaks = np.zeros(integrand.shape[1]), np.array(self.grid.breaks)
        for i, length in enumerate(lengths):
            inside = (self.grid.times > i) & (self.grid.times < i + 1)
            own = breaks[(breaks >= i) & (breaks <= i + 1)]
            grid = TimeGrid(tuple(own.tolist()), self.grid.count)
            total += length * Polynomials(grid, integrand[inside]).duration()
        return total

    def _limit(self, limit: float | Border, reduction: Reduction, points: Array) -> Array:
        """The pseudo-time (m,) of a limit of an integral."""
        borders, within = self._borders(points)
        if isinstance(limit, Border):
            end = self.evaluator.horizon[1]
            self._refuse(borders[limit.place] > end, reduction, points, *_FEWER)
            at = borders[limit.place] - self._late
        else:
            at = np.full(len(points), limit)
        stretch = (within[1:-1] <= at).sum(axis=0)
        if isinstance(limit, Border):
            stretch = np.full(len(points), limit.place - 1)
        columns = np.arange(len(points))
        begin = within[stretch, columns]
        length = within[stretch + 1, columns] - begin
        share = np.where(length != 0.0, (at - begin) / np.where(length != 0.0, length, 1.0), 1.0)
        return np.asarray(stretch + np.clip(share, 0.0, 1.0))

    def _at_instant(self, reduction: Reduction, points: Array, shifts: Array | None) -> Array:
        """The integrand at a time, or on one side of an event, (m,)."""
        borders, _ = self._borders(points)
        instant, columns = reduction.start, np.arange(len(points))
        if isinstance(instant, Border):
            at = borders[instant.place]
            self._refuse(at > self.evaluator.horizon[1], reduction, points, *_FEWER)
            stretch = np.full(len(points), instant.place if instant.after else instant.place - 1)
            later = self._late if instant.after else -self._late
        else:
            at, later = np.full(len(points), instant), 0.0
            stretch = (borders[1:-1] <= instant).sum(axis=0)
        begin = borders[stretch, columns]
        length = borders[stretch + 1, columns] - begin
        share = np.where(
            length != 0.0, (at + later - begin) / np.where(length != 0.0, length, 1.0), 1.0
        )
        sources = self._read(stretch[None], share[None], length[None], points)
        if shifts is not None:
            sources = sources + shifts[:, None, None]
        with np.errstate(all="ignore"):
            clock = (at + later)[None]
            values = self.quantities.integrands(clock, sources, points.T)[reduction.integrand]
        values = np.broadcast_to(values, (1, len(points)))
        self._check_finite(reduction.text, values, points)
        return np.asarray(values[0])


class ClockSampler(Sampler):
    """Functions of time of a solution with events, on a grid over clock time."""

    def __init__(
        self,
        evaluator: TimelineEvaluator,
        parameters: Sequence[str],
        quantities: Quantities,
        grid: TimeGrid,
        rtol: float,
    ) -> None:
        super().__init__(evaluator.slabs, parameters, quantities, grid, rtol)
        self.evaluator = evaluator

    def _sources(self, times: Array, points: Array) -> Array:
        count = len(self.quantities.sources)
        charge(20 * CALL + (1.0 + count) * _NUMBER_COST * times.size * len(points))
        rows = np.array([source.row for source in self.quantities.sources])
        return self.evaluator.curves(times[:, None], np.ascontiguousarray(points.T), rows)

    def _paired(self, times: Array, points: Array) -> Array:
        rows = np.array([source.row for source in self.quantities.sources])
        return self.evaluator.curves(times[None], np.ascontiguousarray(points.T), rows)[:, 0]
