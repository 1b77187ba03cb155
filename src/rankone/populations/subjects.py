"""Subjects of a table: what was measured of each, and what differs between them.

A record is a part of a subject's rows under one condition. Data of all records are stacked, with
records along the first axis; where a record has fewer data than others, the rest is not present.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rankone.estimation.doses import Doses, DosesBySubject
from rankone.estimation.duals import Dual, Operand
from rankone.estimation.experiments import Experiment, fixed_by_label, observed_in
from rankone.estimation.formulas import Formula
from rankone.estimation.noise import Noise, log_likelihood
from rankone.estimation.observations import Observations, check_levels
from rankone.estimation.tables import GROUPS, Block, blocks_of
from rankone.populations.predictions import OwnTimes, own_times
from rankone.solution.core import SolutionCore
from rankone.support.arrays import Array
from rankone.support.errors import OptionError
from rankone.support.wording import did_you_mean, listing, quote

SUBJECT = GROUPS[1]
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
    doses: Doses

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
    doses: DosesBySubject | None = None,
) -> Subjects:
    """The subjects of a table, whose columns are given by name; rows of doses hold no data."""
    if SUBJECT not in columns:
        raise OptionError(
            f"the table has no column {quote(SUBJECT)}{did_you_mean(SUBJECT, columns)}",
            term=list(columns),
            remedy=f"name the column that tells subjects apart: subject=...; the columns are "
            f"{listing(columns)}",
        )
    blocks = blocks_of(solution, dict(columns), experiment.observe)
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
        own_doses = Doses.at_start(solution, order.size)
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


def _states_of(solution: SolutionCore, measured: Sequence[Measured], doses: Doses) -> OwnTimes:
    """The states that observables depend on, at the times of their data."""
    pairs = [(one, state) for one in measured for state in one.states]
    rows = [np.full(one.times.shape[1], solution.states.index(state)) for one, state in pairs]
    times = np.concatenate([one.times for one, _ in pairs], axis=1)
    of_table = np.concatenate([one.rows for one, _ in pairs], axis=1)
    return own_times(solution, np.concatenate(rows), doses.response(times, of_table))


def _stacked(
    solution: SolutionCore, records: Sequence[tuple[Observations, Block]]
) -> tuple[Measured, ...]:
    """Each observable in all records."""
    names = dict.fromkeys(name for one, _ in records for name in one.names)
    return tuple(_measured(solution, name, records) for name in names)


def _measured(
    solution: SolutionCore, name: str, records: Sequence[tuple[Observations, Block]]
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
