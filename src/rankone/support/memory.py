"""Amounts of memory as users write and read them."""

from __future__ import annotations

import math
import numbers
import os
import re
from typing import Any

from rankone.support.errors import OptionError
from rankone.support.wording import shown

_UNITS = {"": 1, "k": 10**3, "m": 10**6, "g": 10**9, "t": 10**12}
_BINARY = {"ki": 2**10, "mi": 2**20, "gi": 2**30, "ti": 2**40}
_TEXT = re.compile(r"\s*(\d+(?:\.\d*)?|\.\d+)\s*([kmgt]i?|)b?\s*", re.IGNORECASE)
_LEAST = 5e7  # Least limit in bytes: libraries that a solve imports take half of that


def checked_memory(name: str, amount: Any) -> float:
    """An amount in bytes, of a number of bytes or a text such as "2GB"; or an OptionError."""
    if isinstance(amount, str):
        match = _TEXT.fullmatch(amount)
        count = float(match[1]) * (_UNITS | _BINARY)[match[2].lower()] if match else math.nan
    else:
        real = isinstance(amount, numbers.Real) and not isinstance(amount, bool)
        count = float(amount) if real else math.nan
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
    for unit, size in (("TB", 1e12), ("GB", 1e9), ("MB", 1e6)):
        if count >= size:
            return f"{count / size:.3g} {unit}"
    return f"{count / 1e3:.3g} kB"
