"""Many solves of one problem: on pieces of its box, under conditions, for designs."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from os import PathLike
from typing import Any, overload

import numpy as np

from rankone.problem.problem import Problem
from rankone.solution.checkpoint import Checkpoint, SolveFiles
from rankone.solution.compiled import CompiledProblem, check_arguments, compile_problem
from rankone.solution.solution import Solution
from rankone.solvers.request import Domain
from rankone.support.arrays import Labelled, Table, Variables
from rankone.support.budget import StepReport, counting_bar
from rankone.support.errors import (
    ConvergenceError,
    OptionError,
    ProblemError,
    RankoneError,
    RankoneWarning,
    check_kind,
    count,
    shown,
    warn,
)
from rankone.support.options import RTOL, takes_options_of
from rankone.support.tasks import (
    ExecutorLike,
    Parcel,
    Pool,
    Tasks,
    checked_executor,
    open_pool,
    packed,
    unpacked,
)
from rankone.tensors.coordinates import name_of
from rankone.trajectories.system.verdict import Status

Box = Mapping[Any, Any]
"""Intervals of parameters, and numbers of constants, by symbols or names."""
Progress = bool | StepReport
"""Whether a bar is shown, or what is called with the numbers of finished and of all boxes."""
_BOXES_REMEDY = "give [{k: (1, 2)}, {k: (2, 3)}], or problem.split(k=2)"


@dataclass(frozen=True, repr=False)
class Solutions(Labelled, Sequence[Solution]):
    """Solutions on several boxes, in their order; they print as a table.

    Attributes
    ----------
    boxes : tuple of dict
        What was changed for each: intervals of parameters, and numbers of constants, by name.
    seconds : tuple of float
        What each took on the clock, where it was solved.
    failures : dict of int to RankoneError
        Why there is no solution, for the boxes without one: an error of the solve, or of its
        worker. Asking for such a solution raises the error.
    """

    boxes: tuple[dict[str, Any], ...]
    seconds: tuple[float, ...]
    failures: dict[int, RankoneError]
    _solutions: tuple[Solution | None, ...]

    @property
    def statuses(self) -> tuple[Status | None, ...]:
        """How each solve ended; None where there is no solution."""
        return tuple(None if s is None else s.status for s in self._solutions)

    @property
    def success(self) -> bool:
        """Whether all are a success."""
        return all(solution is not None and solution.success for solution in self._solutions)

    @property
    def errors(self) -> tuple[float, ...]:
        """The measured error of each; NaN where there is none."""
        return tuple(float("nan") if s is None else s.error for s in self._solutions)

    def join(self) -> Solution:
        """One solution over the box that the boxes tile; see :meth:`rankone.Solution.join`."""
        return Solution.join(self)

    def __len__(self) -> int:
        return len(self._solutions)

    @overload
    def __getitem__(self, index: int) -> Solution: ...

    @overload
    def __getitem__(self, index: slice) -> list[Solution]: ...

    def __getitem__(self, index: int | slice) -> Solution | list[Solution]:
        if isinstance(index, slice):
            return [self[k] for k in range(len(self))[index]]
        solution = self._solutions[index]
        if solution is None:
            raise self.failures[range(len(self))[index]]
        return solution

    def _table(self) -> Table:
        names = list(dict.fromkeys(name for box in self.boxes for name in box))
        header = ["box", *names, "success", "error", "method", "seconds", "message"]
        rows = []
        for k, (box, solution) in enumerate(zip(self.boxes, self._solutions, strict=True)):
            changes = [_cell(box[name]) if name in box else "" for name in names]
            if solution is None:
                outcome = ["no", "", "", str(self.failures[k])]
            else:
                success = "yes" if solution.success else "no"
                message = "" if solution.success else solution.status.value
                outcome = [success, f"{solution.error:.1e}", solution.method, message]
            outcome.insert(3, f"{self.seconds[k]:.2f}")
            rows.append([str(k), *changes, *outcome])
        failed = sum(row[1 + len(names)] == "no" for row in rows)
        ended = "all of them a success" if not failed else f"{failed} without success"
        return Table(f"{count(len(self), 'solution')}, {ended}", header, rows)

    def _variables(self) -> Variables:
        columns = {
            "success": [bool(s and s.success) for s in self._solutions],
            "error": list(self.errors),
            "seconds": list(self.seconds),
        }
        arrays = {name: (("box",), column) for name, column in columns.items()}
        return Variables(arrays, {"box": list(range(len(self)))})


@takes_options_of(CompiledProblem.solve)
def solve_many(
    problem: Problem | CompiledProblem,
    boxes: Sequence[Box],
    rtol: float = RTOL,
    *,
    executor: ExecutorLike | None = None,
    checkpoint: str | PathLike[str] | None = None,
    progress: Progress = False,
    **options: Any,
) -> Solutions:
    """Solve one problem on many boxes, or under many conditions, one by one or side by side.

    Parameters
    ----------
    problem : Problem or CompiledProblem
        It is compiled once; more often only if numbers of constants differ.
    boxes : sequence of mappings
        For each solve what differs from the problem, by symbols or names: intervals of
        parameters, and numbers of constants or parameters, as :meth:`Problem.set` takes them.
        ``problem.split(k=4)`` makes boxes that tile that of the problem.
    rtol : float
        As for :func:`rankone.solve`.
    executor : int, concurrent.futures.Executor, distributed.Client or str, optional
        Where boxes are solved, each by one worker: a number of processes, which are started and
        end with the call, an executor or a client of dask, which are left running, or the address
        of a scheduler of dask. None: here, one after the other. Solutions are the same to the bit.
    checkpoint : path-like, optional
        A folder for finished solutions, which is made if there is none. After an interrupt, or if
        processes were killed, the same call goes on and solves what is missing alone. Several
        processes may share the folder: each takes what the others have finished.
    progress : bool or callable
        True shows a bar on stderr; a callable gets the numbers of finished and of all boxes.
    **options
        Those of :func:`rankone.solve`, such as ``method`` or ``effort``, for each solve.

    Returns
    -------
    Solutions
        A sequence in the order of the boxes. A box that fails does not stop the others: see
        ``statuses`` and ``failures``, or print it. ``.join()`` makes one solution of boxes that
        tile a box.

    Raises
    ------
    OptionError
        If a box or an option is not valid, or something cannot be sent to a worker.
    ProblemError, SeparationError
        As for :func:`rankone.solve`.
    StorageError
        If the checkpoint is of another problem, other options or another version of rankone, or
        cannot be written.
    RankoneError
        If workers die before any of them has finished a box.

    Examples
    --------
    >>> import rankone as ro
    >>> problem = ro.Problem.from_strings({"u": "-k*u"}, {"u": "1"}, {"k": (0.5, 5)}, (0, 2))
    >>> pieces = ro.solve_many(problem, problem.split(k=3), 1e-6)
    >>> pieces.success, pieces.join()(t=1.0, k=2.0).round(5)
    (True, array([0.13534]))
    """
    kind: Any = CompiledProblem if isinstance(problem, CompiledProblem) else Problem
    check_kind("solve_many", problem, kind, remedy="build one with rankone.Problem(...)")
    options = _checked_options(options, rtol)
    base = problem if isinstance(problem, CompiledProblem) else compile_problem(problem)
    solves = _solves(base, boxes, options)
    check_arguments(solves[0].compiled, solves[0].options)  # before they are sent
    kept = None if checkpoint is None else Checkpoint.open(checkpoint, base, options)
    outcomes: dict[int, _Outcome] = {}
    with counting_bar(progress, len(solves)) as report:

        def done(number: int, outcome: _Outcome | RankoneError) -> None:
            if isinstance(outcome, RankoneError):
                outcome = _Outcome(None, outcome, 0.0)
            if isinstance(outcome.failure, OptionError | ProblemError):
                raise _of_box(number, outcome.failure)
            for text in outcome.warned:
                warn(f"box {number}: {text}")
            outcomes[number] = outcome
            report(len(outcomes), len(solves))

        _run_all(solves, executor, kept, done)
    ordered = [outcomes[k] for k in range(len(solves))]
    return Solutions(
        tuple(solve.changes for solve in solves),
        tuple(outcome.seconds for outcome in ordered),
        {k: o.failure for k, o in enumerate(ordered) if o.failure is not None},
        tuple(outcome.solution for outcome in ordered),
    )


@dataclass(frozen=True)
class _Solve:
    """One solve: a compiled problem, the options, and what was changed."""

    compiled: CompiledProblem
    options: dict[str, Any]
    changes: dict[str, Any]


@dataclass(frozen=True)
class _Outcome:
    """The solution of a solve, or why there is none, the seconds it took, and its warnings."""

    solution: Solution | None
    failure: RankoneError | None
    seconds: float
    warned: tuple[str, ...] = ()


def _checked_options(options: Mapping[str, Any], rtol: float) -> dict[str, Any]:
    """The options of every solve."""
    remedies = {
        "parameters": "put intervals into boxes: [{k: (1, 2)}, {k: (2, 3)}]",
        "on_failure": "ask the result: .success, .statuses, .failures",
    }
    for name, remedy in remedies.items():
        if name in options:
            raise OptionError(f"solve_many does not take {name}=", remedy=remedy)
    return {**options, "rtol": rtol}


def _solves(
    base: CompiledProblem, boxes: Sequence[Box], options: Mapping[str, Any]
) -> list[_Solve]:
    """The solves of all boxes, which are checked; equal conditions share a compiled problem."""
    if isinstance(boxes, Mapping | str) or not isinstance(boxes, Sequence):
        raise OptionError(
            f"boxes is {shown(boxes)}, not a list of mappings",
            term=boxes,
            remedy=_BOXES_REMEDY,
        )
    if not boxes:
        raise OptionError("there are no boxes to solve", term=boxes, remedy=_BOXES_REMEDY)
    under: dict[tuple[tuple[str, Any], ...], CompiledProblem] = {(): base}
    solves = []
    for number, box in enumerate(boxes):
        try:
            intervals, numbers = _parted(box)
            key = tuple(sorted(numbers.items()))
            if key not in under:
                under[key] = compile_problem(base.problem.set(numbers))
            compiled = under[key]
            domain = Domain.of(compiled.system)
            domain.moved(compiled.system.parameters, intervals, options.get("t_final"))
        except (OptionError, ProblemError) as error:
            raise _of_box(number, error) from error
        own = {**options, "parameters": intervals}
        changes = {str(name): change for name, change in (*intervals.items(), *numbers.items())}
        solves.append(_Solve(compiled, own, changes))
    return solves


def _parted(box: Box) -> tuple[dict[object, Any], dict[str, Any]]:
    """The intervals and the numbers of a box, by name."""
    if not isinstance(box, Mapping):
        raise OptionError(f"{shown(box)} is not a mapping from names", remedy="give {k: (1, 2)}")
    intervals: dict[object, Any] = {}
    numbers: dict[str, Any] = {}
    for key, change in box.items():
        if isinstance(change, Sequence | np.ndarray):
            intervals[name_of(key)] = change if isinstance(change, str) else tuple(change)
        else:
            numbers[name_of(key)] = change
    return intervals, numbers


def _of_box(number: int, error: RankoneError) -> RankoneError:
    """An error that says which box it is about."""
    told = OptionError if isinstance(error, OptionError) else ProblemError
    return told(f"box {number}: {error.message}", term=error.term, remedy=error.remedy)


_Done = Callable[[int, "_Outcome | RankoneError"], None]


def _run_all(
    solves: Sequence[_Solve], executor: ExecutorLike | None, kept: Checkpoint | None, done: _Done
) -> None:
    """Run all solves that are not finished yet, here or on workers."""
    wanted = None if executor is None else checked_executor("executor", executor)
    files: dict[int, SolveFiles] = {}
    if kept is not None:
        boxes = [solve.options["parameters"] for solve in solves]
        files = {k: kept.files(solve.compiled, boxes[k]) for k, solve in enumerate(solves)}

    def is_finished(number: int) -> bool:
        solution = files[number].read() if files else None
        if solution is not None:
            done(number, _Outcome(solution, None, solution.timings.get("solve", 0.0)))
        return solution is not None

    def hand_over(number: int, outcome: _Outcome | RankoneError) -> None:
        if files and isinstance(outcome, _Outcome) and outcome.solution is not None:
            files[number].write(outcome.solution)
        done(number, outcome)

    missing = [number for number in range(len(solves)) if not is_finished(number)]
    if wanted is None:
        for number in missing:
            if not is_finished(number):
                hand_over(number, _outcome_of(solves[number].compiled, solves[number].options))
    elif missing:
        with open_pool(wanted) as pool:
            Tasks(pool, _Sender(solves, pool, is_finished), hand_over).run(missing)


class _Sender:
    """What workers run for each solve that is not finished; each compiled problem is sent as one.

    Processes get it as a parcel, and keep what they loaded.
    """

    def __init__(
        self, solves: Sequence[_Solve], pool: Pool, is_finished: Callable[[int], bool]
    ) -> None:
        self._solves, self._pool, self._is_finished = solves, pool, is_finished
        self._sent: dict[int, Parcel | CompiledProblem] = {}

    def __call__(self, number: int) -> tuple[Callable[..., _Outcome], tuple[object, ...]] | None:
        if self._is_finished(number):
            return None
        solve = self._solves[number]
        key = id(solve.compiled)
        if key not in self._sent:
            self._sent[key] = packed("the problem", solve.compiled, self._pool.wanted)
        return _outcome_elsewhere, (self._sent[key], solve.options)


def _outcome_of(compiled: CompiledProblem, options: Mapping[str, Any]) -> _Outcome:
    """The outcome of one solve; a trajectory that blows up leaves the solution up to there."""
    began = time.perf_counter()
    solution: Solution | None = None
    failure: RankoneError | None = None
    try:
        solution = compiled.solve(**options)
    except ConvergenceError as error:
        solution, failure = error.solution, error
    except RankoneError as error:
        failure = error
    seconds = time.perf_counter() - began
    return _Outcome(solution, None if solution is not None else failure, seconds)


def _outcome_elsewhere(sent: Parcel | CompiledProblem, options: Mapping[str, Any]) -> _Outcome:
    """The same in a worker, whose warnings travel with the outcome."""
    if isinstance(sent, CompiledProblem):
        return _outcome_of(sent, options)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", RankoneWarning)
        outcome = _outcome_of(unpacked(sent), options)
    texts = (str(w.message) for w in caught if issubclass(w.category, RankoneWarning))
    return replace(outcome, warned=tuple(dict.fromkeys(texts)))


def _cell(change: Any) -> str:
    """An interval or a number in a table."""
    if not isinstance(change, tuple):
        return f"{float(change):.6g}"
    return f"[{', '.join(end if isinstance(end, str) else f'{float(end):.6g}' for end in change)}]"
