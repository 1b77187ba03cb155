"""What all pages share: files and titles, scripts as one, numbers and sentences in HTML.

uPlot draws the curves; it is in ``export/vendor`` with its licence. The scripts are modules that
import each other. A page from a disk cannot import, so the modules are joined here: the model as
one object, the rest one after the other.
"""

from __future__ import annotations

import html
import json
import math
import re
import warnings
from collections.abc import Iterable, Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rankone.share.export.mathml import Notation, with_exponents
from rankone.share.export.model_js import javascript_model
from rankone.share.export.packing import PackedModel
from rankone.share.export.standalone import filled
from rankone.solution.statistics.over_box import CENTRAL
from rankone.solvers.outcome import SolutionMetadata
from rankone.support import __version__
from rankone.support.arrays import MANY_SAMPLES, Array
from rankone.support.errors import ExportError, OptionError, RankoneWarning, is_text, shown
from rankone.support.files import as_path, free_target
from rankone.tensors.coordinates import LINEAR, with_measure
from rankone.tensors.distributions import Measure, from_text, scale_of

if TYPE_CHECKING:
    from rankone.solution.statistics.densities import DistributionOverBox

_FOLDER = Path(__file__).parent / "explorer"
ENDED = ".* still running"
"""A warning that pages ignore: they say themselves that some trajectories have ended."""
CURVE_TIMES = 401  # Times of a curve: about one for two pixels
_CURVE_DIGITS = 7  # Significant digits of curves
_MOST_LINES = 8  # Equations and values above which they are folded, so that curves come first
_VENDOR = _FOLDER.parent / "vendor"
_IMPORT = re.compile(r"^import .*?;\n", re.M | re.S)
_EXPORT = re.compile(r"^export (?=(?:async )?(?:const|let|function|class) )", re.M)
_EXPORTED = re.compile(r"^export (?:const|function|class) (\w+)", re.M)


def page_target(path: str | PathLike[str], overwrite: bool = False) -> Path:
    """The path of a file that a page can be written to, or an ExportError."""
    target = as_path(path, ExportError)
    if target.suffix != ".html":
        bare = target.name in ("", ".html")
        proposal = target.parent / "page.html" if bare else target.with_suffix(".html")
        raise ExportError(
            f"`{target}`: a page has the suffix .html, not {target.suffix!r}",
            term=target,
            remedy=f"name it {proposal}",
        )
    return free_target(target, overwrite, ExportError)


def heading(title: str | None, metadata: SolutionMetadata, target: Path) -> str:
    """The title of a page: as given, or else the name of the problem or of the file."""
    if title is not None and not is_text(title):
        raise OptionError(f"title={shown(title)} is not text", term=title)
    words = target.stem.replace("_", " ").replace("-", " ").strip() or "Explorer"
    return (title or "").strip() or metadata.name or words[:1].upper() + words[1:]


def page_text(
    main: str,
    scripts: Sequence[str],
    data: Mapping[str, Any],
    model: PackedModel,
    fields: Mapping[str, str],
) -> str:
    """Text of a page: its ``main`` template, and scripts, each of which needs only earlier ones.

    Scripts read the ``data`` and call the model; ``fields`` are those of the templates that differ
    from page to page.
    """
    shared = {
        "version": __version__,
        "style": _read(_VENDOR / "uPlot.min.css") + "\n" + _read(_FOLDER / "page.css"),
        "licence": _read(_VENDOR / "uPlot.LICENSE").replace("*/", "* /"),
        "plots": _read(_VENDOR / "uPlot.iife.min.js"),
        "data": json.dumps(data, ensure_ascii=False, allow_nan=False).replace("<", "\\u003c"),
        "model": _as_object(model),
        "script": joined_scripts(scripts),
    }
    content = filled(f"explorer/{main}", fields)
    return filled("explorer/page.html.in", {**fields, **shared, "main": content})


def joined_scripts(names: Sequence[str]) -> str:
    """Scripts of pages as one, without their imports."""
    texts = (_read(_FOLDER / f"{name}.js") for name in names)
    return "\n".join(_EXPORT.sub("", _IMPORT.sub("", text)) for text in texts)


def _as_object(model: PackedModel) -> str:
    """The model's module as an object with everything that it exports."""
    file = Path("model.mjs")
    text = javascript_model(model, file)[file]
    assert isinstance(text, str)
    names = ", ".join(_EXPORTED.findall(text))
    return f"const model = (() => {{\n{_EXPORT.sub('', text)}\nreturn {{ {names} }};\n}})();"


def _read(path: Path) -> str:
    return path.read_text(encoding="utf-8")


# -----------------------------------------------------------------------------
# What pages say of equations, errors, parameters and time.


def equation_fields(notation: Notation) -> dict[str, str]:
    """Fields of the template: equations and values in HTML, and a heading where they are folded."""
    groups = notation.equations()
    lines = sum(map(len, groups))
    return {
        "equations": "\n".join(
            "\n".join(["<ul>", *(f"<li>{line}</li>" for line in group), "</ul>"])
            for group in groups
        ),
        "folded": f"The {lines} equations and values" if lines > _MOST_LINES else "",
    }


def error_fields(unknowns: Sequence[Mapping[str, Any]]) -> dict[str, str]:
    """Fields of the template: the largest error, and that of each unknown by its symbol."""
    measured = [unknown["error"] for unknown in unknowns if unknown["error"] is not None]
    return {
        "error": f"Measured error {scientific(max(measured))}"
        if measured
        else "Error not measured",
        "errors": "\n".join(
            f"<tr><th scope='row'>{u['symbol']}</th><td>{scientific(u['error'])}</td></tr>"
            for u in unknowns
        ),
    }


def asked_for(rtol: float, smaller: float | None) -> str:
    """The tolerance that was asked for, and of a smaller model the further difference, in HTML."""
    text = f"asked for: {scientific(rtol)}"
    return text if smaller is None else f"{text}, and made smaller to within {scientific(smaller)}"


def scientific(error: float | None) -> str:
    """A small number in HTML: ``6.9 · 10<sup>−4</sup>``; None was not measured."""
    if error is None:
        return "not measured"
    digits, power = f"{error:.1e}".split("e")
    return f"{digits} · 10<sup>{int(power)}</sup>".replace("-", "−") if error else "0"


def unbroken(lines: Sequence[str]) -> list[str]:
    """Sentences for HTML: lines break at a hyphen, but not at a minus sign."""
    return [re.sub(r"(?<=\de)-(?=\d)", "−", line.replace("`", "")) for line in lines]


def paragraphs(lines: Sequence[str]) -> str:
    """Sentences as paragraphs of HTML."""
    return "\n".join(f"<p>{html.escape(line)}</p>" for line in lines)


def named(name: str, notation: Notation, units: Mapping[str, str]) -> dict[str, Any]:
    """A name as people write it, and its unit."""
    symbol, text = notation.symbol(name), notation.text(name)
    unit = with_exponents(units.get(name, ""))
    return {"name": name, "text": text, "symbol": symbol, "unit": unit}


def parameter_entries(metadata: SolutionMetadata, notation: Notation) -> list[dict[str, Any]]:
    """Ranges, distributions, and where sliders begin."""
    units, distributions = dict(metadata.units), dict(metadata.distributions)
    return [
        {
            **named(name, notation, units),
            "range": [float(end) for end in ends],
            "distribution": with_measure("", distributions.get(name)).strip(),
            "scale": _scale(ends, distributions.get(name)),
            "median": _median(name, ends, distributions.get(name)),
        }
        for name, ends in zip(metadata.parameters, metadata.box, strict=True)
    ]


def _median(name: str, ends: tuple[float, float], distribution: str | None) -> float:
    """The median of a parameter, with as many digits as a slider has."""
    lower, upper = ends
    if distribution is None:
        return lower + 0.5 * (upper - lower)
    measure = Measure(name, lower, upper, from_text(distribution), from_problem=True)
    middle = float(measure.sample(np.array(0.5)))
    length = upper - lower if _scale(ends, distribution) == LINEAR else middle
    return min(upper, max(lower, round(middle, 3 - math.floor(math.log10(length)))))


def over_box(solution: DistributionOverBox, times: Array) -> Array:
    """The smallest values of the unknowns, the ends of their bands, the largest: (4, n, times)."""
    probabilities = (0.0, *CENTRAL, 1.0)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", ENDED, RankoneWarning)
        return np.asarray(solution.quantile(probabilities, times, count=MANY_SAMPLES))


def unknown_entries(
    solution: DistributionOverBox,
    quantiles: Array,
    errors: Mapping[str, float | None],
    notation: Notation,
) -> list[dict[str, Any]]:
    """Names, errors, extents and bands of the unknowns, of their quantiles over the box."""
    units, varies = dict(solution.metadata.units), bool(solution.metadata.parameters)
    lowest, low, high, highest = quantiles
    return [
        {
            **named(name, notation, units),
            "derivative": name in notation.derivatives,
            "error": errors[name],
            "extent": [float(np.nanmin(lowest[i])), float(np.nanmax(highest[i]))],
            "low": rounded_curve(low[i]) if varies else None,
            "high": rounded_curve(high[i]) if varies else None,
        }
        for i, name in enumerate(solution.unknowns)
    ]


def rounded_curve(curve: Iterable[float]) -> list[float | None]:
    """Numbers with as many digits as a picture needs; None for those that are not finite."""
    return [float(f"{y:.{_CURVE_DIGITS}g}") if np.isfinite(y) else None for y in curve]


def _scale(ends: tuple[float, float], distribution: str | None) -> str:
    """The scale in which the slider of a parameter is even."""
    return LINEAR if distribution is None else scale_of(distribution, ends[0])
