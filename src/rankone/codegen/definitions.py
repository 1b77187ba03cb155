"""What a generated module has beside its functions: imports, constants, data, known cuts."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

import sympy as sp

from rankone.codegen.switching import switches
from rankone.codegen.text import docstring, literal, nested, quoted, table
from rankone.ir.forms import Coordinate
from rankone.ir.functions import known_applied

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
    """``CUTS`` and ``PERIODIC_CUTS``: for each coordinate where functions of it alone switch.

    Nothing where there are none.
    """
    found = switches(coordinates, expressions)
    lines: list[str] = []
    if any(each.points for each in found):
        lines += table("CUTS", nested(tuple(sorted(each.points)) for each in found))
    if any(each.periodic for each in found):
        lines += table("PERIODIC_CUTS", nested(tuple(sorted(each.periodic)) for each in found))
    return lines
