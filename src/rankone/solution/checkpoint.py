"""Finished solves in a folder, found again by digests of what was solved.

Digests are those of a pickle that is never loaded: the same in every process, whatever the hashes
and the addresses of objects. Objects count by their state; functions, which pickle knows by name
alone, by their code, their defaults, and the closures and global variables that they read; those
of installed packages count by their names.
"""

from __future__ import annotations

import dis
import hashlib
import io
import json
import pickle
import sysconfig
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import _lru_cache_wrapper
from os import PathLike
from pathlib import Path
from types import CellType, CodeType, FunctionType, MethodType, ModuleType
from typing import Any

import numpy as np

from rankone.solution.compiled import CompiledProblem
from rankone.solution.solution import Solution, load
from rankone.support import __version__
from rankone.support.errors import OptionError, StorageError, quote, shown, warn
from rankone.support.files import as_path, plain, write_files

_PROTOCOL = 4  # One for all versions of Python, as digests are compared between them
_INSTALLED = tuple(
    Path(sysconfig.get_path(name)).resolve()
    for name in ("stdlib", "platstdlib", "purelib", "platlib")
)
_READS_GLOBAL = ("LOAD_GLOBAL", "LOAD_NAME")


def function_digest(name: str, function: Callable[..., object]) -> str:
    """SHA-256 of what a function of the user runs and holds.

    An OptionError where it holds something whose state cannot be read, such as an open file.
    """
    try:
        return _state_digest(function)
    except Exception as error:  # objects of users raise what they like
        raise OptionError(
            f"checkpoint= cannot tell function {quote(name)} from another, as it holds something "
            f"that cannot be pickled: {error}",
            term=name,
            remedy="make it of functions, numbers and arrays, such as "
            "functools.partial(f, array), or leave out checkpoint=",
        ) from error


def _state_digest(held: object) -> str:
    written = io.BytesIO()
    _StatePickler(written, _PROTOCOL).dump(held)
    return hashlib.sha256(written.getvalue()).hexdigest()


class _StatePickler(pickle.Pickler):
    """Writes functions, methods and classes by what they are, not by their names alone."""

    def __init__(self, file: io.BytesIO, protocol: int) -> None:
        super().__init__(file, protocol)
        self._met: dict[int, tuple[int, object]] = {}  # held, so that no other gets its id

    def persistent_id(self, held: object) -> tuple[object, ...] | None:
        """What is written in place of an object; None for the object itself."""
        if isinstance(held, ModuleType):
            return "module", held.__name__
        if isinstance(held, MethodType):
            return "method", held.__func__, held.__self__
        if isinstance(held, _lru_cache_wrapper):
            return "cached", held.__wrapped__
        if type(held) in (set, frozenset):
            return "set", *sorted(map(_state_digest, held))  # type: ignore[call-overload]
        if not isinstance(held, FunctionType | type):
            return None
        if id(held) in self._met:  # such as a function that calls itself
            return "again", self._met[id(held)][0]
        self._met[id(held)] = len(self._met), held
        named = held.__module__, held.__qualname__
        if isinstance(held, type):
            return "class", *named, held.__bases__, _members(held)
        cells = [_content(cell) for cell in held.__closure__ or ()]
        held_by = held.__defaults__, held.__kwdefaults__, cells, held.__dict__
        if _is_installed(held.__code__):
            return "function", *named, *held_by
        return "function", *named, _of_code(held.__code__), _globals_read(held), *held_by


def _is_installed(code: CodeType) -> bool:
    """Whether code is of the standard library or an installed package."""
    path = Path(code.co_filename)
    return path.is_absolute() and any(path.resolve().is_relative_to(each) for each in _INSTALLED)


def _members(held: type) -> list[tuple[str, object]]:
    """Methods and properties of a class of the user; a class of a package has none to tell."""
    functions = {name: _function_of(each) for name, each in vars(held).items()}
    return [
        (name, each)
        for name, each in sorted(functions.items())
        if isinstance(each, FunctionType) and not _is_installed(each.__code__)
    ]


def _function_of(member: object) -> object:
    if isinstance(member, property):
        return member.fget
    return member.__func__ if isinstance(member, staticmethod | classmethod) else member


def _globals_read(function: FunctionType) -> list[tuple[str, object]]:
    """The global variables that a function reads, by name, as they are now."""
    variables = function.__globals__
    return [
        (name, variables[name])
        for name in sorted(_names_read(function.__code__) & variables.keys())
    ]


def _names_read(code: CodeType) -> set[str]:
    read = {each.argval for each in dis.get_instructions(code) if each.opname in _READS_GLOBAL}
    inner = [_names_read(each) for each in code.co_consts if isinstance(each, CodeType)]
    return read.union(*inner)


def _content(cell: CellType) -> tuple[object, ...]:
    """What a cell holds; nothing where the name has no value yet."""
    try:
        return (cell.cell_contents,)
    except ValueError:
        return ()


def _of_code(code: CodeType) -> str:
    constants = [_of_constant(constant) for constant in code.co_consts]
    return f"{code.co_code.hex()} {constants} {code.co_names}"


def _of_constant(constant: object) -> str:
    if isinstance(constant, CodeType):
        return _of_code(constant)
    if isinstance(constant, frozenset):
        return f"set {sorted(map(_of_constant, constant))}"
    return repr(constant)


# -----------------------------------------------------------------------------
# Finished solves in a folder, so that the same command goes on after it was killed.
#
# Each solve is a file of its own, ``solve-<digest>.npz``, complete or absent; its name is a digest
# of the problem, the box, the options and the version of rankone. ``checkpoint.json`` says in words
# what the folder is of: a folder of another problem, of other options or of another version is
# refused. ``max_memory`` may change: it belongs to the names of solves that failed for lack of
# memory alone.


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
        return self.folder / f"solve-{_text_digest(json.dumps(asked, sort_keys=True))[:24]}.npz"


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
    return _text_digest(json.dumps([plain(compiled.metadata()), functions], sort_keys=True))


def _text_digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


def _plain_options(options: Mapping[str, Any]) -> dict[str, Any]:
    return {n: _plain_option(option) for n, option in sorted(options.items()) if n != _MEMORY}


def _plain_option(option: object) -> Any:
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
