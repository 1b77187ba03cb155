"""The solved model in Python: evaluation and derivatives with NumPy alone."""

from __future__ import annotations

import base64
import re
import textwrap
from dataclasses import astuple
from inspect import getsource
from pathlib import Path

import numpy as np

from rankone.compiler.codegen.layout import (
    Names,
    Nested,
    docstring,
    is_identifier,
    literal,
    nested,
    paragraph,
    quoted,
    table,
)
from rankone.share.export.packing import PackedChoice, PackedModel
from rankone.share.export.standalone import TERMS, banner, source_text
from rankone.support import __version__
from rankone.support.files import WIDTH, Content, npz
from rankone.tensors.coordinates import round_off

_LONGEST_DATA = 200_000  # Characters of coefficients in the file: editors open it at once


def python_model(model: PackedModel, path: Path) -> dict[Path, Content]:
    """The files of a model: the module and, when there are many coefficients, an .npz beside it."""
    coefficients = np.concatenate([core.tensor.ravel() for core in model.cores])
    text = base64.b64encode(coefficients.astype("<f8").tobytes()).decode()
    files: dict[Path, Content] = {}
    end = [*_construction(model), *_END, *_event_end(model)]
    if len(text) <= _LONGEST_DATA:
        imports = _imports(model, "import base64")
        rows = textwrap.wrap(text, WIDTH)
        data = ['DATA = """', *rows, '"""', "", _LOAD_TEXT]
    else:
        imports = _imports(model, "from pathlib import Path")
        files[path.with_suffix(".npz")] = npz({"coefficients": coefficients.astype("<f8")})
        data = _LOAD_FILE
    blocks = [
        "\n".join([*docstring(_head(model, path), indent=""), imports, *_tables(model)]),
        f"{banner('Evaluation')}\n\nArray = NDArray[np.float64]",
        getsource(round_off).strip(),
        *(_IMPORT.split(source_text(name))[-1].strip() for name in _program(model)),
        "\n".join([banner("Coefficients"), "", *data, "", *end]),
    ]
    return {path: "\n\n\n".join(blocks) + "\n", **files}


_EXPORT = "rankone.share.export.model_"
_IMPORT = re.compile(r"^from rankone\..*\n", re.M)  # The last imports of a module


def _program(model: PackedModel) -> list[str]:
    """The modules of the library whose text evaluates a model."""
    modules = [f"{_EXPORT}program"]
    if model.events is not None:
        modules.append(f"{_EXPORT}stretches")
    if model.choice is not None:
        modules += ["rankone.tensors.decisions", f"{_EXPORT}branches"]
    return modules


def _event_end(model: PackedModel) -> list[str]:
    """Lines that make methods about events functions of the module."""
    if model.events is None:
        return []
    return [*_EVENT_END, *([] if model.choice is None else _BRANCH_END)]


def _imports(model: PackedModel, further: str) -> str:
    """The imports of a model, and a further one."""
    several = model.choice is not None
    imports = [
        f"from collections.abc import {'Callable, ' if several else ''}Mapping, Sequence",
        f"from typing import Any{', NamedTuple, Protocol' if several else ''}",
        further,
    ]
    # plain imports first, then by the module
    imports.sort(key=lambda line: (line.startswith("from"), line.split()[1]))
    lines = ["from __future__ import annotations", "", *imports, "", "import numpy as np"]
    return "\n".join(["", *lines, "from numpy.typing import NDArray", ""])


_LOAD_TEXT = 'COEFFICIENTS = np.frombuffer(base64.b64decode(DATA), dtype="<f8")'
_LOAD_FILE = [
    'with np.load(Path(__file__).with_suffix(".npz"), allow_pickle=False) as file:',
    '    COEFFICIENTS = file["coefficients"]',
]
_END = [
    "value = MODEL.value",
    "gradient = MODEL.gradient",
]
_EVENT_END = ["event_times = MODEL.event_times", "end = MODEL.end"]
_BRANCH_END = ["branch = MODEL.branch"]
_MODEL_TABLES = (
    *("UNKNOWNS", "COORDINATES", "KEYWORDS", "INTERVALS", "STARTS", "CORES", "SLABS"),
    "COEFFICIENTS",
)
_TIMELINE = ("STRETCHES", "RUNS", "BORDERS", "AFFINE_BORDERS", "TERMINAL", "INSTANTS", "EVENTS")
_BRANCHES = ("GUARDS", "ROOTS", "FORKS", "HIGHEST", "GRAZINGS", "HEIGHTS", "WIDTH", "TOLERANCES")


def _construction(model: PackedModel) -> list[str]:
    """Lines that make the model of its tables."""
    several = model.choice is not None
    tables = [*_MODEL_TABLES, *(["SCALES"] if model.is_scaled or several else [])]
    if model.events is not None:
        names = [*_TIMELINE, *(_BRANCHES if several else [])]
        named = [f"    {name.lower()}={name}," for name in names]
        kind = "BranchModel" if several else "EventModel"
        return [f"MODEL = {kind}(", *(f"    {name}," for name in tables), *named, ")"]
    line = f"MODEL = Model({', '.join(tables)})"
    return [line] if len(line) <= WIDTH else ["MODEL = Model(", f"    {', '.join(tables)}", ")"]


def keywords(names: tuple[str, ...]) -> tuple[str, ...]:
    """The names as Python identifiers: ``lambda`` becomes ``lambda_``, ``x_{0}`` ``x_0``."""
    kept = [name for name in names if is_identifier(name)]
    identifier = Names()
    identifier.taken -= {"l", "O", "I", "match", "case", "type", "_"}
    identifier.taken.update(kept)
    return tuple(name if name in kept else identifier(name) for name in names)


def _head(model: PackedModel, path: Path) -> list[str]:
    """Lines of the module's docstring."""
    words = keywords(model.coordinates)
    middle = [f"{0.5 * (lower + upper):g}" for lower, upper in model.intervals]
    call = ", ".join(f"{word}={x}" for word, x in zip(words, middle, strict=True))
    renamed = [
        f"`{name}` is written `{word}`."
        for name, word in zip(model.coordinates, words, strict=True)
        if name != word
    ]
    beside = [] if model.size * 4 // 3 * 8 <= _LONGEST_DATA else [f"Data: {path.stem}.npz."]
    unknowns = ", ".join(model.unknowns)
    lines = [f"Solved model of {unknowns}, for every parameter value at once.", ""]
    lines += [f"Generated by rankone {__version__}. Needs NumPy, nothing else.", TERMS, ""]
    lines += [*model.summary, *beside, *renamed, ""]
    stem = path.stem
    if is_identifier(stem):
        lines += [f"    import {stem}", ""]
    else:
        statement = f"    model = importlib.import_module({quoted(stem)})"
        stem, lines = "model", [*lines, "    import importlib", "", statement]
    lines += [f"    {stem}.value({call})", "", f"    {stem}.gradient({call})", ""]
    lines += _event_lines(model, stem, call.partition(", ")[2])
    lines += [f"The gradient is with respect to {', '.join(model.coordinates)}, in this order."]
    return [wrapped for line in lines for wrapped in paragraph(line)]


def _event_lines(model: PackedModel, stem: str, parameters: str) -> list[str]:
    """Lines of the docstring that say how to ask when events are, and what is not known."""
    lines: list[str] = []
    if model.events:
        arguments = ", ".join(filter(None, (quoted(model.events[0]), parameters)))
        lines += [
            f"    {stem}.event_times({arguments})",
            "",
            "Its rows are the occurrences; NaN is one that the horizon ends before.",
        ]
    if model.choice is not None:
        lines += [
            "The order of events changes with the parameters. Next to a change, values that depend "
            "on it are NaN, and next to where an event is just missed its times too.",
        ]
    return lines


def _tables(model: PackedModel) -> list[str]:
    """Names, intervals and the layout of the coefficients."""
    layout = tuple(
        (core.lowers, core.scales, core.tensor.shape)
        if core.edges
        else (core.lower, core.scale, core.tensor.shape)
        for core in model.cores
    )
    unequal = any(core.edges for core in model.cores)
    unequal_note = ["# (where elements are unequal, both are given for each of them)"]
    return [
        banner("The model"),
        "",
        *table("UNKNOWNS", [quoted(name) for name in model.unknowns]),
        *table("COORDINATES", [quoted(name) for name in model.coordinates]),
        *table("KEYWORDS", [quoted(name) for name in keywords(model.coordinates)]),
        *table("INTERVALS", nested(model.intervals)),
        "# of each core where its elements begin, elements per unit, and the shape (elements,",
        "# left rank, polynomials, right rank) of its coefficients",
        *(unequal_note if unequal else []),
        *table("CORES", nested(layout)),
        *_of_branches(model),
        *(_forks(model, model.choice) if model.choice else []),
    ]


def _of_branches(model: PackedModel) -> list[str]:
    """The tables of a branch; of several branches each table has one entry for each."""
    several = model.choice is not None
    rows: dict[str, list[Nested]] = {}
    for k in range(len(model.branches)):
        for name, row in _of_branch(model, k).items():
            rows.setdefault(name, []).append(row)
    lines = ["# the tables from here on have one entry for each order of events"] if several else []
    for name, entries in rows.items():
        pseudo = ", in pseudo-time" if name == "STARTS" and model.events is not None else ""
        lines += [f"{line}{pseudo}" for line in _COMMENTS[name]]
        entry = entries if several else entries[0]
        lines += [f"{name} = {entry}"] if isinstance(entry, str) else table(name, entry)
    if model.events is not None:
        lines += table("EVENTS", [quoted(name) for name in model.events])
    return lines


_COMMENTS = {
    "STARTS": ["# where each time slab begins"],
    "SLABS": ["# for each slab which cores it has, for time and for each parameter"],
    "SCALES": ["# the scale of each coordinate, in which its elements lie"],
    "STRETCHES": ["# the first slab of each stretch between events, and the number of slabs"],
    "RUNS": [
        "# the run of each slab, of those with the same cores for all parameters; and for each run",
        "# the core that makes the times of the borders of stretches",
    ],
    "BORDERS": [],
    "AFFINE_BORDERS": [
        "# the borders at affine functions of the parameters: the constant, and the slopes"
    ],
    "TERMINAL": ["# whether an event ends it all"],
    "INSTANTS": ["# the events at the end of each stretch that is met"],
    "GUARDS": ["# the core that makes what tells where a branch holds"],
    "ROOTS": ["# further coordinates: roots of a guard of another branch, and their intervals"],
}


def _of_branch(model: PackedModel, k: int) -> dict[str, Nested]:
    """The tables of branch k."""
    branch, timeline = model.branches[k], model.branches[k].timeline
    tables: dict[str, Nested] = {
        "STARTS": nested(branch.starts),
        "SLABS": nested(model.slabs_of(branch)),
    }
    if model.is_scaled or model.choice is not None:
        tables["SCALES"] = [quoted(scale.kind) for scale in branch.scales]
    if timeline is not None:
        tables |= {
            "STRETCHES": nested(timeline.first_slabs),
            "RUNS": nested(timeline.runs),
            "BORDERS": nested(model.borders_of(branch)),
            "AFFINE_BORDERS": nested(timeline.affine_borders),
            "TERMINAL": str(timeline.terminal),
            "INSTANTS": [[quoted(name) for name in instant] for instant in timeline.instants],
        }
    if model.choice is not None:
        openings = model.choice.openings_of(k)
        roots = tuple((o.parent, o.guard, o.lower, o.upper) for o in openings)
        guards = None if branch.guards is None else model.place(branch.guards)
        tables |= {"GUARDS": str(guards), "ROOTS": nested(roots)}
    return tables


def _forks(model: PackedModel, choice: PackedChoice) -> list[str]:
    """The tables that tell which branch holds."""
    heights = tuple(
        tuple((run, model.place(core)) for run, core in cores) for cores in choice.heights
    )
    return [
        "# two branches each, the stretch at which they part, the guard that decides if times do",
        "# not, its sign and scale, whether events may be past there, whether it is at a turn",
        *table("FORKS", nested(map(astuple, choice.forks))),
        "# the largest guard for which the second one is solved",
        *table("HIGHEST", nested(choice.highest)),
        "# events that a branch misses on a stretch: the guard, scale, whether they begin it or",
        "# end it, or would come for the first time; and runs with cores that make the guard",
        *table("GRAZINGS", nested(map(astuple, choice.grazings))),
        *table("HEIGHTS", nested(heights)),
        "# how well times and guards are known, relative to the horizon and the scales",
        f"WIDTH = {literal(choice.width)}",
        "# differences of the unknowns between branches up to which either of them will do",
        *table("TOLERANCES", nested(choice.tolerances)),
    ]
