"""Evaluation of the solved model with events: its slabs are over the stretches between them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from rankone.share.export.model_program import _CHUNK, Model, _train
from rankone.support.arrays import Array
from rankone.tensors.coordinates import round_off


class EventModel(Model):
    """A model with events; values at the time of an event are those after it.

    Stretch i has the pseudo-time [i, i + 1]; the clock times of its ends depend on the parameters.
    Except for affine ones they are rounded, so that a time just before one counts as at it. After a
    terminal event values are NaN.
    """

    def __init__(
        self,
        *tables: Any,
        stretches: Sequence[int],
        runs: Sequence[int],
        borders: Sequence[int],
        affine_borders: Sequence[tuple[int, Sequence[float]]],
        terminal: bool,
        instants: Sequence[Sequence[str]],
        events: Sequence[str],
    ) -> None:
        super().__init__(*tables)
        self._first = np.array(stretches)
        self._runs, self._affine, self.terminal = runs, affine_borders, terminal
        self._borders = [self._cores[core][2][0, :, 0] for core in borders]
        self._instants, self.events = instants, events
        self._rounding = round_off(*self.intervals[0])
        self._early = np.full((len(stretches), 1), self._rounding)
        self._early[[border for border, _ in affine_borders]] = 0.0

    def event_times(
        self, event: str, values: Mapping[str, Any] | None = None, /, **named: Any
    ) -> Array:
        """Times of an event: shape (occurrences, *broadcast shape of the parameters).

        NaN where it is not reached by the end of the horizon.
        """
        occurrences = self.occurrences(event)
        borders, shape = self._at_parameters({**(values or {}), **named})
        times = borders[occurrences]
        times[times > self.intervals[0][1]] = np.nan
        return times.reshape(len(times), *shape)

    def occurrences(self, event: str) -> list[int]:
        """The borders of stretches at which an event occurs."""
        if event not in self.events:
            raise ValueError(f"there is no event {event}, only {', '.join(self.events)}")
        return [i for i, names in enumerate(self._instants, 1) if event in names]

    def end(self, values: Mapping[str, Any] | None = None, /, **named: Any) -> Array:
        """When the solution ends: at a terminal event, or with the horizon."""
        borders, shape = self._at_parameters({**(values or {}), **named})
        last = self.intervals[0][1]
        ends = np.minimum(borders[-1], last) if self.terminal else np.full_like(borders[-1], last)
        return np.asarray(ends.reshape(shape))

    def _at_parameters(self, at: Mapping[str, Any]) -> tuple[Array, tuple[int, ...]]:
        """The borders (1 + stretches, N) at parameters, and the shape of N."""
        points, shape = self._points(at, first=1)
        borders = self._over_parameters(points, derivatives=False)[1][:, 0]
        return _ascending(borders), shape

    def _over_parameters(self, points: Array, derivatives: bool) -> tuple[list[Array], Array]:
        """What depends on the parameters (d, N) alone, with derivatives if asked for.

        The products of the cores of each run of slabs (right, 1 or 1 + d, N), and the clock times
        of the borders of stretches (1 + stretches, 1 or 1 + d, N).
        """
        products, borders = self._products(points, derivatives), []
        for matrix, product in zip(self._borders, products, strict=True):
            clock = matrix @ product.reshape(len(product), -1)
            borders.append(clock.reshape(len(matrix), *product.shape[1:]))
        clock = np.concatenate(borders)
        for border, (constant, *slopes) in self._affine:
            clock[border, 0] = constant
            for j in np.flatnonzero(slopes):
                clock[border, 0] += slopes[j] * points[j]
            if derivatives:
                clock[border, 1:] = np.array(slopes)[:, None]
        return products, clock

    def _products(self, points: Array, derivatives: bool) -> list[Array]:
        """The products of the cores of each run of slabs at parameters (d, N)."""
        runs = range(len(self._borders))
        cores = (self._slabs[self._runs.index(run)][1:] for run in runs)
        return [_train(each, self._scales[1:], points, derivatives) for each in cores]

    def _evaluate(self, points: Array, derivatives: bool) -> Array:
        """Values, and derivatives if asked for, as for a model without events."""
        columns = 1 + len(points) if derivatives else 1
        states = np.empty((len(self.unknowns), columns, points.shape[1]))
        for begin in range(0, points.shape[1], _CHUNK):
            chunk = slice(begin, begin + _CHUNK)
            states[:, :, chunk] = self._at_clock_times(points[:, chunk], derivatives)
        return states

    def _at_clock_times(self, points: Array, derivatives: bool) -> Array:
        """The same at a few points (coordinates, N): the stretch of each first, then its slab."""
        products, clock = self._over_parameters(points[1:], derivatives)
        borders, times, each = clock[:, 0], points[0], np.arange(points.shape[1])
        stretch = (times >= _ascending(borders - self._early)[1:-1]).sum(axis=0)
        begin = borders[stretch, each]
        length = borders[stretch + 1, each] - begin
        share = np.clip((times - begin) / np.where(length > 0.0, length, 1.0), 0.0, 1.0)
        pseudo = stretch + share
        latest = np.searchsorted(self._starts, pseudo, side="right") - 1
        owner = np.clip(latest, self._first[stretch], self._first[stretch + 1] - 1)
        columns = 2 + len(points) - 1 if derivatives else 1  # value, by pseudo-time, by parameters
        states = np.empty((len(self.unknowns), columns, times.size))
        for index in np.unique(owner):
            here = np.flatnonzero(owner == index)
            product = products[self._runs[index]][:, :, here].swapaxes(0, 1)
            first = self._slabs[index][:1]
            states[:, :, here] = _train(first, ["linear"], pseudo[None, here], derivatives, product)
        if derivatives:
            # at a fixed clock time the pseudo-time moves with the borders of the stretch
            speed = np.where(length > 0.0, 1.0, 0.0) / np.where(length > 0.0, length, 1.0)
            of_begin, of_end = clock[stretch, 1:, each].T, clock[stretch + 1, 1:, each].T
            moved = (of_begin + share * (of_end - of_begin)) * speed
            states[:, 2:] -= states[:, 1:2] * moved
            states[:, 1] *= speed
        states[:, :, times > borders[-1] + self._rounding] = np.nan
        return states


def _ascending(borders: Array) -> Array:
    """Borders (1 + stretches, N), none before the one in front of it."""
    return np.asarray(np.maximum.accumulate(borders, axis=0))
