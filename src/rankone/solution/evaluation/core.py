"""Evaluation of a solution at times and parameters, in blocks that take bounded memory.

:class:`~rankone.solution.solution.Solution` adds everything that exported solvers do without.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property, partial
from os import PathLike
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from rankone.solution.storage.npz import write
from rankone.solvers.branches import branch_evaluator
from rankone.solvers.outcome import Outcome, SafeInterval, SolutionMetadata
from rankone.support.arrays import AT_ONCE, Array
from rankone.support.errors import BlowUpError, ConvergenceError, EvaluationError, listing, quote
from rankone.support.options import checked_memory, in_words, physical_memory
from rankone.tensors.branch_evaluator import BranchEvaluator, PieceEvaluator, Tiling
from rankone.tensors.coordinates import Coordinates, name_of
from rankone.tensors.evaluator import Rows, TrainEvaluator
from rankone.tensors.slab import SlabTrain
from rankone.tensors.timeline_evaluator import TimelineEvaluator
from rankone.trajectories.system.timeline import BranchedTimeline, Timeline
from rankone.trajectories.system.verdict import Status, SwitchesNotHeld, SwitchingTerm

# How trajectories end before the horizon
_ENDS = {
    Status.BLOW_UP: "blows up inside the horizon",
    Status.LEAVES: "reaches a point where its right-hand side is not finite",
    Status.SWITCHES: "switches to and fro without end",
    Status.STALLS: "gets no further: steps shrink without end, although its rates are finite",
}
# Fractions of a safe interval to solve on: near its end the states are very large
_KEPT_SHARES = (0.95, 0.8, 0.5)
_MOST_SMALLER_BOXES = 4  # Most boxes to solve on; each has an equal share of the budget
_MESSAGE_DIGITS = 100.0  # A message gives the end of an interval to a hundredth of its length

Evaluator = TrainEvaluator | TimelineEvaluator | BranchEvaluator | PieceEvaluator
"""What evaluates a solution."""
_OnBox = Callable[[Mapping[int, tuple[float, float]], float], "SolutionCore"]
"""Solves with other intervals of some parameters, and a fraction of the budget."""


class SolutionCore:
    """The unknowns as functions of time and of all parameters.

    Call it with times and parameter values, or index it to get one unknown:

    - ``solution(t=1.0, x0=9.0, y0=5.0)`` has the shape (unknowns,);
    - ``solution(times, {x0: 9, y0: [4.5, 5.5]})`` broadcasts as NumPy does and has the shape
      (unknowns, *broadcast shape); keys are symbols or names. Many times of one point, or times
      along an axis of their own, ``times[:, None]``, cost less than as many separate points;
    - ``solution[x](t=times, x0=9, y0=5)`` has the broadcast shape alone;
    - ``solution.grid(t=times, x0=..., y0=...)`` evaluates every combination.

    Values outside the box or the horizon are errors; nothing is extrapolated. ``outcome`` is
    what the engine returned, ``metadata`` what was asked.
    """

    def __init__(self, outcome: Outcome, metadata: SolutionMetadata) -> None:
        self.outcome = outcome
        self.metadata = metadata
        self._unknowns = _rows(metadata.unknown_rows)
        self._coordinates = Coordinates(
            (metadata.time, *metadata.parameters),
            (self.time, *metadata.box),
            timeless=metadata.timeless,
        )

    # --- evaluation ----------------------------------------------------------------------------

    def __call__(
        self, *at: object, max_memory: str | float | None = None, **named: object
    ) -> Array:
        """Evaluate all unknowns.

        Parameters
        ----------
        *at
            Times, then a mapping from symbols or names to values; or either of the two alone.
        max_memory : float or str, optional
            Bytes that the call may take, its values included, or a text such as ``"2GB"``.
        **named
            Values by name.

        Returns
        -------
        ndarray (unknowns, *broadcast shape of the values)

        Raises
        ------
        EvaluationError
            If a coordinate is missing, unknown, given twice, not a real number, or outside
            the box or the horizon; or if the values do not fit into the memory.
        """
        return self._evaluate(self._coordinates.gather(at, named), self._unknowns, max_memory)

    def grid(self, *at: object, max_memory: str | float | None = None, **named: object) -> Array:
        """Evaluate all unknowns for every combination of values, one axis per coordinate.

        Arguments and errors are those of a call; each value is a number or one-dimensional.

        Returns
        -------
        ndarray (unknowns, times, values of parameter 1, values of parameter 2, ...)
            Without times if nothing depends on time.
        """
        gathered = self._coordinates.gather(at, named)
        return self._evaluate_grid(gathered, self._unknowns, max_memory)

    def blocks(
        self, *at: object, max_memory: str | float = "256MB", **named: object
    ) -> Iterator[tuple[Index, Array]]:
        """Evaluate all unknowns block after block, in bounded memory.

        Parameters
        ----------
        *at, **named
            As for a call; memory-mapped arrays are read as they are needed.
        max_memory : float or str
            Bytes that a block may take, its values included, or a text such as ``"2GB"``.

        Yields
        ------
        index : tuple of int and slice
            Where the block is in the broadcast shape of the values.
        values : ndarray (unknowns, *shape of the block)

        Raises
        ------
        EvaluationError
            As for a call, or if not even a point fits.

        Examples
        --------
        >>> total = 0.0
        >>> for index, values in solution.blocks(t=1.0, k=many):  # doctest: +SKIP
        ...     total += values.sum()
        """
        most = checked_memory("max_memory", max_memory)
        gathered = self._coordinates.gather(at, named)
        arrays = self._coordinates.as_arrays(gathered)
        evaluate = partial(self._evaluate_block, rows=self._unknowns)
        yield from in_blocks(arrays, len(self.unknowns), most, evaluate)

    def __getitem__(self, state: object) -> UnknownView:
        """Return one unknown, or one derivative that is a state: ``solution[x.diff(t)]``."""
        name = name_of(state, self.metadata.time)
        if name not in self.states:
            raise EvaluationError(
                f"no unknown `{name}`{self.metadata.hint(name)}; "
                f"the solution holds {listing(self.states, name)}",
                term=state,
            )
        return UnknownView(self, name)

    def __repr__(self) -> str:
        success = "success" if self.success else "no success"
        return f"Solution of {', '.join(self.unknowns)}: {success}, {self.message}"

    def __iter__(self) -> NoReturn:
        raise TypeError("a Solution is not iterable; its unknowns are in `.unknowns`")

    def _evaluate(
        self, gathered: list[Any], rows: Rows, max_memory: str | float | None = None
    ) -> Array:
        """Values of some states, (rows, *broadcast shape)."""
        evaluator = self._evaluator
        point = self._coordinates.numbers(gathered) if max_memory is None else None
        if point is not None:
            return evaluator.one(point, rows)
        evaluate = partial(self._evaluate_block, rows=rows)
        return self._within(max_memory, gathered, (_count(rows),), evaluate)

    def _within(
        self,
        max_memory: str | float | None,
        gathered: Sequence[Any],
        leading: tuple[int, ...],
        evaluate: Callable[[Sequence[Array]], Array],
    ) -> Array:
        """Values (*leading, *broadcast shape) of what evaluates arrays that fit into the memory."""
        arrays = self._coordinates.as_arrays(gathered)
        shape = self._coordinates.common_shape(arrays)
        if 0 in shape:
            foreseen(0.0, 0.0, max_memory)  # raises for what is no amount
            self._coordinates.arrays(arrays)  # and this for values outside
            return np.empty((*leading, *shape))
        with _memory():
            return whole(arrays, shape, leading, max_memory, evaluate)

    def _evaluate_block(self, gathered: Sequence[Array], rows: Rows) -> Array:
        """Values of some states at arrays that fit into the memory, (rows, *broadcast shape)."""
        arrays = self._coordinates.arrays(gathered)
        if all(array.ndim == 0 for array in arrays):
            return self._evaluator.one([float(array) for array in arrays], rows)
        curves = self._coordinates.curves(arrays)
        return curves.shaped(self._evaluator.curves(curves.times, curves.points, rows))

    def _evaluate_grid(
        self, gathered: list[Any], rows: Rows, max_memory: str | float | None = None
    ) -> Array:
        """Values of some states on a tensor grid, (rows, *sizes of the axes)."""
        axes, states = self._coordinates.axes(gathered), _count(rows)
        sizes = [axis.size for axis in axes]
        foreseen(8 * states * math.prod(sizes), bytes_of(1, len(axes), states), max_memory)
        with _memory():
            values = np.empty((states, *sizes)) if 0 in sizes else self._evaluator.grid(axes, rows)
        return values[:, 0] if self.metadata.timeless else values

    @cached_property
    def _evaluator(self) -> Evaluator:
        if not self.outcome.is_solved:
            raise EvaluationError(f"nothing was solved: {self.message}")
        return evaluator_of(self.outcome, self.metadata)

    # --- what was asked and what came out ------------------------------------------------------

    @property
    def success(self) -> bool:
        """Whether the measured error is within the tolerance asked; False if it is not known."""
        return self.outcome.status is Status.CONVERGED

    @property
    def status(self) -> Status:
        """How the solve ended."""
        return self.outcome.status

    @property
    def message(self) -> str:
        """How the solve ended, why, and what to do."""
        return self.outcome.message

    @property
    def error(self) -> float:
        """Largest measured error over all states, relative to each one's size; NaN if unchecked.

        Derivatives that became states count as well, unless ``unknowns`` said what to solve for.
        """
        measured = self.outcome.measured
        return float("nan") if measured is None else measured.error

    @property
    def errors(self) -> dict[str, float]:
        """Measured error of each state; NaN if unchecked."""
        measured = self.outcome.measured
        every = [float("nan")] * len(self.states) if measured is None else measured.interior
        return _ByState(zip(self.states, every, strict=True), self.metadata)

    @property
    def corner_error(self) -> float:
        """Largest measured error at corners of the box; NaN if there are none or unchecked.

        Of the same states as ``error``.
        """
        measured = self.outcome.measured
        return measured.corner_error if measured and measured.corners else float("nan")

    @property
    def method(self) -> str:
        """Name of the engine that found it."""
        return self.metadata.method

    @property
    def rtol(self) -> float:
        """Relative tolerance asked for."""
        return self.metadata.rtol

    @property
    def unknowns(self) -> tuple[str, ...]:
        """Names of the unknowns, in the order of the values."""
        return self.metadata.unknowns

    @property
    def states(self) -> tuple[str, ...]:
        """Names of all that can be asked for: the unknowns and derivatives that are states."""
        return self.metadata.states

    @property
    def parameters(self) -> dict[str, tuple[float, float]]:
        """The box: the interval of each parameter."""
        return dict(zip(self.metadata.parameters, self.metadata.box, strict=True))

    @property
    def time(self) -> tuple[float, float]:
        """Start and end of what was solved."""
        start, end = self.metadata.horizon
        pieces = self.outcome.pieces
        outcomes = [piece.outcome for piece in pieces] if pieces else [self.outcome]
        return start, min(_solved_end(outcome, start, end) for outcome in outcomes)

    # --- files ---------------------------------------------------------------------------------

    def save(self, path: str | PathLike[str], *, overwrite: bool = False) -> Path:
        """Write the solution to a file in an open format, without pickle.

        Parameters
        ----------
        path : path-like
            Ends in ``.npz``; in the library also in ``.nc`` for netCDF, which needs h5netcdf and
            h5py.
        overwrite : bool
            Whether to replace an existing file.

        Raises
        ------
        StorageError
            If the name has another suffix, the file exists and must not be replaced, it cannot be
            written, or a package that it needs is not installed. The file is complete or absent,
            even after an interrupt.
        """
        return self._write(path, self.outcome, self.metadata, overwrite)

    _write = staticmethod(write)

    def __reduce__(self) -> tuple[object, ...]:
        return type(self), (self.outcome, self.metadata)


@dataclass(frozen=True, repr=False)
class UnknownView:
    """One unknown, or derivative that is a state, as a function of time and the parameters."""

    solution: SolutionCore
    name: str

    @property
    def row(self) -> int:
        """Position among the states."""
        return self.solution.states.index(self.name)

    def __call__(self, *at: object, max_memory: str | float | None = None, **named: object) -> Any:
        """Evaluate: arguments and errors as for a solution, shape of the result as broadcast."""
        gathered = self.solution._coordinates.gather(at, named)
        return self.solution._evaluate(gathered, _rows([self.row]), max_memory)[0]

    def grid(self, *at: object, max_memory: str | float | None = None, **named: object) -> Array:
        """Evaluate for every combination of values: shape (times, values of parameter 1, ...)."""
        gathered = self.solution._coordinates.gather(at, named)
        values: Array = self.solution._evaluate_grid(gathered, _rows([self.row]), max_memory)[0]
        return values

    @property
    def error(self) -> float:
        """Measured error, relative to the unknown's size; NaN if unchecked."""
        return self.solution.errors[self.name]

    def __repr__(self) -> str:
        coordinates = ", ".join(self.solution._coordinates.asked)
        return f"{self.name}({coordinates}) of a Solution, measured error {self.error:.2g}"


class _ByState(dict[str, float]):
    """Errors by the names of states; symbols are understood."""

    def __init__(self, errors: Iterable[tuple[str, float]], metadata: SolutionMetadata) -> None:
        super().__init__(errors)
        self._hint = metadata.hint

    def __missing__(self, state: object) -> float:
        name = name_of(state)
        if name not in self:
            raise KeyError(f"no state {name}{self._hint(name)}; known are {listing(self, name)}")
        return self[name]


def evaluator_of(outcome: Outcome, metadata: SolutionMetadata) -> Evaluator:
    """The evaluator of what was solved."""
    if outcome.pieces:
        boxes = [piece.metadata.box for piece in outcome.pieces]
        evaluators = [_own_evaluator(piece.outcome) for piece in outcome.pieces]
        return PieceEvaluator(evaluators, Tiling.of(boxes, metadata.parameters))
    return _own_evaluator(outcome)


def _own_evaluator(outcome: Outcome) -> TrainEvaluator | TimelineEvaluator | BranchEvaluator:
    """The evaluator of slabs."""
    timeline = outcome.timeline
    if isinstance(timeline, BranchedTimeline):
        return branch_evaluator(outcome.slabs, timeline)
    if timeline is not None:
        return timeline_evaluator(outcome.slabs, timeline)
    return TrainEvaluator(outcome.slabs)


def timeline_evaluator(slabs: Sequence[SlabTrain], timeline: Timeline) -> TimelineEvaluator:
    """The evaluator of slabs over the stretches of a timeline."""
    return TimelineEvaluator(slabs, timeline.horizon, timeline.affine_borders)


def _solved_end(outcome: Outcome, start: float, end: float) -> float:
    """The end of what was solved of a horizon."""
    if not outcome.slabs:
        return start
    if outcome.timeline is not None:
        return end
    reached = outcome.slabs[-1].end
    return end if abs(end - reached) <= 1e-10 * (end - start) else reached


@contextmanager
def _memory() -> Iterator[None]:
    """Turn a MemoryError into an EvaluationError."""
    try:
        yield
    except MemoryError as error:
        raise no_memory(error) from None


def raise_blow_up(solution: SolutionCore, on_box: _OnBox) -> None:
    """Raise a BlowUpError with the solution if a trajectory ends before the horizon.

    ``on_box`` is for the part of the box that is safe.
    """
    outcome = solution.outcome
    if not outcome.status.ends_early or outcome.blow_up is None:
        return
    when, point = outcome.blow_up
    names, safe = tuple(solution.parameters), outcome.safe
    parameters = dict(zip(names, point, strict=True))
    at = ", ".join(f"{name} = {coordinate:.6g}" for name, coordinate in parameters.items())
    subject = "the solution"
    if outcome.switching is not None:
        subject = f"the rate of {quote(solution.states[outcome.switching])}"
    remedy = f"end the horizon before t = {when:.4g}"
    attached = f"the error has the solution up to t = {solution.time[1]:.4g} as .solution"
    if safe:
        remedy += f", or narrow the box: {_safe_sentence(safe[0], names)} would do"
        attached += "; its .part solves a smaller box over the whole horizon"
    elif names:
        remedy += ", or narrow the box"

    def solve_smaller_box() -> SolutionCore | None:
        return _on_smaller_box(safe, on_box)

    raise BlowUpError(
        f"{subject} {_ENDS[outcome.status]}: near t = {when:.4g}"
        + (f" at {at}" if at else "")
        + "".join(
            note.lead + note.sentence(outcome.status)
            for note in outcome.notes
            if isinstance(note, SwitchingTerm | SwitchesNotHeld)
        ),
        time=when,
        parameters=parameters,
        solution=solution,
        part=solve_smaller_box if safe else None,
        remedy=f"{remedy}; {attached}",
    )


def _on_smaller_box(safe: Sequence[SafeInterval], on_box: _OnBox) -> SolutionCore | None:
    """The solution on the largest box that is safe over the whole horizon; None if none is."""
    boxes = [interval.shortened(share) for interval in safe for share in _KEPT_SHARES]
    for box in sorted(boxes, key=lambda each: -each.share)[:_MOST_SMALLER_BOXES]:
        try:
            smaller = on_box({box.parameter: (box.lower, box.upper)}, 1.0 / _MOST_SMALLER_BOXES)
        except ConvergenceError:
            continue
        if smaller.status in (Status.CONVERGED, Status.UNCHECKED):
            return smaller
    return None


def _count(rows: Rows) -> int:
    """How many states there are by position."""
    return rows.stop - rows.start if isinstance(rows, slice) else rows.size


def _rows(positions: Sequence[int]) -> Rows:
    """States by position: a slice, which needs no copy, where they follow each other."""
    first, last = positions[0], positions[-1]
    adjacent = len(positions) == last + 1 - first
    return slice(first, last + 1) if adjacent else np.array(positions, dtype=np.intp)


def _safe_sentence(interval: SafeInterval, names: Sequence[str]) -> str:
    """An interval that would do, as a user reads it: "`k` below 1.83"."""
    step = 10.0 ** math.floor(math.log10((interval.upper - interval.lower) / _MESSAGE_DIGITS))
    end = interval.upper if interval.below else interval.lower
    rounded = (math.floor if interval.below else math.ceil)(end / step) * step
    side = "below" if interval.below else "above"
    return f"{quote(names[interval.parameter])} {side} {rounded:.10g}"


# -----------------------------------------------------------------------------
# Evaluation in blocks, so that values of any number of points take bounded memory.


Index = tuple[int | slice, ...]
"""Where a block is in the broadcast shape of the arguments."""

# Numbers for each point beside its coordinates and values: copies of both in the order of slabs
_COPIES = 3
# Bytes that an evaluation takes whatever the number of points: buffers of products
_BUFFERS = 4 * 8 * AT_ONCE
_WORKSPACE = 4 * _BUFFERS  # Bytes beside all values for the blocks of a call that has no limit
_STREAM = "evaluate block after block: solution.blocks(...)"


def bytes_of(points: int, coordinates: int, numbers: int) -> float:
    """Bytes that an evaluation of this many points takes, with ``numbers`` values of each."""
    return 8 * _COPIES * (coordinates + numbers + 1) * points + _BUFFERS


def in_blocks(
    arrays: Sequence[Array],
    numbers: int,
    most: float,
    evaluate: Callable[[Sequence[Array]], Array],
) -> Iterator[tuple[Index, Array]]:
    """Indices into the broadcast shape of arrays, and values (..., *block) there.

    A point has ``numbers`` values. Axes along which the first array, times, varies alone are cut
    last: parameters have to be evaluated for each block. No block takes more than ``most`` bytes,
    or it is an EvaluationError.
    """
    try:
        shape = np.broadcast_shapes(*(array.shape for array in arrays))
    except ValueError:
        yield (), evaluate(arrays)  # raises an error that names the shapes
        return
    each = bytes_of(1, len(arrays), numbers) - _BUFFERS
    points = int((most - _BUFFERS) // each)
    if points < 1:
        raise EvaluationError(
            f"max_memory={in_words(most)} is less than evaluations take, "
            f"{in_words(_BUFFERS + each)}",
            remedy="raise max_memory",
        )
    padded = [array.reshape((1,) * (len(shape) - array.ndim) + array.shape) for array in arrays]
    of_times = [all(array.shape[k] == 1 for array in padded[1:]) for k in range(len(shape))]
    for index in _indices(shape, points, sorted(range(len(shape)), key=of_times.__getitem__)):
        yield index, evaluate([_block(array, index) for array in padded])


def whole(
    arrays: Sequence[Array],
    shape: tuple[int, ...],
    leading: tuple[int, ...],
    max_memory: str | float | None,
    evaluate: Callable[[Sequence[Array]], Array],
) -> Array:
    """Values (*leading, *shape) at arrays that broadcast to a shape, in blocks if they are many.

    An EvaluationError if they do not fit into ``max_memory``, or into the memory of the machine.
    """
    numbers = math.prod(leading)
    needed = 8 * numbers * math.prod(shape)
    if max_memory is None and needed <= _WORKSPACE:
        return evaluate(arrays)
    least = bytes_of(1, len(arrays), numbers)
    left = min(foreseen(needed, least, max_memory) - needed, max(_WORKSPACE, least))
    values = np.empty((*leading, *shape))
    every = (slice(None),) * len(leading)
    for index, block in in_blocks(arrays, numbers, left, evaluate):
        values[(*every, *index)] = block
    return values


def foreseen(values: float, beside: float, max_memory: str | float | None) -> float:
    """The limit on bytes; an EvaluationError if the values, and those ``beside``, exceed it."""
    there = physical_memory()
    if values > there:
        raise EvaluationError(
            f"all values take {in_words(values)}, and this machine has {in_words(there)}",
            remedy=_STREAM,
        )
    if max_memory is None:
        return math.inf
    most = checked_memory("max_memory", max_memory)
    if values + beside > most:
        raise EvaluationError(
            f"all values take {in_words(values)}, their evaluation {in_words(beside)} more, "
            f"and max_memory is {in_words(most)}",
            remedy=_STREAM,
        )
    return most


def no_memory(error: MemoryError) -> EvaluationError:
    """The error for values that the machine has no memory for after all."""
    return EvaluationError(f"there is no memory for all values: {error}", remedy=_STREAM)


def _block(array: Array, index: Index) -> Array:
    """What a padded array has at an index of the broadcast shape: axes of length one stay."""
    along = zip(index, array.shape, strict=True)
    own = (k if size != 1 else slice(None) if isinstance(k, slice) else 0 for k, size in along)
    return array[tuple(own)]


def _indices(shape: tuple[int, ...], points: int, order: Sequence[int]) -> Iterator[Index]:
    """Indices of parts of a shape, of at most ``points`` each; axes are cut in the given order."""
    sizes = [shape[axis] for axis in order]
    if not shape or 0 in shape:
        yield from () if shape else ((),)
        return
    cut = 0  # the first axis that fits in part, with all after it whole
    while cut < len(sizes) and math.prod(sizes[cut + 1 :]) > points:
        cut += 1
    step = max(points // math.prod(sizes[cut + 1 :]), 1)
    back = np.argsort(order).tolist()
    after = [slice(0, size) for size in sizes[cut + 1 :]]
    for before in itertools.product(*map(range, sizes[:cut])):
        for start in range(0, sizes[cut], step):
            index = (*before, slice(start, min(start + step, sizes[cut])), *after)
            yield tuple(index[k] for k in back)
