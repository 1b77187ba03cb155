"""The solved model in C99: one source file and its header, without any dependency.

A core is contracted block by block: eight rows of the left rank together, padded with zeros. The
coefficients stand in the order in which they are used. For each polynomial a block stores the right
rank up to its last entry that is not zero. Cores that several slabs share are stored once.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rankone.export.c_names import c_identifier, number, padded, words
from rankone.export.model_c_events import (
    choice_tables,
    most_roots,
    needs_math,
    timeline_tables,
)
from rankone.export.packed import PackedCore, PackedModel
from rankone.export.scales import scale_expressions
from rankone.export.templates import TERMS, c_comment, c_string, comment, filled, wrapped
from rankone.support import __version__
from rankone.support.errors import ExportError
from rankone.support.files import Content

_BLOCK = 8  # Rows of a core contracted together; the same in the template
_NO_ROOT = PackedCore(0.0, 0.0, np.ones((1, 1, 1, 1)))  # In place of a coordinate that is none
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
        "lower": ", ".join(number(lower) for lower, _ in model.intervals[1:]) or "0.0",
        "upper": ", ".join(number(upper) for _, upper in model.intervals[1:]) or "0.0",
        "time_lower": number(model.intervals[0][0]),
        "time_upper": number(model.intervals[0][1]),
        "needs_math": "yes" if needs_math(model) else "",
        **_tables(model),
        **_scales(model),
        **timeline_tables(model, prefix.upper()),
    }
    evaluation = "model_slabs.c.in" if model.events is None else "model_stretches.c.in"
    fields["evaluation"] = filled(evaluation, fields)
    return {
        path: filled("model.c.in", fields),
        path.with_suffix(".h"): filled("model.h.in", fields),
    }


def _indices(model: PackedModel, prefix: str) -> str:
    """Positions of parameters and unknowns by name."""
    lines = []
    for group, names in (("P", model.coordinates[1:]), ("U", model.unknowns)):
        word = words(names)
        lines += [f"#define {prefix}_{group}_{word[name]} {k}" for k, name in enumerate(names)]
    return "\n".join(lines)


def _tables(model: PackedModel) -> dict[str, str]:
    """The layout of the cores, their coefficients, and the sizes of the work arrays."""
    rows: list[str] = []
    places: list[str] = []
    pieces: list[str] = []
    runs: list[int] = []
    coefficients: list[float] = []
    roots = most_roots(model)
    cores = [*model.cores, *([_NO_ROOT] if roots else [])]
    unequal = any(core.edges for core in cores)
    for core in cores:
        elements, left, degree, right = core.tensor.shape
        rows.append(
            f"{number(core.lower)}, {number(core.scale)}, "
            f"{elements}, {left}, {degree}, {right}, {len(pieces)}"
            + (f", {len(places) if core.edges else -1}" if unequal else "")
        )
        for lower, scale in zip(core.lowers, core.scales, strict=True):
            places.append(f"{number(lower)}, {number(scale)}")
        for tensor in core.tensor:
            pieces.append(f"{len(coefficients)}, {len(runs)}")
            for run, block in _runs(tensor):
                runs.append(run)
                coefficients += block
    shapes = [core.tensor.shape for core in cores]
    filler = [len(cores) - 1] * roots  # for orders without roots
    width = len(model.coordinates) + roots
    slabs = [
        [*slab, *filler][:width] for branch in model.branches for slab in model.slabs_of(branch)
    ]
    return {
        "slabs": str(len(slabs)),
        "starts": wrapped(number(start) for branch in model.branches for start in branch.starts),
        "cores": "\n".join(f"    {{{rows[k]}}}," for slab in slabs for k in slab),
        "border_cores": "\n".join(
            f"    {{{rows[k]}}}," for branch in model.branches for k in model.borders_of(branch)
        ),
        **choice_tables(model, rows),
        "equal": "" if unequal else "yes",
        "unequal": "yes" if unequal else "",
        "places": wrapped(f"{{{place}}}" for place in places),
        "pieces": wrapped(f"{{{piece}}}" for piece in pieces),
        "runs": wrapped(map(str, runs)),
        "coefficients": wrapped(map(repr, coefficients or [0.0])),
        "most_rows": str(max(padded(max(left, right), _BLOCK) for _, left, _, right in shapes)),
        "most_polynomials": str(max(degree for _, _, degree, _ in shapes)),
        "most_products": str(max(degree * padded(right, _LANES) for *_, degree, right in shapes)),
    }


def _scales(model: PackedModel) -> dict[str, str]:
    """Expressions of the coordinates that have a scale, by case, or nothing."""
    expressions = [
        (j, *scale_expressions(scale))
        for j, scale in enumerate(model.scales)
        if not scale.is_identity
    ]
    return {
        "scaled": "yes" if expressions else "",
        "coordinate_cases": "\n".join(
            f"    case {j}:\n        return {s};" for j, s, _ in expressions
        ),
        "slope_cases": "\n".join(f"    case {j}:\n        return {g};" for j, _, g in expressions),
    }


def _runs(tensor: NDArray[np.float64]) -> Iterator[tuple[int, list[float]]]:
    """For each block of rows and each polynomial the length of its run, and the coefficients.

    ``tensor`` is (left, degree, right); the coefficients are in the order (right, row).
    """
    left, degree, right = tensor.shape
    entries = np.zeros((padded(left, _BLOCK), degree, padded(right, _PAIR)))
    entries[:left, :, :right] = tensor
    for block in entries.reshape(-1, _BLOCK, degree, entries.shape[2]):
        for polynomial in block.transpose(1, 2, 0):
            used = np.flatnonzero(polynomial.any(axis=1))
            run = padded(int(used[-1]) + 1, _PAIR) if used.size else 0
            yield run, polynomial[:run].ravel().tolist()
