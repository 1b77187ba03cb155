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
from typing import Any

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

__all__ = ["Workers", "open_workers"]

_DEATHS = (BrokenExecutor, concurrent.futures.CancelledError)
"""How an executor says that a worker died."""
_GUARD = 'a script that starts processes needs `if __name__ == "__main__":` around what it runs'


class _Spawn(SpawnContext):
    """Starts processes anew, and keeps them in a list."""

    def __init__(self) -> None:
        super().__init__()
        self.started: list[SpawnProcess] = []

    def Process(self, *arguments: Any, **named: Any) -> SpawnProcess:  # type: ignore[override]
        self.started.append(SpawnProcess(*arguments, **named))
        return self.started[-1]


class Workers:
    """Calls of a function of a system and further arguments; without an executor, here.

    Parameters
    ----------
    system : System
    executor : Executor or int, optional
        An int is a number of processes, which :meth:`open` starts and :meth:`close` ends. They end
        with this process too, however it ends.
    """

    def __init__(self, system: System, executor: Executor | int | None = None) -> None:
        self.system, self._asked = system, executor
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
        function: Callable[..., Any],
        tasks: Sequence[tuple[Any, ...]],
        *failures: type[Exception],
        done: Callable[[float], None] | None = None,
    ) -> list[Any]:
        """The results of ``function(system, *task)`` in order.

        ``done`` is told the part of the tasks that is done after each, if they are run here.
        A single task is run here. Tasks of a worker that died are submitted once more. Failures
        of the function are raised as they are, other errors as a RankoneError. The work of the
        tasks is charged, and a failure raised, in their order: it does not matter who was first.
        """
        if self._executor is None or len(tasks) < 2:
            return list(self._here(function, tasks, done))
        limits = work_left(), time.time() + seconds_left()
        results: dict[int, Any] = {}
        lost = self._round(function, tasks, range(len(tasks)), limits, results, failures)
        if lost is not None:
            if isinstance(self._asked, int):
                self.close()
                self.open()
            left = [k for k in range(len(tasks)) if k not in results]
            lost = self._round(function, tasks, left, limits, results, failures)
        if lost is not None:
            raise RankoneError(
                f"a worker of the executor died, and once more when it was tried again: {lost}",
                remedy="look for a crash or a lack of memory in the workers; " + _GUARD,
            ) from lost
        return [results[k] for k in range(len(tasks))]

    def _here(
        self,
        function: Callable[..., Any],
        tasks: Sequence[tuple[Any, ...]],
        done: Callable[[float], None] | None,
    ) -> Iterator[Any]:
        """The results of tasks that are run one after the other."""
        for count, task in enumerate(tasks, 1):
            yield function(self.system, *task)
            if done is not None:
                done(count / len(tasks))

    def close(self) -> None:
        """End the processes that were started here, also in the middle of a task or of a start."""
        if not isinstance(self._asked, int) or self._executor is None:
            return
        self._executor.shutdown(wait=False, cancel_futures=True)
        running = [process for process in self._processes if process.is_alive()]
        for process in running:
            process.terminate()
        for process in running:
            process.join()

    def open(self) -> None:
        """Start processes, or ask whether the executor given takes work."""
        if self._asked is None:
            return
        self._executor, starts = self._asked, 1  # type: ignore[assignment]
        if isinstance(self._asked, int):
            starts, context = self._asked, _Spawn()
            self._executor = ProcessPoolExecutor(starts, context, initializer=_obey_parent)
            self._processes = context.started
        for _ in range(starts):
            try:
                self._submit(time.time)
            except _DEATHS:
                return  # the tasks will say it

    def _submit(self, function: Callable[..., Any], *arguments: Any) -> Future[Any]:
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
        self,
        function: Callable[..., Any],
        tasks: Sequence[tuple[Any, ...]],
        chosen: Sequence[int],
        limits: tuple[float, float],
        results: dict[int, Any],
        failures: tuple[type[Exception], ...],
    ) -> BaseException | None:
        """Add results of the tasks chosen; how a worker was lost, if one was."""
        futures: dict[int, Future[_Result]] = {}
        lost: BaseException | None = None
        try:
            for k in chosen:
                task = _Task(function, tasks[k], failures, *limits)
                futures[k] = self._submit(_call, self._specification, task)
        except _DEATHS as error:
            lost = error
        try:
            for k, future in futures.items():
                try:
                    results[k] = _taken(future, limits[1])
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
class _Task:
    """A call for a worker, the failures it may have, and its limits.

    ``operations`` are those that all tasks together have left, ``end`` is a time of the clock on
    the wall.
    """

    function: Callable[..., Any]
    arguments: tuple[Any, ...]
    failures: tuple[type[Exception], ...]
    operations: float
    end: float


@dataclass(frozen=True)
class _Result:
    """What a call gave, or how it failed, and the work that was counted."""

    work: float
    value: Any = None
    failure: Exception | None = None


def _call(specification: Any, task: _Task) -> _Result:
    """What a worker runs; an executor may run it in the thread of the solve, so it counts anew."""
    if isinstance(specification, bytes):
        specification = _unpickled(specification)
    return Context().run(_counted, specification, task)


def _counted(specification: Any, task: _Task) -> _Result:
    seconds = math.inf if task.end == math.inf else task.end - time.time()
    with limited(task.operations, seconds) as account:
        try:
            value = specification.call(task.function, *task.arguments)
        except Exception as failure:
            if isinstance(failure, (OutOfBudgetError, *task.failures)):
                return _Result(account.done, failure=failure)
            raise
        return _Result(account.done, value)


def _taken(future: Future[_Result], end: float) -> Any:
    """The value of a task when it is done, or its failure; its work is charged."""
    left = None if end == math.inf else max(end - time.time(), 0.0)
    concurrent.futures.wait([future], left)
    if not future.done():
        raise OutOfTimeError
    try:
        result = future.result()
    except (*_DEATHS, RankoneError):
        raise
    except Exception as error:
        raise RankoneError(
            f"a worker of the executor failed: {type(error).__name__}: {error}",
            remedy="solve without executor= to see whether the worker is the reason",
        ) from error
    charge(result.work)
    if result.failure is not None:
        raise result.failure
    return result.value


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
def _unpickled(specification: bytes) -> Any:
    try:
        return pickle.loads(specification)
    except Exception as error:
        raise OptionError(
            f"a worker cannot load a function of the user: {type(error).__name__}: {error}",
            remedy="define it in a module that the workers can import",
        ) from error
