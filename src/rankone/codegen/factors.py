"""Factor functions: all known functions of one coordinate, evaluated together."""

from __future__ import annotations

from collections.abc import Sequence

import sympy as sp

from rankone.codegen.printer import common_subexpressions, factor_text
from rankone.codegen.text import Names, assignment, docstring, table
from rankone.ir.forms import Coordinate

_SHARED_ARGUMENT = "p"  # Name of the parameter in a function that serves several parameters
_MAX_SUMMARY = 90  # Characters of a summary that lists the factors


def coordinate_functions(
    coordinates: Sequence[Coordinate], expressions: Sequence[Sequence[sp.Expr]]
) -> list[list[str]]:
    """``time_factors``, the functions of the parameters and ``parameter_factors``.

    The expressions are those of each coordinate in turn; the first of each is one.
    Parameters whose factors are the same but for the name share one function.
    """
    clock, *parameters = coordinates
    names = Names(["np", "special", "out"])
    identifiers = [names(parameter.name) for parameter in parameters]
    shared = sp.Symbol(_SHARED_ARGUMENT)
    renamed = [
        tuple(factor.xreplace({c.symbol: shared}) for factor in factors)
        for c, factors in zip(parameters, expressions[1:], strict=True)
    ]
    blocks = [_factor_function("time_factors", "t", clock.symbol, expressions[0], clock.name)]
    functions: dict[tuple[sp.Expr, ...], str] = {}
    for j, factors in enumerate(renamed):
        if factors in functions:
            continue
        users = [i for i, candidate in enumerate(renamed) if candidate == factors]
        title = ", ".join(parameters[i].name for i in users)
        name = f"factors_of_{identifiers[j]}"
        if len(users) == 1:
            arguments = identifiers[j], parameters[j].symbol, expressions[j + 1]
        else:
            name += f"_and_{len(users) - 1}_more"
            arguments = _SHARED_ARGUMENT, shared, factors
        functions[factors] = name
        blocks.append(_factor_function(name, *arguments, title))
    listed = [functions[factors] for factors in renamed]
    alike = len(listed) > 1 and len(functions) == 1
    repeated = [f"PARAMETER_FACTORS = ({listed[0]},) * {len(listed)}"] if alike else []
    blocks.append(
        [
            *(repeated or table("PARAMETER_FACTORS", listed)),
            "",
            "",
            "def parameter_factors(dimension, p):",
            *docstring(["Factors of one parameter at the points p (N,): shape (number, N)."]),
            "    return PARAMETER_FACTORS[dimension](p)",
        ]
    )
    return blocks


def _factor_function(
    name: str, argument: str, symbol: sp.Symbol, expressions: Sequence[sp.Expr], title: str
) -> list[str]:
    """A function that evaluates all factors of a coordinate, called ``title``."""
    names = Names(["np", "special", "out", argument])
    shared, texts = common_subexpressions(expressions, {symbol: argument}, names.numbered("c"))
    summary = f"Factors of {title}: {', '.join(map(factor_text, expressions))}."
    if len(summary) > _MAX_SUMMARY:
        summary = f"Factors of {title} ({len(expressions)})."
    if len(summary) > _MAX_SUMMARY:
        summary = f"Factors of several parameters ({len(expressions)})."
    lines = [f"def {name}({argument}):", *docstring([summary])]
    for target, text in shared:
        lines += assignment(target, [text])
    lines.append(f"    out = np.empty(({len(expressions)}, {argument}.size))")
    for row, text in enumerate(texts):
        lines += assignment(f"out[{row}]", ["1.0" if text == "1" else text])
    return [*lines, "    return out"]
