"""Templates of exported files."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

__all__ = ["filled", "outside_of_comments", "wrapped"]

_PLACE = Path(__file__).parent
_CONDITION = re.compile(r"^@if (\w+)@\n(.*?)(?:^@else@\n(.*?))?^@end@\n", re.DOTALL | re.MULTILINE)


def filled(template: str, values: Mapping[str, str]) -> str:
    """A template with every ``@name@`` replaced.

    Lines from ``@if name@`` to ``@end@`` are there only if that value is not empty; those after
    ``@else@`` only if it is.
    """
    text = (_PLACE / template).read_text(encoding="utf-8")
    text = _CONDITION.sub(lambda match: match[2 if values[match[1]] else 3] or "", text)
    return re.sub(r"@(\w+)@", lambda match: values[match.group(1)], text)


def outside_of_comments(text: str) -> str:
    """Text that neither ends a comment nor begins one."""
    return text.replace("*/", "* /").replace("/*", "/ *")


def wrapped(items: Iterable[str], width: int, indent: int = 4) -> Iterator[str]:
    """Items with commas, as many in a line as fit."""
    line = " " * (indent - 1)
    for item in items:
        if len(line) + len(item) + 2 > width:
            yield line
            line = " " * (indent - 1)
        line += f" {item},"
    yield line
