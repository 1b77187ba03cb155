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

_NOT_FINITE = ("nan", "inf", "-inf")


class Tagged:
    """Base of alternative dataclasses: plain data has the class name under ``"type"``."""

    subclasses: ClassVar[dict[str, type[Tagged]]] = {}

    def __init_subclass__(cls) -> None:
        Tagged.subclasses[cls.__name__] = cls


def plain(value: Any) -> Any:
    """Turn dataclasses, mappings, tuples, enumerations and NumPy numbers into plain data."""
    if is_dataclass(value):
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


def rebuilt(annotation: Any, content: Any) -> Any:
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


def _instance(annotation: Any, content: Mapping[str, Any]) -> Any:
    """An instance of a dataclass, or of the class that tagged content names."""
    if issubclass(annotation, Tagged):
        tagged = Tagged.subclasses[content["type"]]
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
