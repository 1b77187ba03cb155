"""Finished solves in a folder, so that the same command goes on after it was killed.

Each solve is a file of its own, ``solve-<digest>.npz``, complete or absent; its name is a digest of
the problem, the box, the options and the version of rankone. ``checkpoint.json`` says in words what
the folder is of: a folder of another problem, of other options or of another version is refused.
``max_memory`` may change: it belongs to the names of solves that failed for lack of memory alone.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from rankone.interface.compiled import CompiledProblem
from rankone.interface.digests import function_digest
from rankone.interface.solution import Solution, load
from rankone.support import __version__
from rankone.support.errors import StorageError, warn
from rankone.support.files import as_path, write_files
from rankone.support.plain_data import plain
from rankone.support.wording import shown

_MANIFEST = "checkpoint.json"
_FORMAT = "rankone-checkpoint"
_OTHER_FOLDER = "choose another folder, or delete this one"
_MEMORY = "max_memory"  # May change: what is within the tolerance is, whatever memory it had


@dataclass(frozen=True)
class Checkpoint:
    """A folder of finished solves of one problem with the same options."""

    folder: Path
    options: Mapping[str, Any]

    @classmethod
    def open(
        cls, folder: str | PathLike[str], compiled: CompiledProblem, options: Mapping[str, Any]
    ) -> Checkpoint:
        """The checkpoint in a folder, which is made if there is none.

        A StorageError if it is of another problem, of other options or of another version, or the
        folder cannot be written.
        """
        place = as_path(folder, StorageError)
        if folder == "":
            raise StorageError("checkpoint is empty text", remedy='give a folder; "." is this one')
        manifest = {
            "format": _FORMAT,
            "problem": _title(compiled),
            "digest": problem_digest(compiled),
            "options": _plain_options(options),
            "rankone": __version__,
        }
        try:
            place.mkdir(parents=True, exist_ok=True)
            written = _read(place / _MANIFEST)
        except OSError as error:
            raise StorageError(
                f"checkpoint `{place}` cannot be used: {error.strerror or error}",
                term=folder,
                remedy="give a folder that can be written",
            ) from error
        if written is None:
            text = json.dumps(manifest, indent=1)
            write_files({place / _MANIFEST: text}, True, StorageError)
        else:
            _check_same(place, written, manifest)
        return cls(place, options)

    def files(self, compiled: CompiledProblem, box: Mapping[Any, Any]) -> SolveFiles:
        """The files of the solve of a compiled problem on a box."""
        changes = {str(name): _plain_option(change) for name, change in box.items()}
        asked = [problem_digest(compiled), changes, _plain_options(self.options), __version__]
        limit = _plain_option(self.options.get(_MEMORY))
        return SolveFiles(self._path(asked), self._path([*asked, limit]))

    def _path(self, asked: list[Any]) -> Path:
        return self.folder / f"solve-{_digest(json.dumps(asked, sort_keys=True))[:24]}.npz"


@dataclass(frozen=True)
class SolveFiles:
    """Where the solution of a solve is kept: one that failed for lack of memory is apart."""

    usual: Path
    of_failure: Path

    def read(self) -> Solution | None:
        """The finished solution; None if there is none, or it is damaged, of which is warned."""
        for path in (self.usual, self.of_failure):
            try:
                if path.exists():
                    return load(path)
            except StorageError as error:
                warn(f"a finished solve is damaged and is solved again: {error.message}")
        return None

    def write(self, solution: Solution) -> None:
        """Keep a finished solution; the file is complete or absent, whatever happens."""
        failed = not solution.success and solution.outcome.verdict.lacked_memory
        solution.save(self.of_failure if failed else self.usual, overwrite=True)


def problem_digest(compiled: CompiledProblem) -> str:
    """SHA-256 of all that a problem says; functions of the user count by their code and state."""
    functions = {
        name: function_digest(name.removeprefix("f_"), getattr(guarded, "value", guarded))
        for name, guarded in sorted(compiled.user_functions.items())
    }
    return _digest(json.dumps([plain(compiled.metadata()), functions], sort_keys=True))


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


def _plain_options(options: Mapping[str, Any]) -> dict[str, Any]:
    return {n: _plain_option(option) for n, option in sorted(options.items()) if n != _MEMORY}


def _plain_option(option: Any) -> Any:
    """An option as JSON holds it; symbols and other objects as text."""
    if isinstance(option, Mapping):
        return {str(key): _plain_option(entry) for key, entry in option.items()}
    if isinstance(option, list | tuple | set | frozenset | np.ndarray):
        return [_plain_option(entry) for entry in option]
    if isinstance(option, bool | str | None):
        return option
    if isinstance(option, int | float | np.generic):
        return float(option)
    return str(option)


def _title(compiled: CompiledProblem) -> str:
    """A problem in one line: its name and its equations."""
    name, texts = compiled.problem.name, compiled.metadata().equations
    equations = shown("; ".join(texts)).strip("'")
    return f"{name} ({equations})" if name else equations


def _read(path: Path) -> dict[str, Any] | None:
    """The manifest of a checkpoint; None if there is none, or it is damaged."""
    if not path.exists():
        return None
    try:
        manifest = json.loads(path.read_text(encoding="utf-8"))
    except ValueError:
        return None
    complete = isinstance(manifest, dict) and manifest.get("format") == _FORMAT
    fields = ("problem", "digest", "options", "rankone")
    return manifest if complete and all(name in manifest for name in fields) else None


def _check_same(place: Path, written: Mapping[str, Any], asked: Mapping[str, Any]) -> None:
    """Raise a StorageError unless a checkpoint is of what is asked for."""
    if written["rankone"] != asked["rankone"]:
        raise StorageError(
            f"checkpoint `{place}` was written by rankone {written['rankone']}, "
            f"and this is {asked['rankone']}",
            remedy=_OTHER_FOLDER,
        )
    if written["digest"] != asked["digest"]:
        same = written["problem"] == asked["problem"]
        other = "another box, horizon, function or detail of it" if same else asked["problem"]
        raise StorageError(
            f"checkpoint `{place}` is of the problem {written['problem']}, not of {other}",
            remedy=_OTHER_FOLDER,
        )
    for name in sorted({*written["options"], *asked["options"]}):
        one, other = (side["options"].get(name) for side in (written, asked))
        if one != other:
            raise StorageError(
                f"checkpoint `{place}` is of solves with {name}={one!r}, not {other!r}",
                remedy=_OTHER_FOLDER,
            )
