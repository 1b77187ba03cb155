"""Functions of the user told apart: a digest of the code of each and of what it holds.

Digests are those of a pickle that is never loaded: the same in every process, whatever the hashes
and the addresses of objects. Objects count by their state; functions, which pickle knows by name
alone, by their code, their defaults and the contents of their closures. What they read as global
variables does not count.
"""

from __future__ import annotations

import hashlib
import io
import pickle
from collections.abc import Callable
from functools import _lru_cache_wrapper
from types import CellType, CodeType, FunctionType, MethodType, ModuleType

from rankone.support.errors import OptionError
from rankone.support.wording import quote

_PROTOCOL = 4  # One for all versions of Python, as digests are compared between them


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
            called = getattr(held, "__call__", None)  # noqa: B004
            return "class", *named, called if isinstance(called, FunctionType) else None
        cells = [_content(cell) for cell in held.__closure__ or ()]
        attributes = held.__dict__
        code = _of_code(held.__code__)
        return "function", *named, code, held.__defaults__, held.__kwdefaults__, cells, attributes


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
