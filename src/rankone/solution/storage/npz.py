"""Solutions in NumPy's ``.npz``: the default, always available, no pickle.

An array for the header, for each core and for the digest, as
:mod:`rankone.solution.storage.contents` says.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from os import PathLike
from pathlib import Path
from zipfile import ZIP_STORED, ZipFile, is_zipfile

import numpy as np

from rankone.solution.storage.contents import Arrays, not_a_solution, packed, reading, unpacked
from rankone.solvers.outcome import Outcome, SlabRecord, SolutionMetadata
from rankone.support.arrays import Array
from rankone.support.errors import StorageError
from rankone.support.files import as_path, free_target, npz, write_files

_SUFFIX = ".npy"
# Readers of the header of an array, by the version of its format
_READERS = {
    (1, 0): np.lib.format.read_array_header_1_0,
    (2, 0): np.lib.format.read_array_header_2_0,
}


def target(path: str | PathLike[str], overwrite: bool) -> Path:
    """The path of an ``.npz`` file that can be written, as in
    :func:`rankone.solution.storage.target`."""
    if as_path(path, StorageError).suffix != ".npz":
        raise StorageError(
            f"`{path}` is not a name for an .npz file", term=path, remedy="end the name in .npz"
        )
    return free_target(path, overwrite, StorageError)


def write(
    path: str | PathLike[str],
    outcome: Outcome,
    metadata: SolutionMetadata,
    overwrite: bool = False,
) -> Path:
    """Write a solution to a file, as :func:`rankone.solution.storage.write` does."""
    place = target(path, overwrite)
    write_files({place: npz(packed(outcome, metadata))}, overwrite, StorageError)
    return place


def read(
    path: str | PathLike[str], records: Mapping[str, type[SlabRecord]]
) -> tuple[Outcome, SolutionMetadata]:
    """Read a solution from a file, as :func:`rankone.solution.storage.read` does."""
    with read_arrays(path) as (arrays, place):
        return unpacked(arrays, place, records)


@contextmanager
def read_arrays(path: str | PathLike[str]) -> Iterator[tuple[Arrays, Path]]:
    """The arrays of a file and its path; whatever goes wrong inside becomes a StorageError."""
    with reading(path) as place, place.open("rb") as stream:
        if not is_zipfile(stream):
            raise not_a_solution(place)
        stream.seek(0)
        size = stream.seek(0, os.SEEK_END)
        with ZipFile(stream) as archive:
            yield _Members(archive, size), place


class _Members(Mapping[str, Array]):
    """The arrays of an archive by name, each read where it is asked for.

    Members are stored as they are, so none is larger than the file and no array than its member:
    what says otherwise is refused before memory is taken.
    """

    def __init__(self, archive: ZipFile, size: int) -> None:
        self._archive = archive
        self._members = {
            member.filename.removesuffix(_SUFFIX): member
            for member in archive.infolist()
            if member.filename.endswith(_SUFFIX)
        }
        stored = all(m.compress_type == ZIP_STORED for m in self._members.values())
        if not stored or sum(m.file_size for m in self._members.values()) > size:
            raise ValueError("its arrays are not stored as they are, but larger than the file")
        if len(self._members) < len(archive.infolist()):
            raise ValueError("it holds something else than arrays, or one twice")

    def __getitem__(self, name: str) -> Array:
        member = self._members[name]
        with self._archive.open(member) as stream:
            version = np.lib.format.read_magic(stream)
            if version not in _READERS:
                raise ValueError(f"{name} is an array of a format that is not known")
            shape, fortran, dtype = _READERS[version](stream)
            content = stream.read()
            if dtype.hasobject or math.prod(shape) * dtype.itemsize != len(content):
                raise ValueError(f"{name} is said to be of shape {shape}, which does not fit it")
        array = np.array(np.frombuffer(content, dtype))
        return array.reshape(shape[::-1]).T if fortran else array.reshape(shape)

    def __iter__(self) -> Iterator[str]:
        return iter(self._members)

    def __len__(self) -> int:
        return len(self._members)
