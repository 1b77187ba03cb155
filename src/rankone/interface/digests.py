"""Functions of the user told apart: a digest of the code of each and of what it holds.

Digests are those of a pickle that is never loaded: the same in every process, whatever the hashes
and the addresses of objects. Objects count by their state; functions, which pickle knows by name
alone, by their code, their defaults, and the closures and global variables that they read; those
of installed packages count by their names.
"""

from __future__ import annotations

import dis
import hashlib
import io
import pickle
import sysconfig
from collections.abc import Callable
from functools import _lru_cache_wrapper
from pathlib import Path
from types import CellType, CodeType, FunctionType, MethodType, ModuleType

from rankone.support.errors import OptionError
from rankone.support.wording import quote

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
        return _digest(function)
    except Exception as error:  # objects of users raise what they like
        raise OptionError(
            f"checkpoint= cannot tell function {quote(name)} from another, as it holds something "
            f"that cannot be pickled: {error}",
            term=name,
            remedy="make it of functions, numbers and arrays, such as "
            "functools.partial(f, array), or leave out checkpoint=",
        ) from error


def _digest(held: object) -> str:
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
            return "set", *sorted(map(_digest, held))  # type: ignore[call-overload]
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
