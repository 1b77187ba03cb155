"""Free targets, files written together, and frozen dataclasses as plain data."""

from __future__ import annotations

import glob
import math
import os
import secrets
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import MISSING, fields, is_dataclass
from enum import Enum
from functools import cache
from os import PathLike
from pathlib import Path
from types import UnionType
from typing import IO, Any, ClassVar, Union, cast, get_args, get_origin, get_type_hints
from zipfile import ZipFile

import numpy as np

from rankone.support.errors import RankoneError

Content = str | bytes | Callable[[IO[bytes]], object]
"""Text, bytes, or a function that writes to a binary stream."""
WIDTH = 100
"""Characters of a line of generated code."""
# Characters of a name that its temporary file keeps: file systems limit names to 255 bytes
_KEPT_CHARACTERS = 48
_OTHER_NAME = "choose another name, or overwrite=True"


def as_path(path: object, error: type[RankoneError]) -> Path:
    """An argument as a path; an error if it is something else."""
    try:
        return Path(cast(str, path))
    except TypeError:
        raise error(f"{path!r} is not a path", term=path, remedy="give a file name") from None


def free_target(path: str | PathLike[str], overwrite: bool, error: type[RankoneError]) -> Path:
    """The path of a file that may be written or replaced, or an ``error``."""
    target = as_path(path, error)
    try:
        place = Path(os.path.realpath(target))
        exists, folder, inside = place.exists(), place.is_dir(), place.parent.is_dir()
        regular = place.is_file()
    except (OSError, ValueError) as reason:  # no permission, too long, a null character
        raise error(f"`{target}` cannot be written: {reason}", term=target) from reason
    if folder:
        raise error(f"`{target}` cannot be written: it is a directory", term=target)
    if exists and not regular:
        raise error(f"`{target}` cannot be written: it is not a regular file", term=target)
    if not inside:
        missing = f"there is no directory `{target.parent}`"
        raise error(f"`{target}` cannot be written: {missing}", term=target)
    if exists and not overwrite:
        raise error(f"`{target}` exists", term=target, remedy=_OTHER_NAME)
    return target


def write_files(files: Mapping[Path, Content], overwrite: bool, error: type[RankoneError]) -> None:
    """Write files that belong together.

    Each is written beside its place and moved there when all are complete: an interrupt or a full
    disk leaves no half-written file, and older files stay as they were. What a killed process left
    behind is removed when the same file is written again. If several processes write the same new
    file at once without ``overwrite``, one succeeds. An ``error`` is raised if a file must not be
    replaced or cannot be written.
    """
    places = {path: Path(os.path.realpath(free_target(path, overwrite, error))) for path in files}
    if len({*places.values()}) < len(places):
        raise error(f"{' and '.join(f'`{path}`' for path in files)} are one file")
    complete: dict[Path, Path] = {}
    moved: dict[Path, bytes | None] = {}
    try:
        with ExitStack() as beside:
            for path, content in files.items():
                complete[path] = beside.enter_context(_complete(places[path], content))
            for position, (path, place) in enumerate(places.items(), 1):
                keep = position < len(places) and place.exists()  # nothing can fail after the last
                before = place.read_bytes() if keep else None
                try:
                    _move(complete[path], place, overwrite)
                except FileExistsError:  # another process wrote it meanwhile
                    raise error(f"`{path}` exists", term=path, remedy=_OTHER_NAME) from None
                moved[place] = before
    except BaseException as reason:
        for place, before in moved.items():  # put back what was replaced before one failed
            if before is None:
                place.unlink(missing_ok=True)
            else:
                place.write_bytes(before)
        if not isinstance(reason, OSError):
            raise
        why = reason.strerror or reason
        raise error(f"`{path}` cannot be written: {why}", term=path) from reason


def npz(arrays: Mapping[str, Any]) -> Callable[[IO[bytes]], None]:
    """Content of an .npz file, whatever the names; the same arrays give the same bytes."""

    def write(stream: IO[bytes]) -> None:
        with ZipFile(stream, "w") as archive:
            for name, array in arrays.items():
                with archive.open(f"{name}.npy", "w", force_zip64=True) as entry:
                    np.lib.format.write_array(entry, np.asarray(array), allow_pickle=False)

    return write


@contextmanager
def _complete(place: Path, content: Content) -> Iterator[Path]:
    """A complete file beside its place, flushed to disk; removed unless it is moved there."""
    _remove_abandoned(place)
    with ExitStack() as until_moved:
        stream = _begin(place, until_moved)
        path = Path(stream.name)
        until_moved.callback(path.unlink, missing_ok=True)
        with stream:
            if callable(content):
                content(stream)
            else:
                stream.write(content.encode() if isinstance(content, str) else content)
            stream.flush()
            os.fsync(stream.fileno())
        yield path


def _begin(place: Path, until_moved: ExitStack) -> IO[bytes]:
    """A new file beside its place, locked until it is moved."""
    while True:
        name = f".{place.name[:_KEPT_CHARACTERS]}.{secrets.token_hex(4)}.partial"
        stream = place.with_name(name).open("xb")
        if not _lock(stream):
            return stream
        until_moved.callback(os.close, os.dup(stream.fileno()))
        # Another process may have removed it as abandoned before the lock
        if Path(stream.name).exists():
            return stream
        stream.close()


def _remove_abandoned(place: Path) -> None:
    """Remove the files that killed processes left beside a place, where the system has locks."""
    names = f".{glob.escape(place.name[:_KEPT_CHARACTERS])}.{'[0-9a-f]' * 8}.partial"
    for path in place.parent.glob(names):
        with suppress(OSError), path.open("r+b") as stream:
            if _lock(stream, wait=False):
                path.unlink()


def _lock(stream: IO[bytes], wait: bool = True) -> bool:
    """Lock a file for as long as it, or a duplicate, is open; False where there are no locks.

    Without ``wait`` a file that another has locked is an OSError.
    """
    try:
        import fcntl

        fcntl.flock(stream, fcntl.LOCK_EX if wait else fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise
    except (ImportError, OSError):  # Windows; file systems of a network
        return False
    return True


def _move(complete: Path, place: Path, overwrite: bool) -> None:
    """Give a complete file its name; a FileExistsError if it must not replace another file."""
    if overwrite:
        complete.replace(place)
        return
    try:
        os.link(complete, place)  # unlike a renaming, this never replaces a file
    except FileExistsError:
        raise
    except OSError:  # a file system without links: the process that creates the file replaces it
        place.open("xb").close()
        try:
            complete.replace(place)
        except BaseException:
            place.unlink(missing_ok=True)
            raise


# -----------------------------------------------------------------------------
# Frozen dataclasses as plain data, and rebuilt from it by their annotations.
#
# Plain data is what JSON holds: texts, numbers, booleans, null, lists and objects. Numbers that
# JSON lacks become the texts ``"nan"``, ``"inf"`` and ``"-inf"``.


_NOT_FINITE = ("nan", "inf", "-inf")


class Tagged:
    """Base of alternative dataclasses: plain data has the class name under ``"type"``."""

    subclasses: ClassVar[dict[str, type[Tagged]]] = {}

    def __init_subclass__(cls) -> None:
        Tagged.subclasses[cls.__name__] = cls


def plain(value: object) -> Any:
    """Turn dataclasses, mappings, tuples, enumerations and NumPy numbers into plain data."""
    if is_dataclass(value) and not isinstance(value, type):
        content = {field.name: plain(getattr(value, field.name)) for field in fields(value)}
        return {"type": type(value).__name__, **content} if isinstance(value, Tagged) else content
    if isinstance(value, Mapping):
        return {str(key): plain(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [plain(each) for each in value]
    if isinstance(value, Enum):
        return value.value if isinstance(value, str) else value.name
    scalar = value.item() if isinstance(value, np.generic) else value
    return str(scalar) if isinstance(scalar, float) and not math.isfinite(scalar) else scalar


def rebuilt(annotation: object, content: Any) -> Any:
    """Turn plain data into an object of an annotated type.

    That is a dataclass, an enumeration (of texts by value, others by name), ``float``, ``int``,
    ``bool``, ``str``, ``None``, and tuples, dictionaries and optional ones of them. Entries that a
    dataclass does not have are ignored; fields that the content lacks need a default. Content that
    does not fit is a TypeError, ValueError or LookupError.
    """
    inner: tuple[Any, ...] = get_args(annotation)
    origin = get_origin(annotation)
    if origin in (Union, UnionType):
        chosen = next(each for each in inner if (each is type(None)) == (content is None))
        return rebuilt(chosen, content)
    if origin is tuple and isinstance(content, list):
        if inner[-1:] == (...,):
            inner = inner[:1] * len(content)
        return tuple(rebuilt(each, entry) for each, entry in zip(inner, content, strict=True))
    if origin is dict and isinstance(content, dict):
        return {rebuilt(inner[0], k): rebuilt(inner[1], v) for k, v in content.items()}
    if origin is None and isinstance(annotation, type) and isinstance(content, dict):
        return _instance(annotation, content)
    if isinstance(annotation, type) and issubclass(annotation, Enum):
        return annotation(content) if issubclass(annotation, str) else annotation[content]
    if annotation is float and (type(content) in (float, int) or content in _NOT_FINITE):
        return float(content)
    if type(content) is annotation:
        if annotation is str:
            content.encode()  # an error for half of a surrogate pair
        return content
    raise TypeError(f"{content!r} is not of the type {annotation}")


def _instance(annotation: Any, content: Mapping[str, object]) -> Any:
    """An instance of a dataclass, or of the class that tagged content names."""
    if issubclass(annotation, Tagged):
        tagged = Tagged.subclasses[str(content["type"])]
        if not issubclass(tagged, annotation):
            raise TypeError(f"{tagged.__name__} is not a {annotation.__name__}")
        annotation = tagged
    return annotation(
        **{
            name: rebuilt(inner, content[name])
            for name, (inner, optional) in _annotations(annotation).items()
            if name in content or not optional
        }
    )


@cache
def _annotations(dataclass: Any) -> dict[str, tuple[Any, bool]]:
    """For each field of a dataclass its annotation and whether it has a default."""
    hints = get_type_hints(dataclass)
    return {
        field.name: (
            hints[field.name],
            field.default is not MISSING or field.default_factory is not MISSING,
        )
        for field in fields(dataclass)
    }
