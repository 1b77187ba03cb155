"""Values of quantities of a solution at parameter points."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rankone.outputs.over_time import Polynomials
from rankone.outputs.quantities import Kind, Quantities, Reduction
from rankone.solvers.cross.time_grid import TimeGrid
from rankone.support.arrays import Array
from rankone.support.budget import charge
from rankone.support.costs import CALL
from rankone.support.errors import EvaluationError
from rankone.tensors.slab import SlabTrain

__all__ = ["Sampler"]

_NUMBERS = 1 << 21
"""Numbers of a chunk of trajectories."""
_MIDDLES = 4
"""Most places of something narrow on each trajectory that are looked at."""
_FUNCTIONS, _RANK, _SUMMED, _SEARCHED = 20.0, 0.2, 15.0, 200.0
"""Operations for each number of a function of time: to evaluate functions of the sources, for each
rank of a source, to integrate it, to look for extremes or zeros."""
_CHANGING = (Kind.MAXIMUM, Kind.MINIMUM, Kind.CROSSING, Kind.DURATION)
_SIGNS, _LEAST = 10.0, 1e-9
"""What has a sign at all, relative to the largest value: over the tolerance, and at least."""


class Sampler:
    """Quantities of a solution on a time grid.

    Parameters
    ----------
    slabs : sequence of SlabTrain
        Of the solution.
    parameters : sequence of str
    quantities : Quantities
    grid : TimeGrid
        No slab of it crosses the ends of those of the solution.
    rtol : float
        Tolerance of the solution: changes of sign that are not far above it are none.
    """

    def __init__(
        self,
        slabs: Sequence[SlabTrain],
        parameters: Sequence[str],
        quantities: Quantities,
        grid: TimeGrid,
        rtol: float,
    ) -> None:
        self.slabs, self.parameters, self.quantities = slabs, parameters, quantities
        self.grid = grid
        self._nothing = max(_SIGNS * rtol, _LEAST)
        self.largest = 0.0
        self._orders: dict[int, Sequence[SlabTrain]] = {0: slabs}
        for order in range(1, 1 + max((s.order for s in quantities.sources), default=0)):
            self._orders[order] = [slab.derivative() for slab in self._orders[order - 1]]

    @property
    def rows(self) -> int:
        """Times at which a quantity is held."""
        return 1 if self.quantities.timeless else self.grid.times.size

    def __call__(self, points: Array, shifts: Array | None = None) -> Array:
        """Quantities at points (m, d): shape (quantities, rows, m).

        Parameters
        ----------
        shifts : ndarray (sources,), optional
            What is added to the sources.

        Raises
        ------
        EvaluationError
            If one is not finite somewhere, or does not cross.
        """
        per_point = (4 + len(self.quantities.sources)) * self.grid.times.size
        pieces = -(-len(points) * per_point // _NUMBERS)
        chunks = np.array_split(points, max(pieces, 1))
        return np.concatenate([self._chunk(chunk, shifts) for chunk in chunks], axis=2)

    def at(self, times: Array, points: Array) -> Array:
        """Integrands and, without reductions, values at times (T,): shape (functions, T, m)."""
        given = times[:, None], self._sources(times, points), points.T
        shape = times.size, len(points)
        return np.array([np.broadcast_to(part, shape) for part in self._functions(*given)])

    def margins(self, points: Array) -> Array:
        """How near functions of time are to a change of what is reduced, at points (m, d): (m,)."""
        margins = np.full(len(points), np.inf)
        kinds = [r for r in self.quantities.reductions if r.kind in _CHANGING]
        if kinds:
            given = self.grid.times[:, None], self.sources(points), points.T
            with np.errstate(all="ignore"):
                integrands = self.quantities.integrands(*given)
            for reduction in kinds:
                values = np.broadcast_to(
                    integrands[reduction.integrand], (given[0].size, len(points))
                )
                charge(CALL + _SEARCHED * values.size)
                functions = Polynomials(self.grid, np.nan_to_num(values))
                margins = np.minimum(margins, functions.margins(reduction.kind))
        return margins

    def roughness(self, points: Array) -> Array:
        """Largest of the highest modes in time of the functions, over their sizes: (m,)."""
        values = self.at(self.grid.times, points)
        found = np.zeros(len(points))
        for function in values:
            finite = np.nan_to_num(function, posinf=0.0, neginf=0.0)
            modes = np.abs(Polynomials(self.grid, finite).modes[:, -2:]).max(axis=(0, 1))
            found = np.maximum(found, modes / max(np.abs(finite).max(), 1e-300))
        return found

    def narrow(self, points: Array) -> float:
        """What the grid misses where something narrow is, over the largest values.

        Of the integrands, and of the values if there are no reductions.
        """
        times, sources = self.grid.times, self.sources(points)
        shape = times.size, len(points)
        given = times[:, None], sources, points.T
        with np.errstate(all="ignore"):
            middles = self.quantities.middles(*given)
        worst = 0.0
        at_nodes = self._functions(*given) if middles else []
        for middle in middles:
            zeros = Polynomials(self.grid, np.broadcast_to(middle, shape)).zeros(_MIDDLES)
            at, columns = zeros
            there = self._paired(at, points[columns])
            exact = self._functions(at[None, :], there[:, None, :], points[columns].T)
            for values, here in zip(at_nodes, exact, strict=True):
                values = np.broadcast_to(values, shape)
                size = max(np.abs(values).max(), np.abs(here).max(initial=0.0), 1e-300)
                found = Polynomials(self.grid, values).at(at, columns)
                missed = np.abs(np.broadcast_to(here, (1, at.size))[0] - found)
                worst = max(worst, float(missed.max(initial=0.0)) / size)
        return worst

    def sources(self, points: Array) -> Array:
        """The states or derivatives that are needed, at the nodes: shape (sources, T, m)."""
        return self._sources(self.grid.times, points)

    def _functions(self, times: Array, sources: Array, points: Array) -> list[Array]:
        """Integrands and, without reductions, values."""
        with np.errstate(all="ignore"):
            found = list(self.quantities.integrands(times, sources, points))
            if not self.quantities.reductions:
                found += self.quantities.values(times, sources, points, [])
        return found

    def _paired(self, times: Array, points: Array) -> Array:
        """Sources at pairs of times (N,) and points (N, d): shape (sources, N)."""
        owner = np.searchsorted([slab.start for slab in self.slabs[1:]], times, side="right")
        found = np.empty((len(self.quantities.sources), times.size))
        for k in np.unique(owner):
            here = owner == k
            for order, slabs in self._orders.items():
                states = slabs[k](times[here], points[here].T)
                for i, source in enumerate(self.quantities.sources):
                    if source.order == order:
                        found[i, here] = states[source.row]
        return found

    def _chunk(self, points: Array, shifts: Array | None) -> Array:
        times, sources = self.grid.times[:, None], self.sources(points)
        if shifts is not None:
            sources = sources + shifts[:, None, None]
        self._refuse_gaps(times, sources, points)
        with np.errstate(all="ignore"):
            integrands = self.quantities.integrands(times, sources, points.T)
            operands = [sources, *integrands]
            largest = [float(np.nanmax(np.abs(part), initial=0.0)) for part in operands]
            self.largest = max(self.largest, *(x for x in largest if np.isfinite(x)), 0.0)
            reduced = [
                self._reduced(reduction, integrands[reduction.integrand], points)
                for reduction in self.quantities.reductions
            ]
            given = times[: self.rows], sources[:, : self.rows], points.T
            found = self.quantities.values(*given, reduced)
            shape = self.rows, len(points)
            values = np.array([np.broadcast_to(part, shape) for part in found])
        self._check(values, points)
        return values

    def _refuse_gaps(self, times: Array, sources: Array, points: Array) -> None:
        """Raise an EvaluationError where a piecewise function of the states has no branch."""
        found = self.quantities.gaps(times, sources, points.T)
        for text, inside in zip(self.quantities.gap_texts, found, strict=True):
            rows, columns = np.nonzero(np.broadcast_to(inside, (times.size, len(points))))
            if rows.size:
                when, where = times.ravel()[rows[0]], self._named(points[columns[0]])
                raise EvaluationError(
                    f"{text}: met at t = {when:.6g}" + (f", {where}" if where else ""),
                    term=text,
                    remedy="add a branch (value, True) for everything else",
                )

    def _reduced(self, reduction: Reduction, values: Array, points: Array) -> Array:
        """A reduction of values that broadcast to (T, m): (m,), or (T, m) for a running one."""
        values = np.broadcast_to(values, (self.grid.times.size, len(points)))
        if not np.isfinite(values).all():
            wrong = ~np.isfinite(values).all(axis=0)
            raise self._not_finite(reduction.text, points[wrong])
        searched = reduction.kind in _CHANGING
        charge(100.0 * CALL + (_SEARCHED if searched else _SUMMED) * values.size)
        functions = Polynomials(self.grid, values)
        match reduction.kind:
            case Kind.INTEGRAL:
                return functions.integral(reduction.start, reduction.end)
            case Kind.RUNNING:
                return functions.running(reduction.start)
            case Kind.MAXIMUM:
                return functions.maximum()
            case Kind.MINIMUM:
                return -Polynomials(self.grid, -values).maximum()
            case Kind.DURATION:
                return functions.duration()
        found = functions.first_crossing(reduction.direction, self._nothing)
        if np.isnan(found).any():
            raise EvaluationError(
                f"`{reduction.text}` does not happen at {self._named(points[np.isnan(found)][0])}",
                term=reduction.text,
                remedy="restrict the solution to parameters where it does: solution.restrict(...)",
            )
        return found

    def _check(self, values: Array, points: Array) -> None:
        for text, part in zip(self.quantities.texts, values, strict=True):
            wrong = ~np.isfinite(part).all(axis=0)
            if wrong.any():
                raise self._not_finite(text, points[wrong])

    def _not_finite(self, text: str, points: Array) -> EvaluationError:
        where = self._named(points[0])
        return EvaluationError(
            f"`{text}` is not finite{where and f' at {where}'}",
            term=text,
            remedy="restrict the solution to parameters where it is: solution.restrict(...)",
        )

    def _named(self, point: Array) -> str:
        """A parameter point as text."""
        pairs = zip(self.parameters, point, strict=True)
        return ", ".join(f"{name} = {value:.6g}" for name, value in pairs)

    def _sources(self, times: Array, points: Array) -> Array:
        """Sources at times (T,) in any order and points (m, d): shape (sources, T, m)."""
        size = times.size * len(points)
        ranks = sum(max(slab.ranks, default=1) for slab in self.slabs) / len(self.slabs)
        each = _FUNCTIONS + len(self.quantities.sources) * _RANK * ranks
        charge(len(self.slabs) * 20.0 * CALL + size * each)
        starts = np.array([slab.start for slab in self.slabs[1:]])
        owner = np.searchsorted(starts, times, side="right")
        found = np.empty((len(self.quantities.sources), times.size, len(points)))
        carry, last = np.empty(0), None
        for k in np.unique(owner):
            here, slab = owner == k, self.slabs[k]
            if last is None or not slab.shares_parameters(last):
                carry, last = slab.over_parameters(points.T), slab
            for order, slabs in self._orders.items():
                first = slabs[k].in_time(times[here])
                for i, source in enumerate(self.quantities.sources):
                    if source.order == order:
                        found[i, here] = first[source.row] @ carry
        return found
