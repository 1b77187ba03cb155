"""Errors and warnings, and their wording: what was given, where, what was expected, what to do."""

from __future__ import annotations

import difflib
import functools
import html
import importlib
import math
import re
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from fractions import Fraction
from types import ModuleType
from typing import Any, Protocol, TypeVar

Subject = TypeVar("Subject")

_LONGEST = 1000  # Characters of a message that is shown: about ten lines
_LONGEST_QUOTE = 160  # Characters of a quote: about two lines of a terminal
_LONGEST_FRACTION = 24  # Characters above which a fraction is written as a decimal number
LISTED = 6  # Those of a longer list that are shown
_MOST_ROWS = 40  # Rows of a table that fit on one screen
_ENDS = 8  # Lines of a longer list that are shown at its beginning, and at its end
SIMILAR = 0.75  # Least similarity of names where one that is new is possible, or many are alike
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
        first = listed[:LISTED]
        if near is not None:
            by_text = {written(subject): subject for subject in listed}
            closest = difflib.get_close_matches(near, by_text, n=LISTED, cutoff=0.0)
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


# -----------------------------------------------------------------------------
# Errors and warnings: what was given, where, what was expected, what to do.
#
# Every error of the library derives from :class:`RankoneError`. It has its message (``.message``)
# and, as far as they apply, the term (``.term``) and what to do (``.remedy``); errors of problems
# also have the equation (``.equation``). All can be pickled.


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
