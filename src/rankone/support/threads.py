"""The threads of BLAS while a solve runs."""

from __future__ import annotations

import threading
from contextlib import AbstractContextManager, nullcontext
from functools import cache

from threadpoolctl import ThreadpoolController


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
