"""How names, symbols and expressions are quoted in messages."""

from __future__ import annotations

import difflib
import functools
from collections.abc import Iterable
from fractions import Fraction

__all__ = [
    "clip",
    "count",
    "did_you_mean",
    "is_text",
    "listing",
    "number",
    "quote",
    "shown",
    "written",
]

_LONGEST_QUOTE = 160
_LONGEST_FRACTION = 24
"""Characters above which a fraction is written as a decimal number."""


written = functools.singledispatch(str)
"""Text of a thing in messages; what has expressions registers how they are written."""


def quote(thing: object) -> str:
    """Show what the user wrote between backquotes, cut in the middle when it is long."""
    return f"`{clip(written(thing), _LONGEST_QUOTE)}`"


def shown(value: object) -> str:
    """Show a value as Python writes it, cut in the middle when it is long."""
    try:
        return clip(repr(value), _LONGEST_QUOTE)
    except ValueError:  # Python refuses to write integers of thousands of digits
        return "a number of thousands of digits"


def is_text(value: object) -> bool:
    """Whether a value is text that can be written to a file: no half of a surrogate pair."""
    return isinstance(value, str) and not any("\ud800" <= letter <= "\udfff" for letter in value)


def clip(text: str, longest: int) -> str:
    """Cut a long text in the middle."""
    half = longest // 2 - 3
    return text if len(text) <= longest else f"{text[:half]} ... {text[-half:]}"


def listing(things: Iterable[object]) -> str:
    """Quote several things: ```a`, `b` and `c```."""
    quoted = [quote(thing) for thing in things]
    if len(quoted) < 2:
        return "".join(quoted)
    return f"{', '.join(quoted[:-1])} and {quoted[-1]}"


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """Return ``" (did you mean `beta`?)"`` when a known name is close, else nothing.

    Names that differ in case alone are the closest.
    """
    lowered = {candidate.lower(): candidate for candidate in reversed(list(known))}
    close = difflib.get_close_matches(name.lower(), lowered, n=1, cutoff=0.6)
    return f" (did you mean {quote(lowered[close[0]])}?)" if close else ""


def count(n: int, noun: str, plural: str | None = None) -> str:
    """Return ``"1 unknown"`` or ``"2 unknowns"``; a plural without "s" is given."""
    return f"{n} {noun if n == 1 else plural or noun + 's'}"


def number(value: Fraction | float) -> str:
    """Shortest text of a number: a decimal that is exact, or else the fraction.

    >>> number(Fraction(3, 2)), number(Fraction(1, 3)), number(2.0), number(0.1)
    ('1.5', '1/3', '2', '0.1')
    """
    text = repr(float(value)).removesuffix(".0")
    if isinstance(value, Fraction) and Fraction(text) != value:
        exact = f"{value.numerator}/{value.denominator}"
        text = exact if len(exact) <= _LONGEST_FRACTION else text
    return text
