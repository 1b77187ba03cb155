"""Trajectories on the workers of an executor: chunks of samples, and groups of references."""

from __future__ import annotations

import concurrent.futures
import copy
import itertools
import math
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Generic, TypeAlias, TypeVar, cast

import numpy as np

from rankone.support.arrays import MANY_STATES, Array
from rankone.support.budget import (
    Counted,
    LimitsElsewhere,
    OutOfMemoryError,
    OutOfTimeError,
    hold,
    memory_left,
)
from rankone.support.errors import OptionError, RankoneError
from rankone.support.tasks import (
    DEATHS,
    GUARD,
    ExecutorLike,
    Filed,
    MemoryFile,
    Parcel,
    Place,
    Pool,
    filed,
    packed,
    unpacked,
)
from rankone.trajectories.integrators.integrator import Path, SampledTrajectories, Spans, Tolerances
from rankone.trajectories.integrators.single import SingleIntegrator, SingleTrajectories
from rankone.trajectories.stacks.explicit import Piece
from rankone.trajectories.stacks.stack import StackedIntegrator, StackedTrajectories
from rankone.trajectories.system.system import ModuleSpecification, System

Arguments: TypeAlias = "tuple[object, ...]"  # Those of a task, after the system
_Sent: TypeAlias = "Counted[Answer] | Filed[Counted[Answer]]"  # What comes from a worker
_MOST_FILES = 200  # Files of large trajectories that are open at once


class Workers:
    """Calls of a function of a system and further arguments; without an executor, here."""

    def __init__(self, system: System, executor: ExecutorLike | None = None) -> None:
        self.system = system
        self.pool: Pool | None = None
        if executor is None:
            return
        self.pool = Pool(executor)
        self._pack(executor)

    def of(self, system: System) -> Workers:
        """The same workers for another system."""
        if system is self.system:
            return self
        other = copy.copy(self)
        other.system = system
        if self.pool is not None:
            other._pack(self.pool.wanted)
        return other

    def _pack(self, executor: ExecutorLike) -> None:
        """Pack what workers load the system from."""
        specification = self.system.specification
        if specification is None:
            raise OptionError(
                "executor= needs a system compiled by rankone: workers cannot load this one",
                remedy="leave it out, or solve with rankone.solve",
            )
        self._specification = packed("a function of the user", specification, executor)

    def map(
        self,
        function: Callable[..., Answer],
        tasks: Sequence[Arguments],
        *failures: type[Exception],
        done: Callable[[float], None] | None = None,
    ) -> list[Answer]:
        """The answers of ``function(system, *task)`` in order.

        ``done`` is told the part of the tasks that is done after each, if they are run here.
        A single task is run here. Tasks of a worker that died are submitted once more. Failures
        of the function are raised as they are, other errors as a RankoneError. The work of the
        tasks is charged, and a failure raised, in their order: it does not matter who was first.
        """
        answers: dict[int, Answer] = {}
        if self.pool is None or len(tasks) < 2:
            for k, task in enumerate(tasks):
                answers[k] = function(self.system, *task)
                if done is not None:
                    done((k + 1) / len(tasks))
            return list(answers.values())
        limits = LimitsElsewhere.left()
        calls = [(function, task, failures, limits) for task in tasks]
        lost = self._round(calls, limits.end, answers)
        if lost is not None:
            self.pool.restart()
            lost = self._round(calls, limits.end, answers)
        if lost is not None:
            raise RankoneError(
                f"a worker of the executor died, and once more when it was tried again: {lost}",
                remedy="look for a crash or a lack of memory in the workers; " + GUARD,
            ) from lost
        return [answers[k] for k in range(len(tasks))]

    def _round(
        self, calls: Sequence[Arguments], end: float, answers: dict[int, Answer]
    ) -> BaseException | None:
        """Add the answers that are missing; how a worker was lost, if one was."""
        assert self.pool is not None
        futures: dict[int, Future[_Sent[Answer]]] = {}
        files = self._files(len(calls))
        lost: BaseException | None = None
        try:
            for k, call in enumerate(calls):
                if k not in answers:
                    file = files.get(k)
                    place = None if file is None else file.place
                    futures[k] = self.pool.submit(_run, self._specification, place, *call)
        except DEATHS as error:
            lost = error
        try:
            for k, future in futures.items():
                try:
                    answers[k] = _answer(future, end, files.get(k))
                except DEATHS as error:
                    lost = error
        finally:
            for future in futures.values():
                future.cancel()
            for file in files.values():
                file.close()
        return lost

    def _files(self, count: int) -> dict[int, MemoryFile]:
        """Files for the answers of so many calls, where these are large."""
        assert self.pool is not None
        if self.system.n_differential < MANY_STATES or count > _MOST_FILES:
            return {}
        files = (MemoryFile.for_workers(self.pool.wanted) for _ in range(count))
        return {k: file for k, file in enumerate(files) if file is not None}


@contextmanager
def open_workers(system: System, executor: ExecutorLike | None) -> Iterator[Workers]:
    """Workers for a solve; processes that were started end with it."""
    workers = Workers(system, executor)
    if workers.pool is None:
        yield workers
        return
    try:
        workers.pool.open()
        yield workers
    finally:
        workers.pool.close()


def _run(
    specification: Parcel | ModuleSpecification,
    place: Place | None,
    function: Callable[..., Answer],
    arguments: Arguments,
    failures: tuple[type[Exception], ...],
    limits: LimitsElsewhere,
) -> _Sent[Answer]:
    """What a worker runs."""
    call = partial(unpacked(specification).call, function, *arguments)
    return filed(Counted.of(limits, failures, call), place)


def _answer(future: Future[_Sent[Answer]], end: float, file: MemoryFile | None) -> Answer:
    """The answer of a call when it is done, or its failure; its work is charged."""
    left = None if end == math.inf else max(end - time.time(), 0.0)
    concurrent.futures.wait([future], left)
    if not future.done():
        raise OutOfTimeError
    try:
        sent = future.result()
    except (*DEATHS, RankoneError):
        raise
    except Exception as error:
        raise RankoneError(
            f"a worker of the executor failed: {type(error).__name__}: {error}",
            remedy="solve without executor= to see whether the worker is the reason",
        ) from error
    return (cast(Counted[Answer], sent) if file is None else file.answer(sent)).settled()


# -----------------------------------------------------------------------------
# Reference trajectories in groups, which workers integrate side by side.
#
# Trajectories that are integrated one by one do not depend on each other. A stack of many states is
# divided into groups that fit the cache, whoever integrates them, which costs less than a stack of
# all. So the bits do not depend on workers.


Answer = TypeVar("Answer")  # What a task comes to
_Integrator = TypeVar("_Integrator", SingleIntegrator, StackedIntegrator)
_SINGLES = 8  # Trajectories of one task where each is integrated alone
_STACK_STATES = 15_000  # States of a group that fits the cache
_READ_TOGETHER = 8  # Times that are read off a step together
_LEAST_STACK = 32  # Fewest trajectories of a group: calls of NumPy dominate below


@dataclass(frozen=True)
class OnWorkers(Generic[_Integrator]):
    """An integrator of which :meth:`run` is divided among workers, and nothing else."""

    integrator: _Integrator
    workers: Workers

    def groups(self, system: System, points: Array) -> list[Array]:
        """Points (m, d) of a system in groups, whoever integrates them."""
        raise NotImplementedError

    def sends(self, system: System) -> bool:
        """Whether there are workers, and the system is theirs."""
        return system is self.workers.system and self.workers.pool is not None

    def map(
        self,
        function: Callable[..., Answer],
        system: System,
        tasks: Sequence[tuple[object, ...]],
        *failures: type[Exception],
        done: Callable[[float], None] | None = None,
    ) -> list[Answer]:
        """The answers of ``function(system, *task)``, by workers if it is their system."""
        if system is self.workers.system:
            return self.workers.map(function, tasks, *failures, done=done)
        return [function(system, *task) for task in tasks]

    def sample(
        self,
        system: System,
        points: Array,
        edges: Sequence[float],
        tolerances: Tolerances,
        times: Array,
    ) -> SampledTrajectories:
        """Trajectories at ascending times; see :meth:`Integrator.sample`."""
        return self.integrator.sample(system, points, edges, tolerances, times)

    def paths(
        self, system: System, points: Array, spans: Spans, tolerances: Tolerances
    ) -> Sequence[Path]:
        """Trajectories of spans of their own; see :meth:`SpanIntegrator.paths`."""
        return self.integrator.paths(system, points, spans, tolerances)


@dataclass(frozen=True)
class SinglesOnWorkers(OnWorkers[SingleIntegrator]):
    """Trajectories one by one, of which each worker integrates some."""

    def groups(self, system: System, points: Array) -> list[Array]:
        return _divided(points, _SINGLES)

    def run(
        self, system: System, points: Array, edges: Sequence[float], tolerances: Tolerances
    ) -> SingleTrajectories:
        """Trajectories at all times; see :meth:`Integrator.run`."""
        work = self.integrator, edges, tolerances
        if not self.sends(system):
            return self.integrator.run(system, points, *work[1:])
        tasks = [(group, *work) for group in self.groups(system, points)]
        some = self.workers.map(_singles, tasks)
        if any(each.end < edges[-1] for each in some):  # the others end there as well
            return self.integrator.run(system, points, *work[1:])
        paths = tuple(itertools.chain.from_iterable(each.paths for each in some))
        if len(tasks) > 1:
            hold_all(paths)
        return SingleTrajectories(
            paths, some[0].end, np.concatenate([each.state for each in some], 1)
        )


@dataclass(frozen=True)
class GroupedStacks(OnWorkers[StackedIntegrator]):
    """Stacks of trajectories of many states in groups."""

    def groups(self, system: System, points: Array) -> list[Array]:
        return _divided(points, max(_STACK_STATES // system.n_differential, _LEAST_STACK))

    def run(
        self, system: System, points: Array, edges: Sequence[float], tolerances: Tolerances
    ) -> StackedTrajectories | GroupedTrajectories:
        """Trajectories at all times; see :meth:`Integrator.run`."""
        work = self.integrator, edges, tolerances
        tasks = [(group, *work) for group in self.groups(system, points)]
        if len(tasks) == 1:
            return self.integrator.run(system, points, edges, tolerances)
        with _expecting_all() as done:
            groups = self.map(_stacked, system, tasks, done=done)
        if self.sends(system):
            hold_all([piece for group in groups for piece in group.pieces])
        return GroupedTrajectories(tuple(groups))


@dataclass(frozen=True)
class GroupedTrajectories:
    """Dense trajectories of groups, each with common steps, up to where the first one ends.

    Fulfils :class:`DenseTrajectories`.
    """

    groups: tuple[StackedTrajectories, ...]

    @property
    def start(self) -> float:
        return self.groups[0].start

    @cached_property
    def end(self) -> float:
        return min(group.end for group in self.groups)

    @property
    def steps(self) -> int:
        return max(group.steps for group in self.groups)

    @property
    def has_begun(self) -> bool:
        return all(group.has_begun for group in self.groups)

    @cached_property
    def state(self) -> Array:
        end = np.array([self.end])
        states = [
            group.state if group.end == self.end or not self.has_begun else group(end)[:, :, 0]
            for group in self.groups
        ]
        return np.concatenate(states, axis=1)

    @cached_property
    def last(self) -> Array:
        if not self.has_begun:
            return self.state
        before = np.array([np.nextafter(self.end, self.start)])
        states = [
            group.last if group.end == self.end else group(before)[:, :, 0] for group in self.groups
        ]
        return np.concatenate(states, axis=1)

    @property
    def largest(self) -> Array:
        return np.concatenate([group.largest for group in self.groups], axis=1)

    @property
    def early(self) -> Array:
        return np.concatenate([group.early for group in self.groups], axis=1)

    @property
    def avoided(self) -> float:
        return max(group.avoided for group in self.groups)

    @property
    def integrator(self) -> str:
        return self.groups[0].integrator

    @property
    def method(self) -> str:
        """That of a group for which explicit steps were given up, if there is one."""
        stiff = (group.method for group in self.groups if group.avoided)
        return next(stiff, self.groups[0].method)

    def __call__(self, times: Array) -> Array:
        """States at times (T,), after a jump at its time: shape (n, m, T)."""
        return np.concatenate([group(times) for group in self.groups], axis=1)

    def of(self, trajectories: slice) -> GroupedTrajectories:
        """Some of the trajectories; see :meth:`DenseTrajectories.of`."""
        counts = [group.state.shape[1] for group in self.groups]
        first, end, _ = trajectories.indices(sum(counts))
        selected = list[StackedTrajectories]()
        for group, count in zip(self.groups, counts, strict=True):
            a, b = max(first, 0), min(end, count)
            if a < b:
                selected.append(group if b - a == count else group.of(slice(a, b)))
            first, end = first - count, end - count
        return replace(self, groups=tuple(selected))

    def samples(self, count: int) -> Iterator[tuple[float, Array]]:
        """Ends of steps of the first group, with all states there."""
        first, *others = self.groups
        samples = itertools.takewhile(lambda sample: sample[0] <= self.end, first.samples(count))
        while some := list(itertools.islice(samples, _READ_TOGETHER)):
            times = np.array([instant for instant, _ in some])
            at_times = [group(times) for group in others]
            for k, (instant, states) in enumerate(some):
                yield (
                    instant,
                    np.concatenate([states, *(each[:, :, k] for each in at_times)], axis=1),
                )


def _divided(points: Array, size: int) -> list[Array]:
    """Points (m, d) in groups of this size at most."""
    return np.array_split(points, max(-(-len(points) // size), 1))


@contextmanager
def _expecting_all() -> Iterator[Callable[[float], None]]:
    """Let an OutOfMemoryError say what all groups need, where some are integrated.

    What is yielded is to be told the part that is done.
    """
    before, taken = memory_left(), 0.0

    def done(share: float) -> None:
        nonlocal taken
        if before < math.inf:
            taken = (before - memory_left()) / share

    try:
        yield done
    except OutOfMemoryError as out:
        needed = out.limit - before + taken
        raise OutOfMemoryError(max(out.needed, needed), out.limit, out.reached) from out


def hold_all(pieces: Sequence[Path | Piece]) -> None:
    """Count what workers sent as held."""
    left = sum(piece.nbytes for piece in pieces)
    for piece in pieces:
        left -= piece.nbytes
        hold(piece, piece.nbytes, left)


def _singles(
    system: System,
    points: Array,
    single: SingleIntegrator,
    edges: Sequence[float],
    tolerances: Tolerances,
) -> SingleTrajectories:
    return single.run(system, points, edges, tolerances)


def _stacked(
    system: System,
    points: Array,
    stack: StackedIntegrator,
    edges: Sequence[float],
    tolerances: Tolerances,
) -> StackedTrajectories:
    return stack.run(system, points, edges, tolerances)
