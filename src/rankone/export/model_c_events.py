"""Tables of the solved model in C99 about events: stretches, and which order of them holds."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Sequence

from rankone.export.c_names import number, padded, words
from rankone.export.packed import PackedChoice, PackedModel, PackedTimeline
from rankone.export.templates import c_string, wrapped

_BLOCK = 8  # Rows of a core contracted together; the same in the template
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
        "border_room": str(padded(longest + 1, _BLOCK) + _BLOCK),
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
        "guard_room": str(padded(room, _BLOCK)),
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
