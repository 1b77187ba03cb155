"""Saving and loading solutions in open formats, without pickle.

==================  ===================================================================
module              subject
==================  ===================================================================
``header``          what a file holds, whatever its container; checks on reading
``npz``             NumPy's ``.npz``: the default, always available
``netcdf``          netCDF-4, ``.nc``, which xarray opens by itself
==================  ===================================================================
"""

from __future__ import annotations

from collections.abc import Mapping
from os import PathLike
from pathlib import Path

from rankone.ir.metadata import SolutionMetadata
from rankone.ir.outcome import Outcome, SlabRecord
from rankone.storage import netcdf, npz
from rankone.storage.header import FORMAT, FORMAT_VERSION
from rankone.support.errors import StorageError
from rankone.support.files import as_path

__all__ = ["FORMAT", "FORMAT_VERSION", "SUFFIXES", "read", "target", "write"]

SUFFIXES = (".npz", netcdf.SUFFIX)
"""How names of saved solutions end."""


def target(path: str | PathLike[str], overwrite: bool) -> Path:
    """The path of a file that a solution can be written to.

    Raises
    ------
    StorageError
        If its name ends in neither ``.npz`` nor ``.nc``, it exists and is not to be replaced, it
        cannot be written, or a package that it needs is not installed.
    """
    given = as_path(path, StorageError)
    if given.suffix not in SUFFIXES:
        raise StorageError(
            f"`{path}` is no name for a saved solution",
            term=path,
            remedy="end the name in .npz, or in .nc for netCDF",
        )
    of_kind = netcdf.target if given.suffix == netcdf.SUFFIX else npz.target
    return of_kind(given, overwrite)


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
    of_kind = netcdf.write if place.suffix == netcdf.SUFFIX else npz.write
    return of_kind(place, outcome, metadata, overwrite)


def read(
    path: str | PathLike[str], records: Mapping[str, type[SlabRecord]]
) -> tuple[Outcome, SolutionMetadata]:
    """Read what was solved from a file written by :func:`write`, whatever its name.

    Nothing in the file is executed.

    Parameters
    ----------
    records : mapping of str to type
        For each method the class of the records of its history.

    Raises
    ------
    StorageError
        If there is no such file, it is not a rankone solution, it is damaged, a newer version of
        rankone wrote it, its method is none of these, or a package that it needs is not installed.
    """
    of_kind = netcdf.read if _is_netcdf(as_path(path, StorageError)) else npz.read
    return of_kind(path, records)


def _is_netcdf(path: Path) -> bool:
    """Whether a file begins as one of netCDF-4; not if it cannot be read."""
    try:
        if path.is_file():
            with path.open("rb") as stream:
                return stream.read(len(netcdf.SIGNATURE)) == netcdf.SIGNATURE
    except (OSError, ValueError):  # the reader says so
        pass
    return False
