"""The standalone solver: one file that needs only NumPy and SciPy.

A file is made of the generated module of the problem, the engine and what it needs, carried over
from the library (:mod:`rankone.export.carry`), and a short end that ties them together. It reads
from top to bottom: equations, system, engine, evaluation, files, command line.
"""

from __future__ import annotations

import ast
import dataclasses
import itertools
import textwrap
from collections.abc import Iterable
from typing import Any

from rankone.codegen.names import is_identifier
from rankone.codegen.text import INDENT, WIDTH, docstring, literal, quoted, tuple_lines
from rankone.export.carry import Section, banner, carry, import_lines
from rankone.export.modules import Import, bound_names, imported
from rankone.export.templates import TERMS
from rankone.ir.metadata import SolutionMetadata
from rankone.ir.system import GeneratedNames
from rankone.solvers.engine import Engine
from rankone.solvers.registry import engines_for
from rankone.support.version import __version__

__all__ = ["standalone_source"]


_PROGRAM = "rankone.export.program"
_PARTS: dict[str, tuple[str, ...]] = {
    "Foundations": (
        *(f"support.{name}" for name in ("arrays", "errors", "wording", "options", "progress")),
        *("ir.domain", "ir.features", "ir.jumps", "ir.system"),
        *(f"discretization.{name}" for name in ("basis", "finite_elements", "radau")),
    ),
    "Engine": (),
    "Evaluation": (
        *("tensors.evaluator", "discretization.coordinates", "ir.metadata", "solution.core"),
    ),
    "Files": ("support.files", "support.plain_data", "storage.header", "storage.npz"),
    "Command line": ("export.program",),
}
"""Modules in each part of the file; the engine has all that are in no other."""
_TITLES = {
    "rankone.support.errors": "Errors: what was given, what was expected, what to do",
    "rankone.support.progress": "Progress",
    "rankone.ir.domain": "Domain: horizon, box and known factors on it",
    "rankone.solution.core": "Solutions: evaluation, how good they are, saving",
    _PROGRAM: "Solve, load and the command line",
}
"""Titles of sections whose module says more than the part of it that is carried over."""
_OWN_NAMES = ("SYSTEM", "METADATA", "Solution", "solve", "load", "np", "os", "sys")


def standalone_source(
    title: str | None, separated: object, source: str, metadata: SolutionMetadata
) -> str:
    """Text of the standalone solver of a problem: the same text, byte for byte, each time.

    The header shows the separated form; ``source`` is the text of the generated module, and the
    engine is that of the metadata. If there is no such engine that is an OptionError, if a part of
    the library cannot be carried over an ExportError.
    """
    engine, *_ = engines_for(metadata.method)
    module = _GeneratedModule(source)
    sections, imports = carry(
        [
            f"rankone.solvers.{engine.name}:ENGINE",
            "rankone.ir.system:system_of",
            *(f"{_PROGRAM}:{name}" for name in ("run", "solve_system", "load_solution")),
        ],
        reserved={*module.names, *_OWN_NAMES, *(found.alias for found in module.imports)},
        renamed={"SolutionCore": "Solution"},
        order=_part,
        titles=_TITLES,
    )
    imports |= module.imports | {Import("sys", None, "sys")}
    blocks = [
        _head(title, separated, metadata, module, imports)
        + f"\n\n{_heading('System')}\n\n{module.text}",
        *_engine_to_command_line(sections),
        _system_object(module),
        _end(engine, metadata),
    ]
    return "\n\n\n".join(blocks) + "\n"


class _GeneratedModule:
    """The generated module without its docstring and its imports."""

    def __init__(self, source: str) -> None:
        tree = ast.parse(source)
        self.imports = {found for node in tree.body for found in imported(node)}
        self.docstring = (ast.get_docstring(tree) or "").splitlines()
        body = [
            node
            for node in tree.body
            if not isinstance(node, ast.Expr | ast.Import | ast.ImportFrom)
        ]
        self.names = {name for node in body for name in bound_names(node)}
        self.text = "\n".join(source.splitlines()[body[0].lineno - 1 :]).strip()


def _part(module: str) -> int:
    """Position of the part of the file that a module of the library belongs to."""
    own = module.removeprefix("rankone.")
    return next(
        (k for k, modules in enumerate(_PARTS.values()) if own in modules),
        list(_PARTS).index("Engine"),
    )


def _engine_to_command_line(sections: Iterable[Section]) -> Iterable[str]:
    """The sections, with a heading before the first of each part."""
    titles = list(_PARTS)
    for part, found in itertools.groupby(sections, lambda section: _part(section.module)):
        yield "\n\n\n".join([_heading(titles[part]), *map(str, found)])


def _heading(title: str) -> str:
    """A comment that opens a part of the file."""
    line = f"# {'=' * (WIDTH - 3)}"
    return f"{line}\n# {title}\n{line}"


def _head(
    title: str | None,
    separated: object,
    metadata: SolutionMetadata,
    module: _GeneratedModule,
    imports: set[Import],
) -> str:
    """The docstring and the imports."""
    table = (line.rstrip() for line in str(separated).splitlines())
    lines = [
        f"{title or ', '.join(metadata.unknowns)}: a solver for every parameter value at once.",
        "",
        *textwrap.wrap(
            f'Generated by rankone {__version__} (method="{metadata.method}"). Needs Python 3.11 '
            "or newer, NumPy and SciPy.",
            WIDTH,
        ),
        TERMS,
        *module.docstring[3:],
        "",
        *(line if len(line) <= WIDTH else line[: WIDTH - 4] + " ..." for line in table),
        "",
        *_usage(metadata),
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


def _usage(metadata: SolutionMetadata) -> list[str]:
    """How the file is used, with values in the middle of the box."""
    names = (metadata.time, *metadata.parameters)
    intervals = (metadata.horizon, *metadata.box)
    middle = [f"{0.5 * (lower + upper):g}" for lower, upper in intervals]
    at = " ".join(f"{name}={value}" for name, value in zip(names, middle, strict=True))
    example = at.replace(" ", ", ")
    if not all(map(is_identifier, names)):
        pairs = zip(map(quoted, names), middle, strict=True)
        example = f"{{{', '.join(f'{name}: {value}' for name, value in pairs)}}}"
    return [
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


def _system_object(module: _GeneratedModule) -> str:
    """The system that engines take, made of the names that the generated module defines."""
    defined = (name for name in GeneratedNames.__annotations__ if name in module.names)
    entries = (f"{INDENT * 2}{quoted(name)}: {name}," for name in defined)
    return "\n".join(["SYSTEM = system_of(", f"{INDENT}{{", *entries, f"{INDENT}}}", ")"])


def _end(engine: Engine, metadata: SolutionMetadata) -> str:
    """What ties the parts together: the metadata, ``solve`` and ``load``."""
    fields = (f.name for f in dataclasses.fields(metadata) if _is_said(metadata, f))
    entries = [
        line
        for name in fields
        for line in tuple_lines(f"{name}=", _text(getattr(metadata, name)), ",", INDENT)
    ]
    text = _END.format(metadata="\n".join(entries), options=engine.options.__name__)
    return f"{banner('This solver: what was asked, solve and load')}\n\n{text.strip()}"


def _is_said(metadata: SolutionMetadata, field: dataclasses.Field[Any]) -> bool:
    """Whether a field is written: the source is not, nor is what is empty by default."""
    value = getattr(metadata, field.name)
    return field.name != "source" and (bool(value) or value != field.default)


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
    cover: str | None = None,
    effort: str | float = "normal",
    max_seconds: float | None = None,
    unknowns: Sequence[str] | None = None,
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
        Number of check points in the interior, 96 for True; without any the error is not known.
    cover : {{"interior", "box"}}, optional
        Whether success covers the corners of the box too; by default up to three parameters.
    effort : {{"low", "normal", "high"}} or float
        Budget of counted work, 0.2, 1 or 10 times what a core does in about 25 seconds, or another
        factor; the best solution so far is returned.
    max_seconds : float, optional
        Time limit on the clock besides.
    unknowns : sequence of str, optional
        The unknowns whose error has to be within the tolerance; by default all.
    **options
        See `{options}`.

    Raises
    ------
    BlowUpError
        A trajectory blows up inside the horizon. `.solution` holds the part up to there.
    OptionError
        An option is out of its range, or a coefficient is not finite on the other ranges.
    """
    request = SolveRequest.of(
        SYSTEM,
        [ENGINE.options],
        options,
        rtol=rtol,
        parameters=parameters,
        t_final=t_final,
        check=check,
        cover=cover,
        effort=effort,
        max_seconds=max_seconds,
        unknowns=unknowns,
    )
    return solve_system(ENGINE, SYSTEM, METADATA, request)


def load(path: str) -> Solution:
    """Read a solution of this problem that was saved by this file or by rankone."""
    return load_solution(path, METADATA, {{ENGINE.name: ENGINE.record}})


if __name__ == "__main__":
    sys.exit(run(solve, load, __doc__))
'''


def _text(value: object) -> str | list[str]:
    """A value as Python text; a tuple item by item."""
    if isinstance(value, tuple):
        return [_wrapped(item) if isinstance(item, str) else literal(item) for item in value]
    return quoted(value) if isinstance(value, str) else literal(value)


def _wrapped(text: str) -> str:
    """A string literal; a long one in several lines, cut at spaces."""
    pieces: list[str] = []
    for word in text.split(" "):
        longer = f"{pieces[-1]} {word}" if pieces else word
        if pieces and len(quoted(longer)) > WIDTH - 12:
            pieces.append(f" {word}")
        else:
            pieces[-1:] = [longer]
    return "\n        ".join(map(quoted, pieces))
