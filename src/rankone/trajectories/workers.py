"""Chunks of trajectories on the workers of an executor, or in this process."""

from __future__ import annotations

import concurrent.futures
import math
import multiprocessing
import os
import pickle
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import BrokenExecutor, Executor, Future, ProcessPoolExecutor
from contextlib import contextmanager
from contextvars import Context
from dataclasses import dataclass
from functools import lru_cache
from multiprocessing.context import SpawnContext, SpawnProcess
from typing import Generic, TypeAlias, TypeVar, cast

from rankone.ir.system import ModuleSpecification, System
from rankone.support.budget import (
    OutOfBudgetError,
    OutOfTimeError,
    charge,
    limited,
    seconds_left,
    work_left,
)
from rankone.support.errors import OptionError, RankoneError

_DEATHS = (BrokenExecutor, concurrent.futures.CancelledError)  # A worker died
# What to do if workers die at once
_GUARD = 'a script that starts processes needs `if __name__ == "__main__":` around what it runs'
Answer = TypeVar("Answer")  # What a task comes to
Arguments: TypeAlias = "tuple[object, ...]"  # Those of a task, after the system


class _Spawn(SpawnContext):
    """Starts processes anew, and keeps them in a list."""

    def __init__(self) -> None:
        super().__init__()
        self.started: list[SpawnProcess] = []

    def Process(self, *arguments: object, **named: object) -> SpawnProcess:  # type: ignore[override]
        self.started.append(SpawnProcess(*arguments, **named))  # type: ignore[arg-type]
        return self.started[-1]


class Workers:
    """Calls of a function of a system and further arguments; without an executor, here.

    An int as executor is a number of processes, which :meth:`open` starts and :meth:`close` ends.
    They end with this process too, however it ends.
    """

    def __init__(self, system: System, executor: Executor | int | None = None) -> None:
        self.system, self._wanted = system, executor
        self._executor: Executor | None = None
        self._processes: list[SpawnProcess] = []
        if executor is None:
            return
        specification = system.specification
        if specification is None:
            raise OptionError(
                "executor= needs a system compiled by rankone: workers cannot load this one",
                remedy="leave it out, or solve with rankone.solve",
            )
        processes = isinstance(executor, int | ProcessPoolExecutor)
        self._specification = _pickled(specification) if processes else specification

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
        if self._executor is None or len(tasks) < 2:
            for k, task in enumerate(tasks):
                answers[k] = function(self.system, *task)
                if done is not None:
                    done((k + 1) / len(tasks))
            return list(answers.values())
        limits = work_left(), time.time() + seconds_left()
        calls = [_Call(function, task, failures, *limits) for task in tasks]
        lost = self._round(calls, answers)
        if lost is not None:
            if isinstance(self._wanted, int):
                self.close()
                self.open()
            lost = self._round(calls, answers)
        if lost is not None:
            raise RankoneError(
                f"a worker of the executor died, and once more when it was tried again: {lost}",
                remedy="look for a crash or a lack of memory in the workers; " + _GUARD,
            ) from lost
        return [answers[k] for k in range(len(tasks))]

    def close(self) -> None:
        """End the processes that were started here, also in the middle of a task or of a start."""
        if not isinstance(self._wanted, int) or self._executor is None:
            return
        self._executor.shutdown(wait=False, cancel_futures=True)
        running = [process for process in self._processes if process.is_alive()]
        for process in running:
            process.terminate()
        for process in running:
            process.join()

    def open(self) -> None:
        """Start processes, or ask whether the executor given takes work."""
        if self._wanted is None:
            return
        if isinstance(self._wanted, int):
            starts, context = self._wanted, _Spawn()
            self._executor = ProcessPoolExecutor(starts, context, initializer=_obey_parent)
            self._processes = context.started
        else:
            self._executor, starts = self._wanted, 1
        for _ in range(starts):
            try:
                self._submit(time.time)
            except _DEATHS:
                return  # the tasks will say it

    def _submit(self, function: Callable[..., Answer], *arguments: object) -> Future[Answer]:
        assert self._executor is not None
        try:
            return self._executor.submit(function, *arguments)
        except _DEATHS:
            raise
        except Exception as error:
            raise OptionError(
                f"executor= takes no work: {type(error).__name__}: {error}",
                remedy="give one that is open, or a number of processes",
            ) from error

    def _round(
        self, calls: Sequence[_Call[Answer]], answers: dict[int, Answer]
    ) -> BaseException | None:
        """Add the answers that are missing; how a worker was lost, if one was."""
        futures: dict[int, Future[_Return[Answer]]] = {}
        lost: BaseException | None = None
        try:
            for k, call in enumerate(calls):
                if k not in answers:
                    futures[k] = self._submit(_run, self._specification, call)
        except _DEATHS as error:
            lost = error
        try:
            for k, future in futures.items():
                try:
                    answers[k] = _answer(future, calls[k].end)
                except _DEATHS as error:
                    lost = error
        finally:
            for future in futures.values():
                future.cancel()
        return lost


@contextmanager
def open_workers(system: System, executor: Executor | int | None) -> Iterator[Workers]:
    """Workers for a solve; processes that were started end with it."""
    workers = Workers(system, executor)
    try:
        workers.open()
        yield workers
    finally:
        workers.close()


def _obey_parent() -> None:
    """Let the parent alone decide when this worker ends, in the middle of a task too.

    An interrupt from the keyboard reaches all processes: the parent ends its workers then. When the
    parent is killed, nobody does, and a worker would wait for tasks for ever.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """Wait until the parent has ended, without polling, then end at once."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


@dataclass(frozen=True)
class _Call(Generic[Answer]):
    """A call for a worker, the failures it may have, and its limits.

    ``operations`` are those that all tasks together have left, ``end`` is a time of the clock on
    the wall.
    """

    function: Callable[..., Answer]
    arguments: Arguments
    failures: tuple[type[Exception], ...]
    operations: float
    end: float


@dataclass(frozen=True)
class _Return(Generic[Answer]):
    """The answer of a call, or how it failed, and the work that was counted."""

    work: float
    answer: Answer | None = None
    failure: Exception | None = None


def _run(specification: ModuleSpecification | bytes, call: _Call[Answer]) -> _Return[Answer]:
    """What a worker runs; an executor may run it in the thread of the solve, so it counts anew."""
    if isinstance(specification, bytes):
        specification = _unpickled(specification)
    return Context().run(_counted, specification, call)


def _counted(specification: ModuleSpecification, call: _Call[Answer]) -> _Return[Answer]:
    seconds = math.inf if call.end == math.inf else call.end - time.time()
    failures: tuple[type[Exception], ...] = (OutOfBudgetError, *call.failures)
    with limited(call.operations, seconds) as account:
        try:
            answer = specification.call(call.function, *call.arguments)
        except failures as failure:
            return _Return(account.done, failure=failure)
        return _Return(account.done, answer)


def _answer(future: Future[_Return[Answer]], end: float) -> Answer:
    """The answer of a call when it is done, or its failure; its work is charged."""
    left = None if end == math.inf else max(end - time.time(), 0.0)
    concurrent.futures.wait([future], left)
    if not future.done():
        raise OutOfTimeError
    try:
        returned = future.result()
    except (*_DEATHS, RankoneError):
        raise
    except Exception as error:
        raise RankoneError(
            f"a worker of the executor failed: {type(error).__name__}: {error}",
            remedy="solve without executor= to see whether the worker is the reason",
        ) from error
    charge(returned.work)
    if returned.failure is not None:
        raise returned.failure
    return cast(Answer, returned.answer)


def _pickled(specification: ModuleSpecification) -> bytes:
    """The specification for another process, or an error that names what cannot be sent."""
    try:
        return pickle.dumps(specification)
    except Exception as error:
        raise OptionError(
            f"a function of the user cannot be sent to another process: {error}",
            remedy="define it by def at the top of a module, or leave out executor=",
        ) from error


@lru_cache(8)
def _unpickled(specification: bytes) -> ModuleSpecification:
    try:
        return cast(ModuleSpecification, pickle.loads(specification))
    except Exception as error:
        raise OptionError(
            f"a worker cannot load a function of the user: {type(error).__name__}: {error}",
            remedy="define it in a module that the workers can import",
        ) from error
