"""Saving and loading solutions in an open format: NumPy ``.npz`` with a JSON header, no pickle.

The array ``header`` is a text that holds what was asked
(:class:`~rankone.metadata.SolutionMetadata`, and ``unknowns``), the bases of every slab and the
:class:`~rankone.solvers.outcome.Outcome` as JSON; ``core_<slab>_<dimension>`` are the cores of each
:class:`~rankone.tensors.slab.SlabTrain`. Readers refuse versions newer than their own and pass over
entries they do not know; the version grows when an old reader could misunderstand a file.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from os import PathLike
from pathlib import Path
from typing import Any, get_type_hints
from zipfile import BadZipFile, is_zipfile
from zlib import error as ZlibError

import numpy as np

from rankone.discretization import BASES, Basis1D
from rankone.errors import StorageError
from rankone.files import free_target, npz, write_files
from rankone.metadata import SolutionMetadata
from rankone.plain_data import plain, rebuilt
from rankone.solvers.outcome import Outcome, SlabRecord
from rankone.tensors.slab import SlabTrain

__all__ = ["FORMAT", "FORMAT_VERSION", "read", "target", "write"]

FORMAT = "rankone-solution"
FORMAT_VERSION = 2
"""The newest version: 2 if there are elements of unequal size, else 1 is written."""
_PLAIN = ("status", "message", "measured", "timings", "blow_up")
"""Fields of an outcome that the header holds as they are."""


def target(path: str | PathLike[str], overwrite: bool) -> Path:
    """The path of a file that a solution, or a table of values, can be written to.

    Raises
    ------
    StorageError
        If its name does not end in ``.npz``, it exists and is not to be replaced, or it cannot be
        written.
    """
    if Path(path).suffix != ".npz":
        raise StorageError(
            f"`{path}` is no name for an .npz file", term=path, remedy="end the name in .npz"
        )
    return free_target(path, overwrite, StorageError)


def write(
    path: str | PathLike[str],
    outcome: Outcome,
    metadata: SolutionMetadata,
    overwrite: bool = False,
) -> Path:
    """Write what was solved to a file; paths and errors are those of :func:`target`.

    A file is either complete or not there, also after an interrupt.
    """
    place = target(path, overwrite)
    write_files({place: npz(_arrays(outcome, metadata))}, overwrite, StorageError)
    return place


def read(
    path: str | PathLike[str], records: Mapping[str, type[SlabRecord]]
) -> tuple[Outcome, SolutionMetadata]:
    """Read what was solved from a file written by :func:`write`.

    Nothing in the file is executed.

    Parameters
    ----------
    records : mapping of str to type
        For each method the class of the records of its history.

    Raises
    ------
    StorageError
        If there is no such file, it is not a rankone solution, it is damaged, a newer version of
        rankone wrote it, or its method is none of these.
    """
    given = Path(path)
    try:
        with given.open("rb") as stream:
            if not is_zipfile(stream):
                raise _not_a_solution(given)
            stream.seek(0)
            with np.load(stream, allow_pickle=False) as arrays:
                header = _header(arrays, given)
                metadata = _metadata(header["metadata"])
                if metadata.method not in records:
                    raise StorageError(
                        f"`{given}` holds a solution by method={metadata.method!r}, which is not "
                        f"known here",
                        term=given,
                        remedy=f"methods that can be read: {', '.join(records)}",
                    )
                outcome = _outcome(header, records[metadata.method], arrays)
        _check(outcome, metadata)
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
    return outcome, metadata


def _not_a_solution(path: Path) -> StorageError:
    return StorageError(
        f"`{path}` is not a rankone solution",
        term=path,
        remedy="give a file written by `solution.save` or `rankone solve --save`",
    )


# --- writing -----------------------------------------------------------------------------------


def _arrays(outcome: Outcome, metadata: SolutionMetadata) -> dict[str, Any]:
    """The arrays of a file by name."""
    bases: dict[Basis1D, int] = {}
    slabs = []
    for slab in outcome.slabs:
        used = [bases.setdefault(basis, len(bases)) for basis in slab.bases]
        slabs.append({"start": slab.start, "end": slab.end, "bases": used})
    header = {
        "format": FORMAT,
        "format_version": 2 if any(basis.breaks for basis in bases) else 1,
        "metadata": {"unknowns": metadata.unknowns, **plain(metadata)},
        **{name: getattr(outcome, name) for name in _PLAIN},
        "history": outcome.history,
        "bases": [_plain_basis(basis) for basis in bases],
        "slabs": slabs,
    }
    arrays = {"header": np.array(json.dumps(plain(header), allow_nan=False))}
    for i, slab in enumerate(outcome.slabs):
        for j, core in enumerate(slab.cores):
            arrays[f"core_{i}_{j}"] = np.ascontiguousarray(core, dtype="<f8")
    return arrays


def _plain_basis(basis: Basis1D) -> dict[str, Any]:
    """The fields of a basis; breaks only if there are any."""
    fields = {"kind": basis.kind, **plain(basis)}
    return fields if basis.breaks else {k: v for k, v in fields.items() if k != "breaks"}


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


def _metadata(fields: Mapping[str, Any]) -> SolutionMetadata:
    """What was asked; without roles the states behind the unknowns are derivatives."""
    unknowns, states = fields["unknowns"], fields["states"]
    behind = ["derivative"] * (len(states) - len(unknowns))
    roles = {"roles": ["unknown"] * len(unknowns) + behind}
    metadata: SolutionMetadata = rebuilt(SolutionMetadata, roles | {**fields})
    if len(metadata.roles) != len(states) or [*metadata.unknowns] != unknowns:
        raise ValueError("the unknowns do not fit the states")
    return metadata


def _outcome(
    header: Mapping[str, Any], record: type[SlabRecord], arrays: Mapping[str, Any]
) -> Outcome:
    hints = get_type_hints(Outcome)
    bases = [_basis(fields, header["format_version"]) for fields in header["bases"]]
    slabs = [
        _slab(i, fields, tuple(bases[k] for k in fields["bases"]), arrays)
        for i, fields in enumerate(header["slabs"])
    ]
    return Outcome(
        slabs=tuple(slabs),
        history=tuple(rebuilt(record, entry) for entry in header["history"]),
        **{name: rebuilt(hints[name], header[name]) for name in _PLAIN},
    )


def _basis(fields: Mapping[str, Any], version: int) -> Basis1D:
    """One basis; breaks are part of the format since version 2 and fit the number of elements."""
    basis: Basis1D = rebuilt(BASES[fields["kind"]], fields)
    if basis.breaks and (version < 2 or basis.elements != fields["elements"]):
        raise ValueError("the breaks of a basis do not fit")
    return basis


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
    return SlabTrain(rebuilt(float, fields["start"]), rebuilt(float, fields["end"]), cores, bases)


def _check(outcome: Outcome, metadata: SolutionMetadata) -> None:
    """The names have to fit the cores and what was measured."""
    states, parameters = len(metadata.states), len(metadata.parameters)
    fits = len(metadata.box) == parameters
    for slab in outcome.slabs:
        fits = fits and len(slab.cores[0]) == states and len(slab.bases) == parameters
    if outcome.measured is not None:
        fits = fits and len(outcome.measured.interior) == states
    if not fits:
        raise ValueError("the names do not fit the cores")
