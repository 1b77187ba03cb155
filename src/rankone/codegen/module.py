"""The generated module: its parts in the order a person reads them, and how it is imported."""

from __future__ import annotations

import hashlib
import linecache
import types
from collections.abc import Sequence
from typing import cast

from rankone.codegen.grouping import Group, group_terms
from rankone.codegen.header import header, signature_text
from rankone.codegen.kernels import KERNELS, KernelWriter, helpers
from rankone.codegen.lowering import LoweredSystem, lower, right_hand_side, state_names
from rankone.codegen.names import Names
from rankone.codegen.pointwise import PointwiseWriter
from rankone.codegen.printer import common_subexpressions, plain_text
from rankone.codegen.text import (
    assignment,
    docstring,
    literal,
    nested,
    quoted,
    table,
)
from rankone.ir import SeparatedForm, Term
from rankone.system import System

__all__ = ["generate_source", "load_module"]


def generate_source(form: SeparatedForm, title: str | None = None) -> str:
    """Python source of the module for a separated system.

    Parameters
    ----------
    form : SeparatedForm
        The system; every derivative term is ``u'`` alone.
    title : str, optional
        First line of the module's docstring.

    Returns
    -------
    str
        A module that fulfils :class:`rankone.system.System` and imports NumPy alone. The same
        form gives the same text, byte for byte.

    Raises
    ------
    SeparationError
        If a factor cannot be written with NumPy, or a derivative has a factor.
    """
    f = right_hand_side(form)
    lowered = lower(f, len(form.states))
    groups = group_terms(lowered.terms)
    pointwise = PointwiseWriter(form, f, lowered)
    functions = [
        pointwise.rhs(),
        pointwise.jacobian(),
        pointwise.with_products(),
        pointwise.quadratic_jacobian(),
    ]
    blocks = [
        constants(form, f, lowered, groups),
        *coordinate_functions(form),
        *kernel_functions(form, lowered, groups),
        *functions,
    ]
    head = header(form, lowered, groups, pointwise.operations, title)
    top = [*docstring(head, indent=""), "", "import numpy as np", "", *blocks[0]]
    return "\n\n\n".join("\n".join(block) for block in [top, *blocks[1:]] if block) + "\n"


def load_module(source: str, name: str) -> System:
    """Import generated source, without a file and without an entry in ``sys.modules``.

    Tracebacks show the generated lines.

    Parameters
    ----------
    source : str
        Text written by :func:`generate_source`.
    name : str
        Name of the module.
    """
    digest = hashlib.sha256(source.encode()).hexdigest()[:8]
    filename = f"<rankone {name} {digest}>"
    module = types.ModuleType(name)
    module.__file__ = filename
    exec(compile(source, filename, "exec"), module.__dict__)
    linecache.cache[filename] = (len(source), None, source.splitlines(keepends=True), filename)
    return cast(System, module)


def constants(
    form: SeparatedForm, f: Sequence[Term], lowered: LoweredSystem, groups: tuple[Group, ...]
) -> list[str]:
    """The tables that describe the system."""
    time, *parameters = form.coordinates
    initial = nested(
        (float(term.coefficient), term.equation, term.factors[1:]) for term in form.initial
    )
    terms = nested(
        (float(term.coefficient), term.equation, term.factors, term.monomial) for term in f
    )
    return [
        *table("STATES", [quoted(name) for name in state_names(form, lowered)]),
        f"N_DIFFERENTIAL = {lowered.n_differential}",
        *table("PRODUCTS", nested(lowered.products)),
        *table("PARAMETERS", [quoted(parameter.name) for parameter in parameters]),
        f"TIME = {literal((float(time.lower), float(time.upper)))}",
        *table("BOX", nested((float(c.lower), float(c.upper)) for c in parameters)),
        *table("TERMS", terms),
        *table("SIGNATURES", nested(group.signature for group in groups)),
        *table("INITIAL", initial),
    ]


def coordinate_functions(form: SeparatedForm) -> list[list[str]]:
    """``time_factors``, one function for each parameter, and ``parameter_factors``."""
    names = Names(["np", "out"])
    parameters = form.coordinates[1:]
    blocks = [factor_function("time_factors", "t", form, 0)]
    functions = []
    for j, parameter in enumerate(parameters, start=1):
        argument = names(parameter.name)
        functions.append(f"factors_of_{argument}")
        blocks.append(factor_function(functions[-1], argument, form, j))
    blocks.append(
        [
            *table("PARAMETER_FACTORS", functions),
            "",
            "",
            "def parameter_factors(dimension, p):",
            *docstring(["Factors of one parameter at the points p (N,): shape (number, N)."]),
            "    return PARAMETER_FACTORS[dimension](p)",
        ]
    )
    return blocks


def factor_function(name: str, argument: str, form: SeparatedForm, dimension: int) -> list[str]:
    """A function that evaluates all factors of one coordinate."""
    expressions = [factor.expression for factor in form.factors[dimension]]
    names = Names(["np", "out", argument])
    written = {form.coordinates[dimension].symbol: argument}
    shared, texts = common_subexpressions(expressions, written, names.numbered("c"))
    readable = ", ".join(plain_text(expression) for expression in expressions)
    summary = f"Factors of {form.coordinates[dimension].name}: {readable}."
    if len(summary) > 90:
        summary = f"Factors of {form.coordinates[dimension].name} ({len(expressions)})."
    lines = [f"def {name}({argument}):", *docstring([summary])]
    for target, text in shared:
        lines += assignment(target, [text])
    lines.append(f"    out = np.empty(({len(expressions)}, {argument}.size))")
    for row, text in enumerate(texts):
        lines += assignment(f"out[{row}]", ["1.0" if text == "1" else text])
    return [*lines, "    return out"]


def kernel_functions(
    form: SeparatedForm, lowered: LoweredSystem, groups: tuple[Group, ...]
) -> list[list[str]]:
    """What the kernels share, the kernels of every group, then the tables that list them."""
    states = state_names(form, lowered)
    time_factors = [plain_text(factor.expression) for factor in form.factors[0]]
    writers = [
        KernelWriter(group, signature_text(form, group.signature), states, time_factors)
        for group in groups
    ]
    blocks = [helpers(writers)]
    listed: dict[str, list[str]] = {kernel: [] for kernel in KERNELS}
    for group, writer in zip(groups, writers, strict=True):
        functions = writer.functions()
        blocks += [writer.tables(), *functions.values()]
        for kernel, entries in listed.items():
            entries.append(f"{kernel}_{group.index}" if kernel in functions else "None")
    listing = [line for kernel in KERNELS for line in table(kernel.upper(), listed[kernel])]
    paired = table("PAIRED", nested(group.paired for group in groups))
    return [*blocks, [*listing, *paired]]
