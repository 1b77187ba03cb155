"""The page that explores fields: pictures of them beside the sliders.

The page has the solved model of the coefficients, and the modes in single precision: a picture is
one product of modes and coefficients.
"""

from __future__ import annotations

import base64
import html
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rankone.share.export.explorer import curve_times, lead
from rankone.share.export.field_layout import Layout, Mesh, index_line
from rankone.share.export.mathml import Notation
from rankone.share.export.packing import PackedModel, pack
from rankone.share.export.pages import (
    asked_for,
    equation_fields,
    error_fields,
    heading,
    named,
    over_box,
    page_target,
    page_text,
    paragraphs,
    parameter_entries,
    unbroken,
    unknown_entries,
)
from rankone.solution.solution import Solution
from rankone.solvers.outcome import Role
from rankone.solvers.reduced.field_modes import FieldModes
from rankone.support.arrays import AT_ONCE, SAMPLES, SEED, Array, corners, spread
from rankone.support.errors import ExportError
from rankone.support.files import write_files

if TYPE_CHECKING:
    from rankone.solution.fields.field_core import FieldCore

_SCRIPTS = (
    *("values", "looks", "events", "legend", "curves", "palette", "raster", "controls", "state"),
    *("frames", "fields", "picture", "moves", "field_main"),
)


def export_field_page(
    solution: FieldCore,
    path: str | PathLike[str],
    layout: Layout | None,
    *,
    title: str | None = None,
    rtol: float | None = None,
    overwrite: bool = False,
    allow_failed: bool = False,
) -> Path:
    """What :meth:`FieldSolution.explore` does, with the layout of its entries."""
    target = page_target(path, overwrite)
    title = heading(title, solution.metadata, target)
    if not (solution.success or allow_failed):
        raise ExportError(
            f"the fields are not a success: {solution.message}",
            remedy="solve them to the tolerance, or give allow_failed=True",
        )
    if solution.metadata.timeless:
        raise ExportError(
            "these fields do not depend on time, and a page shows them over time",
            remedy="write a model of them: solution.export(path)",
        )
    model = pack(solution.coefficients, rtol=rtol, allow_failed=True)
    notation = Notation(solution.metadata)
    page = FieldPage(solution, model, layout, notation)
    data = page.content()
    lines = page.sentences()
    fields = {
        "title": html.escape(title),
        "lead": html.escape(lead({**data, "unknowns": data["fields"] + data["unknowns"]})),
        "success": "yes" if solution.success else "",
        "covers": f"({asked_for(solution.rtol, rtol)})" if solution.modes.errors else "",
        "message": html.escape(lines[0]),
        "quality": paragraphs(lines),
        **error_fields(data["fields"] + data["unknowns"]),
        **equation_fields(notation),
        "several": "yes" if len(data["pictures"]) > 1 else "",
        "unknowns": "yes" if data["unknowns"] else "",
        "bands": _bands(data["parameters"]),
        "sampled": f"{data['sampled']:,}",
    }
    text = page_text("field.html.in", _SCRIPTS, data, model, fields)
    write_files({target: text}, overwrite, ExportError)
    return target


@dataclass(frozen=True, eq=False)
class FieldPage:
    """What a page of fields shows: the model of their coefficients, and where entries are."""

    solution: FieldCore
    model: PackedModel
    layout: Layout | None
    notation: Notation

    def content(self) -> dict[str, Any]:
        """Names, modes, layouts, ranges of values, and curves of the ordinary unknowns."""
        solution, modes, notation = self.solution, self.solution.modes, self.notation
        metadata, units = solution.metadata, dict(solution.metadata.units)
        sample = BoxSample.of(solution.coefficients, modes)
        layouts, pictures = self._layouts(sample)
        times = curve_times(solution.coefficients)
        return {
            "fields": [
                {
                    **named(unknown.name, notation, units),
                    "error": self._errors[unknown.name],
                    "first": modes.coefficients_of(k).start,
                    "entries": unknown.size,
                    "modes": _encoded(modes.modes[k]),
                }
                for k, unknown in enumerate(modes.unknowns)
                if unknown.is_field
            ],
            "unknowns": self._ordinary(times),
            "parameters": parameter_entries(metadata, notation),
            "time": {
                **named(metadata.time, notation, units),
                "range": [float(end) for end in solution.time],
                "start": self._opening_time(times),
            },
            "times": times.tolist(),
            "layouts": layouts,
            "pictures": pictures,
            "sampled": sample.size,
        }

    def _ordinary(self, times: Array) -> list[dict[str, Any]]:
        """Curves of the unknowns that are no fields, and their rows in the model."""
        unknowns, solved = self.solution.modes.unknowns, self.solution.coefficients
        rows = {
            unknown.name: self.solution.modes.coefficients_of(k).start
            for k, unknown in enumerate(unknowns)
            if not unknown.is_field
        }
        if not rows:
            return []
        roles = [Role.UNKNOWN if name in rows else Role.AUXILIARY for name in solved.states]
        ordinary = Solution(solved.outcome, replace(solved.metadata, roles=tuple(roles)))
        entries = unknown_entries(ordinary, over_box(ordinary, times), self._errors, self.notation)
        return [{**entry, "row": rows[entry["name"]]} for entry in entries]

    def _opening_time(self, times: Array) -> float:
        """The time at which the fields vary most over the box; the beginning where none does.

        Modes are orthonormal in the mean, so that the variances of the coefficients add up to the
        mean variance of the entries.
        """
        solved, modes = self.solution.coefficients, self.solution.modes
        variances = solved.var(times)
        total = np.zeros(len(times))
        for k, scale in enumerate(modes.scales):
            if scale > 0.0:
                total += variances[modes.coefficients_of(k)].sum(axis=0) / scale / scale
        return float(times[int(np.argmax(total))])

    def _layouts(self, sample: BoxSample) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
        """Where entries are, and the pictures drawn there: each field, and how far a body moves.

        Fields that the layout does not fit are lines over the index of their entries.
        """
        modes = self.solution.modes
        layouts: list[dict[str, Any]] = []
        pictures: list[dict[str, Any]] = []
        if self.layout is not None:
            layouts.append(self.layout.content)
        if isinstance(self.layout, Mesh):
            layouts[0]["extents"] = sample.extents(self.layout)
            if self.layout.displacement:
                moved, longest = self.layout.displacement[0].name, sample.longest(self.layout)
                shown = {"text": "displacement", "field": None, "layout": 0}
                pictures.append({**self._shown(moved, [0.0, longest]), **shown})
        fields = [k for k, unknown in enumerate(modes.unknowns) if unknown.is_field]
        for position, k in enumerate(fields):
            name, size = modes.unknowns[k].name, modes.unknowns[k].size
            fits = self.layout is not None and self.layout.size == size
            if not fits:
                layouts.append(index_line(size).content)
            place = {"field": position, "layout": 0 if fits else len(layouts) - 1}
            pictures.append({**self._shown(name, sample.range_of(modes.modes[k], k)), **place})
        return layouts, sorted(pictures, key=lambda picture: picture["layout"])

    def _shown(self, name: str, values: list[float]) -> dict[str, Any]:
        """Text, unit and error of an unknown, and the range of its picture."""
        about = named(name, self.notation, dict(self.solution.metadata.units))
        about = {key: about[key] for key in ("text", "unit")}
        return {**about, "error": self._errors[name], "range": values}

    @property
    def _errors(self) -> dict[str, float | None]:
        """Measured errors by name, None of what was not measured."""
        return {name: None if np.isnan(e) else e for name, e in self.solution.errors.items()}

    def sentences(self) -> list[str]:
        """How the solve ended, and how good fields and pictures are."""
        solution = self.solution
        lines = [f"{solution.message[:1].upper()}{solution.message[1:]}".rstrip(".") + "."]
        if solution.modes.errors:
            lines.append(
                "The error was measured on full trajectories that no mode was made of, at all "
                "entries, relative to the largest value of each field; the tolerance asked for is "
                f"{solution.rtol:.3g}."
            )
        else:
            lines.append("The error of these fields is not known: it was not measured.")
        if self.model.reduction is not None:
            lines.append(f"{self.model.reduction} That is about the coefficients of the modes.")
        lines.append(
            "Modes are in the page in single precision, which changes values by some 1e-7 of the "
            "largest one."
        )
        return unbroken(lines)


@dataclass(frozen=True, eq=False)
class BoxSample:
    """Coefficients (R, m) at times and at corners and inner points of the box."""

    modes: FieldModes
    coefficients: Array

    @classmethod
    def of(cls, solved: Solution, modes: FieldModes) -> BoxSample:
        """Evaluate them; the same points each time."""
        d, generator = len(solved.metadata.parameters), np.random.default_rng(SEED)
        shares = np.concatenate([corners(d, SAMPLES, generator), spread(SAMPLES, d, generator)])
        ends = np.array(solved.metadata.box, dtype=float).reshape(d, 2)
        points = ends[:, :1] * (1.0 - shares.T) + ends[:, 1:] * shares.T
        times = np.linspace(*solved.time, SAMPLES)
        at = {solved.metadata.time: times[:, None]} if d else {solved.metadata.time: times}
        for name, axis in zip(solved.metadata.parameters, points, strict=True):
            at[name] = axis[None, :]
        values = solved(at)
        return cls(modes, values.reshape(len(values), -1))

    @property
    def size(self) -> int:
        """Number of points."""
        return len(self.coefficients.T)

    def values(self, *weights: tuple[Array, slice]) -> Iterator[tuple[Array, ...]]:
        """Entries (n, ...) of weights (n, r), which multiply their own coefficients, in blocks."""
        step = max(1, AT_ONCE // max(len(rows) for rows, _ in weights))
        for start in range(0, self.size, step):
            block = self.coefficients[:, start : start + step]
            yield tuple(rows @ block[own] for rows, own in weights)

    def range_of(self, modes: Array, unknown: int) -> list[float]:
        """The smallest and the largest value of a field."""
        return _bounds(x for (x,) in self.values((modes, self.modes.coefficients_of(unknown))))

    def longest(self, mesh: Mesh) -> float:
        """The largest length of a displacement."""
        weights = ((view.weights, view.own) for view in mesh.displacement)
        return max(float(np.hypot(*moves).max()) for moves in self.values(*weights))

    def extents(self, mesh: Mesh) -> list[list[float]]:
        """Between which numbers x and y of the places are, wherever they move to."""
        if not mesh.displacement:
            return [_bounds([axis]) for axis in mesh.places.T]
        return [
            _bounds(axis[:, None] + move for (move,) in self.values((view.weights, view.own)))
            for axis, view in zip(mesh.places.T, mesh.displacement, strict=True)
        ]


def _bands(parameters: Sequence[Mapping[str, Any]]) -> str:
    """What bands around the curves of ordinary unknowns are."""
    if not parameters:
        return ""
    distributed = any(parameter["distribution"] for parameter in parameters)
    spread_over = "under their distributions" if distributed else "over their ranges"
    return f"Bands: 95 % of the values, for parameters spread {spread_over}."


def _bounds(blocks: Sequence[Array] | Iterator[Array]) -> list[float]:
    """The smallest and the largest of all numbers."""
    ends = [(float(block.min()), float(block.max())) for block in blocks]
    return [min(low for low, _ in ends), max(high for _, high in ends)]


def _encoded(modes: Array) -> str:
    """Numbers as base64 of little-endian float32, row by row."""
    return base64.b64encode(np.ascontiguousarray(modes, dtype="<f4").tobytes()).decode()
