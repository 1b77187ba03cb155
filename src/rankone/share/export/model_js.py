"""The solved model in JavaScript: one ES module without dependencies, and its declarations.

A core is contracted with a column, eight rows together. In each such block of rows a column stores
its coefficients up to the last one that is not zero. Cores that several time slabs share are stored
once.
"""

from __future__ import annotations

import base64
import re
import textwrap
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rankone.share.export.packing import PackedModel
from rankone.share.export.standalone import (
    BLOCK,
    LINE,
    TERMS,
    comment,
    filled,
    js_comment,
    js_string,
    scale_expressions,
    wrapped,
)
from rankone.support import __version__
from rankone.support.arrays import Array
from rankone.support.errors import ExportError
from rankone.support.files import Content
from rankone.tensors import Scale
from rankone.tensors.coordinates import round_off
from rankone.trajectories.system.timeline import Fork, Grazing


def javascript_model(model: PackedModel, path: Path) -> dict[Path, Content]:
    """Module (``.js`` or ``.mjs``) and declarations (``.d.ts`` or ``.d.mts``) of a model."""
    if not path.stem.isprintable():
        raise ExportError(f"`{path}` cannot be imported: its name has unprintable characters")
    time, *parameters = model.coordinates
    moment, *middles = (f"{0.5 * (lower + upper):g}" for lower, upper in model.intervals)
    point = ", ".join(f"{_key(p)}: {x}" for p, x in zip(parameters, middles, strict=True))
    start, end = model.intervals[0]
    names = {*model.coordinates, *model.unknowns}
    units = [(name, js_string(unit)) for name, unit in model.units if name in names]
    fields = {
        "file": js_comment(path.name),
        "version": __version__,
        "terms": TERMS.replace("file", "module"),
        "summary": comment(model.summary, js_comment),
        "unknown_list": js_comment(", ".join(model.unknowns)),
        "unknowns": ", ".join(map(js_string, model.unknowns)),
        "parameters": ", ".join(map(js_string, parameters)),
        "time": js_string(time),
        "ranges": _entries(zip(model.coordinates, map(_list, model.intervals), strict=True)),
        "errors": _entries(zip(model.unknowns, map(_error, model.errors), strict=True)),
        "units": f"{{\n{_entries(units)}\n}}" if units else "{}",
        "round_off": ", ".join(_number(round_off(*interval)) for interval in model.intervals),
        "unknown_type": " | ".join(map(js_string, model.unknowns)) or "never",
        "parameter_type": " | ".join(map(js_string, parameters)) or "never",
        "optional": "" if parameters else "?",
        "absent": "" if parameters else " | undefined",
        "time_example": moment,
        "example": js_comment(f"{{ {point} }}" if point else "{}"),
        "times_example": f"{start:g}, {moment}, {end:g}",
        **_tables(model),
        "scaled": "yes" if model.is_scaled else "",
        "scales": "\n".join(map(_scale, model.scales)),
        **_timelines(model),
        **_choice(model),
    }
    evaluation = "model_slabs.js.in" if model.events is None else "model_stretches.js.in"
    fields["evaluation"] = filled(evaluation, fields)
    module = filled("model.js.in", fields) + filled("model_train.js.in", fields)
    declarations = path.with_suffix(path.suffix.replace(".", ".d.").replace("js", "ts"))
    return {path: module, declarations: filled("model.d.ts.in", fields)}


def _key(name: str) -> str:
    if name == "__proto__":
        return '["__proto__"]'
    return name if re.fullmatch(r"[A-Za-z_]\w*", name, re.ASCII) else js_string(name)


def _entries(pairs: Iterable[tuple[str, str]]) -> str:
    return "\n".join(f"  {_key(name)}: {text}," for name, text in pairs)


def _number(x: float) -> str:
    return repr(float(x)).removesuffix(".0")


def _list(numbers: Iterable[float]) -> str:
    return f"[{', '.join(map(_number, numbers))}]"


def _error(error: float) -> str:
    return _number(error) if np.isfinite(error) else "null"


def _scale(scale: Scale) -> str:
    """An entry of the table of scales."""
    coordinate, slope = scale_expressions(scale, "Math.")
    argument = "(x)" if "x" in slope else "()"
    return f"  {{ coordinate: (x) => {coordinate}, slope: {argument} => {slope} }},"


def _timelines(model: PackedModel) -> dict[str, str]:
    """The stretches between events, or nothing."""
    if model.events is None:
        return {"events": "", "event_example": ""}
    names = list(map(js_string, model.events))
    several = model.choice is not None
    instants = [
        wrapped(f"[{', '.join(map(js_string, instant))}]" for instant in timeline.instants)
        for timeline in model.timelines
    ]
    listed = "readonly (readonly string[])[]"
    return {
        "events": "yes",
        "event_names": ", ".join(names),
        "event_example": js_comment(names[0]) if names else "",
        "event_type": " | ".join(names) or "never",
        "instants": "\n".join(f"  [\n{of}\n  ]," for of in instants) if several else instants[0],
        "instants_of_orders": "instants" if several else "[instants]",
        "instants_type": f"readonly ({listed})[]" if several else listed,
        "of_each_order": " * For each order of events.\n" if several else "",
        "of_held": ", of the order that holds" if several else "",
        "branches": "\n".join(_branch(model, k) for k in range(len(model.branches))),
    }


def _branch(model: PackedModel, k: int) -> str:
    """The tables of a branch as an object."""
    branch, timeline = model.branches[k], model.timelines[k]
    slabs = [
        f"      [{', '.join([_number(start), *map(str, [run, *places])])}],"
        for start, run, places in zip(
            branch.starts, timeline.runs, model.slabs_of(branch), strict=True
        )
    ]
    affine = (f"[{border}, {_list(row)}]" for border, row in timeline.affine_borders)
    lines = [
        *("  {", "    slabs: [", *slabs, "    ],"),
        *("    firstSlabs: [", _deeper(wrapped(map(str, timeline.first_slabs))), "    ],"),
        f"    borders: [{', '.join(map(str, model.borders_of(branch)))}],",
        *("    affine: [", _deeper(wrapped(affine)), "    ],"),
        f"    terminal: {str(timeline.terminal).lower()},",
    ]
    if model.choice is not None:
        guards = "null" if branch.guards is None else str(model.place(branch.guards))
        roots = [
            f"{{ parent: {o.parent}, guard: {o.guard}, "
            f"lower: {_number(o.lower)}, upper: {_number(o.upper)} }}"
            for o in model.choice.openings_of(k)
        ]
        lines += [f"    guards: {guards},", f"    roots: [{', '.join(roots)}],"]
    return "\n".join([*lines, "  },"])


def _deeper(lines: str) -> str:
    """Lines of a table inside of another one."""
    return textwrap.indent(lines, "  ")


def _choice(model: PackedModel) -> dict[str, str]:
    """What tells which branch holds, or nothing for one branch."""
    choice = model.choice
    if choice is None:
        one_order = "" if model.events is None else "yes"
        return {"several": "", "one_order": one_order, "further_roots": ""}
    looks = [sum(len(core.tensor[0]) for _, core in cores) for cores in choice.heights]
    most_roots = max(len(choice.openings_of(k)) for k in range(len(model.branches)))
    return {
        "several": "yes",
        "one_order": "",
        "further_roots": " + ROOTS",
        "roots": str(most_roots),
        "looks": str(max(looks, default=0) + BLOCK),
        "forks": "\n".join(map(_fork, choice.forks, choice.highest)),
        "grazings": "\n".join(
            _grazing(each, [(run, model.place(core)) for run, core in cores])
            for each, cores in zip(choice.grazings, choice.heights, strict=True)
        ),
        "width": _number(choice.width),
        "tolerances": ", ".join(map(_number, choice.tolerances)),
    }


def _fork(fork: Fork, highest: float) -> str:
    """An entry of the table of forks."""
    fields = {
        "first": str(fork.first),
        "second": str(fork.second),
        "stretch": str(fork.stretch),
        "guard": "null" if fork.guard is None else str(fork.guard),
        "sign": _number(fork.sign),
        "scale": _number(fork.scale),
        "highest": _number(highest),
        "mayBePast": f"[{', '.join(map(_boolean, fork.may_be_past))}]",
        "atTurn": _boolean(fork.at_turn),
    }
    return f"  {{ {', '.join(f'{name}: {text}' for name, text in fields.items())} }},"


def _grazing(grazing: Grazing, cores: Sequence[tuple[int, int]]) -> str:
    """An entry of the table of grazings, with runs and positions of cores."""
    fields = {
        "branch": str(grazing.branch),
        "scale": _number(grazing.scale),
        "begins": _boolean(grazing.begins),
        "ends": _boolean(grazing.ends),
        "first": _boolean(grazing.first),
        "cores": f"[{', '.join(f'[{run}, {place}]' for run, place in cores)}]",
    }
    return f"  {{ {', '.join(f'{name}: {text}' for name, text in fields.items())} }},"


def _boolean(value: bool) -> str:
    return str(value).lower()


def _tables(model: PackedModel) -> dict[str, str]:
    """The layout of the cores and their coefficients."""
    rows: list[str] = []
    runs: list[NDArray[np.intp]] = []
    coefficients: list[Array] = []
    for core in model.cores:
        elements = [_packed(tensor) for tensor in core.tensor]
        sparse = any((run < core.tensor.shape[2]).any() for run, _ in elements)
        runs += [run for run, _ in elements] if sparse else []
        coefficients += [packed for _, packed in elements]
        place = [_number(core.lower), _number(core.scale)]
        if core.edges:
            place = [_list(core.lowers), _list(core.scales)]
        rows.append(f"  [{', '.join([*place, *map(str, core.tensor.shape), str(int(sparse))])}],")
    branch = model.branches[0]
    slabs = [
        f"  [{', '.join([_number(start), *map(str, places)])}],"
        for start, places in zip(branch.starts, model.slabs_of(branch), strict=True)
    ]
    return {
        "cores": "\n".join(rows),
        "slabs": "\n".join(slabs),
        "runs": _base64(runs, "<u2"),
        "data": _base64(coefficients, "<f8"),
    }


def _packed(tensor: Array) -> tuple[NDArray[np.intp], Array]:
    """How many polynomials each column of a block of one element has, and their coefficients.

    ``tensor`` is (left, degree, right). The columns are in the order (block of rows, right), the
    coefficients in the order (block of rows, right, degree, row).
    """
    left, degree, right = tensor.shape
    blocks = -(-left // BLOCK)
    padded = np.zeros((blocks * BLOCK, degree, right))
    padded[:left] = tensor
    columns = padded.reshape(blocks, BLOCK, degree, right).transpose(0, 3, 2, 1)
    runs = ((columns != 0.0).any(axis=3) * np.arange(1, degree + 1)).max(axis=2)
    within = np.arange(degree) < runs[..., None]
    rows = (np.arange(blocks * BLOCK) < left).reshape(blocks, 1, 1, BLOCK)
    return runs.ravel(), columns[rows & within[..., None]]


def _base64(arrays: Sequence[NDArray[np.generic]], dtype: str) -> str:
    joined = np.concatenate(arrays) if arrays else np.empty(0)
    text = base64.b64encode(joined.astype(dtype).tobytes()).decode()
    return "\n".join(text[begin : begin + LINE] for begin in range(0, len(text), LINE))
