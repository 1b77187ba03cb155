"""A time limit that every long loop asks for."""

from __future__ import annotations

import math
import time as clock
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any

from rankone.errors import ConvergenceError

__all__ = ["OutOfTimeError", "check_time", "preparing", "seconds_left", "time_limit"]

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


@contextmanager
def preparing(seconds: Any) -> Iterator[None]:
    """Limit what comes before a solve, and the solve; a ConvergenceError if that takes too long.

    Anything but a positive number is no limit: the solve refuses it.
    """
    limits = isinstance(seconds, int | float) and 0.0 < seconds < 1e18
    try:
        with time_limit(seconds if limits else None):
            yield
    except OutOfTimeError:
        raise ConvergenceError(
            "the time limit was reached before the problem was compiled",
            remedy="give more time by max_seconds",
        ) from None


def check_time(seconds: float = 0.0) -> None:
    """Raise OutOfTimeError when the limit has passed, or will have in so many seconds."""
    if clock.perf_counter() + seconds > _END.get():
        raise OutOfTimeError


def seconds_left() -> float:
    """Seconds until the limit; infinite if there is none."""
    return _END.get() - clock.perf_counter()
