"""The page itself: model, plots, styles and data in one HTML file.

Scripts are written as modules that import each other. A page from a disk cannot import, so that
they are put together here: the model as one object, the others one after the other.
"""

from __future__ import annotations

import html
import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rankone.export.explorer.sentences import lead, spread
from rankone.export.model_js import javascript_model
from rankone.export.packing import PackedModel
from rankone.export.templates import filled
from rankone.support.version import __version__

__all__ = ["page"]

_PLACE = Path(__file__).parent
_VENDOR = _PLACE.parent / "vendor"
_SCRIPTS = (
    *("values", "looks", "curves", "phase", "shares", "controls", "legend"),
    *("state", "drawing", "actions", "main"),
)
"""In an order in which each one needs only those before it."""
_IMPORT = re.compile(r"^import .*?;\n", re.M | re.S)
_EXPORT = re.compile(r"^export (?=(?:async )?(?:const|let|function|class) )", re.M)
_EXPORTED = re.compile(r"^export (?:const|function|class) (\w+)", re.M)


def page(
    model: PackedModel,
    data: Mapping[str, Any],
    *,
    title: str,
    equations: list[list[str]],
    quality: list[str],
    place: str,
    asked: float | None,
    smaller: float | None,
    success: bool,
) -> str:
    """Text of the page.

    Parameters
    ----------
    model : PackedModel
    data : mapping
        Of :func:`rankone.export.explorer.content.content`.
    title : str
    equations : list of list of str
        Groups of elements of HTML.
    quality : list of str
        Sentences; the first is in the warning if there is no ``success``.
    place : str
        Where the error was measured.
    asked : float, optional
        The tolerance asked for; None if the error was not measured.
    smaller : float, optional
        By how much the curves may differ from the solution.
    success : bool
    """
    known = [unknown["error"] for unknown in data["unknowns"] if unknown["error"] is not None]
    values = {
        "title": html.escape(title),
        "lead": html.escape(lead(data)),
        "version": __version__,
        "success": "yes" if success else "",
        "error": f"Measured error {_scientific(max(known))}" if known else "Error not measured",
        "covers": _covers(place, asked, smaller),
        "bands": spread(data),
        "message": html.escape(quality[0]),
        "quality": "\n".join(f"<p>{html.escape(line)}</p>" for line in quality),
        "errors": "\n".join(map(_error_row, data["unknowns"])),
        "equations": "\n".join(map(_list, equations)),
        "parameters": "yes" if data["parameters"] else "",
        "sobol": "yes" if data["sobol"] else "",
        "phase": "yes" if len(data["unknowns"]) > 1 else "",
        "style": _read(_VENDOR / "uPlot.min.css") + "\n" + _read(_PLACE / "page.css"),
        "licence": _read(_VENDOR / "uPlot.LICENSE").replace("*/", "* /"),
        "plots": _read(_VENDOR / "uPlot.iife.min.js"),
        "data": json.dumps(data, ensure_ascii=False, allow_nan=False).replace("<", "\\u003c"),
        "model": _as_object(model),
        "script": "\n".join(map(_as_part, _SCRIPTS)),
    }
    return filled("explorer/page.html.in", values)


def _covers(place: str, asked: float | None, smaller: float | None) -> str:
    """Where the error was measured, and what it may be, in HTML."""
    if asked is None:
        return ""
    text = f"asked for: {_scientific(asked)}"
    if smaller is not None:
        text += f", and made smaller to within {_scientific(smaller)}"
    return f"{place} ({text})".strip()


def _as_object(model: PackedModel) -> str:
    """The model's module as an object with everything that it exports."""
    file = Path("model.mjs")
    text = javascript_model(model, file)[file]
    assert isinstance(text, str)
    names = ", ".join(_EXPORTED.findall(text))
    return f"const model = (() => {{\n{_EXPORT.sub('', text)}\nreturn {{ {names} }};\n}})();"


def _as_part(name: str) -> str:
    """A script of the page without what makes it a module."""
    return _EXPORT.sub("", _IMPORT.sub("", _read(_PLACE / f"{name}.js")))


def _error_row(unknown: Mapping[str, Any]) -> str:
    error = unknown["error"]
    shown = "not measured" if error is None else _scientific(error)
    return f"<tr><th scope='row'>{unknown['symbol']}</th><td>{shown}</td></tr>"


def _list(items: list[str]) -> str:
    return "<ul>\n" + "\n".join(f"<li>{item}</li>" for item in items) + "\n</ul>"


def _scientific(value: float) -> str:
    """A small number in HTML: ``6.9 · 10<sup>−4</sup>``."""
    digits, power = f"{value:.1e}".split("e")
    return f"{digits} · 10<sup>{int(power)}</sup>".replace("-", "−") if value else "0"


def _read(path: Path) -> str:
    return path.read_text(encoding="utf-8")
