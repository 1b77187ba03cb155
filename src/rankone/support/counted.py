"""Counted work that is done elsewhere: by a worker, within what is left of the budget here.

Each task counts anew, up to all that is left when it is sent. What it counted is charged here when
its answer is taken, so that it does not matter which of several tasks was done first.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from contextvars import Context
from dataclasses import dataclass
from typing import Generic, TypeVar, cast

from rankone.support.budget import (
    OutOfBudgetError,
    charge,
    limited,
    memory_left,
    seconds_left,
    work_left,
)

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
