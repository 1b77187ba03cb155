"""A page in which a solution is explored: one HTML file, without a server or a network.

==============  =======================================================================
file            subject
==============  =======================================================================
``content``     times, ranges, bands and sensitivities, as plain data
``sentences``   what the solution holds for and how good it is, in words
``mathml``      names and equations, typeset
``page``        everything put together
``page.html.in``, ``page.css``
                structure and looks
``values.js``   numbers without a page: steps of sliders, links, tables
``looks.js``    colours of the theme, texts of numbers
``curves.js``, ``phase.js``, ``shares.js``
                curves over time, two unknowns against each other, Sobol indices
``controls.js``, ``legend.js``
                sliders and number fields; names and values of the unknowns
``state.js``    everything that changes
``drawing.js``, ``actions.js``
                what is drawn and when; what happens
``main.js``     the page is set up
==============  =======================================================================

The plots are by uPlot, in ``export/vendor`` with its licence.
"""

from __future__ import annotations

from os import PathLike
from pathlib import Path
from typing import Any

from rankone.export.explorer.content import content, with_derivatives
from rankone.export.explorer.mathml import Notation
from rankone.export.explorer.page import page
from rankone.export.explorer.sentences import place, quality
from rankone.export.packing import pack
from rankone.support.errors import ExportError, OptionError
from rankone.support.files import as_path, free_target, write_files
from rankone.support.wording import is_text, shown

__all__ = ["export_page", "page_target"]


def page_target(path: str | PathLike[str], overwrite: bool = False) -> Path:
    """The path of a file that a page can be written to, or an ExportError."""
    given = as_path(path, ExportError)
    if given.suffix != ".html":
        bare = given.name in ("", ".html")
        named = given.parent / "page.html" if bare else given.with_suffix(".html")
        raise ExportError(
            f"`{given}`: a page has the suffix .html, not {given.suffix!r}",
            term=given,
            remedy=f"name it {named}",
        )
    return free_target(given, overwrite, ExportError)


def export_page(
    solution: Any,
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
        raise OptionError(f"title={shown(title)} is no text", term=title)
    if solution.metadata.timeless:
        raise ExportError(
            "these values do not depend on time, and a page shows curves over time",
            remedy="write a model (model.js), or plot them: rankone.plotting.plot_surface",
        )
    every = with_derivatives(solution)
    model = pack(every, rtol=rtol, allow_failed=allow_failed)
    notation = Notation(solution.metadata)
    text = page(
        model,
        content(every, model, notation),
        title=(title or "").strip() or solution.metadata.name or _title(target),
        equations=notation.equations(),
        quality=quality(solution, model),
        place=place(solution),
        asked=None if solution.outcome.measured is None else solution.rtol,
        smaller=rtol,
        success=solution.success,
    )
    write_files({target: text}, overwrite, ExportError)
    return target


def _title(path: Path) -> str:
    """The name of a file as a title."""
    words = path.stem.replace("_", " ").replace("-", " ").strip() or "Explorer"
    return words[:1].upper() + words[1:]
