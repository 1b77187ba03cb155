"""A time limit that every long loop asks for."""

from __future__ import annotations

import math
import time as clock
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

__all__ = ["OutOfTimeError", "check_time", "seconds_left", "time_limit"]

_END: ContextVar[float] = ContextVar("rankone_deadline", default=math.inf)


class OutOfTimeError(Exception):
    """The time limit has passed; caught where the best answer so far is known."""


@contextmanager
def time_limit(seconds: float | None) -> Iterator[None]:
    """Limit what is done inside to so many seconds; an outer limit holds as well."""
    end = math.inf if seconds is None else clock.perf_counter() + seconds
    token = _END.set(min(end, _END.get()))
    try:
        yield
    finally:
        _END.reset(token)


def check_time() -> None:
    """Raise OutOfTimeError when the limit has passed."""
    if clock.perf_counter() > _END.get():
        raise OutOfTimeError


def seconds_left() -> float:
    """Seconds until the limit; infinite if there is none."""
    return _END.get() - clock.perf_counter()
