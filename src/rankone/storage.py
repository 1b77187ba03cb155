"""Saving and loading solutions in an open format: NumPy ``.npz`` with a JSON header, no pickle.

A file is a zip archive of ``.npy`` arrays, readable by ``numpy.load(path, allow_pickle=False)``
and by any program that reads zip and npy:

``header``
    A text array without dimensions that holds JSON:

    - ``format``: ``"rankone-solution"``; ``format_version``: 1;
    - ``metadata``: the fields of :class:`~rankone.solution.SolutionMetadata`;
    - ``status`` (name of a :class:`~rankone.solvers.outcome.Status`), ``message``, ``measured``
      (or null), ``history`` (one object for each slab tried), ``timings``, ``blow_up`` (time and
      list of parameter values, or null): as in :class:`~rankone.solvers.outcome.Outcome`;
    - ``bases``: the distinct bases, each with ``kind`` (``"chebyshev"`` or ``"legendre"``),
      ``lower``, ``upper``, ``degree`` and ``elements``;
    - ``slabs``: for each slab its ``start``, ``end`` and ``bases``, one index into ``bases`` for
      each parameter.

    Numbers have the fewest digits that give them back exactly; NaN and infinities are the texts
    ``"nan"``, ``"inf"`` and ``"-inf"``, since JSON has none.

``core_<slab>_<dimension>``
    The cores of each slab, float64: dimension 0 (states, time modes, rank) on the Legendre
    polynomials orthonormal on the slab, dimension j (rank, modes, rank) on the modes of the basis
    of parameter j: on each of its equal elements the polynomials orthonormal for the uniform
    (Legendre) or arcsine (Chebyshev) probability measure of the whole interval. See
    :class:`~rankone.tensors.slab.SlabTrain`.

Readers refuse versions newer than their own. The version grows when an old reader could
misunderstand a file.
"""

from __future__ import annotations

import json
import math
import os
import secrets
from collections.abc import Mapping
from dataclasses import asdict
from os import PathLike
from pathlib import Path
from typing import Any
from zipfile import BadZipFile, ZipFile, is_zipfile
from zlib import error as ZlibError

import numpy as np

from rankone.discretization import BASES, Basis1D
from rankone.errors import StorageError
from rankone.solution import Solution, SolutionMetadata
from rankone.solvers.outcome import Measured, Outcome, SlabRecord, Status
from rankone.tensors.slab import SlabTrain

__all__ = ["FORMAT", "FORMAT_VERSION", "load", "save"]

FORMAT = "rankone-solution"
FORMAT_VERSION = 1


def save(solution: Solution, path: str | PathLike[str], *, overwrite: bool = False) -> Path:
    """Write a solution to a file.

    The file is written beside its final place and moved there when it is complete, so that an
    interrupt or a full disk leaves no half-written file and an older file stays as it was.

    Parameters
    ----------
    solution : Solution
    path : path-like
        Used as given; the usual suffix is ``.npz``.
    overwrite : bool
        Whether to replace an existing file.

    Returns
    -------
    Path

    Raises
    ------
    StorageError
        If the file exists and is not to be replaced, or cannot be written.
    """
    return write_arrays(path, slab_arrays(solution), overwrite)


def free_target(path: str | PathLike[str], overwrite: bool) -> Path:
    """The path of a file that can be written and need not stay as it is, or a StorageError."""
    target = Path(path)
    try:
        exists, folder = target.exists(), target.is_dir() or not target.absolute().parent.is_dir()
    except (OSError, ValueError) as error:
        raise StorageError(f"`{target}` cannot be written: {error}", term=target) from error
    if folder:
        raise StorageError(f"`{target}` cannot be written: a directory, or in no directory")
    if exists and not overwrite:
        remedy = "choose another name, or overwrite=True (--overwrite on the command line)"
        raise StorageError(f"`{target}` exists", term=target, remedy=remedy)
    return target


def write_arrays(
    path: str | PathLike[str], arrays: Mapping[str, Any], overwrite: bool = False
) -> Path:
    """Write an .npz file, whatever the names; it is either complete or not there."""
    given = free_target(path, overwrite)
    target = Path(os.path.realpath(given))
    partial = target.with_name(f".{target.name}.{secrets.token_hex(4)}.partial")
    try:
        with partial.open("xb") as file:
            with ZipFile(file, "w") as archive:
                for name, array in arrays.items():
                    with archive.open(f"{name}.npy", "w", force_zip64=True) as entry:
                        np.lib.format.write_array(entry, np.asarray(array), allow_pickle=False)
            file.flush()
            os.fsync(file.fileno())
        partial.replace(target)
    except OSError as error:
        raise StorageError(f"`{given}` cannot be written: {error.strerror or error}") from error
    finally:
        partial.unlink(missing_ok=True)
    return given


def load(path: str | PathLike[str]) -> Solution:
    """Read a solution from a file written by :func:`save`.

    Nothing in the file is executed.

    Parameters
    ----------
    path : path-like

    Returns
    -------
    Solution
        Evaluates to exactly the same values as the one saved.

    Raises
    ------
    StorageError
        If there is no such file, it is not a rankone solution, it is damaged, or a newer version
        of rankone wrote it.
    """
    given = Path(path)
    try:
        with given.open("rb") as stream:
            if not is_zipfile(stream):
                raise _not_a_solution(given)
            stream.seek(0)
            with np.load(stream, allow_pickle=False) as arrays:
                header = _header(arrays, given)
                outcome = _outcome(header, arrays)
        return Solution(outcome, _metadata(header["metadata"], outcome))
    except StorageError:
        raise
    except FileNotFoundError:
        raise StorageError(f"there is no file `{given}`", term=given) from None
    except OSError as error:
        raise StorageError(f"`{given}` cannot be read: {error}", term=given) from error
    except (BadZipFile, EOFError, LookupError, TypeError, ValueError, ZlibError) as error:
        raise StorageError(
            f"`{given}` is damaged ({type(error).__name__}: {error})",
            term=given,
            remedy="restore it from a copy, or solve again",
        ) from error


def _not_a_solution(path: Path) -> StorageError:
    return StorageError(
        f"`{path}` is not a rankone solution",
        term=path,
        remedy="give a file written by `solution.save` or `rankone solve --save`",
    )


# --- writing -----------------------------------------------------------------------------------


def slab_arrays(solution: Solution) -> dict[str, Any]:
    """The arrays of a file by name."""
    outcome = solution.outcome
    bases: dict[Basis1D, int] = {}
    slabs = []
    for slab in outcome.slabs:
        used = [bases.setdefault(basis, len(bases)) for basis in slab.bases]
        slabs.append({"start": slab.start, "end": slab.end, "bases": used})
    header = {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "metadata": asdict(solution.metadata),
        "status": outcome.status.name,
        "message": outcome.message,
        "measured": None if outcome.measured is None else asdict(outcome.measured),
        "history": [asdict(record) for record in outcome.history],
        "timings": outcome.timings,
        "blow_up": outcome.blow_up,
        "bases": [{"kind": basis.kind, **asdict(basis)} for basis in bases],
        "slabs": slabs,
    }
    arrays = {"header": np.array(json.dumps(_plain(header), allow_nan=False))}
    for i, slab in enumerate(outcome.slabs):
        for j, core in enumerate(slab.cores):
            arrays[f"core_{i}_{j}"] = np.ascontiguousarray(core, dtype="<f8")
    return arrays


def _plain(value: Any) -> Any:
    """Turn NumPy numbers into Python numbers, and numbers that JSON lacks into text."""
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, np.generic):
        value = value.item()
    return str(value) if isinstance(value, float) and not math.isfinite(value) else value


# --- reading -----------------------------------------------------------------------------------


def _header(arrays: Mapping[str, Any], path: Path) -> dict[str, Any]:
    """The header, if it is one that this version understands."""
    if "header" not in arrays:
        raise _not_a_solution(path)
    header = json.loads(str(arrays["header"][()]))
    if not isinstance(header, dict) or header.get("format") != FORMAT:
        raise _not_a_solution(path)
    version = header["format_version"]
    if version > FORMAT_VERSION:
        raise StorageError(
            f"`{path}` has version {version} of the format; this rankone reads up to "
            f"version {FORMAT_VERSION}",
            term=path,
            remedy="upgrade rankone",
        )
    return header


def _metadata(fields: Mapping[str, Any], outcome: Outcome) -> SolutionMetadata:
    metadata = SolutionMetadata(
        unknowns=_names(fields["unknowns"]),
        states=_names(fields["states"]),
        parameters=_names(fields["parameters"]),
        box=tuple((float(lower), float(upper)) for lower, upper in fields["box"]),
        time=str(fields["time"]),
        horizon=(float(fields["horizon"][0]), float(fields["horizon"][1])),
        rtol=float(fields["rtol"]),
        method=str(fields["method"]),
        equations=_names(fields["equations"]),
        version=str(fields["version"]),
        source=None if fields["source"] is None else str(fields["source"]),
    )
    n, d = len(metadata.states), len(metadata.parameters)
    fits = metadata.states[: len(metadata.unknowns)] == metadata.unknowns
    fits = fits and len(metadata.box) == d
    if not fits or any(s.cores[0].shape[0] != n or len(s.bases) != d for s in outcome.slabs):
        raise ValueError("the names do not fit the cores")
    return metadata


def _outcome(header: Mapping[str, Any], arrays: Mapping[str, Any]) -> Outcome:
    bases = [
        BASES[fields["kind"]](
            float(fields["lower"]),
            float(fields["upper"]),
            int(fields["degree"]),
            int(fields["elements"]),
        )
        for fields in header["bases"]
    ]
    measured, blow_up = header["measured"], header["blow_up"]
    return Outcome(
        slabs=tuple(
            _slab(i, fields, tuple(bases[k] for k in fields["bases"]), arrays)
            for i, fields in enumerate(header["slabs"])
        ),
        status=Status[header["status"]],
        message=str(header["message"]),
        measured=None
        if measured is None
        else Measured(
            interior=_floats(measured["interior"]),
            corners=_floats(measured["corners"]),
            points=int(measured["points"]),
            method=str(measured["method"]),
        ),
        history=tuple(
            SlabRecord(
                attempt=int(record["attempt"]),
                start=float(record["start"]),
                end=float(record["end"]),
                accepted=bool(record["accepted"]),
                tolerance=float(record["tolerance"]),
                residuals=_floats(record["residuals"]),
                ranks=tuple(int(rank) for rank in record["ranks"]),
                nodes=tuple(int(count) for count in record["nodes"]),
            )
            for record in header["history"]
        ),
        timings={str(stage): float(seconds) for stage, seconds in header["timings"].items()},
        blow_up=None if blow_up is None else (float(blow_up[0]), _floats(blow_up[1])),
    )


def _slab(
    index: int, fields: Mapping[str, Any], bases: tuple[Basis1D, ...], arrays: Mapping[str, Any]
) -> SlabTrain:
    """One slab; its cores have to be float64 and to fit together and to their bases."""
    cores = tuple(arrays[f"core_{index}_{j}"] for j in range(len(bases) + 1))
    for core, following in zip(cores, (*cores[1:], None), strict=True):
        rank = 1 if following is None else following.shape[0]
        if core.dtype != np.float64 or core.ndim != 3 or core.shape[2] != rank or not core.size:
            raise ValueError(f"the cores of slab {index} do not fit together")
    if any(core.shape[1] != basis.size for core, basis in zip(cores[1:], bases, strict=True)):
        raise ValueError(f"the cores of slab {index} do not fit their bases")
    return SlabTrain(float(fields["start"]), float(fields["end"]), cores, bases)


def _names(values: Any) -> tuple[str, ...]:
    return tuple(str(value) for value in values)


def _floats(values: Any) -> tuple[float, ...]:
    return tuple(float(value) for value in values)
