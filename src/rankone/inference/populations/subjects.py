"""Subjects of a table, and the states of all of them at the times of their data."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from rankone.inference.estimation import tables
from rankone.inference.estimation.experiments import Experiment, fixed_by_label, observed_in
from rankone.inference.estimation.formulas import Dual, Formula, Operand
from rankone.inference.estimation.noise import Noise, log_likelihood
from rankone.inference.estimation.observations import Observations, check_levels
from rankone.solution.evaluation.core import SolutionCore, timeline_evaluator
from rankone.solvers.branches import branch_evaluator
from rankone.support.arrays import MINOR, Array
from rankone.support.errors import OptionError, did_you_mean, listing, quote
from rankone.tensors.branch_evaluator import BranchEvaluator
from rankone.tensors.slab import SlabTrain, slab_positions
from rankone.tensors.timeline_evaluator import TimelineEvaluator
from rankone.trajectories.system.timeline import BranchedTimeline

_POINTS_AT_ONCE = 4096  # Points that are evaluated together, to bound memory


class OwnTimes(Protocol):
    """States of n records, each at M times of its own, as functions of the parameters."""

    def linearised(self, points: Array, free: Sequence[int]) -> tuple[Array, Array]:
        """States (K, n, M) at points (d, K, n), and derivatives (K, n, M, k).

        ``free`` are the positions of k parameters, ascending.
        """

    def selected(self, records: NDArray[np.intp]) -> OwnTimes:
        """The states of some of the records."""


def own_times(
    solution: SolutionCore, rows: NDArray[np.intp], response: tables.Response
) -> OwnTimes:
    """States ``rows`` (M,) of a solution where records have a response."""
    outcome = solution.outcome
    if isinstance(outcome.timeline, BranchedTimeline):
        return _OnTimeline(
            branch_evaluator(outcome.slabs, outcome.timeline).likeliest(), rows, response
        )
    if outcome.timeline is not None:
        return _OnTimeline(timeline_evaluator(outcome.slabs, outcome.timeline), rows, response)
    # thinner trains that change the states by less than anybody sees
    return _OnSlabs(outcome.slabs, rows, response, MINOR * solution.rtol)


class _OnSlabs:
    """The first core of the train is evaluated once, at the times of each record, over its doses.

    Ranks that matter at no time of the data are left out, within a tolerance relative to each
    state's size: the root mean square over the box and over the data.
    """

    def __init__(
        self,
        slabs: Sequence[SlabTrain],
        rows: NDArray[np.intp],
        response: tables.Response,
        tolerance: float,
    ) -> None:
        times, weights = response
        self.shape = times.shape[:2]
        owner = slab_positions(slabs, times.ravel()).reshape(times.shape)
        self._groups: list[tuple[SlabTrain, Array]] = []
        for k in np.unique(owner[weights != 0.0]):
            slab, here = slabs[k], (owner == k) & (weights != 0.0)
            records, columns, _ = np.nonzero(here)
            at = slab.in_time(times[here])[rows[columns], np.arange(records.size)]
            first = np.zeros((*self.shape, slab.cores[0].shape[2]))
            np.add.at(first, (records, columns), weights[here][:, None] * at)
            shared = (i for i, (one, _) in enumerate(self._groups) if one.shares_parameters(slab))
            same = next(shared, None)
            if same is None:
                self._groups.append((slab, first))
            else:
                self._groups[same][1][...] += first
        self._groups = [self._thinned(*group, rows, tolerance) for group in self._groups]

    def _thinned(
        self, slab: SlabTrain, first: Array, rows: NDArray[np.intp], tolerance: float
    ) -> tuple[SlabTrain, Array]:
        """A group with smaller ranks."""
        here = first.any(axis=2)
        train = slab.train.with_first(first[here]).right_orthonormal()
        norms = np.linalg.norm(train.first, axis=1)
        states = np.broadcast_to(rows, self.shape)[here]
        sizes = np.array([norms[states == state].max() for state in states])
        scaled = train.with_first(train.first / sizes[:, None])
        scaled, _ = scaled.truncated(tolerance * np.sqrt(norms.size))
        thinned = np.zeros((*self.shape, scaled.first.shape[1]))
        thinned[here] = scaled.first * sizes[:, None]
        return replace(slab, train=scaled.with_first(slab.cores[0])), thinned

    def linearised(self, points: Array, free: Sequence[int]) -> tuple[Array, Array]:
        """See :meth:`OwnTimes.linearised`."""
        count, width = points.shape[1], 1 + len(free)
        table = np.zeros((self.shape[0], self.shape[1], count, width))
        step = max(_POINTS_AT_ONCE // max(self.shape[0], 1), 1)
        for slab, first in self._groups:
            records = np.flatnonzero(first.any(axis=(1, 2)))
            for begin in range(0, count, step):
                block = points[:, begin : begin + step, records]
                products = slab.with_slopes(block.reshape(len(points), -1), free)
                by_record = products.reshape(len(products), block.shape[1], records.size, width)
                columns = by_record.transpose(2, 0, 1, 3).reshape(records.size, len(products), -1)
                states = (first[records] @ columns).reshape(records.size, -1, block.shape[1], width)
                table[records, :, begin : begin + step] += states
        moved = table.transpose(2, 0, 1, 3)
        return moved[..., 0], moved[..., :0:-1]

    def selected(self, records: NDArray[np.intp]) -> _OnSlabs:
        """See :meth:`OwnTimes.selected`."""
        fewer = copy(self)
        fewer.shape = (records.size, self.shape[1])
        fewer._groups = [(slab, first[records]) for slab, first in self._groups]
        return fewer


class _OnTimeline:
    """A solution over stretches between events."""

    def __init__(
        self,
        evaluator: TimelineEvaluator | BranchEvaluator,
        rows: NDArray[np.intp],
        response: tables.Response,
    ) -> None:
        self.evaluator, self.rows, self.response = evaluator, rows, response

    def selected(self, records: NDArray[np.intp]) -> _OnTimeline:
        """See :meth:`OwnTimes.selected`."""
        fewer = tables.Response(*(each[records] for each in self.response))
        return _OnTimeline(self.evaluator, self.rows, fewer)

    def linearised(self, points: Array, free: Sequence[int]) -> tuple[Array, Array]:
        """See :meth:`OwnTimes.linearised`."""
        d, count, records = points.shape
        times, weights = self.response
        values = np.empty((count, records, self.rows.size))
        slopes = np.empty((*values.shape, len(free)))
        step = max(_POINTS_AT_ONCE // max(records, 1), 1)
        for row in np.unique(self.rows):
            columns = np.flatnonzero(self.rows == row)
            shape = columns.size, times.shape[2]
            own = weights[:, columns]
            clock = times[:, columns].reshape(records, -1).T
            for begin in range(0, count, step):
                block = points[:, begin : begin + step]
                size = block.shape[1]
                at = np.tile(clock, (1, size))
                states, moved = self.evaluator.linearised(
                    at, block.reshape(d, -1), np.array([row]), free
                )
                here = slice(begin, begin + size)
                each = states[0].T.reshape(size, records, *shape)
                values[here][..., columns] = (own * each).sum(axis=-1)
                each = moved[0].swapaxes(0, 1).reshape(size, records, *shape, len(free))
                slopes[here][..., columns, :] = (own[..., None] * each).sum(axis=-2)
        return values, slopes


# -----------------------------------------------------------------------------
# Subjects of a table: what was measured of each, and what differs between them.
#
# A record is a part of a subject's rows under one condition. Data of all records are stacked, with
# records along the first axis; where a record has fewer data than others, the rest is not present.


SUBJECT = tables.GROUPS[1]
"""The column of subjects."""


@dataclass(frozen=True)
class Measured:
    """One observable in n records, at up to m times each.

    ``times``, ``data`` and ``present`` have the shape (n, m), and so have the spread of the noise
    and the ``rows`` of the table. ``states`` are those that the observable and its noise depend on.
    """

    name: str
    formula: Formula
    noise: Noise
    times: Array
    data: Array
    present: NDArray[np.bool_]
    rows: NDArray[np.intp]
    states: tuple[str, ...]

    def selected(self, records: NDArray[np.intp]) -> Measured:
        """What was measured in some of the records."""
        noise = replace(self.noise, spread=self.noise.spread[records])
        times, data, present = self.times[records], self.data[records], self.present[records]
        rows = self.rows[records]
        return replace(self, noise=noise, times=times, data=data, present=present, rows=rows)


@dataclass(frozen=True)
class Subjects:
    """All subjects: their ``names``, and for each record the position of its ``owner`` (n,).

    ``held`` are the parameters that the table or the user fixes, (n,) each. Records of a subject
    follow each other; ``doses`` are those of the records.
    """

    solution: SolutionCore
    names: tuple[str, ...]
    owner: NDArray[np.intp]
    held: dict[str, Array]
    measured: tuple[Measured, ...]
    states: OwnTimes
    doses: tables.Doses

    @property
    def size(self) -> int:
        """Number of data."""
        return sum(int(one.present.sum()) for one in self.measured)

    @property
    def sizes(self) -> Array:
        """Number of data of each subject (subjects,)."""
        records = sum(one.present.sum(axis=1) for one in self.measured)
        return self.over_records(np.asarray(records, dtype=float))

    @property
    def levels(self) -> tuple[str, ...]:
        """Levels of noise that are estimated."""
        return tuple(dict.fromkeys(name for one in self.measured for name in one.noise.levels))

    def over_records(self, rows: Array, axis: int = 0) -> Array:
        """Sums over the records of each subject, along an axis."""
        if len(self.names) == self.owner.size:
            return rows
        begins = np.searchsorted(self.owner, np.arange(len(self.names)))
        return np.asarray(np.add.reduceat(rows, begins, axis=axis))

    def points(self, at: Mapping[str, Array]) -> Array:
        """All parameters of the solution (d, K, n) for some by name, (K, n) each."""
        shape = next(iter(at.values())).shape
        rows = [at[name] if name in at else self.held[name] for name in self.solution.parameters]
        return np.array([np.broadcast_to(row, shape) for row in rows])

    def operands(self, index: int, at: Mapping[str, Operand], columns: Operand) -> dict[str, Any]:
        """What the formula of an observable takes.

        ``at`` are parameters by name, ``columns`` the states (K, n, M) of :attr:`states`.
        """
        one, begin = self.measured[index], 0
        operands: dict[str, Any] = {name: row[:, None] for name, row in self.held.items()}
        operands |= {**at, self.solution.metadata.time: one.times}
        for earlier in self.measured[:index]:
            begin += len(earlier.states) * earlier.times.shape[1]
        for state in one.states:
            end = begin + one.times.shape[1]
            if isinstance(columns, Dual):
                operands[state] = Dual(
                    columns.value[..., begin:end], columns.slope[..., begin:end, :]
                )
            else:
                operands[state] = np.asarray(columns)[..., begin:end]
            begin = end
        return operands

    def selected(self, which: NDArray[np.intp]) -> Subjects:
        """Some of the subjects, by ascending positions."""
        records = np.flatnonzero(np.isin(self.owner, which))
        return replace(
            self,
            names=tuple(self.names[i] for i in which),
            owner=np.searchsorted(which, self.owner[records]),
            held={name: row[records] for name, row in self.held.items()},
            measured=tuple(one.selected(records) for one in self.measured),
            states=self.states.selected(records),
            doses=self.doses.selected(records),
        )

    def constant(self) -> float:
        """What -2 log L has beside the costs of the data."""
        whole = 0.0
        for one in self.measured:
            spread = one.noise.spread[one.present]
            noise = replace(one.noise, spread=spread)
            sigma = np.ones(spread.shape) if noise.estimated else spread
            data = one.data[one.present]
            whole -= 2.0 * log_likelihood(noise, data, np.zeros(data.shape), sigma)
        return whole


def subjects_of(
    solution: SolutionCore,
    experiment: Experiment,
    columns: Mapping[str, Any],
    doses: tables.DosesBySubject | None = None,
) -> Subjects:
    """The subjects of a table, whose columns are given by name; rows of doses hold no data."""
    if SUBJECT not in columns:
        raise OptionError(
            f"the table has no column {quote(SUBJECT)}{did_you_mean(SUBJECT, columns)}",
            term=list(columns),
            remedy=f"name the column that tells subjects apart: subject=...; the columns are "
            f"{listing(columns)}",
        )
    blocks = tables.blocks_of(solution, dict(columns), experiment.observe)
    held = fixed_by_label(solution, experiment.fixed, blocks)
    observed = [observed_in(solution, experiment, block) for block in blocks]
    for each in observed:
        check_levels(solution, each)
    names = list(dict.fromkeys(block.labels[-1] for block in blocks))
    owners = np.array([names.index(block.labels[-1]) for block in blocks], dtype=np.intp)
    order = np.argsort(owners, kind="stable")
    held = [held[i] for i in order]
    stacked = {name: np.array([own[name] for own in held]) for name in held[0]}
    measured = _stacked(solution, [(observed[i], blocks[i]) for i in order])
    if doses is None:
        own_doses = tables.Doses.at_start(solution, order.size)
    else:
        own_doses = doses.of_records(solution, [names[i] for i in owners[order]])
    return Subjects(
        solution,
        tuple(names),
        owners[order],
        stacked,
        measured,
        _states_of(solution, measured, own_doses),
        own_doses,
    )


def _states_of(
    solution: SolutionCore, measured: Sequence[Measured], doses: tables.Doses
) -> OwnTimes:
    """The states that observables depend on, at the times of their data."""
    pairs = [(one, state) for one in measured for state in one.states]
    rows = [np.full(one.times.shape[1], solution.states.index(state)) for one, state in pairs]
    times = np.concatenate([one.times for one, _ in pairs], axis=1)
    of_table = np.concatenate([one.rows for one, _ in pairs], axis=1)
    return own_times(solution, np.concatenate(rows), doses.response(times, of_table))


def _stacked(
    solution: SolutionCore, records: Sequence[tuple[Observations, tables.Block]]
) -> tuple[Measured, ...]:
    """Each observable in all records."""
    names = dict.fromkeys(name for one, _ in records for name in one.names)
    return tuple(_measured(solution, name, records) for name in names)


def _measured(
    solution: SolutionCore, name: str, records: Sequence[tuple[Observations, tables.Block]]
) -> Measured:
    observed = [one for one, _ in records]
    places = [one.names.index(name) if name in one.names else None for one in observed]
    pairs = list(zip(observed, places, strict=True))
    slices = [slice(0, 0) if i is None else one.of(i) for one, i in pairs]
    sizes = [here.stop - here.start for here in slices]
    shape = (len(observed), max(sizes))
    present = np.arange(shape[1]) < np.array(sizes)[:, None]
    times, data, spread = (np.empty(shape) for _ in range(3))
    times[:], data[:], spread[:] = solution.time[0], 1.0, 1.0
    rows = np.full(shape, -1)
    for k, ((one, i), here, size) in enumerate(zip(pairs, slices, sizes, strict=True)):
        if i is None:
            continue
        times[k, :size], data[k, :size] = one.times[here], one.values[here]
        times[k, size:] = times[k, 0]
        spread[k, :size] = one.noises[i].spread
        rows[k, :size] = records[k][1].rows[name]
    first, place = next((one, i) for one, i in pairs if i is not None)
    noise = replace(first.noises[place], spread=spread)
    formula = first.formulas[place]
    _check_names(solution, name, formula, noise)
    needed = [*formula.names, *(noise.formula.names if noise.formula is not None else ())]
    states = tuple(dict.fromkeys(each for each in needed if each in solution.states))
    return Measured(name, formula, noise, times, data, present, rows, states)


def _check_names(solution: SolutionCore, name: str, formula: Formula, noise: Noise) -> None:
    """Raise an OptionError for parameters of an observable that the solution does not have."""
    names = {*solution.states, *solution.parameters, solution.metadata.time, name, *noise.levels}
    needed = [*formula.names, *(noise.formula.names if noise.formula is not None else ())]
    for each in needed:
        if each not in names:
            raise OptionError(
                f"{quote(formula.text)}: {quote(each)} is neither an unknown nor a parameter"
                f"{did_you_mean(each, names)}",
                term=each,
                remedy="make it a parameter of the problem",
            )
