"""Export: what was compiled or solved, as files that need neither rankone nor SymPy.

==================  ===================================================================
module              subject
==================  ===================================================================
``modules``         modules of the library as text, and what their names stand for
``carry``           definitions and all they need, carried over into one file
``program``         solving, evaluation and command line of the standalone solver
``standalone``      the standalone solver in Python
``packing``         a solution as plain tables
``rounding``        smaller trains for models that may differ from the solution
``model_program``   evaluation of the solved model in Python
``model_python``    the solved model in Python
``model_c``         the solved model in C99
``model_js``        the solved model in JavaScript
``explorer``        the page with sliders and curves
``model_fmu``       the solved model as an FMU: the one in C99 behind the functions of FMI
``fmu_description`` what an FMU says about itself, as XML
``fmu_binary``      the shared library of an FMU
``templates``       templates of the models in C99 and JavaScript
==================  ===================================================================
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from functools import partial
from os import PathLike
from pathlib import Path
from typing import Any

from rankone.errors import ExportError
from rankone.export.fmu_description import FMI
from rankone.export.packing import PackedModel, States, check_states, checked_rtol, pack
from rankone.export.standalone import standalone_source
from rankone.files import Content, as_path, free_target, write_files
from rankone.solution_core import SolutionCore
from rankone.solvers.registry import AUTO, engines_for
from rankone.wording import quote

__all__ = [
    "MODELS",
    "check_options",
    "export_model",
    "export_solver",
    "model_target",
    "solver_target",
]

MODELS = {
    ".py": "model in Python",
    ".c": "model in C99",
    ".js": "model in JavaScript",
    ".mjs": "the same, a module by its name",
    ".html": "page with sliders and curves",
    ".fmu": "FMU for co-simulation",
}
"""Suffixes of what a solution is written to."""


_MODULES = {*sys.stdlib_module_names, "numpy", "rankone", "scipy", "sympy"}


def export_solver(
    compiled: Any,
    path: str | PathLike[str],
    *,
    method: str = "auto",
    overwrite: bool = False,
) -> Path:
    """Write a standalone solver: one Python file that needs only NumPy and SciPy.

    Parameters
    ----------
    compiled : CompiledProblem
        Or anything with its ``problem``, ``separated`` form, ``methods``, ``form_for`` a method,
        ``user_functions`` and ``metadata``.
    path : path-like
        Ends in ``.py``.
    method : {"auto", "train", "cross", "greedy"}
        The engine; ``"auto"`` takes the one that ``solve`` tries first.
    overwrite : bool
        Whether to replace an existing file.

    Raises
    ------
    ExportError
        If the path has another suffix, exists or cannot be written, the method does not apply
        to the problem, or the problem has functions of the user.
    OptionError
        If there is no such method.
    """
    target = solver_target(path, overwrite)
    form = compiled.separated
    engine, *_ = engines_for(
        method, (), len(form.coordinates) - 1, separated=not form.general or method != AUTO
    )
    _check_exportable(compiled, engine.name)
    taken = compiled.form_for(engine.name)
    given = taken.separated, taken.source, compiled.metadata(method=engine.name)
    text = standalone_source(compiled.problem.name, *given)
    write_files({target: text}, overwrite, ExportError)
    return target


def _check_exportable(compiled: Any, method: str) -> None:
    """Raise an ExportError unless a solver by that method can be written."""
    reason = compiled.methods[method]
    if reason is not None:
        raise ExportError(
            f"a solver by method={method!r} cannot be exported: {reason}",
            remedy="export with method='cross'",
        )
    if compiled.user_functions:
        named = min(compiled.user_functions).removeprefix("f_")
        raise ExportError(
            f"the function {quote(named)} is a Python callable, which cannot be written to a file",
            term=named,
            remedy="give it as a formula or a table (rankone.table)",
        )


def solver_target(path: str | PathLike[str], overwrite: bool = False) -> Path:
    """The path of a file that a standalone solver can be written to, or an ExportError."""
    return free_target(_named(path, {".py": "standalone solver"}), overwrite, ExportError)


def model_target(path: str | PathLike[str], overwrite: bool = False) -> Path:
    """The path of a file that a solved model can be written to, or an ExportError."""
    return free_target(_named(path, MODELS), overwrite, ExportError)


def export_model(
    solution: SolutionCore,
    path: str | PathLike[str],
    *,
    states: States = "unknowns",
    rtol: float | None = None,
    overwrite: bool = False,
    allow_failed: bool = False,
    fmi: FMI | None = None,
) -> Path:
    """Write a solved model, for evaluation only.

    Parameters
    ----------
    path : path-like
        ``.py`` writes a Python module that needs only NumPy, with an ``.npz`` beside it if there
        are many coefficients; ``.c`` writes C99 source and its header ``.h``; ``.js`` or
        ``.mjs`` writes an ES module for Node and browsers and its TypeScript declarations;
        ``.html`` writes a page, see :func:`rankone.export.explorer.export_page`;
        ``.fmu`` writes an FMU for co-simulation, with a binary if there is a C compiler.
    states : {"unknowns", "all"}
        Whether the model evaluates the unknowns alone or derivatives that are states as well,
        as a page always does.
    rtol : float, optional
        By how much the model may differ from the solution, relative to the size of each unknown,
        to be smaller and faster; 1e-12 to 0.1. The difference is measured at 4200 random points
        and said in the model. Without it the model is the solution.
    overwrite : bool
        Whether to replace existing files.
    allow_failed : bool
        Whether a solution may be exported that is not a success.
    fmi : {"2.0", "3.0"}, optional
        Version of FMI for an FMU, by default 2.0.

    Raises
    ------
    ExportError
        If the solution is not a success, or the path has another suffix, exists or cannot be
        written; for a page also if nothing depends on time.
    OptionError
        If there is no such choice of states or no such version of FMI, or ``rtol`` is out of its
        range.

    Warns
    -----
    RankoneWarning
        If an FMU has no binary, because nothing could be compiled.
    """
    from rankone.export.explorer import export_page
    from rankone.export.model_c import c_model
    from rankone.export.model_fmu import checked_fmi, fmu_model
    from rankone.export.model_js import javascript_model
    from rankone.export.model_python import python_model

    target = _named(path, MODELS)
    version = checked_fmi(fmi, target.suffix)
    writers: dict[str, Callable[[PackedModel, Path], dict[Path, Content]]] = {
        ".py": python_model,
        ".c": c_model,
        ".js": javascript_model,
        ".mjs": javascript_model,
        ".fmu": partial(fmu_model, fmi=version, timeless=solution.metadata.timeless),
    }
    if target.suffix == ".html":
        check_states(states)
        return export_page(
            solution, target, rtol=rtol, overwrite=overwrite, allow_failed=allow_failed
        )
    if target.suffix == ".fmu":
        free_target(target, overwrite, ExportError)  # before it is compiled
    model = pack(solution, states=states, rtol=rtol, allow_failed=allow_failed)
    files = writers[target.suffix](model, target)
    write_files(files, overwrite, ExportError)
    return target


def check_options(target: Path, *, rtol: float | None = None, fmi: FMI | None = None) -> None:
    """Raise an OptionError if a model cannot be written so."""
    from rankone.export.model_fmu import checked_fmi

    checked_rtol(rtol)
    checked_fmi(fmi, target.suffix)


def _named(path: str | PathLike[str], kinds: Mapping[str, str]) -> Path:
    """The path, if its suffix names something that can be exported, or an ExportError."""
    given = as_path(path, ExportError)
    if given.suffix not in kinds:
        choices = ", ".join(f"{suffix} ({what})" for suffix, what in kinds.items())
        raise ExportError(
            f"`{given}`: the suffix {given.suffix!r} names no target of this export",
            term=given,
            remedy=f"choose one of {choices}",
        )
    if given.suffix == ".py" and given.stem in _MODULES:
        raise ExportError(
            f"`{given}` would hide the module `{given.stem}` from Python programs beside it",
            term=given,
            remedy=f"choose another name, such as my_{given.name}",
        )
    return given
