"""Templates of exported files."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path

from rankone.codegen.text import paragraph

__all__ = ["LINE", "TERMS", "comment", "filled", "wrapped"]

LINE = 96
"""Characters in a line of a file that is not in Python."""
TERMS = "On rankone's part this file may be used, changed and passed on without restriction."
"""What exported files say of the source of the library that is in them."""
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


def comment(paragraphs: Iterable[str], escaped: Callable[[str], str]) -> str:
    """The lines inside a block comment, each of them escaped."""
    lines = (part for text in paragraphs for part in paragraph(text, LINE))
    return "\n".join(f" * {escaped(line)}".rstrip() for line in lines)


def wrapped(items: Iterable[str], width: int, indent: int = 4) -> Iterator[str]:
    """Items with commas, as many in a line as fit."""
    line = " " * (indent - 1)
    for item in items:
        if len(line) + len(item) + 2 > width:
            yield line
            line = " " * (indent - 1)
        line += f" {item},"
    yield line
