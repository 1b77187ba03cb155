"""A call in a process of its own, which may die or take too long without harm to the others."""

from __future__ import annotations

import multiprocessing
import resource
import signal
import traceback
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from typing import Any

__all__ = ["Failed", "apart", "each_apart"]

_WALL = 30.0
"""Seconds on the clock per second of the processor after which a process hangs."""


@dataclass(frozen=True)
class Failed:
    """A call that returned nothing."""

    reason: str
    slow: bool = False


def apart(function: Callable[..., Any], arguments: Sequence[object], limit: float) -> Any:
    """What the function returns, or a Failed after this many seconds of the processor."""
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe(duplex=False)
    process = context.Process(target=_called, args=(theirs, function, arguments, limit))
    process.start()
    theirs.close()
    try:
        if ours.poll(_WALL * limit):
            return ours.recv()
        return Failed(f"no answer in {_WALL * limit:.0f} s on the clock", slow=True)
    except EOFError:
        process.join()
        if process.exitcode == -signal.SIGXCPU:
            return Failed(f"no answer in {limit:.0f} s of the processor", slow=True)
        return Failed(f"the process died with code {process.exitcode}")
    finally:
        if process.is_alive():
            process.kill()
        process.join()


def _called(pipe: Any, function: Callable[..., Any], arguments: Sequence[object], limit: float):
    hard = resource.getrlimit(resource.RLIMIT_CPU)[1]
    resource.setrlimit(resource.RLIMIT_CPU, (int(limit) + 1, hard))
    try:
        found = function(*arguments)
    except Exception as error:
        frame = traceback.extract_tb(error.__traceback__)[-1]
        found = Failed(f"{type(error).__name__} in {frame.name}: {error}")
    pipe.send(found)


def each_apart(
    function: Callable[..., Any], names: Sequence[str], limit: float, processes: int
) -> Iterator[tuple[str, Any]]:
    """The names and what the function returns for each, as they end."""
    with ThreadPoolExecutor(processes) as pool:
        calls = {pool.submit(apart, function, (name,), limit): name for name in names}
        for call in as_completed(calls):
            yield calls[call], call.result()
