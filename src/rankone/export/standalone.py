"""The standalone solver: one file that needs only NumPy and SciPy.

A file is made of the generated module of the problem, the engine and what it needs, carried over
from the library (:mod:`rankone.export.carry`), and a short end that ties them together.
"""

from __future__ import annotations

import ast
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

from rankone.codegen.names import is_identifier
from rankone.codegen.text import WIDTH, docstring, literal, quoted
from rankone.errors import OptionError
from rankone.export.carry import banner, carry, import_lines
from rankone.export.modules import Import
from rankone.metadata import SolutionMetadata

if TYPE_CHECKING:
    from rankone.ir import SeparatedForm

__all__ = ["ENGINES", "Compiled", "Engine", "standalone_source"]


class Compiled(Protocol):
    """What the exporter needs of a compiled problem."""

    @property
    def source(self) -> str:
        """Text of the generated module."""

    @property
    def separated(self) -> object:
        """The separated form, shown in the header."""

    def metadata(self, rtol: float, method: str) -> SolutionMetadata:
        """What a solution says was asked."""


@dataclass(frozen=True)
class Engine:
    """Where an engine is found.

    Attributes
    ----------
    module : str
        Package of the engine.
    solve : str
        Its function ``(system, rtol, options, check) -> Outcome``.
    options : str
        The class of its options.
    unused : tuple of str
        Methods that only the library calls.
    form : bool
        Whether ``solve`` takes the separated form after the system.
    """

    module: str
    solve: str
    options: str
    unused: tuple[str, ...] = ()
    form: bool = False


ENGINES = {
    "train": Engine(
        "rankone.solvers.train",
        "solve_train",
        "TrainOptions",
        ("rankone.tensors.slab:SlabTrain.ranks",),
    ),
    "greedy": Engine(
        "rankone.solvers.greedy",
        "solve_greedy",
        "GreedyOptions",
        form=True,
    ),
}
"""The engines that can be exported, by the name of the method."""

_SYSTEM_TITLE = "The system: tables, factors and kernels, generated from the equations"
_END_TITLE = "This solver: what was asked, solve, and the command line"
_FEATURES = "rankone.solvers.features:system_features"
_PROGRAM = "rankone.export.program"
_TABLES = ("CONSTANT", "LINEAR", "LINEAR_ADJOINT", "QUADRATIC", "QUADRATIC_ADJOINT")
_TITLES = {
    "rankone.errors": "Errors: what was given, what was expected, what to do",
    "rankone.compiled": "Checks of what was asked, and delivery of what came out",
    "rankone.solution": "What was asked, in plain data",
    "rankone.storage": "Solutions as named arrays, in the open format of rankone",
    _PROGRAM: "Solution, files and command line",
}
"""Titles of sections that hold only a part of their module."""
_OWN_NAMES = (
    *("System", "SYSTEM", "SeparatedForm", "FORM", "METADATA", "solve"),
    *("_contract", "_expand"),
)


def standalone_source(compiled: Compiled, method: str = "train") -> str:
    """Text of the standalone solver of a problem.

    Parameters
    ----------
    compiled : Compiled
    method : {"train", "greedy"}
        The engine.

    Returns
    -------
    str
        A module, formatted; the same problem gives the same text, byte for byte.

    Raises
    ------
    OptionError
        If there is no such engine.
    ExportError
        If a part of the library cannot be carried over.
    """
    engine = ENGINES.get(method)
    if engine is None:
        raise OptionError(
            f"method={method!r} cannot be exported", remedy=f"choose from {', '.join(ENGINES)}"
        )
    metadata = compiled._metadata(1e-6, method)
    system = _SystemText(compiled.source)
    sections, imports = carry(
        [
            f"{engine.module}:{engine.solve}",
            f"{engine.module}:{engine.options}",
            *(["rankone.ir:Term"] if engine.form else []),
            *(f"{_PROGRAM}:{name}" for name in ("run", "solve_system", "load_solution")),
            *(f"{_PROGRAM}:Solution.{name}" for name in ("grid", "error")),
        ],
        reserved={*system.names, *_OWN_NAMES, "np", "os", "sys"},
        replaced={
            "rankone.system:System": "",
            "rankone.ir:SeparatedForm": "",
            "rankone.solution:Solution": f"{_PROGRAM}:Solution",
            **({_FEATURES: f"{_PROGRAM}:system_features"} if _only_polynomials(compiled) else {}),
        },
        dropped=engine.unused,
        titles=_TITLES,
    )
    imports |= {Import("types", "SimpleNamespace", "SimpleNamespace")}
    imports |= {Import("sys", None, "sys")}
    imports |= {Import("numpy", None, "np")}
    parts = [
        _head(compiled, method, imports) + f"\n\n{banner(_SYSTEM_TITLE)}\n\n{system.text}",
        _system_object(system),
        *(str(section) for section in sections),
        f"{banner(_END_TITLE)}\n{_end(engine, metadata, compiled.separated)}",
    ]
    return "\n\n\n".join(parts) + "\n"


class _SystemText:
    """The generated module without its docstring, its imports and the tables of kernels."""

    def __init__(self, source: str) -> None:
        tree = ast.parse(source)
        lines = source.splitlines()
        self.docstring = (ast.get_docstring(tree) or "").splitlines()
        self.tables: dict[str, list[str]] = {}
        self.names: set[str] = set()
        first = 0
        dropped: set[int] = set()
        for node in tree.body:
            span = range(node.lineno - 1, node.end_lineno or 0)
            if isinstance(node, ast.FunctionDef):
                self.names.add(node.name)
            elif isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name):
                name = node.targets[0].id
                if name in _TABLES and isinstance(node.value, ast.Tuple):
                    self.tables[name] = [ast.unparse(item) for item in node.value.elts]
                    dropped.update(span)
                else:
                    self.names.add(name)
            else:
                first = max(first, node.end_lineno or 0)
        kept = [line for k, line in enumerate(lines) if k >= first and k not in dropped]
        self.text = "\n".join(kept).strip("\n")


def _only_polynomials(compiled: Compiled) -> bool:
    """Whether every factor is a polynomial of its coordinate: there is nothing to step over."""
    form = compiled.separated
    return all(
        factor.expression.is_polynomial(coordinate.symbol)
        for coordinate, factors in zip(form.coordinates, form.factors, strict=True)
        for factor in factors
    )


def _head(compiled: Compiled, method: str, imports: set[Import]) -> str:
    """The docstring and the imports."""
    from rankone.version import __version__

    generated = _SystemText(compiled.source).docstring
    body = generated[3:]
    while body and not body[0]:
        body.pop(0)
    unknowns = ", ".join(compiled._metadata(1e-6, method).unknowns)
    separated = [line.rstrip() for line in str(compiled.separated).splitlines()]
    middle = {c.name: f"{0.5 * (c.lower + c.upper):g}" for c in compiled.separated.coordinates}
    at = " ".join(f"{name}={value}" for name, value in middle.items())
    if all(map(is_identifier, middle)):
        example = at.replace(" ", ", ")
    else:
        pairs = (f"{quoted(name)}: {value}" for name, value in middle.items())
        example = f"{{{', '.join(pairs)}}}"
    lines = [
        f"{compiled.problem.name or unknowns}: a solver for every parameter value at once.",
        "",
        *textwrap.wrap(
            f'Generated by rankone {__version__} (method="{method}"). Needs Python 3.11 or newer, '
            "NumPy and SciPy.",
            WIDTH,
        ),
        "",
        *body,
        "",
        *(line if len(line) <= WIDTH else line[: WIDTH - 4] + " ..." for line in separated),
        "",
        "As a module, in a file solver.py:",
        "",
        "    import solver",
        "    solution = solver.solve(rtol=1e-6)",
        *textwrap.wrap(f"    solution({example})", WIDTH, subsequent_indent=" " * 13),
        "",
        "As a program (--help shows all options):",
        "",
        *textwrap.wrap(
            f"    python solver.py --rtol 1e-6 --at {at} --json", WIDTH, subsequent_indent=" " * 8
        ),
        "    python solver.py --grid 20 --save values.npz",
    ]
    return "\n".join(
        [
            *docstring(lines, indent=""),
            "",
            "from __future__ import annotations",
            "",
            "import os",
            "",
            'os.environ.setdefault("OMP_NUM_THREADS", "1")  # more only slow small products down',
            "",
            *import_lines(imports - {Import("os", None, "os")}),
        ]
    )


def _system_object(system: _SystemText) -> str:
    """The generated names as one object, and what the solutions carry along."""
    lines = [
        "System = SimpleNamespace  # the names above as one object, so that they can be replaced",
        "SYSTEM = System(",
        "    **globals(),",
    ]
    for name in _TABLES:
        lines += _entry(name, system.tables[name])
    return "\n".join([*lines, ")"])


def _entry(name: str, items: Sequence[str]) -> list[str]:
    """A tuple as a keyword argument, one line for each item if it is too long for one."""
    line = f"    {name}=({', '.join(items)}{',' if len(items) == 1 else ''}),"
    if len(line) <= WIDTH:
        return [line]
    lines = (f"        {item}," for item in items)
    return [
        f"    {name}=(",
        *(line if len(line) <= WIDTH else f"{line}  # noqa: E501" for line in lines),
        "    ),",
    ]


def _end(engine: Engine, metadata: SolutionMetadata, form: SeparatedForm) -> str:
    """What ties the parts together: the metadata, ``solve`` and the command line."""
    values = {name: getattr(metadata, name) for name in _METADATA}
    table = [line for name, value in values.items() for line in _literal(name, value)]
    text = _END.format(
        metadata="\n".join(table),
        call=f"{engine.solve}_form" if engine.form else engine.solve,
        options=engine.options,
    )
    if not engine.form:
        return f"\n{text.strip()}"
    return f"{_form(engine, form)}\n\n\n{text.strip()}"


def _form(engine: Engine, form: SeparatedForm) -> str:
    """The separated terms as data, for an engine that takes them one by one."""
    terms = (
        (term.equation, float(term.coefficient), term.factors, term.monomial, term.derivative)
        for term in form.terms
    )
    return _FORM.format(
        terms="\n".join(f"        Term({', '.join(map(literal, term))})," for term in terms),
        solve=engine.solve,
        options=engine.options,
    ).strip()


_METADATA = (
    *("unknowns", "states", "parameters", "box", "time", "horizon", "rtol", "method"),
    *("equations", "version"),
)

_FORM = '''
class SeparatedForm(SimpleNamespace):
    """The terms of the residual u\' - f: equation, coefficient, factors, states, derivative."""


FORM = SeparatedForm(
    terms=(
{terms}
    )
)


def {solve}_form(system: System, rtol: float, options: {options}, check: int) -> Outcome:
    """Solve the system, whose terms are those of FORM."""
    return {solve}(system, FORM, rtol, options, check)
'''

_END = '''
METADATA = SolutionMetadata(
{metadata}
)


def solve(
    rtol: float = 1e-6,
    *,
    parameters: Mapping[str, Sequence[float]] | None = None,
    t_final: float | None = None,
    check: bool | int = True,
    **options: Any,
) -> Solution:
    """Solve for every parameter value at once.

    Parameters
    ----------
    rtol : float
        Largest error asked for, relative to the size of each unknown. It is measured against
        SciPy trajectories after the solve; `success` of the solution says whether it is kept.
    parameters : mapping of str to (float, float), optional
        Other ranges of parameters.
    t_final : float, optional
        Another end of the horizon.
    check : bool or int
        Number of random check points, 24 for True; without any the error is not known.
    **options
        See `{options}`.
    """
    engine_options = {options}.of(**options)
    return solve_system(
        SYSTEM, METADATA, {call}, engine_options, rtol, parameters, t_final, check
    )


def load(path: str) -> Solution:
    """Read a solution of this problem that was saved by this file or by rankone."""
    return load_solution(path, METADATA)


if __name__ == "__main__":
    sys.exit(run(solve, load, __doc__))
'''


def _literal(name: str, value: object) -> list[str]:
    """A keyword argument with a text, a number or a tuple of them."""
    if isinstance(value, tuple):
        return _entry(name, [_text(item) for item in value])
    return [f"    {name}={_text(value)},"]


def _text(value: object) -> str:
    return quoted(value) if isinstance(value, str) else literal(value)
