"""Solvers and solved models as files that need neither rankone nor SymPy.

- ``explorer``: the page that explores a solution: one HTML file, its data and its sentences
- ``field_layout``: where the entries of fields are, as pages draw them
- ``field_model``: exported fields: the solved model of the coefficients, and beside it their modes
- ``field_page``: the page that explores fields: pictures of them beside the sliders
- ``mathml``: equations as people write them, typeset as MathML
- ``model_branches``: evaluation of the solved model where the order of events changes inside the
  box
- ``model_c``: the solved model in C99: one source file and its header, without any dependency
- ``model_fmu``: the solved model as an FMU for co-simulation, with the files that describe it
- ``model_js``: the solved model in JavaScript: one ES module without dependencies, and its
  declarations
- ``model_program``: evaluation of the solved model, which exported Python modules contain as text
- ``model_python``: the solved model in Python: evaluation and derivatives with NumPy alone
- ``model_stretches``: evaluation of the solved model with events: its slabs are over the
  stretches between them
- ``packing``: a solution as plain tables, which the solved models evaluate
- ``pages``: what all pages share: files and titles, scripts as one, numbers and sentences in HTML
- ``program``: solving, loading and the command line of every standalone solver
- ``rounding``: smaller slabs of a model that may differ from its solution, also in branches
- ``standalone``: the standalone solver, and templates of exported files in other languages
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from functools import partial
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rankone.share.export.model_fmu import FMI
from rankone.share.export.packing import PackedModel, States, check_states, checked_rtol, pack
from rankone.share.export.standalone import standalone_source
from rankone.solvers.selection import AUTO, engines_for
from rankone.support.errors import ExportError, quote
from rankone.support.files import Content, as_path, free_target, write_files

if TYPE_CHECKING:
    from rankone.solution.statistics.densities import DistributionOverBox

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
# Modules that a file of the same name would hide
_MODULES = {*sys.stdlib_module_names, "numpy", "rankone", "scipy", "sympy"}


def export_solver(
    compiled: Any, path: str | PathLike[str], *, method: str = "auto", overwrite: bool = False
) -> Path:
    """What :meth:`rankone.CompiledProblem.export` does.

    ``compiled`` is a CompiledProblem, or anything with its ``problem``, ``separated`` form,
    ``methods``, ``form_for`` a method, ``user_functions`` and ``metadata``.
    """
    target = solver_target(path, overwrite)
    separated = compiled.separated
    engine, *_ = engines_for(
        method,
        (),
        len(separated.coordinates) - 1,
        separated=not separated.general or method != AUTO,
        states=len(separated.states),
    )
    reason = compiled.methods[engine.name]
    if reason is not None:
        raise ExportError(
            f"a solver by method={engine.name!r} cannot be exported: {reason}",
            remedy="export with method='cross'",
        )
    if compiled.user_functions:
        name = min(compiled.user_functions).removeprefix("f_")
        raise ExportError(
            f"the function {quote(name)} is a Python callable, which cannot be written to a file",
            term=name,
            remedy="give it as a formula or a table (rankone.table)",
        )
    form = compiled.form_for(engine.name)
    if form.system.separated_stretches is not None:
        raise ExportError(
            f"a solver by method={engine.name!r} cannot be exported: it would need SymPy to write "
            "the equations over stretches between events",
            remedy="export with method='cross'",
        )
    metadata = compiled.metadata(method=engine.name)
    held = compiled.held_source if form is compiled else None
    text = standalone_source(compiled.problem.name, form.source, metadata, held)
    write_files({target: text}, overwrite, ExportError)
    return target


def solver_target(path: str | PathLike[str], overwrite: bool = False) -> Path:
    """The path of a file that a standalone solver can be written to, or an ExportError."""
    return free_target(_named(path, {".py": "standalone solver"}), overwrite, ExportError)


def model_target(path: str | PathLike[str], overwrite: bool = False) -> Path:
    """The path of a file that a solved model can be written to, or an ExportError."""
    return free_target(_named(path, MODELS), overwrite, ExportError)


def export_model(
    solution: DistributionOverBox,
    path: str | PathLike[str],
    *,
    states: States = "unknowns",
    rtol: float | None = None,
    overwrite: bool = False,
    allow_failed: bool = False,
    fmi: FMI | None = None,
) -> Path:
    """What :meth:`rankone.Solution.export` does."""
    from rankone.share.export.explorer import export_page
    from rankone.share.export.model_c import c_model
    from rankone.share.export.model_fmu import checked_fmi, fmu_model
    from rankone.share.export.model_js import javascript_model
    from rankone.share.export.model_python import python_model

    target = _named(path, MODELS)
    version = checked_fmi(fmi, target.suffix)
    writers: dict[str, Callable[[PackedModel, Path], dict[Path, Content]]] = {
        ".py": python_model,
        ".c": c_model,
        ".js": javascript_model,
        ".mjs": javascript_model,
        ".fmu": partial(
            fmu_model,
            fmi=version,
            name=solution.metadata.name,
            timeless=solution.metadata.timeless,
        ),
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
    """Raise an OptionError if these options do not apply to a target."""
    from rankone.share.export.model_fmu import checked_fmi

    checked_rtol(rtol)
    checked_fmi(fmi, target.suffix)


def _named(path: str | PathLike[str], targets: Mapping[str, str]) -> Path:
    """The path, if its suffix names a target, or an ExportError."""
    named = as_path(path, ExportError)
    if named.suffix not in targets:
        choices = ", ".join(f"{suffix} ({target})" for suffix, target in targets.items())
        raise ExportError(
            f"`{named}`: the suffix {named.suffix!r} names no target of this export",
            term=named,
            remedy=f"choose one of {choices}",
        )
    if named.suffix == ".py" and named.stem in _MODULES:
        raise ExportError(
            f"`{named}` would hide the module `{named.stem}` from Python programs beside it",
            term=named,
            remedy=f"choose another name, such as my_{named.name}",
        )
    return named
