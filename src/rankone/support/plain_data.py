"""Frozen dataclasses as plain data, and rebuilt from it by their annotations.

Plain data is what JSON holds: texts, numbers, booleans, null, lists and objects. Numbers that JSON
lacks become the texts ``"nan"``, ``"inf"`` and ``"-inf"``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import MISSING, fields, is_dataclass
from enum import Enum
from functools import cache
from types import UnionType
from typing import Any, ClassVar, Union, get_args, get_origin, get_type_hints

import numpy as np

__all__ = ["Tagged", "plain", "rebuilt"]

_NOT_FINITE = ("nan", "inf", "-inf")


class Tagged:
    """Base of dataclasses that stand for each other: plain data names the class as ``"type"``."""

    subclasses: ClassVar[dict[str, type[Tagged]]] = {}

    def __init_subclass__(cls) -> None:
        Tagged.subclasses[cls.__name__] = cls


def plain(value: Any) -> Any:
    """Turn dataclasses, mappings, tuples, enumerations and NumPy numbers into plain data."""
    if is_dataclass(value):
        content = {field.name: plain(getattr(value, field.name)) for field in fields(value)}
        return {"type": type(value).__name__, **content} if isinstance(value, Tagged) else content
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, Enum):
        return value.value if isinstance(value, str) else value.name
    if isinstance(value, np.generic):
        value = value.item()
    return str(value) if isinstance(value, float) and not math.isfinite(value) else value


def rebuilt(kind: Any, value: Any) -> Any:
    """Turn plain data into what an annotation says.

    Parameters
    ----------
    kind : type or annotation
        A dataclass, an enumeration (of texts by value, others by name), ``float``, ``int``,
        ``bool``, ``str``, ``None``, and tuples, dictionaries and optional ones of them.
    value : object
        Plain data.

    Raises
    ------
    TypeError, ValueError, LookupError
        If the value is no such thing. Entries that a dataclass does not have are passed over;
        those that it lacks have to have a default.
    """
    parts: tuple[Any, ...] = get_args(kind)
    origin = get_origin(kind)
    if origin in (Union, UnionType):
        part = next(part for part in parts if (part is type(None)) == (value is None))
        return rebuilt(part, value)
    if origin is tuple and isinstance(value, list):
        if parts[-1:] == (...,):
            parts = parts[:1] * len(value)
        return tuple(rebuilt(part, item) for part, item in zip(parts, value, strict=True))
    if origin is dict and isinstance(value, dict):
        return {rebuilt(parts[0], key): rebuilt(parts[1], item) for key, item in value.items()}
    if isinstance(kind, type) and issubclass(kind, Tagged) and isinstance(value, dict):
        tagged = Tagged.subclasses[value["type"]]
        if not issubclass(tagged, kind):
            raise TypeError(f"{tagged.__name__} is no {kind.__name__}")
        return _dataclass(tagged, value)
    if origin is None and is_dataclass(kind) and isinstance(value, dict):
        return _dataclass(kind, value)
    if isinstance(kind, type) and issubclass(kind, Enum):
        return kind(value) if issubclass(kind, str) else kind[value]
    if kind is float and (type(value) in (float, int) or value in _NOT_FINITE):
        return float(value)
    if type(value) is kind:
        if kind is str:
            value.encode()  # an error for half of a surrogate pair
        return value
    raise TypeError(f"{value!r} is not of the kind {kind}")


def _dataclass(kind: Any, value: Mapping[str, Any]) -> Any:
    """An instance made of the entries of its fields."""
    return kind(
        **{
            name: rebuilt(annotation, value[name])
            for name, (annotation, optional) in _annotations(kind).items()
            if name in value or not optional
        }
    )


@cache
def _annotations(kind: Any) -> dict[str, tuple[Any, bool]]:
    """For each field of a dataclass its annotation and whether it has a default."""
    hints = get_type_hints(kind)
    return {
        field.name: (
            hints[field.name],
            field.default is not MISSING or field.default_factory is not MISSING,
        )
        for field in fields(kind)
    }
