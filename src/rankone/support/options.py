"""Options of the engines: what they may be is declared at the field and checked in one place."""

from __future__ import annotations

import math
import numbers
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, fields
from typing import Any, ClassVar, Self

from rankone.support.errors import OptionError
from rankone.support.wording import did_you_mean, shown

__all__ = [
    "Options",
    "checked_count",
    "checked_number",
    "choice",
    "integer",
    "integers",
    "number",
    "refuse_positional",
]


_MOST_NUMBERS = 2**28
"""Floating-point numbers that random, or evenly spread, points may take."""
_LARGEST_INTEGER = 10**9
"""Largest integer of an option: beyond it a limit limits nothing."""


def checked_number(
    name: str, value: Any, least: float, most: float = math.inf, kind: type = int
) -> Any:
    """The value as an int or float (``kind``) between two others, or an OptionError."""
    kinds = numbers.Integral if kind is int else numbers.Real
    valid = isinstance(value, kinds) and not isinstance(value, bool)
    try:
        if valid and least <= value <= most:
            return kind(value)
    except OverflowError:
        pass
    what = "an integer" if kind is int else "a number"
    where = f"of at least {least:g}" if most == math.inf else f"from {least:g} to {most:g}"
    raise OptionError(f"{name}={shown(value)} is not valid", remedy=f"choose {what} {where}")


def checked_count(name: str, value: Any, least: int, each: int) -> int:
    """A number of points, each of which takes so many numbers, or an OptionError.

    The most are what 2 GiB hold: beyond, the operating system ends the process, or all of them.
    """
    return int(checked_number(name, value, least, max(least, _MOST_NUMBERS // max(each, 1))))


def refuse_positional(arguments: Sequence[Any], keyword: str) -> None:
    """Raise an OptionError if there are arguments by position, with the form by keyword."""
    if arguments:
        raise OptionError(
            f"{arguments[0]!r} is given by position",
            remedy=f"give it by its keyword: {keyword}={arguments[0]!r}",
        )


def integer(default: int | None, least: int = 1, most: int = _LARGEST_INTEGER) -> Any:
    """Declare an integer between two others."""
    return _declared(default, lambda name, value: checked_number(name, value, least, most))


def number(default: float | None, least: float, most: float = math.inf) -> Any:
    """Declare a real number between two others."""
    return _declared(default, lambda name, value: checked_number(name, value, least, most, float))


def integers(default: int | None, least: int = 1) -> Any:
    """Declare an integer, or several of them, of at least another."""

    def check(name: str, value: Any) -> Any:
        if isinstance(value, list | tuple):
            return tuple(checked_number(name, item, least, _LARGEST_INTEGER) for item in value)
        return checked_number(name, value, least, _LARGEST_INTEGER)

    return _declared(default, check)


def choice(default: str, choices: Iterable[str]) -> Any:
    """Declare one of several names."""
    known = tuple(choices)

    def check(name: str, value: Any) -> Any:
        if not isinstance(value, str) or value not in known:
            remedy = f"choose one of {', '.join(known)}"
            raise OptionError(f"{name}={value!r} is unknown", remedy=remedy)
        return value

    return _declared(default, check)


def _declared(default: Any, check: Callable[[str, Any], Any]) -> Any:
    return field(default=default, metadata={"check": check})


@dataclass(frozen=True)
class Options:
    """Options of an engine, checked; None is possible where it is the default."""

    usual_attempts: ClassVar[int] = 10
    """Attempts of a solve, unless ``max_attempts`` is given; more are made while they pay."""

    def __post_init__(self) -> None:
        for option in fields(self):
            value = getattr(self, option.name)
            if value is not None or option.default is not None:
                value = option.metadata["check"](option.name, value)
                object.__setattr__(self, option.name, value)

    @property
    def max_attempts(self) -> int | None:
        """How often a solve may be tried; a field of engines that try again."""
        return 1

    @classmethod
    def names(cls) -> list[str]:
        """What :meth:`of` takes."""
        return sorted(option.name for option in fields(cls))

    @classmethod
    def of(cls, keywords: Sequence[str] = (), /, **changes: Any) -> Self:
        """Options with changes, or an OptionError if one is unknown or out of its range.

        ``keywords`` are what the caller takes beside options.
        """
        known = cls.names()
        for name in sorted(changes.keys() - known):
            beside = f"; solve itself takes {', '.join(keywords)}" if keywords else ""
            raise OptionError(
                f"unknown option {name!r}{did_you_mean(name, [*known, *keywords])}",
                remedy=f"choose from {', '.join(known)}{beside}",
            )
        return cls(**changes)
