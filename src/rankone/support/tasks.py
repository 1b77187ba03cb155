"""Independent calls on a pool, and the threads of BLAS while they run."""

from __future__ import annotations

import concurrent.futures
import threading
from collections import Counter, deque
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Future
from contextlib import AbstractContextManager, nullcontext
from functools import cache
from typing import Any, Generic, TypeVar

from threadpoolctl import ThreadpoolController

from rankone.support.errors import RankoneError
from rankone.support.executors import DEATHS, GUARD, Parcel, Pool, packed, unpacked


class _OneThread(AbstractContextManager[None]):
    """Keeps BLAS on one thread as long as any thread of this process is inside."""

    def __init__(self) -> None:
        self._lock, self._inside = threading.Lock(), 0
        self._limit: AbstractContextManager[object] = nullcontext()

    def __enter__(self) -> None:
        with self._lock:
            if not self._inside:
                self._limit = _thread_pools().limit(limits=1, user_api="blas")
            self._inside += 1

    def __exit__(self, *_: object) -> None:
        with self._lock:
            self._inside -= 1
            if not self._inside:
                self._limit.__exit__(None, None, None)


_ONE_THREAD = _OneThread()


def one_thread() -> AbstractContextManager[None]:
    """BLAS on one thread: small products run fastest so, and two busy pools slow each other."""
    return _ONE_THREAD


@cache
def _thread_pools() -> ThreadpoolController:
    """The BLAS pools of this process; looking for them takes milliseconds."""
    return ThreadpoolController()


# -----------------------------------------------------------------------------
# Independent calls on a pool: a worker that dies costs its own call alone, tried again.


# Deaths of the worker of one call, alone on the machine, after which it is given up
_MOST_DEATHS = 5
_KILLED = "KilledWorker"  # The error of dask for a call on which several workers died
_REMEDY = "look for a crash or a lack of memory in the workers; " + GUARD
Answer = TypeVar("Answer")  # What a call comes to
Content = TypeVar("Content")  # What all of them read


class Tasks(Generic[Answer]):
    """Calls by number on an open pool, in their order as far as workers are free.

    ``begin`` gives the function and the arguments of a call when it is its turn, or None if it is
    not needed any more; ``done`` takes each answer as it comes, or the error of a call that was
    given up. If several calls were running when a process died, they are run one by one, to tell
    which of them it was.
    """

    def __init__(
        self,
        pool: Pool,
        begin: Callable[[int], tuple[Callable[..., Answer], tuple[object, ...]] | None],
        done: Callable[[int, Answer | RankoneError], None],
    ) -> None:
        self._pool, self._begin, self._done = pool, begin, done
        self._waiting: deque[int] = deque()
        self._suspects: deque[int] = deque()
        self._running: dict[Future[Answer], int] = {}
        self._deaths: Counter[int] = Counter()
        self._finished = 0

    def run(self, numbers: Iterable[int]) -> None:
        """Run the calls; after an interrupt, those that are finished are still handed over."""
        self._waiting.extend(numbers)
        try:
            while self._waiting or self._suspects or self._running:
                self._submit()
                if self._running:
                    first = concurrent.futures.FIRST_COMPLETED
                    concurrent.futures.wait(self._running, return_when=first)
                    self._collect()
        finally:
            for future, index in self._running.items():
                if not future.cancel() and future.done() and future.exception() is None:
                    self._done(index, future.result())

    def _submit(self) -> None:
        """Submit as many calls as there are processes; a suspect alone."""
        most = self._pool.processes or len(self._waiting) + len(self._running)
        while self._waiting or self._suspects:
            if len(self._running) >= (1 if self._suspects else most):
                return
            index = (self._suspects or self._waiting).popleft()
            call = self._begin(index)
            if call is None:
                continue
            try:
                self._running[self._pool.submit(call[0], *call[1])] = index
            except DEATHS as error:
                self._lost([index], error)

    def _collect(self) -> None:
        """Hand over the answers that have come."""
        lost: list[int] = []
        death: BaseException | None = None
        for future in [future for future in self._running if future.done()]:
            index = self._running.pop(future)
            try:
                answer = future.result()
            except Exception as error:
                if not isinstance(error, DEATHS) and type(error).__name__ != _KILLED:
                    raise _failed(error) from error
                lost.append(index)
                death = error
                continue
            self._finished += 1
            self._done(index, answer)
        if death is not None:
            self._lost(lost, death)

    def _lost(self, lost: list[int], death: BaseException) -> None:
        """Start processes again, and put back the calls that were running when one died."""
        if self._pool.processes:
            lost = sorted([*lost, *self._running.values()])
            self._running.clear()
            self._pool.restart()
        elif isinstance(death, concurrent.futures.BrokenExecutor):
            raise RankoneError(
                f"a process of executor= died, and it takes no work any more: {death}",
                remedy="give a number of processes, which are started again; " + _REMEDY,
            ) from death
        if len(lost) == 1 or not self._pool.processes:
            self._deaths.update(lost)
        if not self._finished and self._deaths.total() >= _MOST_DEATHS:
            raise RankoneError(
                f"workers died {_MOST_DEATHS} times, and none finished anything: {death}",
                remedy=_REMEDY,
            ) from death
        for index in lost:
            if self._deaths[index] < _MOST_DEATHS:
                self._suspects.append(index)
                continue
            message = f"a worker died {_MOST_DEATHS} times: {death}"
            self._done(index, RankoneError(message, remedy=_REMEDY))


class Shared(Generic[Content]):
    """Something that tasks read, such as a density: workers get it once."""

    def __init__(self, name: str, content: Content, pool: Pool | None) -> None:
        self._content, self._pool = content, pool
        self._sent = content if pool is None else packed(name, content, pool.wanted)

    def map(
        self, function: Callable[..., Answer], tasks: Sequence[tuple[object, ...]]
    ) -> list[Answer]:
        """The answers of ``function(content, *task)`` in order; a single task is run here.

        BLAS has one thread in all of them, so that the bits do not depend on the pool.
        """
        if self._pool is None or len(tasks) < 2:
            return [_on_one_thread(function, self._content, task) for task in tasks]
        answers: dict[int, Answer] = {}

        def done(index: int, answer: Answer | RankoneError) -> None:
            if isinstance(answer, RankoneError):
                raise answer
            answers[index] = answer

        def begin(index: int) -> tuple[Callable[..., Answer], tuple[object, ...]]:
            return _on_one_thread, (function, self._sent, tasks[index])

        Tasks(self._pool, begin, done).run(range(len(tasks)))
        return [answers[index] for index in range(len(tasks))]


def _on_one_thread(
    function: Callable[..., Answer], sent: Parcel | object, task: tuple[object, ...]
) -> Answer:
    with one_thread():
        return function(unpacked(sent), *task)


def _failed(error: Exception) -> Any:
    """The error for a call that failed otherwise, such as one that cannot be sent."""
    if isinstance(error, RankoneError):
        return error
    return RankoneError(
        f"a worker of the executor failed: {type(error).__name__}: {error}",
        remedy="solve without executor= to see whether the worker is the reason",
    )
