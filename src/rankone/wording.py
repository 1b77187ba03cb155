"""How names, symbols and expressions are quoted in messages."""

from __future__ import annotations

import difflib
from collections.abc import Iterable

__all__ = ["clip", "count", "did_you_mean", "listing", "quote"]

_LONGEST_QUOTE = 160


def quote(thing: object) -> str:
    """Show what the user wrote between backquotes, cut in the middle when it is long."""
    return f"`{clip(str(thing), _LONGEST_QUOTE)}`"


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


def count(n: int, noun: str) -> str:
    """Return ``"1 unknown"`` or ``"2 unknowns"``."""
    return f"{n} {noun}" + ("" if n == 1 else "s")
