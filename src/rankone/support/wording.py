"""Text for people: quotes and lists in messages, names, tables and equations."""

from __future__ import annotations

import difflib
import functools
import html
import re
from collections.abc import Callable, Iterable, Sequence
from fractions import Fraction
from typing import Protocol, TypeVar

Subject = TypeVar("Subject")

_LONGEST = 1000  # Characters of a message that is shown: about ten lines
_LONGEST_QUOTE = 160  # Characters of a quote: about two lines of a terminal
_LONGEST_FRACTION = 24  # Characters above which a fraction is written as a decimal number
_LISTED = 6  # Those of a longer list that are shown
_MOST_ROWS = 40  # Rows of a table that fit on one screen
_ENDS = 8  # Lines of a longer list that are shown at its beginning, and at its end
_WIDEST_CELL = 32  # Characters of a cell, so that a row of three stays on one line
_RIGHT = "coefficient"  # The column that is aligned on the right


class HasLatex(Protocol):
    """An expression that knows its own LaTeX."""

    def _repr_latex_(self) -> str: ...


written = functools.singledispatch(str)
"""Text of an object in messages; the front end registers how expressions are written."""


def quote(subject: object) -> str:
    """Show what the user wrote between backquotes, cut in the middle when it is long."""
    return f"`{clip(written(subject), _LONGEST_QUOTE)}`"


def shown(subject: object) -> str:
    """Show an object as Python writes it, cut in the middle when it is long."""
    try:
        return clip(repr(subject), _LONGEST_QUOTE)
    except ValueError:  # Python refuses to write integers of thousands of digits
        return "a number of thousands of digits"


def is_text(text: object) -> bool:
    """Whether an object is text that can be written to a file: no half of a surrogate pair."""
    return isinstance(text, str) and not any("\ud800" <= letter <= "\udfff" for letter in text)


def clip(text: str, longest: int) -> str:
    """Cut a long text in the middle."""
    half = longest // 2 - 3
    return text if len(text) <= longest else f"{text[:half]} ... {text[-half:]}"


def listing(subjects: Iterable[object], near: str | None = None) -> str:
    """Quote several objects: ```a`, `b` and `c```.

    Of many those that are most like ``near``, or else the first ones, and how many others.
    """
    listed = list(subjects)
    if len(listed) > 2 * _ENDS:
        first = listed[:_LISTED]
        if near is not None:
            by_text = {written(subject): subject for subject in listed}
            closest = difflib.get_close_matches(near, by_text, n=_LISTED, cutoff=0.0)
            first = [by_text[text] for text in closest]
        return f"{', '.join(map(quote, first))} and {len(listed) - len(first)} others"
    quoted = [quote(subject) for subject in listed]
    if len(quoted) < 2:
        return "".join(quoted)
    return f"{', '.join(quoted[:-1])} and {quoted[-1]}"


def abridged(
    subjects: Sequence[Subject], text: Callable[[Subject], str], hidden: str = "... {} more ..."
) -> list[str]:
    """The text of each subject; of many those at both ends, and how many are ``hidden``."""
    more = len(subjects) - 2 * _ENDS
    if len(subjects) <= _MOST_ROWS:
        return [text(subject) for subject in subjects]
    first, last = subjects[:_ENDS], subjects[-_ENDS:]
    return [*map(text, first), hidden.format(more), *map(text, last)]


def did_you_mean(name: str, names: Iterable[str], cutoff: float = 0.6) -> str:
    """Return ``" (did you mean `beta`?)"`` when one of the names is close, else nothing.

    Names that differ in case alone are the closest. ``cutoff`` is the least similarity, up to one.
    """
    lowered = {candidate.lower(): candidate for candidate in reversed(list(names))}
    close = difflib.get_close_matches(name.lower(), lowered, n=1, cutoff=cutoff)
    return f" (did you mean {quote(lowered[close[0]])}?)" if close else ""


def shortened(message: str) -> str:
    """A message of about ten lines at most: the middle of a longer one is left out.

    So are first the middles of its longest words, such as names of files.
    """
    if len(message) <= _LONGEST:
        return message
    half = _LONGEST_QUOTE // 2
    message = re.sub(rf"(\S{{{half}}})\S{{{half},}}(\S{{{half}}})", r"\1…\2", message)
    begin, end = message[: _LONGEST * 3 // 4], message[_LONGEST * 3 // 4 :][-_LONGEST // 4 :]
    if len(begin) + len(end) == len(message):
        return f"{message} (see `.message`)"
    return f"{begin.rpartition(' ')[0]} … (see `.message`) … {end.partition(' ')[2]}"


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


def is_line(text: object) -> bool:
    """Whether an object is text that can be printed in one line and written to a file."""
    return is_text(text) and str.isprintable(str(text))


def name_defect(named: Iterable[tuple[str, str]]) -> tuple[str, str] | None:
    """The first name that cannot be printed or occurs twice, and the reason.

    ``named`` has each name and its owner: ``("k", "parameter `k`")``.
    """
    owners: dict[str, str] = {}
    for name, owner in named:
        if not is_line(name) or not name.strip():
            return name, f"the name {name!r} is not text that can be printed in one line"
        if name in owners:
            return name, f"the name {quote(name)} belongs both to {owners[name]} and to {owner}"
        owners[name] = owner
    return None


def text_table(
    summary: str,
    header: Sequence[str],
    rows: Iterable[Sequence[str]],
    right: Sequence[str] = (_RIGHT,),
) -> str:
    """A table with aligned columns under a line of summary; many rows are cut in the middle.

    The columns named ``right`` are aligned on the right.
    """
    shown = [[_cut(cell) for cell in row] for row in rows]
    hidden = len(shown) - _MOST_ROWS
    if hidden > 1:
        shown[_MOST_ROWS // 2 : -(_MOST_ROWS // 2)] = []
    widths = [max(map(len, column)) for column in zip(header, *shown, strict=True)]
    sides = [name in right for name in header]
    lines = [_aligned(row, widths, sides) for row in [header, *shown]]
    if hidden > 1:
        lines.insert(1 + _MOST_ROWS // 2, f"... {hidden} more ...")
    return "\n".join([summary, *lines])


def html_table(summary: str, header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A summary and the table below it as HTML, in full."""
    head = "".join(f"<th>{html.escape(cell)}</th>" for cell in header)
    body = "\n".join(
        "<tr>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in row) + "</tr>" for row in rows
    )
    return (
        f"<table>\n<caption>{html.escape(summary)}</caption>\n"
        f"<thead><tr>{head}</tr></thead>\n<tbody>\n{body}\n</tbody>\n</table>"
    )


def _cut(cell: str) -> str:
    return cell if len(cell) <= _WIDEST_CELL else cell[: _WIDEST_CELL - 3] + "..."


def _aligned(row: Sequence[str], widths: Sequence[int], right: Sequence[bool]) -> str:
    cells = [
        cell.rjust(width) if on_right else cell.ljust(width)
        for cell, width, on_right in zip(row, widths, right, strict=True)
    ]
    return "  ".join(cells).rstrip()


def aligned_equations(lines: Iterable[str]) -> str:
    """Displayed LaTeX of equations with ``&=``."""
    body = " \\\\\n".join(lines)
    return f"$$\\begin{{aligned}}\n{body}\n\\end{{aligned}}$$"


def latex(expression: HasLatex) -> str:
    """LaTeX of an expression, without dollar signs."""
    text: str = expression._repr_latex_()
    return text.removeprefix("$").removesuffix("$").removeprefix(r"\displaystyle ")


def latex_number(value: Fraction | float) -> str:
    """LaTeX of a nonnegative number to six digits; fractions as they are."""
    size = f"{float(value):.6g}"
    if isinstance(value, Fraction) and Fraction(size) != value:
        return rf"\frac{{{value.numerator}}}{{{value.denominator}}}"
    if "e" in size:
        mantissa, exponent = size.split("e")
        return rf"{mantissa} \cdot 10^{{{int(exponent)}}}"
    return size
