"""Templates of exported files in C, JavaScript and HTML, and expressions they share."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path

from rankone.compiler.codegen.layout import one_line, paragraph
from rankone.support.errors import ExportError
from rankone.tensors.bases import Logarithm, Reciprocal, Scale


def scale_expressions(scale: Scale, library: str = "") -> tuple[str, str]:
    """The coordinate s and its slope ds/dx as functions of ``x``.

    ``library`` stands before the names of functions.
    """
    if scale.is_identity:
        return "x", "1"
    if isinstance(scale, Logarithm):
        return f"{library}log(x)", "1 / x"
    if isinstance(scale, Reciprocal):
        return "-1 / x", "1 / (x * x)"
    raise ExportError(f"the scale {scale} has no expression in other languages", term=scale)


# -----------------------------------------------------------------------------
# Templates of exported files in C, JavaScript and HTML, and text that stays a comment or a string.
#
# What a comment may hold is decided for each language here and nowhere else. Whatever the text, it
# ends neither the line nor the comment and begins no other one; a string says the same text
# exactly.


BLOCK = 8  # Rows of a core contracted together; the same in the templates
LINE = 96  # Characters in a line of a file that is not in Python
TERMS = "On rankone's part this file may be used, changed and passed on without restriction."
"""What exported files say about the source of the library in them."""
_FOLDER = Path(__file__).parent
_CONDITION = re.compile(r"^@if (\w+)@\n(.*?)(?:^@else@\n(.*?))?^@end@\n", re.DOTALL | re.MULTILINE)
_JOINING = ("\\", "*", "/")  # Characters that mean something else together with what follows a text


def filled(template: str, fields: Mapping[str, str]) -> str:
    """A template with every ``@name@`` replaced by the field of that name.

    Lines from ``@if name@`` to ``@end@`` stay only if the field is not empty, lines after
    ``@else@`` only if it is.
    """
    text = (_FOLDER / template).read_text(encoding="utf-8")
    text = _CONDITION.sub(lambda match: match[2 if fields[match[1]] else 3] or "", text)
    return re.sub(r"@(\w+)@", lambda match: fields[match.group(1)], text)


def comment(paragraphs: Iterable[str], escaped: Callable[[str], str]) -> str:
    """The lines inside a block comment, each of them escaped."""
    lines = (line for text in paragraphs for line in paragraph(text, LINE))
    return "\n".join(f" * {escaped(line)}".rstrip() for line in lines)


def wrapped(items: Iterable[str]) -> str:
    """Lines of items separated by commas, as many in a line as fit."""
    lines = ["   "]
    for item in items:
        if len(lines[-1]) + len(item) + 2 > LINE:
            lines.append("   ")
        lines[-1] += f" {item},"
    return "\n".join(lines)


def c_comment(text: str) -> str:
    """Text inside a block comment of C, on one line.

    No trigraph stays, and no backslash at the end, which would join the line with the next one.
    """
    plain = one_line(text)
    while "??" in plain:
        plain = plain.replace("??", "? ?")
    plain = plain.replace("*/", "* /").replace("/*", "/ *")
    return f"{plain}_" if plain.rstrip().endswith(_JOINING) else plain


def c_string(text: str) -> str:
    """A string literal of C; anything but printable ASCII becomes bytes of UTF-8."""
    if text.isascii() and text.isprintable():
        return json.dumps(text).replace("?", "\\?")  # no trigraphs
    return '"' + "".join(f"\\{byte:03o}" for byte in text.encode()) + '"'


def js_comment(text: str) -> str:
    """Text inside a block comment of JavaScript, on one line, also in a script of a page."""
    return c_comment(text).replace("</", "< /").replace("<!", "< !").replace("-->", "-- >")


def js_string(text: str) -> str:
    """A string literal of JavaScript, also in a script of a page."""
    quoted = json.dumps(text, ensure_ascii=not text.isprintable())
    return quoted.replace("<", "\\u003c")
