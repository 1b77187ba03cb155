"""The content of a file of fields: a header, the modes, and the solution of the coefficients.

The array ``header`` is a JSON text, ``modes_<unknown>`` are matrices (entries, modes) of float64 or
float32, and the arrays of the solution of the coefficients follow with the prefix
``coefficients_``, as :mod:`rankone.solution.storage.contents` says. Readers refuse newer versions.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from rankone.solution.storage.contents import (
    FIELD_FORMAT,
    Arrays,
    WithPrefix,
    not_a_solution,
    packed,
    unpacked,
)
from rankone.solution.storage.npz import read_arrays, target
from rankone.solvers.outcome import Outcome, SlabRecord, SolutionMetadata
from rankone.solvers.reduced.field_modes import FieldModes
from rankone.support.errors import StorageError, is_line
from rankone.support.files import npz, plain, rebuilt, write_files
from rankone.trajectories.fields.field_system import Unknown
from rankone.trajectories.system.verdict import Status

FIELD_FORMAT_VERSION = 1  # Newest version that is read
_PREFIX = "coefficients_"
_KINDS = {"float64": "<f8", "float32": "<f4"}


@dataclass(frozen=True, eq=False)
class FieldContent:
    """What a file of fields holds."""

    outcome: Outcome
    metadata: SolutionMetadata
    modes: FieldModes
    status: Status
    message: str


def write_fields(
    path: str | PathLike[str],
    content: FieldContent,
    kind: Literal["float64", "float32"],
    overwrite: bool,
) -> Path:
    """Write fields to an ``.npz`` file, complete or absent, with modes of a kind of numbers."""
    place = target(path, overwrite)
    write_files({place: npz(_packed(content, _KINDS[kind]))}, overwrite, StorageError)
    return place


def fields_of(
    path: str | PathLike[str], records: Mapping[str, type[SlabRecord]]
) -> FieldContent | None:
    """Read fields from a file; None if it is not of fields. Nothing in it is executed.

    Errors are those of :func:`rankone.solution.storage.read`.
    """
    with read_arrays(path) as (arrays, place):
        header = _header(arrays, place)
        return None if header is None else _content(header, arrays, place, records)


def _packed(content: FieldContent, kind: str) -> Arrays:
    """The arrays of a file by name."""
    modes = content.modes
    header = {
        "format": FIELD_FORMAT,
        "format_version": FIELD_FORMAT_VERSION,
        "unknowns": modes.unknowns,
        "scales": modes.scales,
        "errors": modes.errors,
        "trajectories": modes.trajectories,
        "status": content.status,
        "message": content.message,
    }
    arrays: dict[str, NDArray[Any]] = {
        "header": np.array(json.dumps(plain(header), allow_nan=False))
    }
    for k, own in enumerate(modes.modes):
        arrays[f"modes_{k}"] = np.ascontiguousarray(own, dtype=kind)
    coefficients = packed(content.outcome, content.metadata)
    arrays |= {f"{_PREFIX}{name}": array for name, array in coefficients.items()}
    arrays["digest"] = np.array(_digest(arrays, len(modes.modes)))
    return arrays


def _digest(arrays: Arrays, unknowns: int) -> str:
    """SHA-256 of the header, of the digest of the coefficients, and of all modes."""
    digest = hashlib.sha256(str(arrays["header"][()]).encode())
    digest.update(str(arrays[f"{_PREFIX}digest"][()]).encode())
    for k in range(unknowns):
        modes = arrays[f"modes_{k}"]
        digest.update(f"modes_{k} {modes.shape} {modes.dtype.str} ".encode())
        digest.update(np.ascontiguousarray(modes).tobytes())
    return digest.hexdigest()


def _header(arrays: Arrays, path: Path) -> Mapping[str, Any] | None:
    """The header; None if it is not one of fields."""
    if "header" not in arrays:
        raise not_a_solution(path)
    header = json.loads(str(arrays["header"][()]))
    if not isinstance(header, dict) or header.get("format") != FIELD_FORMAT:
        return None
    version = header["format_version"]
    if type(version) is not int or version < 1:
        raise ValueError(f"format_version is {version!r}")
    if version > FIELD_FORMAT_VERSION:
        raise StorageError(
            f"`{path}` has version {version} of the format of fields; this rankone reads up to "
            f"version {FIELD_FORMAT_VERSION}",
            term=path,
            remedy="upgrade rankone",
        )
    return header


def _content(
    header: Mapping[str, Any],
    arrays: Arrays,
    path: Path,
    records: Mapping[str, type[SlabRecord]],
) -> FieldContent:
    """Fields of the arrays of a file, checked."""
    unknowns = rebuilt(tuple[Unknown, ...], header["unknowns"])
    modes = FieldModes(
        unknowns,
        tuple(_matrix(arrays, k, unknown) for k, unknown in enumerate(unknowns)),
        rebuilt(tuple[float, ...], header["scales"]),
        rebuilt(tuple[float, ...], header["errors"]),
        rebuilt(int, header["trajectories"]),
    )
    _check(modes)
    if str(arrays["digest"][()]) != _digest(arrays, len(unknowns)):
        raise ValueError("its contents do not fit their digest: it was changed after it was saved")
    outcome, metadata = unpacked(WithPrefix(arrays, _PREFIX), path, records)
    status, message = rebuilt(Status, header["status"]), rebuilt(str, header["message"])
    if metadata.unknowns != modes.names:
        raise ValueError("the coefficients do not fit the modes")
    if status is Status.CONVERGED and not (
        modes.errors and all(0.0 <= error <= metadata.rtol for error in modes.errors)
    ):
        raise ValueError(f"the status is CONVERGED, and the measured errors are {modes.errors}")
    return FieldContent(outcome, metadata, modes, status, message)


def _matrix(arrays: Arrays, k: int, unknown: Unknown) -> NDArray[Any]:
    """The modes of an unknown, as float64."""
    modes = arrays[f"modes_{k}"]
    if modes.dtype.str not in _KINDS.values() or modes.ndim != 2 or len(modes) != unknown.size:
        raise ValueError(f"the modes of {unknown.name} do not fit its entries")
    if not np.isfinite(modes).all():
        raise ValueError(f"the modes of {unknown.name} are not finite numbers")
    return np.ascontiguousarray(modes, dtype=np.float64)


def _check(modes: FieldModes) -> None:
    """Raise a ValueError unless unknowns, scales and errors fit each other."""
    names = [unknown.name for unknown in modes.unknowns]
    if not names or len({*names}) < len(names) or not all(map(is_line, names)):
        raise ValueError(f"the names of the unknowns are {names}")
    first = 0
    for unknown, count in zip(modes.unknowns, modes.counts, strict=True):
        fits = unknown.first == first and unknown.size > 0
        if not fits or not (unknown.is_field or unknown.size == count == 1):
            raise ValueError(f"{unknown} does not fit the unknowns before it, or its modes")
        first += unknown.size
    if len(modes.scales) != len(names) or not all(0.0 <= s < math.inf for s in modes.scales):
        raise ValueError(f"the scales are {modes.scales}")
    if len(modes.errors) not in (0, len(names)) or any(error < 0.0 for error in modes.errors):
        raise ValueError(f"the errors are {modes.errors}")
