"""Export: what was compiled or solved, as files that need neither rankone nor SymPy.

==================  ===================================================================
module              subject
==================  ===================================================================
``modules``         modules of the library as text, and what their names stand for
``carry``           definitions and all they need, carried over into one file
``program``         solving, evaluation and command line of the standalone solver
``standalone``      the standalone solver in Python
``packing``         a solution as plain tables
``model_program``   evaluation of the solved model in Python
``model_python``    the solved model in Python
``model_c``         the solved model in C99
``files``           writing: all files or none
==================  ===================================================================
"""

from __future__ import annotations

from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING

from rankone.export.files import target, write_all

if TYPE_CHECKING:
    from rankone.compiled import CompiledProblem
    from rankone.solution import Solution

__all__ = ["export_model", "export_solver"]


def export_solver(
    compiled: CompiledProblem,
    path: str | PathLike[str],
    *,
    method: str = "train",
    overwrite: bool = False,
) -> Path:
    """Write a standalone solver: one Python file that needs only NumPy and SciPy.

    Parameters
    ----------
    compiled : CompiledProblem
    path : path-like
        Ends in ``.py``.
    method : {"train", "greedy"}
        The engine.
    overwrite : bool
        Whether to replace an existing file.

    Returns
    -------
    Path

    Raises
    ------
    ExportError
        If the path has another suffix, exists or cannot be written.
    OptionError
        If there is no such method.
    """
    from rankone.export.standalone import standalone_source

    given = target(path, {".py": "standalone solver"})
    write_all({given: standalone_source(compiled, method)}, overwrite=overwrite)
    return given


def export_model(
    solution: Solution,
    path: str | PathLike[str],
    *,
    overwrite: bool = False,
    allow_failed: bool = False,
) -> Path:
    """Write a solved model, for evaluation only.

    Parameters
    ----------
    solution : Solution
    path : path-like
        ``.py`` writes a Python module that needs only NumPy, with an ``.npz`` beside it if there
        are many coefficients; ``.c`` writes C99 source and its header ``.h``.
    overwrite : bool
        Whether to replace existing files.
    allow_failed : bool
        Whether a solution may be exported that is not a success.

    Returns
    -------
    Path

    Raises
    ------
    ExportError
        If the solution is not a success, or the path has another suffix, exists or cannot be
        written.
    """
    from rankone.export.model_c import c_model
    from rankone.export.model_python import python_model
    from rankone.export.packing import pack

    given = target(path, {".py": "model in Python", ".c": "model in C99"})
    model = pack(solution, allow_failed=allow_failed)
    files = (python_model if given.suffix == ".py" else c_model)(model, given)
    write_all(files, overwrite=overwrite)
    return given
