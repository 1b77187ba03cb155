"""Exported fields: the solved model of the coefficients, and beside it their modes.

The model of the coefficients is written as that of any solution. A second file, ``NAME_fields``,
has the modes and one function that multiplies: what the model gives goes in, entries come out. In
Python and JavaScript the modes are base64 of little-endian float64, entry by entry, in C they are
the numbers themselves.
"""

from __future__ import annotations

import base64
import textwrap
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from os import PathLike
from pathlib import Path

import numpy as np

from rankone.share.export.model_c import c_identifier
from rankone.share.export.standalone import LINE
from rankone.solvers.reduced.field_modes import FieldModes
from rankone.support.errors import ExportError, quote
from rankone.support.files import Content, as_path


@dataclass(frozen=True)
class FieldModel:
    """Modes as exported files say them: the ``stem`` is the name of the model beside them.

    ``remarks`` are sentences for readers, such as which error was measured.
    """

    stem: str
    modes: FieldModes
    remarks: tuple[str, ...]

    @property
    def blocks(self) -> list[tuple[str, int, int]]:
        """The name of each unknown, and its numbers of entries and coefficients."""
        triples = zip(self.modes.unknowns, self.modes.modes, strict=True)
        return [(unknown.name, *modes.shape) for unknown, modes in triples]

    def head(self, suffix: str) -> list[str]:
        """What readers of a file see first."""
        return [
            f"Fields of the solved model in {self.stem}{suffix}: modes times coefficients.",
            "",
            *textwrap.wrap(" ".join(self.remarks), LINE),
            "On rankone's part this file may be used, changed and passed on without restriction.",
            "",
            *(f"    {name}: {rows} entries, {count} modes" for name, rows, count in self.blocks),
        ]


def field_files(
    path: str | PathLike[str], modes: FieldModes, remarks: tuple[str, ...]
) -> dict[Path, Content]:
    """The files with the modes beside a model of the coefficients at a path.

    An ExportError where such a model has no functions.
    """
    target = as_path(path, ExportError)
    if target.suffix not in _WRITERS:
        raise ExportError(
            f"`{target}` would hold a whole field, which is for {', '.join(_WRITERS)} alone",
            term=target,
            remedy="export the outputs that you need: "
            'solution.output({"tip": solution[u][3], "mean": rankone.apply(row, u)}).export(path)',
        )
    for unknown in modes.unknowns:
        if not unknown.name.isprintable() or {*unknown.name} & {*'"\\/*'}:
            raise ExportError(
                f"the name {quote(unknown.name)} cannot be written to a program",
                term=unknown.name,
                remedy="give the field a name of letters and digits",
            )
    companion = target.with_name(f"{target.stem}_fields{target.suffix}")
    return _WRITERS[target.suffix](FieldModel(target.stem, modes, remarks), companion)


def _python(model: FieldModel, path: Path) -> dict[Path, Content]:
    """A module with ``fields`` and ``field``."""
    lines = [
        '"""' + model.head(".py")[0],
        *model.head(".py")[1:],
        "",
        f"    >>> from {model.stem} import value",
        f"    >>> from {path.stem} import field, fields",
        "    >>> fields(value(t=..., ...))  # all entries",
        '"""',
        "",
        "import base64",
        "",
        "import numpy as np",
        "",
        f"BLOCKS = {[*model.blocks]!r}",
        '"""Name, entries and coefficients of each unknown, in their order."""',
        "",
        "",
        "def fields(coefficients):",
        '    """All entries (N, ...) of the coefficients (R, ...) that the model gives."""',
        "    names = [name for name, _, _ in BLOCKS]",
        "    return np.concatenate([field(name, coefficients) for name in names])",
        "",
        "",
        "def field(name, coefficients):",
        '    """The entries (n, ...) of one unknown."""',
        "    coefficients, first = np.asarray(coefficients, dtype=float), 0",
        "    for other, _, count in BLOCKS:",
        "        if other == name:",
        "            own = coefficients[first : first + count]",
        "            return np.tensordot(MODES[name], own, axes=1)",
        "        first += count",
        "    raise KeyError(name)",
        "",
        "",
        "_ENCODED = {",
    ]
    for (name, _, _), text in zip(model.blocks, _encoded(model), strict=True):
        lines += [f'    {name!r}: """', *text, '    """,']
    lines += [
        "}",
        "MODES = {",
        '    name: np.frombuffer(base64.b64decode(_ENCODED[name]), "<f8").reshape(rows, count)',
        "    for name, rows, count in BLOCKS",
        "}",
        '"""The modes (n, r) of each unknown."""',
    ]
    return {path: "\n".join(lines) + "\n"}


def _javascript(model: FieldModel, path: Path) -> dict[Path, Content]:
    """A module with ``fields``."""
    blocks = ", ".join(
        f'{{ name: "{name}", entries: {rows}, coefficients: {count} }}'
        for name, rows, count in model.blocks
    )
    lines = [
        "/**",
        *(f" * {line}".rstrip() for line in model.head(path.suffix)),
        " */",
        "",
        "/** Name, entries and coefficients of each unknown, in their order. */",
        f"export const blocks = Object.freeze([{blocks}]);",
        "",
        "/** All entries, of the coefficients that `evaluate` of the model gives. */",
        "export function fields(coefficients, out) {",
        "    const size = blocks.reduce((sum, block) => sum + block.entries, 0);",
        "    const entries = out ?? new Float64Array(size);",
        "    let row = 0;",
        "    let first = 0;",
        "    blocks.forEach((block, k) => {",
        "        for (let i = 0; i < block.entries; i++) {",
        "            let sum = 0;",
        "            const begin = i * block.coefficients;",
        "            for (let j = 0; j < block.coefficients; j++) {",
        "                sum += modes[k][begin + j] * coefficients[first + j];",
        "            }",
        "            entries[row++] = sum;",
        "        }",
        "        first += block.coefficients;",
        "    });",
        "    return entries;",
        "}",
        "",
        "function decoded(text) {",
        "    const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));",
        "    const view = new DataView(bytes.buffer);",
        "    const count = bytes.length / 8;",
        "    return Float64Array.from({ length: count }, (_, i) => view.getFloat64(8 * i, true));",
        "}",
        "",
        "/** The modes of each unknown, entry by entry. */",
        "export const modes = [",
    ]
    for text in _encoded(model):
        lines += ["    decoded(`", *text, "    `),"]
    lines += ["];"]
    return {path: "\n".join(lines) + "\n"}


def _c(model: FieldModel, path: Path) -> dict[Path, Content]:
    """A source with the modes, and its header."""
    prefix = c_identifier(model.stem)
    capital, size = prefix.upper(), sum(rows for _, rows, _ in model.blocks)
    header, real = path.with_suffix(".h"), f"{prefix}_real"
    first, *others = model.head(".c")
    about = [f"/* {first}", *(f" * {line}".rstrip() for line in others), " */"]
    declared = f"void {prefix}_fields(const {real} *coefficients, {real} *entries)"
    top = [
        *about,
        f"#ifndef {capital}_FIELDS_H",
        f"#define {capital}_FIELDS_H",
        "",
        f'#include "{model.stem}.h"',
        "",
        f"#define {capital}_ENTRIES {size}",
        "",
        "#ifdef __cplusplus",
        'extern "C" {',
        "#endif",
        "",
        f"/* All {size} entries, of the coefficients that {prefix}_eval gives. */",
        f"{declared};",
        "",
        "#ifdef __cplusplus",
        "}",
        "#endif",
        "#endif",
    ]
    source = [*about, f'#include "{header.name}"', ""]
    body = [f"{declared} {{", "    int i, j;"]
    for k, ((_, rows, count), own) in enumerate(zip(model.blocks, model.modes.modes, strict=True)):
        numbers = textwrap.wrap(", ".join(repr(x) for x in own.ravel().tolist()), LINE)
        source += [f"static const {real} modes_{k}[{rows * count}] = {{", *numbers, "};", ""]
        body += [
            f"    for (i = 0; i < {rows}; i++) {{",
            f"        {real} sum = 0;",
            f"        for (j = 0; j < {count}; j++) {{",
            f"            sum += modes_{k}[i * {count} + j] * coefficients[j];",
            "        }",
            "        *entries++ = sum;",
            "    }",
            f"    coefficients += {count};",
        ]
    source += [*body, "}"]
    return {path: "\n".join(source) + "\n", header: "\n".join(top) + "\n"}


def _encoded(model: FieldModel) -> list[list[str]]:
    """The modes of each unknown in base64, in lines."""
    texts = (
        base64.b64encode(np.ascontiguousarray(own, dtype="<f8").tobytes()).decode()
        for own in model.modes.modes
    )
    return [[text[k : k + LINE] for k in range(0, len(text), LINE)] for text in texts]


_WRITERS: Mapping[str, Callable[[FieldModel, Path], dict[Path, Content]]] = {
    ".py": _python,
    ".c": _c,
    ".js": _javascript,
    ".mjs": _javascript,
}
