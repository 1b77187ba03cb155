"""Layout of generated Python text: statements and tables as ``ruff format`` would write them."""

from __future__ import annotations

import json
import textwrap
from collections.abc import Iterable, Sequence
from fractions import Fraction
from typing import TypeAlias

from rankone.support.wording import number

__all__ = [
    "INDENT",
    "WIDTH",
    "Nested",
    "assignment",
    "commented",
    "described_table",
    "docstring",
    "literal",
    "nested",
    "one_line",
    "paragraph",
    "quoted",
    "statement",
    "table",
    "tuple_lines",
    "unpacking",
]

WIDTH = 100
_TOGETHER = 400
"""Terms of a sum in one statement at most: Python compiles long sums by recursion."""
INDENT = "    "

Nested: TypeAlias = "str | Sequence[Nested]"
"""A text, or a tuple of them."""


def literal(value: object) -> str:
    """A number, or a tuple of them, as ``ruff format`` writes it; fractions stay exact.

    >>> literal((1e200, 0.5)), literal(Fraction(3, 2)), literal(Fraction(1, 3))
    ('(1e200, 0.5)', '1.5', '1 / 3')
    """
    if isinstance(value, Fraction):
        text = number(value)
        return text.replace("/", " / ") if "/" in text else literal(float(value))
    if isinstance(value, tuple):
        return f"({', '.join(map(literal, value))}{',' * (len(value) == 1)})"
    return quoted(value) if isinstance(value, str) else repr(value).replace("e+", "e")


def assignment(target: str, terms: Sequence[str], meaning: str = "") -> list[str]:
    """``target = sum of terms``; all terms but the first start with their sign.

    >>> assignment("y", ["a * b", "- c"], "x'")
    ["    y = a * b - c  # x'"]
    """
    lines = statement(f"{target} =", terms[:_TOGETHER])
    for k in range(_TOGETHER, len(terms), _TOGETHER):
        lines += statement(f"{target} =", [target, *terms[k : k + _TOGETHER]])
    return [commented(lines[0], meaning)] if meaning and len(lines) == 1 else lines


def statement(start: str, terms: Sequence[str]) -> list[str]:
    """A statement that ends in a sum, such as ``return a - b``, wrapped if it is long."""
    joined = " ".join(terms)
    line = f"{INDENT}{start} {joined}"
    if len(line) <= WIDTH:
        return [line]
    inner = INDENT * 2
    body = [inner + joined] if len(inner + joined) <= WIDTH else [inner + term for term in terms]
    return [f"{INDENT}{start} (", *body, f"{INDENT})"]


def one_line(text: str) -> str:
    """Text that ends neither a line nor a file: what cannot be printed becomes an underscore."""
    return text if text.isprintable() else "".join(c if c.isprintable() else "_" for c in text)


def commented(line: str, comment: str) -> str:
    """The line with a comment, left out if it does not fit."""
    longer = f"{line}  # {one_line(comment)}"
    return longer if len(longer) <= WIDTH else line


def unpacking(names: Sequence[str], source: str) -> list[str]:
    """``a, b = source``; nothing if every name is ``_``."""
    if all(name == "_" for name in names):
        return []
    targets = f"({names[0]},)" if len(names) == 1 else ", ".join(names)
    line = f"{INDENT}{targets} = {source}"
    if len(line) <= WIDTH:
        return [line]
    return [f"{INDENT}(", *(f"{INDENT * 2}{name}," for name in names), f"{INDENT}) = {source}"]


def table(name: str, items: Sequence[Nested]) -> list[str]:
    """A tuple bound to a name, on one line if it fits.

    >>> table("PAIRED", [["0", "2"], ["1"]])
    ['PAIRED = ((0, 2), (1,))']
    """
    return tuple_lines(f"{name} = ", items, "", indent="")


def described_table(name: str, rows: Sequence[object], comments: Sequence[str]) -> list[str]:
    """A tuple of tuples bound to a name, one in a line, each with a comment.

    >>> described_table("TERMS", [(1.5, 0)], ["x': 1.5"])
    ['TERMS = (', "    (1.5, 0),  # x': 1.5", ')']
    """
    lines = []
    for row, comment in zip(nested(rows), comments, strict=True):
        written = tuple_lines("", row, ",", INDENT)
        lines += [commented(written[0], comment)] if len(written) == 1 else written
    return [f"{name} = (", *lines, ")"] if lines else [f"{name} = ()"]


def tuple_lines(start: str, item: Nested, end: str, indent: str) -> list[str]:
    """A text, or a tuple between two texts: one line for each item if it is too long for one."""
    line = f"{indent}{start}{_one_line(item)}{end}"
    if len(line) <= WIDTH or isinstance(item, str):
        return [line]
    inner = [row for part in item for row in tuple_lines("", part, ",", indent + INDENT)]
    return [f"{indent}{start}(", *inner, f"{indent}){end}"]


def _one_line(item: Nested) -> str:
    """A text as it is, or a tuple in one line."""
    if isinstance(item, str):
        return item
    parts = [_one_line(part) for part in item]
    return f"({parts[0]},)" if len(parts) == 1 else f"({', '.join(parts)})"


def docstring(lines: Sequence[str], indent: str = INDENT) -> list[str]:
    """A docstring of a summary and further lines, safe for backslashes and quotes."""
    plain = map(one_line, lines)
    safe = [line.replace("\\", "\\\\").replace('"""', r"\"\"\"") for line in plain]
    if len(safe) == 1 and not safe[0].endswith('"'):
        return [f'{indent}"""{safe[0]}"""']
    body = [(indent + line).rstrip() for line in safe[1:]]
    return [f'{indent}"""{safe[0]}', *body, f'{indent}"""']


def paragraph(text: str, width: int = WIDTH) -> list[str]:
    """Text wrapped to a width, continuation lines indented further; an empty line for none."""
    lines = textwrap.wrap(
        text,
        width,
        subsequent_indent=" " * (len(text) - len(text.lstrip()) + 4),
        break_long_words=False,
        break_on_hyphens=False,
    )
    return lines or [""]


def nested(items: Iterable[object]) -> list[Nested]:
    """Text of nested tuples of numbers."""
    return [nested(item) if isinstance(item, tuple) else literal(item) for item in items]


def quoted(text: str) -> str:
    r"""A string literal in double quotes.

    >>> print(quoted("k'"), quoted(r"\alpha"))
    "k'" "\\alpha"
    """
    text = json.dumps(text, ensure_ascii=False)
    return text if text.isprintable() else "".join(map(_escaped, text))


def _escaped(letter: str) -> str:
    """A character of a string literal; one that cannot be printed by its number."""
    number = ord(letter)
    escape = f"\\u{number:04x}" if number < 0x10000 else f"\\U{number:08x}"
    return letter if letter.isprintable() else escape
