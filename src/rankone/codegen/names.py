"""Names: whatever the user calls a symbol, as a valid Python identifier used once."""

from __future__ import annotations

import itertools
import keyword
import re
import unicodedata
from collections.abc import Iterable, Iterator

__all__ = ["Names", "is_identifier"]


class Names:
    r"""Hands out distinct identifiers, as close to the names asked for as possible.

    Parameters
    ----------
    reserved : iterable of str
        Identifiers that are never handed out, besides Python's keywords.

    Examples
    --------
    >>> names = Names(reserved=["np"])
    >>> [names(name) for name in ["x_{0}", "\\alpha", "k'", "lambda", "x_0", "2a", "np"]]
    ['x_0', 'alpha', 'k_prime', 'lambda_', 'x_0_', '_2a', 'np_']
    """

    def __init__(self, reserved: Iterable[str] = ()) -> None:
        ambiguous = ["l", "O", "I"]  # linters object
        self.taken = {*reserved, *ambiguous, *keyword.kwlist, *keyword.softkwlist}

    def __call__(self, name: str) -> str:
        """A new identifier that resembles ``name``."""
        text = unicodedata.normalize("NFKC", name).replace("'", "_prime")
        text = "".join(letter if f"_{letter}".isidentifier() else " " for letter in text)
        text = re.sub(r"_* +_*", "_", text).strip("_") or "symbol"
        if not text.isidentifier():
            text = f"_{text}"
        while text in self.taken:
            text += "_"
        self.taken.add(text)
        return text

    def numbered(self, prefix: str) -> Iterator[str]:
        """New identifiers ``prefix0``, ``prefix1``, …"""
        return (self(name) for k in itertools.count() if (name := f"{prefix}{k}") not in self.taken)


def is_identifier(name: str) -> bool:
    """Whether Python reads the name as it stands."""
    normal = unicodedata.normalize("NFKC", name) == name
    return normal and name.isidentifier() and not keyword.iskeyword(name)
