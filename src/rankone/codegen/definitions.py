"""What a generated module needs beside its functions: imports, tables of data, known cuts."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import sympy as sp

from rankone.codegen.text import literal, table
from rankone.functions import Table, known_applied
from rankone.ir import Coordinate

__all__ = ["cut_table", "definitions", "import_lines"]


def import_lines(body: str) -> list[str]:
    """The imports that the text of a module needs."""
    lines = ["import numpy as np"]
    if "special." in body:
        lines.append("from scipy import special")
    if "CubicSpline(" in body:
        lines.append("from scipy.interpolate import CubicSpline")
    return lines


def definitions(expressions: Iterable[sp.Expr]) -> list[list[str]]:
    """The tables applied in expressions, each once."""
    classes = {type(part).__name__: type(part) for part in known_applied(expressions)}
    return [made.definition() for _, made in sorted(classes.items()) if made.definition()]


def cut_table(coordinates: Sequence[Coordinate], expressions: Iterable[sp.Expr]) -> list[str]:
    """``CUTS``: for each coordinate where tables of it jump or kink; nothing without tables.

    The points are those of tables of a linear function of the coordinate.
    """
    found: dict[sp.Symbol, set[float]] = {c.symbol: set() for c in coordinates}
    for part in known_applied(expressions):
        symbols = part.args[0].free_symbols
        if not isinstance(part, Table) or part.kind == "cubic" or len(symbols) != 1:
            continue
        (symbol,) = symbols
        argument = part.args[0]
        if symbol not in found or argument.has(sp.core.function.AppliedUndef):
            continue
        slope = argument.diff(symbol)
        if slope.is_number and slope != 0:
            start = float(argument.subs(symbol, 0))
            found[symbol].update((x - start) / float(slope) for x in part.points)
    if not any(found.values()):
        return []
    return table("CUTS", [[literal(x) for x in sorted(cuts)] for cuts in found.values()])
