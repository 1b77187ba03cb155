"""Writing exported files: all of them or none."""

from __future__ import annotations

import os
import secrets
from collections.abc import Mapping
from os import PathLike
from pathlib import Path

from rankone.errors import ExportError

__all__ = ["target", "write_all"]


def target(path: str | PathLike[str], kinds: Mapping[str, str]) -> Path:
    """The path, if its suffix names something that can be exported.

    Parameters
    ----------
    path : path-like
    kinds : mapping of str to str
        For each suffix what it stands for.

    Raises
    ------
    ExportError
        If the suffix is another one, or there is no name before it.
    """
    given = Path(path)
    if given.suffix not in kinds:
        choices = ", ".join(f"{suffix} ({what})" for suffix, what in kinds.items())
        raise ExportError(
            f"`{given}`: the suffix {given.suffix!r} names no target of this export",
            term=given,
            remedy=f"choose one of {choices}",
        )
    return given


def write_all(files: Mapping[Path, str | bytes], *, overwrite: bool) -> None:
    """Write files that belong together.

    Every file is written beside its place first and moved there when all are complete, so that a
    full disk or an interrupt leaves no half-written file.

    Raises
    ------
    ExportError
        If one of them exists and is not to be replaced, or cannot be written.
    """
    for path in files:
        try:
            folder, exists = path.is_dir(), path.exists()
        except (OSError, ValueError) as error:  # no permission, too long, a null character
            raise ExportError(f"`{path}` cannot be written: {error}", term=path) from error
        if folder or (exists and not overwrite):
            remedy = "choose another name" + ("" if folder else ", or pass overwrite=True")
            raise ExportError(f"`{path}` exists", term=path, remedy=remedy)
    if len({os.path.realpath(path) for path in files}) < len(files):
        raise ExportError(f"{' and '.join(f'`{path}`' for path in files)} are one file")
    partial: dict[Path, Path] = {}
    moved: list[Path] = []
    kept: dict[Path, bytes] = {}
    try:
        for path, content in files.items():
            place = Path(os.path.realpath(path))
            partial[path] = place.with_name(f".{place.name}.{secrets.token_hex(4)}.partial")
            data = content.encode() if isinstance(content, str) else content
            with partial[path].open("xb") as file:
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
        for path in files:
            place = Path(os.path.realpath(path))
            if place.exists():
                kept[place] = place.read_bytes()
            partial[path].replace(place)
            moved.append(place)
    except OSError as error:
        _undo(moved, kept)
        raise ExportError(f"`{path}` cannot be written: {error}", term=path) from error
    finally:
        for left in partial.values():
            left.unlink(missing_ok=True)


def _undo(moved: list[Path], kept: Mapping[Path, bytes]) -> None:
    """Put back what the files replaced before one of them failed."""
    for place in moved:
        if place in kept:
            place.write_bytes(kept[place])
        else:
            place.unlink(missing_ok=True)
