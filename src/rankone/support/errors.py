"""Errors and warnings: what was given, where, what was expected, what to do.

Every error of the library derives from :class:`RankoneError`. It has its message (``.message``)
and, as far as they apply, the term (``.term``) and what to do (``.remedy``); errors of problems
also have the equation (``.equation``). All can be pickled.
"""

from __future__ import annotations

import importlib
import math
import sys
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from types import ModuleType
from typing import Any

from rankone.support.wording import shortened

__all__ = [
    "BlowUpError",
    "ConvergenceError",
    "EvaluationError",
    "ExportError",
    "OptionError",
    "ProblemError",
    "RankoneError",
    "RankoneWarning",
    "SeparationError",
    "StorageError",
    "bounded_depth",
    "check_kind",
    "optional_module",
    "warn",
    "with_remedy",
]


def with_remedy(message: str, remedy: str | None) -> str:
    """A message for users: what is wrong and, if there is a remedy, what to do about it."""
    return message if remedy is None else f"{message}; remedy: {remedy}"


class RankoneError(Exception):
    """Base class of all errors raised by rankone.

    Parameters
    ----------
    message : str
        What was given and what was expected.
    term : object, optional
        The term, symbol or value concerned, as the user wrote it.
    remedy : str, optional
        What to do about it; ``str`` puts it behind the message.
    """

    def __init__(self, message: str, *, term: object = None, remedy: str | None = None) -> None:
        super().__init__(message)
        self.message, self.term, self.remedy = message, term, remedy

    def __str__(self) -> str:
        return with_remedy(shortened(self.message), self.remedy)


class ProblemError(RankoneError, ValueError):
    """The problem as written is incomplete or contradictory.

    Parameters
    ----------
    equation : int, optional
        Number of the equation concerned, counted from 1 as the user wrote them.
    term, remedy
        As for every error.
    """

    def __init__(
        self,
        message: str,
        *,
        equation: int | None = None,
        term: object = None,
        remedy: str | None = None,
    ) -> None:
        message = message if equation is None else f"equation {equation}: {message}"
        super().__init__(message, term=term, remedy=remedy)
        self.equation = equation


class SeparationError(ProblemError):
    """A term does not factor into functions of one coordinate and a monomial of the unknowns."""


@contextmanager
def bounded_depth() -> Iterator[None]:
    """Turn a RecursionError, from a deeply nested expression, into a ProblemError."""
    try:
        yield
    except RecursionError:
        raise ProblemError(
            "an expression is nested too deep for Python's recursion limit",
            remedy="give parts of it names of their own, as unknowns with equations",
        ) from None


class OptionError(RankoneError, ValueError):
    """An option of the solver is out of its range."""


def check_kind(function: str, argument: object, *kinds: type, remedy: str) -> None:
    """Raise an OptionError unless the argument of a function is of one of these types."""
    if not isinstance(argument, kinds):
        names = " or a ".join(kind.__name__ for kind in kinds)
        message = f"{function} needs a {names}, not {type(argument).__name__}"
        raise OptionError(message, term=argument, remedy=remedy)


class EvaluationError(RankoneError, ValueError):
    """A solution does not hold the value asked for: outside the box, or an unknown name."""


class StorageError(RankoneError, ValueError):
    """A file cannot be read or written as a rankone solution."""


class ExportError(RankoneError, ValueError):
    """A solver or a solution cannot be exported as asked; nothing was written."""


class ConvergenceError(RankoneError, RuntimeError):
    """The tolerance asked for was not reached; ``.solution`` holds what was reached.

    ``.bifurcation`` is that at which a branch of steady states ends or turns unstable, with its
    kind and place, or None.
    """

    def __init__(
        self,
        message: str,
        *,
        solution: object = None,
        term: object = None,
        remedy: str | None = None,
        bifurcation: object = None,
    ) -> None:
        super().__init__(message, term=term, remedy=remedy)
        self.solution: Any = solution
        self.bifurcation: Any = bifurcation


class BlowUpError(ConvergenceError):
    """A trajectory leaves every bound inside the horizon, or the region of finite rates.

    Attributes
    ----------
    time : float
        Time near which the earliest blow-up was seen.
    parameters : dict of str to float
        Parameter values at which it was seen.
    solution : Solution or None
        For the whole box, up to shortly before ``time``; its error is measured.
    part : Solution or None
        For the whole horizon and a smaller box: one interval is shorter, so that as much as
        possible of the box is kept. None if no such box is known, or a solve on it fails. It is
        solved when it is first asked for, which may take as long as a solve; a copy by pickle
        has it only if it was asked for before.
    """

    def __init__(
        self,
        message: str,
        *,
        time: float = math.nan,
        parameters: Mapping[str, float] | None = None,
        part: Callable[[], object] | None = None,
        solution: object = None,
        term: object = None,
        remedy: str | None = None,
    ) -> None:
        super().__init__(message, solution=solution, term=term, remedy=remedy)
        self.time, self.parameters = time, dict(parameters or {})
        self._solve_part = part
        self._part: Any = None

    @property
    def part(self) -> Any:
        """A solution for the whole horizon on a smaller box, or None."""
        if self._solve_part is not None:
            self._part, self._solve_part = self._solve_part(), None
        return self._part

    def __reduce__(self) -> tuple[object, ...]:
        state = {**self.__dict__, "_solve_part": None}
        return type(self), self.args, state


def optional_module(
    name: str, purpose: str, remedy: str, error: type[RankoneError] = RankoneError
) -> ModuleType:
    """An optional package, or an error that says what needs it and how to install it."""
    try:
        return importlib.import_module(name)
    except ImportError:
        raise error(f"{purpose}, which is not installed", remedy=remedy) from None


class RankoneWarning(UserWarning):
    """Something is probably unintended, but well defined."""


def warn(message: str, *, remedy: str | None = None) -> None:
    """Give a RankoneWarning at the line that called this package from outside."""
    package = __name__.partition(".")[0]
    level = depth = 1
    frame = sys._getframe().f_back
    while frame is not None:
        depth += 1
        if frame.f_globals.get("__name__", "").partition(".")[0] == package:
            level = depth
        frame = frame.f_back
    warnings.warn(with_remedy(message, remedy), RankoneWarning, stacklevel=level + 1)
