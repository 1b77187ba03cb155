"""Chunks of trajectories on the workers of an executor, or in this process."""

from __future__ import annotations

import concurrent.futures
import copy
import math
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from contextlib import contextmanager
from functools import partial
from typing import TypeAlias, TypeVar, cast

from rankone.ir.system import ModuleSpecification, System
from rankone.support.budget import OutOfTimeError
from rankone.support.counted import Counted, LimitsElsewhere
from rankone.support.errors import OptionError, RankoneError
from rankone.support.executors import DEATHS, GUARD, ExecutorLike, Pool
from rankone.support.memory_files import Filed, MemoryFile, Place, filed
from rankone.support.parcels import Parcel, packed, unpacked

Answer = TypeVar("Answer")  # What a task comes to
Arguments: TypeAlias = "tuple[object, ...]"  # Those of a task, after the system
_Sent: TypeAlias = "Counted[Answer] | Filed[Counted[Answer]]"  # What comes from a worker
_LEAST_STATES, _MOST_FILES = 64, 200  # States whose trajectories are large; files open at once


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
        if self.system.n_differential < _LEAST_STATES or count > _MOST_FILES:
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
