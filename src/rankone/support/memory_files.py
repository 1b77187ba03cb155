"""Large answers of workers on this machine: files in memory, of which nothing is copied here.

Arrays that are sent through a pipe are copied five times. A worker writes them once instead, to a
file that is in memory alone and gone with this process, and they are mapped where they are.
"""

from __future__ import annotations

import mmap
import os
import pickle
import uuid
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from typing import Generic, TypeVar, cast

from rankone.support.executors import ExecutorLike

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
