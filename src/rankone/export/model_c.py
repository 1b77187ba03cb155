"""The solved model in C99: one source file and its header, without any dependency.

The coefficients of a core are laid out so that its contraction reads them once, in order: the
left index is split into blocks of eight, padded with zeros, and within a block all products of a
polynomial and an entry of the carry follow each other. The innermost loop runs over a block.
"""

from __future__ import annotations

import json
import re
import textwrap
import unicodedata
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rankone.export.packing import PackedCore, PackedModel
from rankone.version import __version__

__all__ = ["c_identifier", "c_model"]

_WIDTH = 96
_BLOCK = 8
"""Rows of a core contracted together; the same in the template."""
_TEMPLATES = Path(__file__).parent


def c_model(model: PackedModel, path: Path) -> dict[Path, str | bytes]:
    """Source and header of a model; the names start with the stem of the path.

    Parameters
    ----------
    model : PackedModel
    path : Path
        Where the source will be.
    """
    prefix = c_identifier(path.stem)
    values = {
        "prefix": prefix,
        "PREFIX": prefix.upper(),
        "header": path.with_suffix(".h").name,
        "source": path.name,
        "version": __version__,
        "summary": _comment(model),
        "unknowns": str(len(model.unknowns)),
        "parameters": str(len(model.coordinates) - 1),
        "room": str(max(len(model.coordinates) - 1, 1)),
        "unknown_list": ", ".join(model.unknowns),
        "coordinate_list": ", ".join(model.coordinates),
        "indices": _indices(model, prefix.upper()),
        "unknown_names": _strings(model.unknowns),
        "parameter_names": _strings(model.coordinates[1:] or ("",)),
        "lower": _numbers([lower for lower, _ in model.intervals[1:]] or [0.0]),
        "upper": _numbers([upper for _, upper in model.intervals[1:]] or [0.0]),
        "time_lower": _number(model.intervals[0][0]),
        "time_upper": _number(model.intervals[0][1]),
        **_tables(model),
    }
    return {
        path: _filled("model.c.in", values),
        path.with_suffix(".h"): _filled("model.h.in", values),
    }


def c_identifier(name: str) -> str:
    """A C identifier that resembles a name: ``x_{0}`` becomes ``x_0``, ``2a`` becomes ``_2a``.

    Greek letters are spelled out; other characters become underscores.
    """
    letters = []
    for letter in unicodedata.normalize("NFKC", name).replace("'", "_prime"):
        if not letter.isascii() and letter.isalpha():
            letter = unicodedata.name(letter, "x").split(" LETTER ")[-1].split()[-1].lower()
        letters.append(letter)
    text = re.sub(r"_*[^A-Za-z0-9_]+_*", "_", "".join(letters)).rstrip("_") or "model"
    return f"_{text}" if text[0].isdigit() else text


def _filled(template: str, values: dict[str, str]) -> str:
    """A template with every ``@name@`` replaced."""
    text = (_TEMPLATES / template).read_text(encoding="utf-8")
    return re.sub(r"@(\w+)@", lambda match: values[match.group(1)], text)


def _comment(model: PackedModel) -> str:
    lines = []
    for line in model.summary:
        indent = " " * (len(line) - len(line.lstrip()) + 4)
        lines += textwrap.wrap(line, _WIDTH, subsequent_indent=indent) or [""]
    safe = (line.replace("*/", "* /").replace("/*", "/ *") for line in lines)
    return "\n".join(f" * {line}".rstrip() for line in safe)


def _indices(model: PackedModel, prefix: str) -> str:
    """Positions of parameters and unknowns by name."""
    lines = []
    for kind, names in (("P", model.coordinates[1:]), ("U", model.unknowns)):
        taken: set[str] = set()
        for position, name in enumerate(names):
            word = c_identifier(name)
            while word in taken:
                word += "_"
            taken.add(word)
            lines.append(f"#define {prefix}_{kind}_{word} {position}")
    return "\n".join(lines)


def _strings(names: Iterable[str]) -> str:
    """String literals; other characters than ASCII are written as bytes of UTF-8."""
    return ", ".join(_string(name) for name in names)


def _string(text: str) -> str:
    if text.isascii():
        return json.dumps(text).replace("??", '?" "?')
    return '"' + "".join(f"\\{byte:03o}" for byte in text.encode()) + '"'


def _number(value: float) -> str:
    return repr(float(value))


def _numbers(values: Sequence[float]) -> str:
    return ", ".join(map(_number, values))


def _tables(model: PackedModel) -> dict[str, str]:
    """The layout of the cores, their coefficients, and the sizes of the work arrays."""
    rows, blocks, offset = [], [], 0
    for slab in model.slabs:
        for core in slab:
            elements, left, degree, right = core.tensor.shape
            rows.append(
                f"{_number(core.lower)}, {_number(core.scale)}, "
                f"{elements}, {left}, {degree}, {right}, {offset}"
            )
            blocks.append(_blocked(core))
            offset += blocks[-1].size
    shapes = [core.tensor.shape for slab in model.slabs for core in slab]
    return {
        "slabs": str(len(model.slabs)),
        "starts": "\n".join(_wrapped(map(_number, model.starts))),
        "cores": "\n".join(f"    {{{row}}}," for row in rows),
        "coefficients": "\n".join(_wrapped(map(repr, np.concatenate(blocks).tolist()))),
        "most_rows": str(max(_padded(left) for _, left, _, _ in shapes)),
        "most_polynomials": str(max(degree for _, _, degree, _ in shapes)),
        "most_products": str(max(degree * right for _, _, degree, right in shapes)),
    }


def _padded(count: int) -> int:
    return -(-count // _BLOCK) * _BLOCK


def _blocked(core: PackedCore) -> NDArray[np.float64]:
    """Coefficients in the order (element, block of rows, right rank, polynomial, row)."""
    elements, left, degree, right = core.tensor.shape
    padded = np.zeros((elements, _padded(left), degree, right))
    padded[:, :left] = core.tensor
    split = padded.reshape(elements, -1, _BLOCK, degree, right)
    return np.ascontiguousarray(split.transpose(0, 1, 4, 3, 2)).ravel()


def _wrapped(items: Iterable[str]) -> Iterator[str]:
    """Items with commas, as many in a line as fit."""
    line = "   "
    for item in items:
        if len(line) + len(item) + 2 > _WIDTH:
            yield line
            line = "   "
        line += f" {item},"
    yield line
