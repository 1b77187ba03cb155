"""Saving and loading solutions in open formats, without pickle.

- ``contents``: the content of a solution file, whatever its container: a header and cores
- ``field_contents``: the content of a file of fields: a header, the modes, and the solution of
  the coefficients
- ``netcdf``: solutions in netCDF-4: the same header, cores and digest, and what xarray shows of
  them
- ``npz``: solutions in NumPy's ``.npz``: the default, always available, no pickle
"""

from __future__ import annotations

from collections.abc import Mapping
from os import PathLike
from pathlib import Path

from rankone.solution.storage import netcdf, npz
from rankone.solution.storage.field_contents import FieldContent, fields_of
from rankone.solvers.outcome import Outcome, SlabRecord, SolutionMetadata
from rankone.support.errors import StorageError
from rankone.support.files import as_path

SUFFIXES = (".npz", netcdf.SUFFIX)
"""Suffixes of saved solutions."""


def target(path: str | PathLike[str], overwrite: bool) -> Path:
    """The path of a file that a solution can be written to.

    A StorageError if its name ends in neither ``.npz`` nor ``.nc``, it exists and is not to be
    replaced, it cannot be written, or a package that it needs is not installed.
    """
    place = as_path(path, StorageError)
    if place.suffix not in SUFFIXES:
        raise StorageError(
            f"`{path}` is not a name for a saved solution",
            term=path,
            remedy="end the name in .npz, or in .nc for netCDF",
        )
    container_target = netcdf.target if place.suffix == netcdf.SUFFIX else npz.target
    return container_target(place, overwrite)


def write(
    path: str | PathLike[str],
    outcome: Outcome,
    metadata: SolutionMetadata,
    overwrite: bool = False,
) -> Path:
    """Write a solution to a file; paths and errors as in :func:`target`.

    The file is complete or absent, even after an interrupt.
    """
    place = target(path, overwrite)
    container_write = netcdf.write if place.suffix == netcdf.SUFFIX else npz.write
    return container_write(place, outcome, metadata, overwrite)


def read(
    path: str | PathLike[str], records: Mapping[str, type[SlabRecord]]
) -> tuple[Outcome, SolutionMetadata]:
    """Read a solution from a file written by :func:`write`, whatever its name; nothing is executed.

    ``records`` has for each method the class of its records. A StorageError if there is no such
    file, it is not a rankone solution, it is damaged, a newer version of rankone wrote it, its
    method is none of these, or a package that it needs is not installed.
    """
    container_read = netcdf.read if _is_netcdf(as_path(path, StorageError)) else npz.read
    return container_read(path, records)


def read_fields(
    path: str | PathLike[str], records: Mapping[str, type[SlabRecord]]
) -> FieldContent | None:
    """Read fields from a file, whatever its name; None if it holds something else.

    Errors are those of :func:`read`.
    """
    return None if _is_netcdf(as_path(path, StorageError)) else fields_of(path, records)


def _is_netcdf(path: Path) -> bool:
    """Whether a file begins with the signature of netCDF-4."""
    try:
        if path.is_file():
            with path.open("rb") as stream:
                return stream.read(len(netcdf.SIGNATURE)) == netcdf.SIGNATURE
    except (OSError, ValueError):  # the reader says so
        pass
    return False
