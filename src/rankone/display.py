"""The separated form as people read it: a table of terms × dimensions, or sums of products.

Nothing here imports SymPy: expressions know their own text and LaTeX.
"""

from __future__ import annotations

import html
from collections.abc import Iterator, Sequence
from itertools import chain
from typing import Any

from rankone.ir import SeparatedForm, Term

__all__ = ["html_table", "latex_sums", "text_table"]

_MOST_ROWS = 40
_WIDEST_CELL = 32


def text_table(form: SeparatedForm) -> str:
    """Return the terms and initial values as a table with aligned columns.

    A form of many terms is cut in the middle; the first line has the counts.
    """
    header, rows = _header(form), _rows(form)
    shown = [[_cut(cell) for cell in row] for row in rows]
    hidden = len(shown) - _MOST_ROWS
    if hidden > 1:
        shown[_MOST_ROWS // 2 : -(_MOST_ROWS // 2)] = []
    widths = [max(map(len, column)) for column in zip(header, *shown, strict=True)]
    lines = [_aligned(row, widths) for row in [header, *shown]]
    if hidden > 1:
        lines.insert(1 + _MOST_ROWS // 2, f"... {hidden} more ...")
    return "\n".join([_summary(form), *lines])


def html_table(form: SeparatedForm) -> str:
    """Return the terms and initial values as an HTML table."""
    head = "".join(f"<th>{html.escape(cell)}</th>" for cell in _header(form))
    body = "\n".join(
        "<tr>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in row) + "</tr>"
        for row in _rows(form)
    )
    return (
        f"<table>\n<caption>{html.escape(_summary(form))}</caption>\n"
        f"<thead><tr>{head}</tr></thead>\n<tbody>\n{body}\n</tbody>\n</table>"
    )


def latex_sums(form: SeparatedForm) -> str:
    """Return each equation, and each initial value, as a sum of separated products."""
    lines = []
    for i, _ in enumerate(form.states):
        products = [_latex_term(form, term) for term in form.terms if term.equation == i]
        lines.append(f"{_latex_sum(products)} &= 0")
    start = form.coordinates[0]
    for i, state in enumerate(form.states):
        products = [_latex_term(form, term) for term in form.initial if term.equation == i]
        at_start = rf"\Big|_{{{_latex(start.symbol)} = {start.lower:g}}}"
        lines.append(f"{_latex_state(form, state.expression)} {at_start} &= {_latex_sum(products)}")
    body = " \\\\\n".join(lines)
    return f"$$\\begin{{aligned}}\n{body}\n\\end{{aligned}}$$"


# -- tables -----------------------------------------------------------------------------------


def _summary(form: SeparatedForm) -> str:
    counts = [
        (len(form.states), "equation"),
        (len(form.terms), "term"),
        (len(form.coordinates), "dimension"),
        (sum(len(distinct) - 1 for distinct in form.factors), "factor"),
    ]
    shown = ", ".join(f"{n} {noun}{'' if n == 1 else 's'}" for n, noun in counts)
    return f"Separated form: {shown} (residual u' - f = 0)"


def _header(form: SeparatedForm) -> list[str]:
    return ["equation", "coefficient", "monomial", *(c.name for c in form.coordinates)]


def _rows(form: SeparatedForm) -> list[list[str]]:
    start = f"({form.coordinates[0].lower:g})"
    return [
        [
            form.states[term.equation].name + (start if is_initial else ""),
            f"{term.coefficient:.6g}",
            _monomial(form, term),
            *(
                str(distinct[i].expression)
                for distinct, i in zip(form.factors, term.factors, strict=True)
            ),
        ]
        for is_initial, term in chain(
            ((False, term) for term in form.terms), ((True, term) for term in form.initial)
        )
    ]


def _monomial(form: SeparatedForm, term: Term) -> str:
    powers = [
        form.states[i].name + (f"**{power}" if power > 1 else "")
        for i, power in _powers(term.monomial)
    ]
    text = "*".join(powers) or "1"
    if term.derivative == 0:
        return text
    return f"d{text}/d{form.coordinates[0].name}"


def _powers(monomial: Sequence[int]) -> Iterator[tuple[int, int]]:
    for i in sorted(set(monomial)):
        yield i, monomial.count(i)


def _cut(cell: str) -> str:
    return cell if len(cell) <= _WIDEST_CELL else cell[: _WIDEST_CELL - 3] + "..."


def _aligned(row: Sequence[str], widths: Sequence[int]) -> str:
    cells = [
        cell.rjust(width) if i == 1 else cell.ljust(width)
        for i, (cell, width) in enumerate(zip(row, widths, strict=True))
    ]
    return "  ".join(cells).rstrip()


# -- LaTeX ------------------------------------------------------------------------------------


def _latex_term(form: SeparatedForm, term: Term) -> tuple[bool, str]:
    """Return whether the term is negative, and its absolute value."""
    size = f"{abs(term.coefficient):.6g}"
    if "e" in size:
        mantissa, exponent = size.split("e")
        size = rf"{mantissa} \cdot 10^{{{int(exponent)}}}"
    factors = [
        rf"\left[{_latex(distinct[i].expression)}\right]"
        for distinct, i in zip(form.factors, term.factors, strict=True)
        if i
    ]
    states = []
    for i, power in _powers(term.monomial):
        raised = f"^{{{power}}}" if power > 1 else ""
        states.append(f"{{{_latex_state(form, form.states[i].expression)}}}{raised}")
    if term.derivative:
        states.insert(0, rf"\frac{{d}}{{d {_latex(form.coordinates[0].symbol)}}}")
    parts = [*factors, *states]
    if size != "1" or not parts:
        parts.insert(0, size)
    return term.coefficient < 0, " ".join(parts)


def _latex_sum(products: Sequence[tuple[bool, str]]) -> str:
    text = " ".join(("- " if negative else "+ ") + product for negative, product in products)
    return text.removeprefix("+ ") or "0"


def _latex(expression: Any) -> str:
    text: str = expression._repr_latex_()
    return text.removeprefix("$").removesuffix("$").removeprefix(r"\displaystyle ")


def _latex_state(form: SeparatedForm, expression: Any) -> str:
    """Write a state without its argument."""
    time = _latex(form.coordinates[0].symbol)
    return _latex(expression).replace(rf"{{\left({time} \right)}}", "")
