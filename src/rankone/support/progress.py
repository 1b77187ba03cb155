"""Progress of a solve: events for a callback, or a bar on standard error."""

from __future__ import annotations

import logging
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass
from typing import Any

from rankone.support.errors import OptionError, count

logger = logging.getLogger("rankone")


@contextmanager
def timed(timings: dict[str, float], stage: str) -> Iterator[None]:
    """Time a stage, in seconds, and log it."""
    began = time.perf_counter()
    yield
    timings[stage] = time.perf_counter() - began
    logger.info("%s: %.3f s", stage, timings[stage])


@dataclass(frozen=True, slots=True)
class ProgressEvent:
    """The state of a solve after a slab was accepted; for the cross engine within an attempt.

    Attributes
    ----------
    time : float
        End of the slab; for the cross engine the start of the horizon until an attempt is done.
    fraction : float
        Fraction of the horizon solved in this attempt, 0 to 1; for the cross engine the fraction
        of the attempt's sweep over the parameters. It never falls within an attempt.
    attempt : int
        Index of the attempt, from 0; each starts the horizon again with a tighter tolerance.
    slabs : int
        Number of slabs accepted in this attempt; for the cross engine of all.
    rank : int
        Largest rank of the slab; for the cross engine the largest so far.
    """

    time: float
    fraction: float
    attempt: int
    slabs: int
    rank: int


StepReport = Callable[[int, int], object]
"""Called with the numbers of finished and of all steps."""
Report = Callable[[ProgressEvent], object]
"""Called with each event; an exception stops the solve."""


def quiet(event: ProgressEvent, /) -> None:
    """Ignore an event."""


@contextmanager
def progress_bar() -> Iterator[Report]:
    """A bar and the callback that moves it: a widget in notebooks, else on standard error."""
    with _tqdm()(
        total=1.0, leave=False, bar_format="{desc} {percentage:3.0f}% |{bar}| {elapsed}{postfix}"
    ) as bar:
        bar.set_description_str("solving")

        def show(event: ProgressEvent, /) -> None:
            bar.n = event.fraction
            attempt = "" if event.attempt == 0 else f" (attempt {event.attempt + 1})"
            bar.set_description_str(f"solving{attempt}", refresh=False)
            shown = f"t = {event.time:.4g}, {count(event.slabs, 'slab')}, rank {event.rank}"
            bar.set_postfix_str(shown, refresh=False)
            bar.update(0)
            bar.refresh()

        yield show


def _tqdm() -> Any:
    """The class of bars: without ipywidgets it is text, in notebooks as well."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from tqdm.auto import tqdm
    return tqdm


@contextmanager
def counting_bar(
    progress: object, total: int, description: str = "solving", unit: str = "box"
) -> Iterator[StepReport]:
    """What is called with the numbers of finished and of all solves, or other units of work.

    True is a bar on standard error, False nothing; a callable is called; or an OptionError.
    """
    if progress is not True and progress is not False:
        if not callable(progress):
            raise OptionError(
                f"progress is {progress!r}",
                term=progress,
                remedy="use True, False or a function of two numbers: how many are finished, and "
                "how many there are",
            )
        yield progress
        return
    if progress is False:
        yield lambda done, total: None
        return
    with _tqdm()(total=total, leave=False, desc=description, unit=unit) as bar:

        def show(done: int, total: int) -> None:
            bar.update(done - bar.n)

        yield show


def resolve_progress(progress: bool | Report) -> AbstractContextManager[Report]:
    """Turn the option ``progress`` into a context that gives a callback, or an OptionError.

    False is nothing, True a bar on standard error; a callable is called with each event.

    >>> with resolve_progress(print) as report:
    ...     report(ProgressEvent(time=1.0, fraction=0.5, attempt=0, slabs=2, rank=7))
    ProgressEvent(time=1.0, fraction=0.5, attempt=0, slabs=2, rank=7)
    """
    if progress is True:
        return progress_bar()
    if progress is False:
        return nullcontext(quiet)
    if not callable(progress):
        raise OptionError(
            f"progress is {progress!r}",
            term=progress,
            remedy="use True, False or a function of a ProgressEvent",
        )
    return nullcontext(progress)
