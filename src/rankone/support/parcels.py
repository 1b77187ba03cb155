"""What all tasks share, such as the problem: pickled once, and loaded once by each worker."""

from __future__ import annotations

import pickle
import sys
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, TypeVar, cast

from rankone.support.errors import OptionError
from rankone.support.executors import ExecutorLike

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
