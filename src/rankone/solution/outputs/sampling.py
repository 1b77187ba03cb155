"""Values of quantities of a solution at parameter points."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from rankone.compiler.codegen.layout import Kind, Quantities, Reduction
from rankone.support.arrays import AT_ONCE, NEGLIGIBLE, TINY, Array
from rankone.support.budget import Counted, LimitsElsewhere, charge
from rankone.support.costs import CALL
from rankone.support.errors import EvaluationError, RankoneError
from rankone.support.tasks import Pool, Shared
from rankone.tensors.slab import SlabTrain, slab_positions
from rankone.tensors.time_grid import Polynomials, TimeGrid

_MAX_MIDDLES = 4  # Narrow features looked at on each trajectory
# Operations of evaluating functions of the sources, for each number of a function of time
_FUNCTION_COST = 20
_RANK_COST = 0.2  # Operations of evaluating a source, for each number and rank
_INTEGRAL_COST = 15  # Operations of integrating a function of time, for each number
_SEARCH_COST = 200  # Operations of looking for extremes or zeros, for each number
# Reductions that change abruptly where extremes or zeros come and go
_SEARCHED_KINDS = (Kind.MAXIMUM, Kind.MINIMUM, Kind.CROSSING, Kind.DURATION)
# Values below this many tolerances of the solution, relative to the largest, have no sign
_SIGN_RATIO = 10.0


class Sampler:
    """Quantities of a solution on a time grid.

    No slab of the grid crosses the end of a slab of the solution. A change of sign not far above
    the tolerance of the solution is none. Workers of a ``pool`` take parts of the points.
    """

    def __init__(
        self,
        slabs: Sequence[SlabTrain],
        parameters: Sequence[str],
        quantities: Quantities,
        grid: TimeGrid,
        rtol: float,
    ) -> None:
        if quantities.sums:
            slabs = [_with_sums(slab, quantities) for slab in slabs]
        self.slabs, self.parameters, self.quantities = slabs, parameters, quantities
        self.grid, self.largest = grid, 0.0
        self.pool: Pool | None = None
        self._negligible = max(_SIGN_RATIO * rtol, NEGLIGIBLE)
        self._orders: dict[int, Sequence[SlabTrain]] = {0: slabs}
        for order in range(1, 1 + max((s.order for s in quantities.sources), default=0)):
            self._orders[order] = [slab.derivative() for slab in self._orders[order - 1]]

    @property
    def span(self) -> tuple[float, float]:
        """The interval of the grid."""
        return self.grid.breaks[0], self.grid.breaks[-1]

    @property
    def rows(self) -> int:
        """Times at which a quantity is held."""
        return 1 if self.quantities.timeless else self.grid.times.size

    def clock(self, times: Array, points: Array) -> Array:
        """The time (T, 1) or (T, m) at places of the grid (T,) for points (m, d)."""
        return times[:, None]

    def holds(self, points: Array) -> NDArray[np.bool_]:
        """At which points (m, d) the quantities count: elsewhere they are continued."""
        return np.ones(len(points), dtype=bool)

    def moved(self, points: Array) -> Array | None:
        """Quantities at points if events were later by their error; None without events."""
        return None

    def __call__(self, points: Array) -> Array:
        """Quantities at points (m, d): shape (quantities, rows, m).

        Raises an EvaluationError if a quantity is not finite somewhere, or does not cross.
        """
        return self._in_chunks(points, None)

    def changed(self, points: Array, shifts: Array) -> Array:
        """Largest changes of quantities where each source is shifted: (sources, quantities, m).

        Sources are shifted by their ``shifts`` (sources,), up and down, one after the other.
        """
        return self._in_chunks(points, shifts)

    def _in_chunks(self, points: Array, shifts: Array | None) -> Array:
        """Quantities, or their changes by shifts, some points at a time or on workers."""
        chunks = self._chunks(points, 4 + len(self.quantities.sources))
        if self.pool is None or len(chunks) < 2:
            return np.concatenate([self._of_chunk(chunk, shifts) for chunk in chunks], axis=-1)
        limits = LimitsElsewhere.left()
        tasks = [(chunk, shifts, limits) for chunk in chunks]
        sampled = [each.settled() for each in self._shared.map(_counted_chunk, tasks)]
        self.largest = max(self.largest, *(largest for _, largest in sampled))
        return np.concatenate([values for values, _ in sampled], axis=-1)

    def _chunks(self, points: Array, functions: int) -> list[Array]:
        """Points of which so many functions of time are held at once."""
        numbers = len(points) * functions * self.grid.times.size
        return np.array_split(points, max(-(-numbers // AT_ONCE), 1))

    def largest_sources(self, points: Array) -> Array:
        """The largest values of the sources at points (m, d): shape (sources,)."""
        chunks = self._chunks(points, len(self.quantities.sources) + 1)
        each = [np.abs(self.sources(chunk)).max(axis=(1, 2), initial=0.0) for chunk in chunks]
        return np.asarray(np.max(each, axis=0))

    def largest_in_sums(self, points: Array) -> dict[int, float]:
        """The largest values at points (m, d) of states in sums, by their rows."""
        rows = sorted({row for pairs in self.quantities.sums for row, _ in pairs})
        largest = np.zeros(len(rows))
        owner = slab_positions(self.slabs, self.grid.times)
        for k, slab in enumerate(self.slabs if rows else ()):
            some, times = slab.with_first(slab.cores[0][rows]), self.grid.times[owner == k]
            for chunk in self._chunks(points, len(rows)):
                states = np.abs(some.on_grid(times, some.over_parameters(chunk.T)))
                largest = np.maximum(largest, states.max(axis=(1, 2), initial=0.0))
        return dict(zip(rows, largest.tolist(), strict=True))

    @cached_property
    def _shared(self) -> Shared[Sampler]:
        """This sampler, as workers get it."""
        return Shared("a function of an output", self, self.pool)

    def __getstate__(self) -> dict[str, object]:
        return {n: held for n, held in self.__dict__.items() if n != "_shared"} | {"pool": None}

    def at(self, times: Array, points: Array) -> Array:
        """Integrands and, without reductions, values at times (T,): shape (functions, T, m)."""
        at = self.clock(times, points)
        functions = self._functions(at, self._sources(times, points), points.T)
        shape = times.size, len(points)
        return np.array([np.broadcast_to(function, shape) for function in functions])

    def margins(self, points: Array) -> Array:
        """How far functions of time are from an abrupt change of a reduction, at (m, d): (m,).

        For extremes the gap between the two largest, at different times; else the distance of an
        extreme from zero, where crossings come and go.
        """
        margins = np.full(len(points), np.inf)
        reductions = [r for r in self.quantities.reductions if r.kind in _SEARCHED_KINDS]
        if not reductions:
            return margins
        shape = self.grid.times.size, len(points)
        with np.errstate(all="ignore"):
            times = self.clock(self.grid.times, points)
            integrands = self.quantities.integrands(times, self.sources(points), points.T)
        for reduction in reductions:
            charge(CALL + _SEARCH_COST * shape[0] * shape[1])
            finite = np.nan_to_num(np.broadcast_to(integrands[reduction.integrand], shape))
            if reduction.kind is Kind.MINIMUM:
                finite = -finite
            functions = Polynomials(self.grid, finite)
            extremes = reduction.kind in (Kind.MAXIMUM, Kind.MINIMUM)
            distance = functions.gap_of_maxima if extremes else functions.distance_from_tangency
            margins = np.minimum(margins, distance())
        return margins

    def roughness(self, points: Array) -> Array:
        """Largest of the highest modes in time of the functions, over their sizes: (m,)."""
        roughness = np.zeros(len(points))
        for function in self.at(self.grid.times, points):
            finite = np.nan_to_num(function, posinf=0.0, neginf=0.0)
            modes = np.abs(Polynomials(self.grid, finite).modes[:, -2:]).max(axis=(0, 1))
            roughness = np.maximum(roughness, modes / max(np.abs(finite).max(), TINY))
        return roughness

    def narrow(self, points: Array) -> float:
        """Error at narrow features, of integrands and quantities without reductions, relative.

        In their middles, at kinks, and midway between two surfaces that follow each other: a window
        may be open there.
        """
        times, sources = self.clock(self.grid.times, points), self.sources(points)
        shape = self.grid.times.size, len(points)
        with np.errstate(all="ignore"):
            surfaces = self.quantities.state_surfaces(times, sources, points.T)
        if not surfaces:
            return 0.0
        curves = [Polynomials(self.grid, np.broadcast_to(each, shape)) for each in surfaces]
        crossings = [each.zeros(_MAX_MIDDLES) for each in curves]
        some = slice(self.quantities.n_state_surfaces)
        zeros, columns = (np.concatenate(each) for each in zip(*crossings, strict=True))
        order = np.lexsort((zeros, columns))
        zeros, columns = zeros[order], columns[order]
        follow = columns[1:] == columns[:-1]
        middles = 0.5 * (zeros[1:] + zeros[:-1])[follow]
        places = np.concatenate([*(times for times, _ in crossings[some]), middles])
        columns = np.concatenate([*(each for _, each in crossings[some]), columns[1:][follow]])
        at = self._paired_clock(places, points[columns])[None, :]
        exact = self._functions(
            at, self._paired(places, points[columns])[:, None, :], points[columns].T
        )
        worst = 0.0
        for nodal, exact_row in zip(self._functions(times, sources, points.T), exact, strict=True):
            nodal = np.broadcast_to(nodal, shape)
            size = max(np.abs(nodal).max(), np.abs(exact_row).max(initial=0.0), TINY)
            interpolated = Polynomials(self.grid, nodal).at(places, columns)
            errors = np.abs(np.broadcast_to(exact_row, (1, places.size))[0] - interpolated)
            worst = max(worst, float(errors.max(initial=0.0)) / size)
        return worst

    def sources(self, points: Array) -> Array:
        """The states or derivatives that are needed, at the nodes: shape (sources, T, m)."""
        return self._sources(self.grid.times, points)

    def _functions(self, times: Array, sources: Array, points: Array) -> list[Array]:
        """Integrands and, without reductions, values."""
        with np.errstate(all="ignore"):
            functions = list(self.quantities.integrands(times, sources, points))
            if not self.quantities.reductions:
                functions += self.quantities.values(times, sources, points, [])
        return functions

    def _paired(self, times: Array, points: Array) -> Array:
        """Sources at pairs of times (N,) and points (N, d): shape (sources, N)."""
        owner = slab_positions(self.slabs, times)
        sources = np.empty((len(self.quantities.sources), times.size))
        for k in np.unique(owner):
            owned = owner == k
            for order, slabs in self._orders.items():
                states = slabs[k](times[owned], points[owned].T)
                for i, source in enumerate(self.quantities.sources):
                    if source.order == order:
                        sources[i, owned] = states[source.row]
        return sources

    def _paired_clock(self, times: Array, points: Array) -> Array:
        """The time at pairs of places (N,) and points (N, d): shape (N,)."""
        return times

    def _of_chunk(self, points: Array, shifts: Array | None) -> Array:
        """Quantities at some points, or their changes by shifts of the sources."""
        sources = self.sources(points)
        exact = self._quantities(points, sources, None)
        return exact if shifts is None else self._changes(points, sources, shifts, exact)

    def _changes(self, points: Array, sources: Array, shifts: Array, exact: Array) -> Array:
        """Largest changes (sources, quantities, m) by shifts of the sources, up and down."""
        changes = np.zeros((shifts.size, len(exact), len(points)))
        for k, shift in enumerate(shifts):
            alone, source = np.zeros_like(shifts), sources[k].copy()
            for alone[k] in (shift, -shift):
                sources[k] = source + alone[k]
                shifted = self._quantities(points, sources, alone)
                changes[k] = np.maximum(changes[k], np.abs(shifted - exact).max(axis=1))
            sources[k] = source
        return changes

    def _quantities(self, points: Array, sources: Array, shifts: Array | None) -> Array:
        """Quantities of sources that the ``shifts`` (sources,) are added to already."""
        times = self.clock(self.grid.times, points)
        self._refuse_gaps(times, sources, points)
        with np.errstate(all="ignore"):
            integrands = self.quantities.integrands(times, sources, points.T)
            operands = [sources, *integrands]
            largest = [float(np.nanmax(np.abs(operand), initial=0.0)) for operand in operands]
            self.largest = max(self.largest, *(x for x in largest if np.isfinite(x)), 0.0)
            reduced = [
                self._reduced(reduction, integrands[reduction.integrand], points, shifts)
                for reduction in self.quantities.reductions
            ]
            at, kept = self._kept(times[: self.rows], sources[:, : self.rows], points, shifts)
            quantities = self.quantities.values(at, kept, points.T, reduced)
            shape = self.rows, len(points)
            sampled = np.array([np.broadcast_to(quantity, shape) for quantity in quantities])
        for text, quantity in zip(self.quantities.texts, sampled, strict=True):
            self._check_finite(text, quantity, points)
        return sampled

    def _kept(
        self, times: Array, sources: Array, points: Array, shifts: Array | None
    ) -> tuple[Array, Array]:
        """Times and sources at which quantities are held, by those of the reductions."""
        return times, sources

    def _refuse_gaps(self, times: Array, sources: Array, points: Array) -> None:
        """Raise an EvaluationError where a piecewise function of the states has no branch."""
        gaps = self.quantities.gaps(times, sources, points.T)
        for text, inside in zip(self.quantities.gap_texts, gaps, strict=True):
            shape = len(times), len(points)
            rows, columns = np.nonzero(np.broadcast_to(inside, shape))
            if rows.size:
                time = np.broadcast_to(times, shape)[rows[0], columns[0]]
                point = self._named(points[columns[0]])
                raise EvaluationError(
                    f"{text}: met at t = {time:.6g}" + (f", {point}" if point else ""),
                    term=text,
                    remedy="add a branch (value, True) for everything else",
                )

    def _reduced(
        self, reduction: Reduction, integrand: Array, points: Array, shifts: Array | None
    ) -> Array:
        """Reduce an integrand that broadcasts to (T, m): (m,), or (T, m) for a running integral.

        The sources of the integrand are shifted already.
        """
        integrand = np.broadcast_to(integrand, (self.grid.times.size, len(points)))
        self._check_finite(reduction.text, integrand, points)
        cost = _SEARCH_COST if reduction.kind in _SEARCHED_KINDS else _INTEGRAL_COST
        charge(100 * CALL + cost * integrand.size)
        functions = Polynomials(self.grid, integrand)
        match reduction.kind:
            case Kind.INTEGRAL:
                assert isinstance(reduction.start, float)
                assert isinstance(reduction.end, float)
                return functions.integral(reduction.start, reduction.end)
            case Kind.RUNNING:
                assert isinstance(reduction.start, float)
                return functions.running(reduction.start)
            case Kind.MAXIMUM:
                return functions.maximum()
            case Kind.MINIMUM:
                return -Polynomials(self.grid, -integrand).maximum()
            case Kind.DURATION:
                return functions.duration()
        crossings = functions.first_crossing(reduction.direction, self._negligible)
        self._refuse(np.isnan(crossings), reduction, points)
        return crossings

    def _refuse(
        self,
        missing: NDArray[np.bool_],
        reduction: Reduction,
        points: Array,
        why: str = "",
        otherwise: str = "",
    ) -> None:
        """Raise an EvaluationError if something does not happen at some points."""
        if missing.any() and (missing := missing & self.holds(points)).any():
            raise EvaluationError(
                f"`{reduction.text}` does not happen at {self._named(points[missing][0])}{why}",
                term=reduction.text,
                remedy="restrict the solution to parameters where it does: solution.restrict(...)"
                f"{otherwise}",
            )

    def _check_finite(self, text: str, sampled: Array, points: Array) -> None:
        """Raise an EvaluationError unless a function (T, m) is finite at all points."""
        if np.isfinite(sampled).all():
            return
        missing = np.asarray(~np.isfinite(sampled).all(axis=0))
        inside = missing & self.holds(points)
        missing = inside if inside.any() else missing  # nothing is continued across infinity
        point = self._named(points[missing][0])
        raise EvaluationError(
            f"`{text}` is not finite{point and f' at {point}'}",
            term=text,
            remedy="restrict the solution to parameters where it is: solution.restrict(...)",
        )

    def _named(self, point: Array) -> str:
        pairs = zip(self.parameters, point, strict=True)
        return ", ".join(f"{name} = {coordinate:.6g}" for name, coordinate in pairs)

    def _sources(self, times: Array, points: Array) -> Array:
        """Sources at times (T,) in any order and points (m, d): shape (sources, T, m)."""
        size = times.size * len(points)
        ranks = sum(max(slab.ranks, default=1) for slab in self.slabs) / len(self.slabs)
        each = _FUNCTION_COST + len(self.quantities.sources) * _RANK_COST * ranks
        charge(len(self.slabs) * 20 * CALL + size * each)
        owner = slab_positions(self.slabs, times)
        sources = np.empty((len(self.quantities.sources), times.size, len(points)))
        columns, previous = np.empty(0), None
        for k in np.unique(owner):
            owned, slab = owner == k, self.slabs[k]
            if previous is None or not slab.shares_parameters(previous):
                columns, previous = slab.over_parameters(points.T), slab
            for order, slabs in self._orders.items():
                first = slabs[k].in_time(times[owned])
                for i, source in enumerate(self.quantities.sources):
                    if source.order == order:
                        sources[i, owned] = first[source.row] @ columns
        return sources


def _with_sums(slab: SlabTrain, quantities: Quantities) -> SlabTrain:
    """A slab with sums of states as further states."""
    first = slab.cores[0]
    weights = np.zeros((len(quantities.sums), len(first)))
    for row, pairs in zip(weights, quantities.sums, strict=True):
        states, numbers = zip(*pairs, strict=True)
        row[list(states)] = numbers
    return slab.with_first(np.concatenate([first, np.tensordot(weights, first, 1)]))


def _counted_chunk(
    sampler: Sampler, points: Array, shifts: Array | None, limits: LimitsElsewhere
) -> Counted[tuple[Array, float]]:
    """Quantities at points, and the largest operand so far, by a worker."""

    own = copy.copy(sampler)  # workers may be threads

    def sampled() -> tuple[Array, float]:
        return own._of_chunk(points, shifts), own.largest

    return Counted.of(limits, (RankoneError,), sampled)
