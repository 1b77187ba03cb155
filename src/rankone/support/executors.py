"""Executors of tasks, what all tasks share, and how large answers come back."""

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
from collections.abc import Callable, Iterator
from concurrent.futures import BrokenExecutor, Executor, Future, ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from multiprocessing.context import SpawnContext, SpawnProcess
from typing import Any, Generic, TypeVar, cast

from rankone.support.errors import OptionError, optional_module
from rankone.support.options import checked_number

DEATHS = (BrokenExecutor, concurrent.futures.CancelledError)
"""What a future raises whose worker died."""
GUARD = 'a script that starts processes needs `if __name__ == "__main__":` around what it runs'
"""What to do if workers die at once."""
_MAX_PROCESSES = 1000  # More processes than this are a mistake
_REMEDY = (
    "give a number of processes, a concurrent.futures.Executor, or a Client of dask.distributed "
    'or its address, "tcp://host:port"'
)

ExecutorLike = Executor | int | str
"""An executor, a number of processes, or the address of a scheduler of dask."""


def checked_executor(name: str, executor: Any) -> ExecutorLike:
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
    raise OptionError(f"{name}={executor!r} is not valid", remedy=_REMEDY)


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


_KEPT = 8  # Contents that a worker keeps
Content = TypeVar("Content")  # What is sent


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


@lru_cache(_KEPT)
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
Answer = TypeVar("Answer")  # What a task comes to


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
