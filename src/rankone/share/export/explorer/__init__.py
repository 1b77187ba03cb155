"""The page that explores a solution: one HTML file, without a server or a network.

- ``mathml``: equations as people write them, typeset as MathML
- ``page``: the data of the page, and its sentences about the solution

uPlot draws the curves; it is in ``export/vendor`` with its licence. The scripts are modules that
import each other. A page from a disk cannot import, so the modules are joined here: the model as
one object, the rest one after the other.
"""

from __future__ import annotations

import html
import json
import re
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING

from rankone.share.export.explorer.mathml import Notation
from rankone.share.export.explorer.page import content, lead, quality, with_derivatives
from rankone.share.export.model_js import javascript_model
from rankone.share.export.packing import PackedModel, pack
from rankone.share.export.templates import filled
from rankone.support import __version__
from rankone.support.errors import ExportError, OptionError
from rankone.support.files import as_path, free_target, write_files
from rankone.support.wording import is_text, shown

if TYPE_CHECKING:
    from rankone.solution.statistics.densities import DistributionOverBox

__all__ = ["export_page", "page_target"]

_FOLDER = Path(__file__).parent
_MOST_LINES = 8  # Equations and values above which they are folded, so that curves come first
_VENDOR = _FOLDER.parent / "vendor"
# In an order in which each one needs only those before it
_SCRIPTS = (
    *("values", "measurements", "fitting", "looks", "events", "curves", "phase", "shares"),
    *("controls", "legend", "state", "drawing", "actions", "main"),
)
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


def export_page(
    solution: DistributionOverBox,
    path: str | PathLike[str],
    *,
    title: str | None = None,
    rtol: float | None = None,
    overwrite: bool = False,
    allow_failed: bool = False,
) -> Path:
    """What :meth:`rankone.Solution.explore` does."""
    target = page_target(path, overwrite)
    if title is not None and not is_text(title):
        raise OptionError(f"title={shown(title)} is not text", term=title)
    if solution.metadata.timeless:
        raise ExportError(
            "these values do not depend on time, and a page shows curves over time",
            remedy="write a model (model.js), or plot them: rankone.share.plotting.plot_surface",
        )
    full = with_derivatives(solution)
    model = pack(full, rtol=rtol, allow_failed=allow_failed)
    words = target.stem.replace("_", " ").replace("-", " ").strip() or "Explorer"
    title = (title or "").strip() or solution.metadata.name or words[:1].upper() + words[1:]
    text = _page(full, solution, model, title, rtol)
    write_files({target: text}, overwrite, ExportError)
    return target


def _page(
    full: DistributionOverBox,
    solution: DistributionOverBox,
    model: PackedModel,
    title: str,
    rtol: float | None,
) -> str:
    """Text of the page; ``full`` is the solution with its derivatives among the unknowns."""
    notation = Notation(solution.metadata)
    data, groups = content(full, model, notation), notation.equations()
    lines = sum(map(len, groups))
    sentences = quality(solution, model)
    errors = [u["error"] for u in data["unknowns"] if u["error"] is not None]
    distributed = any(parameter["distribution"] for parameter in data["parameters"])
    fields = {
        "title": html.escape(title),
        "lead": html.escape(lead(data)),
        "version": __version__,
        "success": "yes" if solution.success else "",
        "error": f"Measured error {_scientific(max(errors))}" if errors else "Error not measured",
        "covers": _covers(solution, rtol),
        "bands": "under their distributions" if distributed else "over their ranges",
        "message": html.escape(sentences[0]),
        "quality": "\n".join(f"<p>{html.escape(line)}</p>" for line in sentences),
        "errors": "\n".join(
            f"<tr><th scope='row'>{u['symbol']}</th><td>{_scientific(u['error'])}</td></tr>"
            for u in data["unknowns"]
        ),
        "equations": "\n".join(
            "\n".join(["<ul>", *(f"<li>{line}</li>" for line in group), "</ul>"])
            for group in groups
        ),
        "folded": f"The {lines} equations and values" if lines > _MOST_LINES else "",
        "parameters": "yes" if data["parameters"] else "",
        "sobol": "yes" if data["sobol"] else "",
        "events": "yes" if model.events else "",
        "running": " of what still runs" if model.terminal else "",
        "phase": "yes" if len(data["unknowns"]) > 1 else "",
        "style": _read(_VENDOR / "uPlot.min.css") + "\n" + _read(_FOLDER / "page.css"),
        "licence": _read(_VENDOR / "uPlot.LICENSE").replace("*/", "* /"),
        "plots": _read(_VENDOR / "uPlot.iife.min.js"),
        "data": json.dumps(data, ensure_ascii=False, allow_nan=False).replace("<", "\\u003c"),
        "model": _as_object(model),
        "script": "\n".join(
            _EXPORT.sub("", _IMPORT.sub("", _read(_FOLDER / f"{name}.js"))) for name in _SCRIPTS
        ),
    }
    return filled("explorer/page.html.in", fields)


def _covers(solution: DistributionOverBox, rtol: float | None) -> str:
    """Where the error was measured, and what it may be, in HTML."""
    measured = solution.outcome.measured
    if measured is None:
        return ""
    place = "in the whole box" if measured.cover == "box" else "inside the box"
    text = f"asked for: {_scientific(solution.rtol)}"
    if rtol is not None:
        text += f", and made smaller to within {_scientific(rtol)}"
    return f"{place} ({text})" if solution.parameters else f"({text})"


def _as_object(model: PackedModel) -> str:
    """The model's module as an object with everything that it exports."""
    file = Path("model.mjs")
    text = javascript_model(model, file)[file]
    assert isinstance(text, str)
    names = ", ".join(_EXPORTED.findall(text))
    return f"const model = (() => {{\n{_EXPORT.sub('', text)}\nreturn {{ {names} }};\n}})();"


def _scientific(error: float | None) -> str:
    """A small number in HTML: ``6.9 · 10<sup>−4</sup>``; None was not measured."""
    if error is None:
        return "not measured"
    digits, power = f"{error:.1e}".split("e")
    return f"{digits} · 10<sup>{int(power)}</sup>".replace("-", "−") if error else "0"


def _read(path: Path) -> str:
    return path.read_text(encoding="utf-8")
