"""The solved model in C99: one source file and its header, without any dependency.

A core is contracted block by block: eight rows of the left rank together, padded with zeros. The
coefficients stand in the order in which they are used. For each polynomial a block stores the right
rank up to its last entry that is not zero. Cores that several slabs share are stored once.
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rankone.export.packed import PackedModel, PackedTimeline
from rankone.export.scales import scale_expressions
from rankone.export.templates import TERMS, c_comment, c_string, comment, filled, wrapped
from rankone.support import __version__
from rankone.support.errors import ExportError
from rankone.support.files import Content

_GREEK = re.compile(r"GREEK (SMALL|CAPITAL) LETTER (?:\w+ )*(\w+)")
_BLOCK = 8  # Rows of a core contracted together; the same in the template
_LANES = 4  # Products are padded to a multiple of it, to be vectorized; the same in the template
_PAIR = 2  # Runs are padded to a multiple of it, because the template unrolls by it


def c_model(model: PackedModel, path: Path) -> dict[Path, Content]:
    """Source and header of a model; the names start with the stem of the path of the source."""
    stem = path.stem
    if not stem.isprintable() or {*stem} & {*'"\\'} or "??" in stem:
        raise ExportError(
            f"`{path}` cannot be included: `{stem}` has quotes, backslashes, `??` or characters "
            "that cannot be printed",
            term=path,
            remedy="choose another name",
        )
    prefix = c_identifier(path.stem)
    fields = {
        "prefix": prefix,
        "PREFIX": prefix.upper(),
        "header": path.with_suffix(".h").name,
        "source": path.name,
        "version": __version__,
        "terms": TERMS,
        "summary": comment(model.summary, c_comment),
        "unknowns": str(len(model.unknowns)),
        "parameters": str(len(model.coordinates) - 1),
        "room": str(max(len(model.coordinates) - 1, 1)),
        "unknown_list": c_comment(", ".join(model.unknowns)),
        "indices": _indices(model, prefix.upper()),
        "unknown_names": ", ".join(map(c_string, model.unknowns)),
        "parameter_names": ", ".join(map(c_string, model.coordinates[1:] or ("",))),
        "lower": ", ".join(_number(lower) for lower, _ in model.intervals[1:]) or "0.0",
        "upper": ", ".join(_number(upper) for _, upper in model.intervals[1:]) or "0.0",
        "time_lower": _number(model.intervals[0][0]),
        "time_upper": _number(model.intervals[0][1]),
        **_tables(model),
        **_scales(model),
        **_timeline(model, prefix.upper()),
    }
    evaluation = "model_slabs.c.in" if model.events is None else "model_stretches.c.in"
    fields["evaluation"] = filled(evaluation, fields)
    return {
        path: filled("model.c.in", fields),
        path.with_suffix(".h"): filled("model.h.in", fields),
    }


def c_identifier(name: str) -> str:
    """A C identifier that resembles a name: ``x_{0}`` becomes ``x_0``, ``2a`` becomes ``_2a``.

    Letters lose their accents, Greek ones are spelled out; other characters become underscores.
    """
    plain = unicodedata.normalize("NFKD", name).replace("'", "_prime")
    letters = (_latin(letter) for letter in plain if not unicodedata.combining(letter))
    text = re.sub(r"_*[^A-Za-z0-9_]+_*", "_", "".join(letters)).rstrip("_") or "model"
    return f"_{text}" if text[0].isdigit() else text


def _latin(letter: str) -> str:
    """The name of a Greek letter, any other character as it is."""
    match = _GREEK.fullmatch(unicodedata.name(letter, ""))
    if match is None:
        return letter
    word = match[2].lower().replace("lamda", "lambda")
    return word.capitalize() if match[1] == "CAPITAL" else word


def _indices(model: PackedModel, prefix: str) -> str:
    """Positions of parameters and unknowns by name."""
    lines = []
    for group, names in (("P", model.coordinates[1:]), ("U", model.unknowns)):
        words = _words(names)
        lines += [f"#define {prefix}_{group}_{words[name]} {k}" for k, name in enumerate(names)]
    return "\n".join(lines)


def _words(names: Sequence[str]) -> dict[str, str]:
    """Identifiers of names, of which those that need no change keep their own."""
    words = {name: name for name in names if re.fullmatch(r"\w+", name, re.ASCII)}
    for name in (name for name in names if name not in words):
        word = c_identifier(name)
        while word in words.values():
            word += "_"
        words[name] = word
    return words


def _timeline(model: PackedModel, prefix: str) -> dict[str, str]:
    """The tables of the stretches between events, or nothing."""
    timeline = model.single.timeline
    if timeline is None:
        return {"events": "", "in_pseudo": ""}
    affine = dict(timeline.affine_borders)
    names = [c_string(" and ".join(instant)) for instant in timeline.instants]
    return {
        "events": "yes",
        "in_pseudo": ", in pseudo-time",
        "stretches": str(timeline.stretches),
        "run_count": str(len(timeline.borders)),
        "border_room": str(_padded(timeline.stretches + 1, _BLOCK) + _BLOCK),
        "affine_count": str(len(affine)),
        "affine_borders": wrapped(map(str, affine)),
        "border_coefficients": wrapped(_number(x) for row in affine.values() for x in row),
        "terminal": str(int(timeline.terminal)),
        "first_slabs": wrapped(map(str, timeline.first_slabs)),
        "runs_of_slabs": wrapped(map(str, timeline.runs)),
        "first_of_runs": ", ".join(map(str, timeline.first_of_runs)),
        "instants": str(len(timeline.instants)),
        "instant_room": str(max(len(names), 1)),
        "instant_names": ", ".join(names or ['""']),
        "instant_indices": _instant_indices(timeline, prefix),
    }


def _instant_indices(timeline: PackedTimeline, prefix: str) -> str:
    """Positions of the times of events by name and occurrence."""
    names = list(dict.fromkeys(name for instant in timeline.instants for name in instant))
    lines: list[str] = []
    for name, word in _words(names).items():
        for count, i in enumerate(timeline.occurrences(name)):
            lines.append(f"#define {prefix}_T_{word}_{count} {i}")
    return "\n".join(lines)


def _number(x: float) -> str:
    return repr(float(x))


def _tables(model: PackedModel) -> dict[str, str]:
    """The layout of the cores, their coefficients, and the sizes of the work arrays."""
    rows: list[str] = []
    places: list[str] = []
    pieces: list[str] = []
    runs: list[int] = []
    coefficients: list[float] = []
    cores, branch = model.cores, model.single
    unequal = any(core.edges for core in cores)
    for core in cores:
        elements, left, degree, right = core.tensor.shape
        rows.append(
            f"{_number(core.lower)}, {_number(core.scale)}, "
            f"{elements}, {left}, {degree}, {right}, {len(pieces)}"
            + (f", {len(places) if core.edges else -1}" if unequal else "")
        )
        for lower, scale in zip(core.lowers, core.scales, strict=True):
            places.append(f"{_number(lower)}, {_number(scale)}")
        for tensor in core.tensor:
            pieces.append(f"{len(coefficients)}, {len(runs)}")
            for run, block in _runs(tensor):
                runs.append(run)
                coefficients += block
    shapes = [core.tensor.shape for core in cores]
    return {
        "slabs": str(len(branch.slabs)),
        "starts": wrapped(map(_number, branch.starts)),
        "cores": "\n".join(f"    {{{rows[k]}}}," for slab in model.slabs_of(branch) for k in slab),
        "border_cores": "\n".join(f"    {{{rows[k]}}}," for k in model.borders_of(branch)),
        "equal": "" if unequal else "yes",
        "unequal": "yes" if unequal else "",
        "places": wrapped(f"{{{place}}}" for place in places),
        "pieces": wrapped(f"{{{piece}}}" for piece in pieces),
        "runs": wrapped(map(str, runs)),
        "coefficients": wrapped(map(repr, coefficients or [0.0])),
        "most_rows": str(max(_padded(max(left, right), _BLOCK) for _, left, _, right in shapes)),
        "most_polynomials": str(max(degree for _, _, degree, _ in shapes)),
        "most_products": str(max(degree * _padded(right, _LANES) for *_, degree, right in shapes)),
    }


def _scales(model: PackedModel) -> dict[str, str]:
    """Expressions of the coordinates that have a scale, by case, or nothing."""
    expressions = [
        (j, *scale_expressions(scale))
        for j, scale in enumerate(model.single.scales)
        if not scale.is_identity
    ]
    return {
        "scaled": "yes" if expressions else "",
        "coordinate_cases": "\n".join(
            f"    case {j}:\n        return {s};" for j, s, _ in expressions
        ),
        "slope_cases": "\n".join(f"    case {j}:\n        return {g};" for j, _, g in expressions),
    }


def _padded(count: int, multiple: int) -> int:
    return -(-count // multiple) * multiple


def _runs(tensor: NDArray[np.float64]) -> Iterator[tuple[int, list[float]]]:
    """For each block of rows and each polynomial the length of its run, and the coefficients.

    ``tensor`` is (left, degree, right); the coefficients are in the order (right, row).
    """
    left, degree, right = tensor.shape
    padded = np.zeros((_padded(left, _BLOCK), degree, _padded(right, _PAIR)))
    padded[:left, :, :right] = tensor
    for block in padded.reshape(-1, _BLOCK, degree, padded.shape[2]):
        for polynomial in block.transpose(1, 2, 0):
            used = np.flatnonzero(polynomial.any(axis=1))
            run = _padded(int(used[-1]) + 1, _PAIR) if used.size else 0
            yield run, polynomial[:run].ravel().tolist()
