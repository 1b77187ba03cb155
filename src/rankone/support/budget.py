"""The budget of a computation: work counted here and by workers, a deadline, and progress."""

from __future__ import annotations

import logging
import math
import time
import time as clock
import warnings
import weakref
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from contextvars import Context, ContextVar
from dataclasses import dataclass
from typing import Any, Generic, NamedTuple, Self, TypeVar, cast

from rankone.support.arrays import Array
from rankone.support.errors import ConvergenceError, OptionError, count
from rankone.support.options import checked_number

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


# -----------------------------------------------------------------------------
# The budget of a computation: work counted here and by workers, and a deadline where a user asked
# for one.
#
# A unit of work is about one nanosecond of one core. Work is counted from the sizes of arrays and
# the number of calls, never measured, so a computation ends in the same way on a busy machine. The
# clock is read only where a user gave ``max_seconds``.


EFFORT_HELP = "budget of work: low, normal (default), high or a factor; the best so far is kept"
MEMORY_HELP = "limit of memory, such as 2GB; what would not fit is refused"
SECONDS_HELP = "time limit on the clock; the best so far is kept"
NORMAL = 2.5e10
"""Most operations of a solve unless ``effort`` says otherwise: about 25 seconds of a quiet core."""
PATIENCE = 0.43 * NORMAL
"""Operations of the normal effort after which a solve ends unless its attempts still improve."""
REMEDIES = 0.14
"""Share of a budget that is kept for trials of remedies; after a short solve they take less."""
WAITING = 0.1 * NORMAL
"""Most operations that :func:`waiting` adds to the patience of a solve."""
_EFFORTS = {"low": 0.2, "normal": 1.0, "high": 10.0}
COPIES = 6
"""Copies of a large array while others are computed from it: memory is reserved for these."""
LEAST_EFFORT = 1e-6
"""Smallest factor on the budget: 25 microseconds of work, less than any solve."""
_TELLING_SHARE = 0.2  # Part of the work of a look after which it tells how much is left
# Seconds of an operation, roughly: work that would end after the deadline is not begun
_OPERATION_SECONDS = 1e-9


class Reached(NamedTuple):
    """How far an integration came before a limit; ``chattering`` is a state that switches there."""

    time: float
    steps: int
    chattering: int | None


class OutOfBudgetError(Exception):
    """A limit was reached; caught where the best answer so far is known.

    ``reached`` says how far an integration came, if the limit was reached by one, and ``sizes``
    how large its states are, (n,), as far as that is known.
    """

    sizes: Array | None = None

    def __init__(self, reached: Reached | None = None) -> None:
        super().__init__(reached)
        self.reached = reached

    def at(self, reached: Reached | None) -> Self:
        """The error of an integration, with how far it came."""
        return type(self)(reached)


class OutOfWorkError(OutOfBudgetError):
    """The budget of counted work is spent."""


class OutOfTimeError(OutOfBudgetError):
    """The time limit that a user gave has passed."""


class OutOfMemoryError(OutOfBudgetError):
    """What comes next needs more bytes, ``needed``, than the ``limit``."""

    def __init__(self, needed: float, limit: float, reached: Reached | None = None) -> None:
        super().__init__(reached)
        self.needed, self.limit = needed, limit

    def __reduce__(self) -> tuple[object, ...]:
        return type(self), (self.needed, self.limit, self.reached)

    def at(self, reached: Reached | None) -> Self:
        return type(self)(self.needed, self.limit, reached)


class Account:
    """The work that was counted, and the limits on it.

    ``done`` operations are counted, at most ``most`` may be, and ``patience`` where nothing
    improves; once ``telling`` ones are, those that are foreseen count too. ``memory`` are the bytes
    that may be held at once, and ``held`` those that are kept for now. ``end`` is the deadline, by
    ``time.perf_counter``; infinite unless a user asked for one.
    """

    __slots__ = ("done", "end", "held", "memory", "most", "patience", "telling")

    def __init__(self) -> None:
        self.done, self.most, self.end = 0.0, math.inf, math.inf
        self.patience = self.telling = math.inf
        self.held, self.memory = 0.0, math.inf

    @property
    def limit(self) -> float:
        """The operations that may be counted now."""
        return min(self.most, self.patience)

    def release(self, count: float) -> None:
        """Give back this many bytes."""
        self.held -= count


_ACCOUNT: ContextVar[Account | None] = ContextVar("rankone_budget", default=None)


@contextmanager
def limited(
    operations: float = math.inf, seconds: float = math.inf, memory: float = math.inf
) -> Iterator[Account]:
    """Limit the work inside, and the bytes that are held; outer limits hold as well.

    They count the same work.
    """
    outer = _ACCOUNT.get()
    account = outer or Account()
    before = account.most, account.end, account.memory
    token = _ACCOUNT.set(account)
    account.memory = min(account.memory, memory)
    account.most = min(account.most, account.done + operations)
    if seconds < math.inf:
        account.end = min(account.end, clock.perf_counter() + seconds)
    try:
        yield account
    finally:
        account.most, account.end, account.memory = before
        _ACCOUNT.reset(token)


@contextmanager
def patient(operations: float) -> Iterator[None]:
    """End the work inside after so many operations, except for what is :func:`persisting`."""
    account = _ACCOUNT.get() or Account()
    before = account.patience
    account.patience = min(before, account.done + operations)
    try:
        yield
    finally:
        account.patience = before


@contextmanager
def persisting(operations: float = math.inf) -> Iterator[None]:
    """Go on inside where patience has ended, for at most so many operations."""
    account = _ACCOUNT.get() or Account()
    before, account.patience = account.patience, math.inf
    try:
        with limited(operations):
            yield
    finally:
        account.patience = before


@contextmanager
def waiting(operations: float) -> Iterator[None]:
    """Have patience inside for so many operations more; half of what is beyond it stays."""
    account = _ACCOUNT.get() or Account()
    before = account.patience
    if before < account.most:
        account.patience += min(operations, WAITING, 0.5 * (account.most - before))
    try:
        yield
    finally:
        account.patience = before


@contextmanager
def part_of_budget(share: float) -> Iterator[None]:
    """Leave a share of all that is left to the work inside."""
    hard, soft, seconds = share * budget_left(), share * work_left(), share * seconds_left()
    with limited(hard, seconds), patient(soft):
        yield


@contextmanager
def keeping_back(operations: float, seconds: float = 0.0) -> Iterator[None]:
    """Leave so many operations and seconds of what is left for what comes after the work inside."""
    hard, soft = budget_left() - operations, work_left() - operations
    with limited(hard, seconds_left() - seconds), patient(soft):
        yield


@contextmanager
def looking(operations: float) -> Iterator[Account]:
    """Limit the work inside, which ends early where more than that is foreseen.

    What is foreseen counts after a part of the work: before that it tells too little. It does not
    where less is left in all: then the work goes on, to say how far it came.
    """
    lasts = work_left() >= operations
    with limited(operations) as account:
        before = account.telling
        if lasts:
            account.telling = account.done + _TELLING_SHARE * operations
        try:
            yield account
        finally:
            account.telling = before


@contextmanager
def unlimited() -> Iterator[None]:
    """Count the work inside, but without a limit: a solution has to be measured in any case."""
    account = _ACCOUNT.get() or Account()
    before = account.most, account.patience, account.end
    account.most = account.patience = account.end = math.inf
    try:
        yield
    finally:
        account.most, account.patience, account.end = before


@contextmanager
def preparing(seconds: object) -> Iterator[None]:
    """Limit compilation and solve together; a ConvergenceError if compiling takes too long.

    Anything but a positive number is ignored here: the solve refuses it.
    """
    limit = math.inf
    if isinstance(seconds, int | float) and 0.0 < seconds < 1e18:
        limit = float(seconds)
    try:
        with limited(seconds=limit):
            yield
    except OutOfTimeError:
        raise ConvergenceError(
            "the time limit was reached before the problem was compiled",
            remedy="give more time by max_seconds",
        ) from None


def charge(operations: float) -> None:
    """Count operations that are about to be made.

    An OutOfWorkError if they are more than the budget has left; an OutOfTimeError if they would
    hardly end before the deadline.
    """
    account = _ACCOUNT.get()
    if account is None:
        return
    done = account.done + operations
    if done > account.limit:
        # the remaining budget does not depend on the call that ran out
        account.done = max(account.done, account.limit)
        raise OutOfWorkError
    account.done = done
    if (
        account.end < math.inf
        and clock.perf_counter() + _OPERATION_SECONDS * operations > account.end
    ):
        raise OutOfTimeError


def foresee(operations: float) -> None:
    """Raise an OutOfWorkError if so many further operations are more than a look has left."""
    account = _ACCOUNT.get()
    if account is not None and account.telling <= account.done > account.limit - operations:
        raise OutOfWorkError


def check_time() -> None:
    """Raise OutOfTimeError after the deadline; for work that no budget counts."""
    charge(0.0)


def memory_left() -> float:
    """The bytes that may be held beside those that are; infinite outside of a solve."""
    account = _ACCOUNT.get()
    return math.inf if account is None else account.memory - account.held


def reserve(count: float) -> None:
    """Raise an OutOfMemoryError if this many further bytes are more than may be held."""
    account = _ACCOUNT.get()
    if account is not None and account.held + count > account.memory:
        raise OutOfMemoryError(account.held + count, account.memory)


def hold(owner: object, count: float, expected: float = 0.0) -> None:
    """Count bytes as held for as long as their owner lives.

    An OutOfMemoryError if they do not fit: it says that those ``expected`` later are needed too.
    """
    account = _ACCOUNT.get()
    if account is None or account.memory == math.inf:
        return
    account.held += count
    if account.held > account.memory:
        account.held -= count
        raise OutOfMemoryError(account.held + count + expected, account.memory)
    weakref.finalize(owner, account.release, count).atexit = False


def work_done() -> float:
    """Operations counted so far within the outermost limit."""
    account = _ACCOUNT.get()
    return 0.0 if account is None else account.done


def work_left() -> float:
    """Operations until the limit; infinite if there is none."""
    account = _ACCOUNT.get()
    return math.inf if account is None else account.limit - account.done


def budget_left() -> float:
    """Operations until the limit of what still improves: what shares are taken of."""
    account = _ACCOUNT.get()
    return math.inf if account is None else account.most - account.done


def seconds_left() -> float:
    """Seconds until the deadline; infinite if there is none."""
    account = _ACCOUNT.get()
    end = math.inf if account is None else account.end
    return end if end == math.inf else end - clock.perf_counter()


def effort_of(text: str) -> str | float:
    """An effort as ``--effort`` has it: a name or a factor."""
    try:
        return float(text)
    except ValueError:
        return text


def patience_for(operations: float) -> float:
    """Operations of a budget after which a solve ends unless its attempts still improve.

    That of the normal effort, for as long as the budget has them: the seconds of a refusal count,
    not its share of a small budget.
    """
    share = PATIENCE / NORMAL
    return max(share * operations, min(PATIENCE, (1.0 - REMEDIES) * operations))


def operations_for(effort: str | float) -> float:
    """The operations of an effort: a name, or a factor on the normal budget; or an OptionError."""
    if isinstance(effort, str):
        if effort not in _EFFORTS:
            remedy = "choose 'low', 'normal', 'high' or a positive factor"
            raise OptionError(f"effort={effort!r} is unknown", term=effort, remedy=remedy)
        return NORMAL * _EFFORTS[effort]
    return NORMAL * float(checked_number("effort", effort, LEAST_EFFORT, 1.0 / LEAST_EFFORT, float))


# -----------------------------------------------------------------------------
# Counted work that is done elsewhere: by a worker, within what is left of the budget here.
#
# Each task counts anew, up to all that is left when it is sent. What it counted is charged here
# when its answer is taken, so that it does not matter which of several tasks was done first.


Answer = TypeVar("Answer")  # What a task comes to


@dataclass(frozen=True)
class LimitsElsewhere:
    """What is left here: operations, the end by the clock on the wall, and bytes of each worker."""

    operations: float
    end: float
    memory: float

    @classmethod
    def left(cls) -> LimitsElsewhere:
        """What is left now."""
        return cls(work_left(), time.time() + seconds_left(), memory_left())


@dataclass(frozen=True)
class Counted(Generic[Answer]):
    """The answer of a task, or how it failed, and the work that was counted."""

    work: float
    answer: Answer | None = None
    failure: Exception | None = None

    @classmethod
    def of(
        cls,
        limits: LimitsElsewhere,
        failures: tuple[type[Exception], ...],
        call: Callable[[], Answer],
    ) -> Counted[Answer]:
        """The answer of a call, and what it counted.

        Other exceptions than ``failures`` and the end of a limit are raised. An executor may run it
        in the thread of the solve, so it counts in a context of its own.
        """
        return Context().run(lambda: _counted(limits, (OutOfBudgetError, *failures), call))

    def settled(self) -> Answer:
        """The answer, after its work was charged here; a failure is raised."""
        charge(self.work)
        if self.failure is not None:
            raise self.failure
        return cast(Answer, self.answer)


def _counted(
    limits: LimitsElsewhere, failures: tuple[type[Exception], ...], call: Callable[[], Answer]
) -> Counted[Answer]:
    seconds = math.inf if limits.end == math.inf else limits.end - time.time()
    with limited(limits.operations, seconds, limits.memory) as account:
        try:
            answer = call()
        except failures as failure:
            return Counted(account.done, failure=failure)
        return Counted(account.done, answer)
