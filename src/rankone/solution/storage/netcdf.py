"""Solutions in netCDF-4: the same header, cores and digest, and what xarray shows of them.

Every core is a variable with named dimensions. Beside the header, which alone is read again, names,
intervals, slabs, measured errors and units are variables and attributes of their own. The packages
h5netcdf and h5py are needed: ``pip install h5netcdf h5py``, or the extra ``io``.

Behind the end of the netCDF file, where readers do not look, stands its SHA-256. What does not fit
it is refused before the HDF5 library sees it, which a damaged file can keep busy for ever.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from io import BytesIO
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from rankone.solution.storage.contents import (
    FORMAT,
    not_a_solution,
    packed,
    piece_prefix,
    reading,
    unpacked,
)
from rankone.solvers.outcome import Outcome, SlabRecord, SolutionMetadata
from rankone.support.arrays import Array
from rankone.support.errors import StorageError, clip, optional_module
from rankone.support.files import as_path, free_target, write_files
from rankone.trajectories.system.timeline import BranchedTimeline
from rankone.trajectories.system.verdict import Status

SUFFIX = ".nc"
SIGNATURE = b"\x89HDF\r\n\x1a\n"
"""The first bytes of a netCDF-4 file."""
_SEAL = b"\nrankone sha256 "  # What stands between the netCDF file and its SHA-256
# Characters of an attribute: HDF5 keeps less than 64 KiB, four bytes for a character of UTF-8
_LONGEST_ATTRIBUTE = 15_000
_SUMMARY = (
    "Tensor trains: rankone.load evaluates them for every parameter value and time, and reads "
    "header, digest and core_<slab>_<dimension> alone"
)


def target(path: str | PathLike[str], overwrite: bool) -> Path:
    """The path of a file that can be written, as in :func:`rankone.solution.storage.target`."""
    _module("h5netcdf", as_path(path, StorageError))
    _module("h5py", as_path(path, StorageError))
    return free_target(path, overwrite, StorageError)


def write(
    path: str | PathLike[str],
    outcome: Outcome,
    metadata: SolutionMetadata,
    overwrite: bool = False,
) -> Path:
    """Write a solution to a file, as :func:`rankone.solution.storage.write` does."""
    place = target(path, overwrite)
    content = BytesIO()
    with _module("h5netcdf", place).File(content, "w") as file:
        _fill(file, outcome, metadata, _module("h5py", place).string_dtype())
    write_files({place: sealed(content.getvalue())}, overwrite, StorageError)
    return place


def read(
    path: str | PathLike[str], records: Mapping[str, type[SlabRecord]]
) -> tuple[Outcome, SolutionMetadata]:
    """Read a solution from a file, as :func:`rankone.solution.storage.read` does."""
    with reading(path) as place:
        content = place.read_bytes()
        if not (content.startswith(SIGNATURE) and FORMAT.encode() in content):
            raise not_a_solution(place)
        content, _, seal = content.rpartition(_SEAL)
        if seal != hashlib.sha256(content).hexdigest().encode():
            raise ValueError("it was changed after it was saved, or is not complete")
        h5py = _module("h5py", place)
        try:
            with h5py.File(BytesIO(content), "r") as file:
                return unpacked(_Variables(file, h5py, len(content)), place, records)
        except (OSError, RuntimeError) as error:  # of the HDF5 library
            raise ValueError(f"HDF5: {error}") from error


def sealed(content: bytes) -> bytes:
    """A netCDF file with its SHA-256 behind it."""
    return content + _SEAL + hashlib.sha256(content).hexdigest().encode()


def _module(name: str, path: Path) -> Any:
    remedy = "pip install h5netcdf h5py; .npz files need neither"
    return optional_module(
        name, f"`{path}` is a netCDF file, which needs {name}", remedy, StorageError
    )


def _fill(file: Any, outcome: Outcome, metadata: SolutionMetadata, text: Any) -> None:
    """Write everything into an open file; ``text`` is the type of texts."""
    arrays = packed(outcome, metadata)

    def add(name: str, dimensions: tuple[str, ...], content: object, about: str = "") -> None:
        array = np.asarray(content)
        for dimension, size in zip(dimensions, array.shape, strict=True):
            if dimension not in file.dimensions:
                file.dimensions[dimension] = size
        is_text = array.dtype.kind not in "fi"
        variable = file.create_variable(name, dimensions, text if is_text else "<f8")
        variable[...] = array.astype(object) if is_text else array
        if about:
            variable.attrs["long_name"] = about

    file.attrs.update(_attributes(outcome, metadata))
    for name, dimensions, content, about in _described(outcome, metadata):
        if len(content):
            add(name, dimensions, content, about)
    add("header", (), str(arrays["header"]), "what was asked and what came out, as JSON")
    add("digest", (), str(arrays["digest"]), "SHA-256 of header and cores")
    wholes = [piece.outcome for piece in outcome.pieces] or [outcome]
    for k, whole in enumerate(wholes):
        prefix = piece_prefix(k) if outcome.pieces else ""
        if prefix:
            add(f"{prefix}header", (), str(arrays[f"{prefix}header"]))
            add(f"{prefix}digest", (), str(arrays[f"{prefix}digest"]))
        for name, dimensions in _core_dimensions(whole, prefix):
            add(name, dimensions, arrays[name])


def _core_dimensions(outcome: Outcome, prefix: str) -> Iterator[tuple[str, tuple[str, str, str]]]:
    """The names of all cores, and of their dimensions; those of a piece with a prefix."""
    row = "state" if outcome.timeline is None else "state_or_clock"
    for i, slab in enumerate(outcome.slabs):
        if isinstance(outcome.timeline, BranchedTimeline):  # each branch has guards of its own
            row = f"row_of_{len(slab.cores[0])}"
        for j in range(len(slab.cores)):
            left, middle, right = _dimensions(f"{prefix}{i}", j, len(slab.cores), row)
            yield f"{prefix}core_{i}_{j}", (left, middle, right)


def _dimensions(i: str, j: int, count: int, row: str) -> tuple[str, str, str]:
    """Names of the dimensions of core j of slab i, which has ``count`` cores; the first has rows.

    The rows of a solution with events are its states, the guards of branches, the clock and the
    length of the stretch.
    """
    left = row if j == 0 else f"rank_{i}_{j - 1}_{j}"
    right = "one" if j == count - 1 else f"rank_{i}_{j}_{j + 1}"
    return left, f"time_mode_{i}" if j == 0 else f"mode_{i}_{j}", right


_Variable = tuple[str, tuple[str, ...], Sequence[object], str]
"""Name, dimensions, content and description."""


def _described(outcome: Outcome, metadata: SolutionMetadata) -> Iterator[_Variable]:
    """Variables that say in the open what the header says."""
    measured, units = outcome.measured, dict(metadata.units)
    yield "state", ("state",), _texts(metadata.states), "unknowns and other states"
    yield "role", ("state",), _texts(map(str, metadata.roles)), "what a state is"
    if units:
        state_units = [units.get(name, "") for name in metadata.states]
        yield "state_unit", ("state",), _texts(state_units), "unit"
    if measured is not None:
        about = "largest measured error, relative to the largest value"
        yield "error", ("state",), measured.interior, about
        yield "corner_error", ("state",), measured.corners, f"{about}, at corners of the box"
    yield "parameter", ("parameter",), _texts(metadata.parameters), "parameters"
    if units:
        parameter_units = [units.get(name, "") for name in metadata.parameters]
        yield "parameter_unit", ("parameter",), _texts(parameter_units), "unit"
    yield "lower", ("parameter",), [lower for lower, _ in metadata.box], "start of the interval"
    yield "upper", ("parameter",), [upper for _, upper in metadata.box], "end of the interval"
    yield "slab_start", ("slab",), [float(slab.start) for slab in outcome.slabs], "start in time"
    yield "slab_end", ("slab",), [float(slab.end) for slab in outcome.slabs], "end in time"


def _attributes(outcome: Outcome, metadata: SolutionMetadata) -> dict[str, Any]:
    """Attributes of the file: texts and numbers."""
    measured, units = outcome.measured, dict(metadata.units)
    return {
        "Conventions": FORMAT,
        "title": _text(f"Solution of {', '.join(metadata.unknowns)}"),
        "summary": _SUMMARY,
        "source": _text(f"rankone {metadata.version}, method {metadata.method}"),
        "equations": _text("\n".join(metadata.statements)),
        "rtol": float(metadata.rtol),
        **({} if measured is None else {"error": float(measured.error)}),
        "success": int(outcome.status is Status.CONVERGED),
        "comment": _text(outcome.message),
        "time": _text(metadata.time),
        "horizon": np.array(metadata.horizon, dtype=float),
        "timeless": int(metadata.timeless),
        **({"time_unit": _text(units[metadata.time])} if metadata.time in units else {}),
    }


def _text(text: str) -> str:
    """Text as an attribute or a value can hold it: neither very long nor with null characters."""
    return clip(text.replace("\0", "?"), _LONGEST_ATTRIBUTE)


def _texts(texts: Iterable[str]) -> list[str]:
    return [_text(text) for text in texts]


class _Variables(Mapping[str, Array]):
    """Variables of an open HDF5 file as arrays; only what lies in the file itself is read."""

    def __init__(self, file: Any, h5py: Any, size: int) -> None:
        self._file, self._h5py, self._size = file, h5py, size

    def __getitem__(self, name: str) -> Array:
        link = self._file.get(name, getlink=True)
        variable = self._file[name] if isinstance(link, self._h5py.HardLink) else None
        if not isinstance(variable, self._h5py.Dataset) or variable.is_virtual or variable.external:
            raise ValueError(f"{name} is not a variable in the file itself")
        plain = variable.chunks is None and variable.id.get_create_plist().get_nfilters() == 0
        if not plain or not variable.nbytes <= variable.id.get_storage_size() <= self._size:
            raise ValueError(f"{name} is not stored as it is, number after number")
        return np.array(variable.asstr()[()]) if variable.shape == () else np.asarray(variable[...])

    def __contains__(self, name: object) -> bool:
        return name in self._file

    def __iter__(self) -> Iterator[str]:
        return iter(self._file)

    def __len__(self) -> int:
        return len(self._file)
