"""Executors of tasks, independent calls on them, what tasks share, and how answers come back."""

from __future__ import annotations

import concurrent.futures
import mmap
import multiprocessing
import os
import pickle
import signal
import sys
import threading
import time
import uuid
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import BrokenExecutor, Executor, Future, ProcessPoolExecutor
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass
from functools import cache, lru_cache
from multiprocessing.context import SpawnContext, SpawnProcess
from typing import TYPE_CHECKING, Any, Generic, TypeVar, cast

from rankone.support.errors import OptionError, RankoneError, optional_module
from rankone.support.options import checked_number

if TYPE_CHECKING:
    from threadpoolctl import ThreadpoolController

DEATHS = (BrokenExecutor, concurrent.futures.CancelledError)
"""What a future raises whose worker died."""
GUARD = 'a script that starts processes needs `if __name__ == "__main__":` around what it runs'
"""What to do if workers die at once."""
_MAX_PROCESSES = 1000  # More processes than this are a mistake
Answer = TypeVar("Answer")  # What a call comes to
Content = TypeVar("Content")  # What all of them read
_REMEDY_OF_EXECUTORS = (
    "give a number of processes, a concurrent.futures.Executor, or a Client of dask.distributed "
    'or its address, "tcp://host:port"'
)

ExecutorLike = Executor | int | str
"""An executor, a number of processes, or the address of a scheduler of dask."""


def checked_executor(name: str, executor: object) -> ExecutorLike:
    """The option as an executor, a number of processes or an address; or an OptionError."""
    if hasattr(executor, "get_executor"):  # a Client of dask.distributed
        return checked_executor(name, executor.get_executor())
    if isinstance(executor, Executor):
        return executor
    if isinstance(executor, int):
        return int(checked_number(name, executor, 1, _MAX_PROCESSES))
    if isinstance(executor, str) and "://" in executor:
        _dask(executor)
        return executor
    raise OptionError(f"{name}={executor!r} is not valid", remedy=_REMEDY_OF_EXECUTORS)


class Pool:
    """The executor of an option: what it had to start ends with :meth:`close`.

    Processes are started for a number; they end with this process too, however it ends. A client
    is connected for an address. Executors of others are left running.
    """

    def __init__(self, wanted: ExecutorLike) -> None:
        self.wanted = wanted
        self._executor: Executor | None = None
        self._client: Any = None
        self._processes: list[SpawnProcess] = []

    @property
    def processes(self) -> int | None:
        """The number of processes that were asked for, which can be started again."""
        return self.wanted if isinstance(self.wanted, int) else None

    def open(self) -> None:
        """Start processes, or ask whether the executor takes work."""
        starts = 1
        if isinstance(self.wanted, int):
            starts, context = self.wanted, _Spawn()
            self._executor = ProcessPoolExecutor(starts, context, initializer=_obey_parent)
            self._processes = context.started
        elif isinstance(self.wanted, str):
            self._client = _connected(self.wanted)
            self._executor = self._client.get_executor()
        else:
            self._executor = self.wanted
        for _ in range(starts):
            try:
                self.submit(time.time)
            except DEATHS:
                return  # the tasks will say it

    def close(self) -> None:
        """End what was started here, also in the middle of a task or of a start."""
        executor, self._executor = self._executor, None
        if self._client is not None:
            self._client.close()
        if not isinstance(self.wanted, int) or executor is None:
            return
        executor.shutdown(wait=False, cancel_futures=True)
        running = [process for process in self._processes if process.is_alive()]
        for process in running:
            process.terminate()
        for process in running:
            process.join()

    def restart(self) -> bool:
        """Start processes anew after one died; False for an executor of others."""
        if not isinstance(self.wanted, int):
            return False
        self.close()
        self.open()
        return True

    def submit(self, function: Callable[..., Answer], *arguments: object) -> Future[Answer]:
        """A call for a worker; an OptionError if the executor takes none."""
        assert self._executor is not None
        try:
            return self._executor.submit(function, *arguments)
        except DEATHS:
            raise
        except Exception as error:
            raise OptionError(
                f"executor= takes no work: {type(error).__name__}: {error}",
                remedy="give one that is open, or a number of processes",
            ) from error


@contextmanager
def open_pool(wanted: ExecutorLike) -> Iterator[Pool]:
    """A pool that is open; what it had to start ends with the block."""
    pool = Pool(wanted)
    try:
        pool.open()
        yield pool
    finally:
        pool.close()


class _Spawn(SpawnContext):
    """Starts processes anew, and keeps them in a list."""

    def __init__(self) -> None:
        super().__init__()
        self.started: list[SpawnProcess] = []

    def Process(self, *arguments: object, **named: object) -> SpawnProcess:  # type: ignore[override]
        self.started.append(SpawnProcess(*arguments, **named))  # type: ignore[arg-type]
        return self.started[-1]


def _dask(address: str) -> Any:
    """The package of dask's clients; an OptionError that says how to install it."""
    return optional_module(
        "distributed",
        f"executor={address!r} needs dask.distributed",
        'pip install distributed, or pip install ".[dask]" in the folder of the source',
        OptionError,
    )


def _connected(address: str) -> Any:
    """A client of the scheduler at an address."""
    try:
        return _dask(address).Client(address, set_as_default=False)
    except (OSError, ValueError) as error:
        raise OptionError(
            f"there is no scheduler of dask at executor={address!r}: {error}",
            remedy="start one with `dask scheduler`, and give the address that it prints",
        ) from error


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


# -----------------------------------------------------------------------------
# What all tasks share, such as the problem: pickled once, and loaded once by each worker.


KEPT = 8
"""Contents, or loaded modules, that a process keeps."""


@dataclass(frozen=True)
class Parcel:
    """Something pickled, and what messages call it."""

    name: str
    data: bytes


def packed(name: str, content: Content, executor: ExecutorLike) -> Parcel | Content:
    """A parcel if the workers of an executor are processes; otherwise what it was.

    Clients of dask send functions that are defined in a script or a notebook by value.
    """
    dumps = _pickler(executor)
    if dumps is None:
        return content
    try:
        return Parcel(name, dumps(content))
    except Exception as error:
        raise OptionError(
            f"{name} cannot be sent to another process: {error}",
            remedy="define functions by def at the top of a module, or leave out executor=",
        ) from error


def unpacked(sent: Parcel | Content) -> Content:
    """What was sent; a worker that got the same before does not load it again."""
    return cast(Content, _loaded(sent)) if isinstance(sent, Parcel) else sent


@lru_cache(KEPT)
def _loaded(parcel: Parcel) -> Any:
    try:
        return pickle.loads(parcel.data)
    except Exception as error:
        raise OptionError(
            f"a worker cannot load {parcel.name}: {type(error).__name__}: {error}",
            remedy="define functions in a module that the workers can import",
        ) from error


def _pickler(executor: ExecutorLike) -> Callable[[object], bytes] | None:
    """What pickles for the workers of an executor; None if they may be threads."""
    if isinstance(executor, int | ProcessPoolExecutor):
        return pickle.dumps
    if "distributed" not in sys.modules:
        return None
    from distributed.cfexecutor import ClientExecutor
    from distributed.protocol.pickle import dumps

    of_dask = isinstance(executor, str | ClientExecutor)
    return cast(Callable[[object], bytes], dumps) if of_dask else None


# -----------------------------------------------------------------------------
# Large answers of workers on this machine: files in memory, of which nothing is copied here.
#
# Arrays that are sent through a pipe are copied five times. A worker writes them once instead, to a
# file that is in memory alone and gone with this process, and they are mapped where they are.


_LEAST_BYTES = 1 << 20  # Smaller answers are sent as they are
_ALIGNMENT = 64  # Bytes at multiples of which arrays begin


@dataclass(frozen=True)
class Filed(Generic[Answer]):
    """An answer whose arrays of these sizes are in a file, one after the other."""

    data: bytes
    sizes: tuple[int, ...]


@dataclass(frozen=True)
class Place:
    """Where workers of this machine open a file, and its name: the path may be another's later."""

    path: str
    name: str


class MemoryFile:
    """A file that one worker writes its answer to; see :func:`filed`."""

    def __init__(self) -> None:
        name = f"rankone-{uuid.uuid4().hex}"
        self._descriptor = os.memfd_create(name)
        self.place = Place(f"/proc/{os.getpid()}/fd/{self._descriptor}", name)

    @classmethod
    def for_workers(cls, executor: ExecutorLike) -> MemoryFile | None:
        """A file if the workers of an executor are processes that can open it, and there is room.

        A process may hold so many files only.
        """
        of_this_machine = isinstance(executor, int | ProcessPoolExecutor)
        if not of_this_machine or not hasattr(os, "memfd_create"):
            return None
        try:
            return cls()
        except OSError:
            return None

    def answer(self, sent: Filed[Answer] | Answer) -> Answer:
        """What a worker sent; its arrays stay in the file."""
        if not isinstance(sent, Filed):
            return sent
        whole = memoryview(mmap.mmap(self._descriptor, 0, access=mmap.ACCESS_COPY))
        blocks, start = list[memoryview](), 0
        for size in sent.sizes:
            blocks.append(whole[start : start + size])
            start += _padded(size)
        return cast(Answer, pickle.loads(sent.data, buffers=blocks))

    def close(self) -> None:
        """Close the file; what is mapped stays."""
        os.close(self._descriptor)


def filed(answer: Answer, place: Place | None) -> Filed[Answer] | Answer:
    """An answer whose arrays were written to a file; as it is if it is small, or there is none."""
    if place is None:
        return answer
    buffers: list[pickle.PickleBuffer] = []
    keep: Callable[[pickle.PickleBuffer], None] = buffers.append
    data = pickle.dumps(answer, protocol=5, buffer_callback=keep)
    blocks = [buffer.raw() for buffer in buffers]
    if sum(block.nbytes for block in blocks) < _LEAST_BYTES:
        return answer
    try:
        with open(place.path, "r+b") as file:
            if place.name not in os.readlink(f"/proc/self/fd/{file.fileno()}"):
                return answer  # nobody waits for it any more
            for block in blocks:
                file.write(block)
                file.write(bytes(_padded(block.nbytes) - block.nbytes))
    except OSError:  # another machine
        return answer
    return Filed(data, tuple(block.nbytes for block in blocks))


def _padded(size: int) -> int:
    return -(-size // _ALIGNMENT) * _ALIGNMENT


# -----------------------------------------------------------------------------
# Independent calls on a pool, and the threads of BLAS while they run.


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
    """The BLAS pools of this process; looking for them takes milliseconds.

    Exported solvers need NumPy and SciPy alone, so that the import is here.
    """
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()


# -----------------------------------------------------------------------------
# Independent calls on a pool: a worker that dies costs its own call alone, tried again.


# Deaths of the worker of one call, alone on the machine, after which it is given up
_MOST_DEATHS = 5
_KILLED = "KilledWorker"  # The error of dask for a call on which several workers died
_REMEDY = "look for a crash or a lack of memory in the workers; " + GUARD


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
