"""Chunks of trajectories on the workers of an executor, or in this process."""

from __future__ import annotations

import concurrent.futures
import copy
import math
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from contextlib import contextmanager
from typing import TypeAlias, TypeVar

from rankone.ir.system import ModuleSpecification, System
from rankone.support.budget import OutOfTimeError
from rankone.support.counted import Counted, LimitsElsewhere
from rankone.support.errors import OptionError, RankoneError
from rankone.support.executors import DEATHS, GUARD, ExecutorLike, Pool
from rankone.support.parcels import Parcel, packed, unpacked

Answer = TypeVar("Answer")  # What a task comes to
Arguments: TypeAlias = "tuple[object, ...]"  # Those of a task, after the system


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
        futures: dict[int, Future[Counted[Answer]]] = {}
        lost: BaseException | None = None
        try:
            for k, call in enumerate(calls):
                if k not in answers:
                    futures[k] = self.pool.submit(_run, self._specification, *call)
        except DEATHS as error:
            lost = error
        try:
            for k, future in futures.items():
                try:
                    answers[k] = _answer(future, end)
                except DEATHS as error:
                    lost = error
        finally:
            for future in futures.values():
                future.cancel()
        return lost


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
    function: Callable[..., Answer],
    arguments: Arguments,
    failures: tuple[type[Exception], ...],
    limits: LimitsElsewhere,
) -> Counted[Answer]:
    """What a worker runs."""
    return Counted.of(limits, failures, lambda: unpacked(specification).call(function, *arguments))


def _answer(future: Future[Counted[Answer]], end: float) -> Answer:
    """The answer of a call when it is done, or its failure; its work is charged."""
    left = None if end == math.inf else max(end - time.time(), 0.0)
    concurrent.futures.wait([future], left)
    if not future.done():
        raise OutOfTimeError
    try:
        returned = future.result()
    except (*DEATHS, RankoneError):
        raise
    except Exception as error:
        raise RankoneError(
            f"a worker of the executor failed: {type(error).__name__}: {error}",
            remedy="solve without executor= to see whether the worker is the reason",
        ) from error
    return returned.settled()
