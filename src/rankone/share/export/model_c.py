"""The solved model in C99: one source file and its header, without any dependency."""

from __future__ import annotations

import itertools
import re
import unicodedata
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rankone.share.export.packing import PackedChoice, PackedCore, PackedModel, PackedTimeline
from rankone.share.export.standalone import (
    BLOCK,
    TERMS,
    c_comment,
    c_string,
    comment,
    filled,
    scale_expressions,
    wrapped,
)
from rankone.support import __version__
from rankone.support.errors import ExportError
from rankone.support.files import Content

_GREEK = re.compile(r"GREEK (SMALL|CAPITAL) LETTER (?:\w+ )*(\w+)")


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


def words(names: Sequence[str]) -> dict[str, str]:
    """Identifiers of names, of which those that need no change keep their own."""
    words = {name: name for name in names if re.fullmatch(r"\w+", name, re.ASCII)}
    for name in (name for name in names if name not in words):
        word = c_identifier(name)
        while word in words.values():
            word += "_"
        words[name] = word
    return words


def number(x: float) -> str:
    """A float that comes back."""
    return repr(float(x))


def padded(count: int, multiple: int) -> int:
    """The next multiple."""
    return -(-count // multiple) * multiple


# -----------------------------------------------------------------------------
# Tables of the solved model in C99 about events: stretches, and which order of them holds.


_FARTHEST = 1e30  # What stands for infinity, also in single precision; the same in the template

Instants = Sequence[tuple[tuple[str, ...], Sequence[int]]]
"""Names of what happens, and for each order the border at which it does, 0 for none."""


def needs_math(model: PackedModel) -> bool:
    """Whether a model needs the library of mathematical functions."""
    return model.is_scaled or bool(model.choice and model.choice.openings)


def timeline_tables(model: PackedModel, prefix: str) -> dict[str, str]:
    """Fields of the template: the stretches between events, or nothing."""
    if model.events is None:
        return {"events": "", "in_pseudo": ""}
    timelines = model.timelines
    starts = [*itertools.accumulate((len(t.borders) for t in timelines), initial=0)]
    slabs = [*itertools.accumulate((len(b.slabs) for b in model.branches), initial=0)]
    affine = [row for timeline in timelines for row in timeline.affine_borders]
    instants = _instants(timelines)
    longest = max(timeline.stretches for timeline in timelines)
    return {
        "events": "yes",
        "in_pseudo": ", in pseudo-time",
        "branch_count": str(len(timelines)),
        "run_count": str(starts[-1]),
        "border_room": str(padded(longest + 1, BLOCK) + BLOCK),
        "affine_count": str(len(affine)),
        "affine_borders": wrapped(str(border) for border, _ in affine),
        "border_coefficients": wrapped(number(x) for _, row in affine for x in row),
        "first_slabs": wrapped(
            str(k + start)
            for start, timeline in zip(slabs, timelines, strict=False)
            for k in timeline.first_slabs
        ),
        "rounded_borders": wrapped(
            str(int(border not in dict(timeline.affine_borders)))
            for timeline in timelines
            for border in range(timeline.stretches + 1)
        ),
        "runs_of_slabs": wrapped(
            str(run + start)
            for start, timeline in zip(starts, timelines, strict=False)
            for run in timeline.runs
        ),
        "first_of_runs": ", ".join(
            str(k + start)
            for start, timeline in zip(slabs, timelines, strict=False)
            for k in timeline.first_of_runs
        ),
        "branches": "\n".join(_branches(model)),
        "instants": str(len(instants)),
        "instant_room": str(max(len(instants), 1)),
        "instant_names": ", ".join(c_string(" and ".join(names)) for names, _ in instants) or '""',
        "event_borders": wrapped(
            str(borders[k]) for k in range(len(timelines)) for _, borders in instants
        )
        if instants
        else "    0,",
        "instant_indices": _instant_indices(instants, prefix),
    }


def _instants(timelines: Sequence[PackedTimeline]) -> Instants:
    """What happens: of one order its instants, of several ones the occurrences of each name."""
    if len(timelines) == 1:
        return [(names, [i]) for i, names in enumerate(timelines[0].instants, 1)]
    every = (name for timeline in timelines for names in timeline.instants for name in names)
    instants: list[tuple[tuple[str, ...], Sequence[int]]] = []
    for name in dict.fromkeys(every):
        own = [timeline.occurrences(name) for timeline in timelines]
        for k in range(max(map(len, own))):
            borders = [1 + places[k] if k < len(places) else 0 for places in own]
            instants.append(((name,), borders))
    return instants


def _instant_indices(instants: Instants, prefix: str) -> str:
    """Positions of the times of events by name and occurrence."""
    lines: list[str] = []
    every = [name for names, _ in instants for name in names]
    for name, word in words(list(dict.fromkeys(every))).items():
        places = [i for i, (names, _) in enumerate(instants) if name in names]
        lines += [f"#define {prefix}_T_{word}_{count} {i}" for count, i in enumerate(places)]
    return "\n".join(lines)


def _branches(model: PackedModel) -> Iterator[str]:
    """The rows of the table of orders."""
    first = run = affine = root = guards = 0
    for k, timeline in enumerate(model.timelines):
        own_guards, roots = -1, 0
        if model.choice is not None:
            roots = len(model.choice.openings_of(k))
            if model.branches[k].guards is not None:
                own_guards, guards = guards, guards + 1
        numbers = (
            *(timeline.stretches, first, run, len(timeline.borders)),
            *(affine, len(timeline.affine_borders), int(timeline.terminal)),
            *(own_guards, root, roots),
        )
        yield f"    {{{', '.join(map(str, numbers))}}},"
        first, run = first + timeline.stretches + 1, run + len(timeline.borders)
        affine, root = affine + len(timeline.affine_borders), root + roots


def choice_tables(model: PackedModel, rows: Sequence[str]) -> dict[str, str]:
    """Fields of the template: which order holds, by the ``rows`` of the cores, or nothing."""
    choice = model.choice
    if choice is None:
        return {"several": "", "rooted": ""}
    guards = [branch.guards for branch in model.branches if branch.guards is not None]
    runs = [*itertools.accumulate((len(t.borders) for t in model.timelines), initial=0)]
    looks = [
        (runs[grazing.branch] + run, core)
        for grazing, cores in zip(choice.grazings, choice.heights, strict=True)
        for run, core in cores
    ]
    most = max((sum(c.tensor.shape[1] for _, c in cores) for cores in choice.heights), default=0)
    room = max((core.tensor.shape[1] for core in guards), default=1)
    return {
        "several": "yes",
        "rooted": "yes" if choice.openings else "",
        "roots": str(most_roots(model)),
        "guard_room": str(padded(room, BLOCK)),
        "fork_count": str(len(choice.forks)),
        "grazing_count": str(len(choice.grazings)),
        "look_room": str(most),
        "look_count": str(len(looks)),
        "guard_cores": _rows(rows[model.place(core)] for core in guards),
        "root_table": _rows(
            f"{o.parent}, {o.guard}, {number(o.lower)}, {number(o.upper)}"
            for k in range(len(model.branches))
            for o in choice.openings_of(k)
        ),
        "fork_table": _rows(_forks(choice)),
        "grazing_table": _rows(_grazings(choice)),
        "look_cores": _rows(rows[model.place(core)] for _, core in looks),
        "look_runs": ", ".join(str(run) for run, _ in looks) or "0",
        "width": number(choice.width),
        "tolerances": ", ".join(map(number, choice.tolerances)),
    }


def most_roots(model: PackedModel) -> int:
    """The most coordinates that an order has behind the parameters."""
    if model.choice is None:
        return 0
    return max(len(model.choice.openings_of(k)) for k in range(len(model.branches)))


def _forks(choice: PackedChoice) -> Iterator[str]:
    for fork, highest in zip(choice.forks, choice.highest, strict=True):
        guard = -1 if fork.guard is None else fork.guard
        reals = map(number, (fork.sign, fork.scale, min(highest, _FARTHEST)))
        flags = map(str, map(int, (*fork.may_be_past, fork.at_turn)))
        places = map(str, (fork.first, fork.second, fork.stretch, guard))
        yield ", ".join([*places, *reals, *flags])


def _grazings(choice: PackedChoice) -> Iterator[str]:
    part = 0
    for grazing, cores in zip(choice.grazings, choice.heights, strict=True):
        flags = map(int, (grazing.begins, grazing.ends, grazing.first))
        head = ", ".join(map(str, (grazing.branch, *flags)))
        yield f"{head}, {number(grazing.scale)}, {part}, {len(cores)}"
        part += len(cores)


def _rows(rows: Iterable[str]) -> str:
    """Rows of a table; one of zeros if there are none."""
    return "\n".join(f"    {{{row}}}," for row in rows) or "    {0},"


# -----------------------------------------------------------------------------
# The solved model in C99: one source file and its header, without any dependency.
#
# A core is contracted block by block: eight rows of the left rank together, padded with zeros. The
# coefficients stand in the order in which they are used. For each polynomial a block stores the
# right rank up to its last entry that is not zero. Cores that several slabs share are stored once.


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
        "most_rows": str(max(padded(max(left, right), BLOCK) for _, left, _, right in shapes)),
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
    entries = np.zeros((padded(left, BLOCK), degree, padded(right, _PAIR)))
    entries[:left, :, :right] = tensor
    for block in entries.reshape(-1, BLOCK, degree, entries.shape[2]):
        for polynomial in block.transpose(1, 2, 0):
            used = np.flatnonzero(polynomial.any(axis=1))
            run = padded(int(used[-1]) + 1, _PAIR) if used.size else 0
            yield run, polynomial[:run].ravel().tolist()
