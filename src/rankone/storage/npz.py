"""Solutions in NumPy's ``.npz``: the default, always available, no pickle.

An array for the header, for each core and for the digest, as :mod:`rankone.storage.header` says.
"""

from __future__ import annotations

from collections.abc import Mapping
from os import PathLike
from pathlib import Path
from zipfile import is_zipfile

import numpy as np

from rankone.errors import StorageError
from rankone.files import as_path, free_target, npz, write_files
from rankone.metadata import SolutionMetadata
from rankone.solvers.outcome import Outcome, SlabRecord
from rankone.storage.header import not_a_solution, packed, reading, unpacked

__all__ = ["read", "target", "write"]


def target(path: str | PathLike[str], overwrite: bool) -> Path:
    """The path of a file that a solution, or a table of values, can be written to.

    Raises
    ------
    StorageError
        If its name does not end in ``.npz``, it exists and is not to be replaced, or it cannot be
        written.
    """
    if as_path(path, StorageError).suffix != ".npz":
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
    write_files({place: npz(packed(outcome, metadata))}, overwrite, StorageError)
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
    with reading(path) as given, given.open("rb") as stream:
        if not is_zipfile(stream):
            raise not_a_solution(given)
        stream.seek(0)
        with np.load(stream, allow_pickle=False) as arrays:
            return unpacked(arrays, given, records)
