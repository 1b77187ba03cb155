"""The documentation site: ``sphinx-build -W --keep-going -b html docs docs/_build/html``.

The pages are the Markdown files of this folder. They also work without a build, since their links
are paths of the repository. The navigation is the list of links in ``index.md``. The build runs no
code of the pages; ``tests/docs`` does.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "src"))

from rankone import __version__

project = "rankone"
author = "The rankone developers"
copyright = author
version = release = __version__

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "numpydoc",
    "sphinx_copybutton",
]
exclude_patterns = ["_build"]

myst_heading_anchors = 4
copybutton_exclude = ".linenos, .gp, .go"

autodoc_member_order = "groupwise"
autodoc_typehints_format = "short"
autodoc_type_aliases = {"Array": "ndarray"}
numpydoc_show_class_members = False
python_maximum_signature_line_length = 80

html_theme = "furo"
html_title = f"rankone {version}"
html_copy_source = False
html_static_path = ["_static"]
html_css_files = ["site.css"]

_LINK = re.compile(r"\]\(([^)#\s]+\.(?:md|rst))(?:#[^)]*)?\)")
_STAR = re.compile(r"([(,] ?)\*(?=\w)")
_OUTSIDE = {"../CHANGELOG.md": "changelog.rst", "../CONTRIBUTING.md": "contributing.md"}
"""Files beside the folder that are pages of the site, by the page that includes them."""


def _navigation(text: str) -> str:
    """Hidden tables of contents: one for each section of a page, with the pages it links to."""
    tables: list[str] = []
    listed: set[str] = set()
    for section in re.split(r"^## ", text, flags=re.M)[1:]:
        caption, _, body = section.partition("\n")
        pages = [page for page in _LINK.findall(body) if page not in listed]
        listed.update(pages)
        entries = "\n".join(dict.fromkeys(pages))
        tables.append(f"```{{toctree}}\n:hidden:\n:caption: {caption}\n\n{entries}\n```")
    return "\n\n".join(tables)


def _read(app: Any, page: str, source: list[str]) -> None:
    """Point links to files outside the folder to their pages; give the index its navigation."""
    for path, page_name in _OUTSIDE.items():
        source[0] = source[0].replace(f"]({path})", f"]({page_name})")
    if page == "index":
        source[0] += "\n" + _navigation(source[0])


def _shapes(app: Any, what: str, name: str, thing: Any, options: Any, lines: list[str]) -> None:
    """Escape the star of shapes such as ``(unknowns, *shape of the times)`` in docstrings."""
    lines[:] = [line if "``" in line else _STAR.sub(r"\1\\*", line) for line in lines]


def setup(app: Any) -> None:
    app.connect("source-read", _read)
    app.connect("autodoc-process-docstring", _shapes, priority=100)  # before numpydoc
