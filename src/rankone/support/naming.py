"""Which names and texts a problem may have: results are labelled by them, in one line."""

from __future__ import annotations

from collections.abc import Iterable

from rankone.support.wording import is_text, quote

__all__ = ["is_line", "name_defect"]


def is_line(value: object) -> bool:
    """Whether a value is text that can be printed in one line and written to a file."""
    return is_text(value) and str.isprintable(str(value))


def name_defect(named: Iterable[tuple[str, str]]) -> tuple[str, str] | None:
    """The first name that cannot be printed or is there twice, and what is wrong with it.

    Parameters
    ----------
    named : iterable of (str, str)
        Each name, and whose it is: ``("k", "parameter `k`")``.
    """
    taken: dict[str, str] = {}
    for name, what in named:
        if not is_line(name) or not name.strip():
            return name, f"the name {name!r} is no text that can be printed in one line"
        if name in taken:
            return name, f"the name {quote(name)} belongs both to {taken[name]} and to {what}"
        taken[name] = what
    return None
