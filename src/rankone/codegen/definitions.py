"""What a generated module has beside its functions: imports, constants, data, known cuts."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

import sympy as sp

from rankone.codegen.text import docstring, literal, nested, quoted, table
from rankone.functions import Table, known_applied
from rankone.ir import Coordinate

__all__ = ["constants", "cut_table", "definitions", "module_source"]


def module_source(
    header: Callable[[bool], list[str]], tables: Sequence[str], blocks: Iterable[Sequence[str]]
) -> str:
    """The text of a module; ``header`` gives its docstring, told whether SciPy is imported."""
    body = "\n\n\n".join("\n".join(block) for block in blocks if block) + "\n"
    imports = ["import numpy as np"]
    if "special." in body:
        imports.append("from scipy import special")
    if "CubicSpline(" in body:
        imports.append("from scipy.interpolate import CubicSpline")
    lines = docstring(header(len(imports) > 1), indent="")
    return "\n".join([*lines, "", *imports, "", *tables]) + "\n\n\n" + body


def constants(
    separated: bool,
    names: Iterable[str],
    n_differential: int,
    products: Iterable[tuple[int, int]],
    coordinates: Sequence[Coordinate],
) -> list[str]:
    """The tables that describe any system."""
    clock, *parameters = coordinates
    return [
        f"SEPARATED = {separated}",
        *table("STATES", [quoted(name) for name in names]),
        f"N_DIFFERENTIAL = {n_differential}",
        *table("PRODUCTS", nested(products)),
        *table("PARAMETERS", [quoted(parameter.name) for parameter in parameters]),
        f"TIME = {literal((float(clock.lower), float(clock.upper)))}",
        *table("BOX", nested((float(c.lower), float(c.upper)) for c in parameters)),
    ]


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
