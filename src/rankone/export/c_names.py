"""Names and numbers in C99."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Sequence

_GREEK = re.compile(r"GREEK (SMALL|CAPITAL) LETTER (?:\w+ )*(\w+)")


def c_identifier(name: str) -> str:
    """A C identifier that resembles a name: ``x_{0}`` becomes ``x_0``, ``2a`` becomes ``_2a``.

    Letters lose their accents, Greek ones are spelled out; other characters become underscores.
    """
    plain = unicodedata.normalize("NFKD", name).replace("'", "_prime")
    letters = (_latin(letter) for letter in plain if not unicodedata.combining(letter))
    text = re.sub(r"_*[^A-Za-z0-9_]+_*", "_", "".join(letters)).rstrip("_") or "model"
    return f"_{text}" if text[0].isdigit() else text


def _latin(letter: str) -> str:
    """The name of a Greek letter, any other character as it is."""
    match = _GREEK.fullmatch(unicodedata.name(letter, ""))
    if match is None:
        return letter
    word = match[2].lower().replace("lamda", "lambda")
    return word.capitalize() if match[1] == "CAPITAL" else word


def words(names: Sequence[str]) -> dict[str, str]:
    """Identifiers of names, of which those that need no change keep their own."""
    words = {name: name for name in names if re.fullmatch(r"\w+", name, re.ASCII)}
    for name in (name for name in names if name not in words):
        word = c_identifier(name)
        while word in words.values():
            word += "_"
        words[name] = word
    return words


def number(x: float) -> str:
    """A float that comes back."""
    return repr(float(x))


def padded(count: int, multiple: int) -> int:
    """The next multiple."""
    return -(-count // multiple) * multiple
