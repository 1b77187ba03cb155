"""Options, declared with their ranges at the field and checked in one place; amounts of memory."""

from __future__ import annotations

import inspect
import math
import numbers
import os
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field, fields
from typing import Any, ClassVar, Self, TypeVar, cast

from rankone.support.errors import OptionError, did_you_mean, shown

RTOL = 1e-6
"""Relative tolerance unless another is asked for."""
RTOLS = 1e-10, 0.1
"""Tolerances of solves: rounding spoils references of tighter ones, looser ones say little."""
STEP_RTOLS = 1e-12, 0.1
"""Tolerances of trajectories and of smaller models: rounding errors are below them."""
OUTPUT_RTOLS = 1e-13, 0.999
"""Tolerances of outputs and of canonical forms."""
LEVEL = 0.95
"""Probability that intervals and half-widths hold, unless a user chooses another."""
INTEGRATORS = ("auto", "stack", "single")
"""How trajectories are integrated, as the option of that name has it."""
INTEGRATOR_HELP = "how trajectories are integrated: together, or each alone"
# Floating-point numbers of random points: 2 GiB, beyond which systems end processes
_MOST_POINT_NUMBERS = 2**28
_LARGEST_INTEGER = 10**9  # Largest integer of an option: no limit above it is ever reached


def checked_number(
    name: str, value: object, least: float, most: float = math.inf, kind: type[float] = int
) -> Any:
    """The value as an int or float (``kind``) from ``least`` to ``most``, or an OptionError."""
    accepted = numbers.Integral if kind is int else numbers.Real
    valid = isinstance(value, accepted) and not isinstance(value, bool)
    try:
        if valid and least <= cast(float, value) <= most:
            return kind(cast(float, value))
    except OverflowError:
        pass
    article = "an integer" if kind is int else "a number"
    interval = f"of at least {least:g}" if most == math.inf else f"from {least:g} to {most:g}"
    raise OptionError(f"{name}={shown(value)} is not valid", remedy=f"choose {article} {interval}")


def checked_count(name: str, value: object, least: int, each: int) -> int:
    """A count of points, each of ``each`` numbers, that fits into memory, or an OptionError."""
    return int(checked_number(name, value, least, max(least, _MOST_POINT_NUMBERS // max(each, 1))))


def integer(default: int | None, least: int = 1, most: int = _LARGEST_INTEGER) -> Any:
    """Declare an integer from ``least`` to ``most``."""
    return _declared(default, lambda name, value: checked_number(name, value, least, most))


def number(default: float | None, least: float, most: float = math.inf) -> Any:
    """Declare a real number from ``least`` to ``most``."""
    return _declared(default, lambda name, value: checked_number(name, value, least, most, float))


def integers(default: int | None, least: int = 1) -> Any:
    """Declare an integer of at least ``least``, or several of them."""

    def check(name: str, option: object) -> object:
        if isinstance(option, list | tuple):
            return tuple(checked_number(name, n, least, _LARGEST_INTEGER) for n in option)
        return checked_number(name, option, least, _LARGEST_INTEGER)

    return _declared(default, check)


def choice(default: str, choices: Iterable[str]) -> Any:
    """Declare one of several names."""
    names = tuple(choices)

    def check(name: str, option: object) -> object:
        if not isinstance(option, str) or option not in names:
            remedy = f"choose one of {', '.join(names)}"
            raise OptionError(f"{name}={option!r} is unknown", remedy=remedy)
        return option

    return _declared(default, check)


def _declared(default: object, check: Callable[[str, object], object]) -> Any:
    return field(default=default, metadata={"check": check})


_Function = TypeVar("_Function", bound=Callable[..., object])


def takes_options_of(source: Callable[..., object]) -> Callable[[_Function], _Function]:
    """Show the options of ``source`` in the signature of a function that hands them on.

    If the docstring of the function ends with its parameters, those of ``source`` follow.
    """
    handed_on = inspect.signature(source).parameters.values()

    def decorated(function: _Function) -> _Function:
        signature = inspect.signature(function)
        own = [p for p in signature.parameters.values() if p.kind is not p.VAR_KEYWORD]
        names = {parameter.name for parameter in own}
        more = [
            p
            for p in handed_on
            if p.kind in (p.KEYWORD_ONLY, p.VAR_KEYWORD) and p.name not in names
        ]
        named: Any = function
        named.__signature__ = signature.replace(parameters=[*own, *more])
        text = inspect.getdoc(function) or ""
        _, _, parameters = (inspect.getdoc(source) or "").partition("----------\n")
        if "Returns\n-------" not in text:
            named.__doc__ = f"{text}\n{parameters}"
        return function

    return decorated


_Kind = TypeVar("_Kind")


def of_keywords(kind: Callable[..., _Kind], function: str, options: Mapping[str, Any]) -> _Kind:
    """The options of a function from its keywords; a TypeError that names it for unknown ones."""
    if unknown := [name for name in options if name not in inspect.signature(kind).parameters]:
        raise TypeError(f"{function}() got an unexpected keyword argument {unknown[0]!r}")
    return kind(**options)


_PIECES = "ro.solve_many(problem, problem.split(k=4), "
# What solve does not take since something else does, and what to do
_TAKEN_ELSEWHERE = {
    "atol": "absolute tolerances belong to the problem: Problem(..., atol={x: 1e-6}), "
    'Problem.from_strings(..., atol={"x": 1e-6})',
    "checkpoint": "finished pieces of the box are kept by "
    f"{_PIECES}checkpoint='folder'); a finished solution by solution.save('u.npz')",
    "boxes": f"several boxes are solved by {_PIECES}...)",
}


@dataclass(frozen=True)
class Options:
    """Options of an engine, checked; None is allowed where it is the default."""

    usual_attempts: ClassVar[int] = 10
    """Attempts of a solve, unless ``max_attempts`` is given; more are made while they pay."""

    def __post_init__(self) -> None:
        for option in fields(self):
            chosen = getattr(self, option.name)
            if chosen is not None or option.default is not None:
                checked = option.metadata["check"](option.name, chosen)
                object.__setattr__(self, option.name, checked)

    @property
    def max_attempts(self) -> int | None:
        """Most attempts of a solve; a field of engines that repeat it."""
        return 1

    @property
    def executor(self) -> Executor | int | str | None:
        """Where trajectories are integrated; a field of engines that sample many."""
        return None

    @classmethod
    def names(cls) -> list[str]:
        """Names of the options."""
        return sorted(option.name for option in fields(cls))

    @classmethod
    def of(cls, keywords: Sequence[str] = (), /, **changes: Any) -> Self:
        """Options with changes, or an OptionError if one is unknown or out of its range.

        ``keywords`` are what the caller takes beside options.
        """
        names = cls.names()
        for name in sorted(changes.keys() - names):
            if name in _TAKEN_ELSEWHERE:
                raise OptionError(f"solve does not take {name}=", remedy=_TAKEN_ELSEWHERE[name])
            beside = f"; solve itself takes {', '.join(keywords)}" if keywords else ""
            raise OptionError(
                f"unknown option {name!r}{did_you_mean(name, [*names, *keywords])}",
                remedy=f"choose from {', '.join(n for n in names if n not in keywords)}{beside}",
            )
        return cls(**changes)


# -----------------------------------------------------------------------------
# Amounts of memory as users write and read them.


_UNITS = {"": 1, "k": 10**3, "m": 10**6, "g": 10**9, "t": 10**12}
_BINARY = {"ki": 2**10, "mi": 2**20, "gi": 2**30, "ti": 2**40}
_TEXT = re.compile(r"\s*(\d+(?:\.\d*)?|\.\d+)\s*([kmgt]i?|)b?\s*", re.IGNORECASE)
_LEAST = 5e7  # Least limit in bytes: libraries that a solve imports take half of that


def checked_memory(name: str, amount: object) -> float:
    """An amount in bytes, of a number of bytes or a text such as "2GB"; or an OptionError."""
    if isinstance(amount, str):
        match = _TEXT.fullmatch(amount)
        count = float(match[1]) * (_UNITS | _BINARY)[match[2].lower()] if match else math.nan
    else:
        real = isinstance(amount, numbers.Real) and not isinstance(amount, bool)
        count = float(cast(float, amount)) if real else math.nan
    if math.isnan(count):
        raise OptionError(
            f"{name}={shown(amount)} is no amount of memory",
            term=amount,
            remedy='give bytes, or a text such as "500MB", "2GB" or "1.5GiB"',
        )
    if count < _LEAST:
        raise OptionError(
            f"{name}={shown(amount)} is too little",
            term=amount,
            remedy=f"give at least {in_words(_LEAST)}",
        )
    return count


def physical_memory() -> float:
    """Bytes of memory that this machine has; infinite where it does not say."""
    try:
        return float(os.sysconf("SC_PAGE_SIZE")) * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, OSError, ValueError):
        return math.inf


def in_words(count: float) -> str:
    """Bytes as a user reads them: "2.1 GB"."""
    for unit, size in (("TB", 10**12), ("GB", 10**9), ("MB", 10**6)):
        if count >= size:
            return f"{count / size:.3g} {unit}"
    return f"{count / 10**3:.3g} kB"
