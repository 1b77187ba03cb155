"""Tables and equations as people read them: text, HTML, LaTeX.

Nothing here imports SymPy: expressions know their own LaTeX.
"""

from __future__ import annotations

import html
from collections.abc import Iterable, Sequence
from fractions import Fraction
from typing import Any

__all__ = ["aligned_equations", "html_table", "latex", "latex_number", "text_table"]

_MOST_ROWS = 40
_WIDEST_CELL = 32
_RIGHT = "coefficient"
"""The column that is aligned on the right."""


def text_table(summary: str, header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table with aligned columns under a line of summary; many rows are cut in the middle."""
    shown = [[_cut(cell) for cell in row] for row in rows]
    hidden = len(shown) - _MOST_ROWS
    if hidden > 1:
        shown[_MOST_ROWS // 2 : -(_MOST_ROWS // 2)] = []
    widths = [max(map(len, column)) for column in zip(header, *shown, strict=True)]
    right = header.index(_RIGHT)
    lines = [_aligned(row, widths, right) for row in [header, *shown]]
    if hidden > 1:
        lines.insert(1 + _MOST_ROWS // 2, f"... {hidden} more ...")
    return "\n".join([summary, *lines])


def html_table(summary: str, header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """The same as an HTML table, in full."""
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


def _aligned(row: Sequence[str], widths: Sequence[int], right: int) -> str:
    cells = [
        cell.rjust(width) if i == right else cell.ljust(width)
        for i, (cell, width) in enumerate(zip(row, widths, strict=True))
    ]
    return "  ".join(cells).rstrip()


def aligned_equations(lines: Iterable[str]) -> str:
    """Displayed LaTeX of equations with ``&=``."""
    body = " \\\\\n".join(lines)
    return f"$$\\begin{{aligned}}\n{body}\n\\end{{aligned}}$$"


def latex(expression: Any) -> str:
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
