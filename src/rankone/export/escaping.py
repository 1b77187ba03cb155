"""Names, titles and equations inside exported sources: text that stays a comment or a string.

What a comment may hold is decided for each language here and nowhere else. Whatever the text, it
ends neither the line nor the comment, and begins no other one; strings say the same text exactly.
"""

from __future__ import annotations

import json

from rankone.codegen.text import one_line

__all__ = ["c_comment", "c_string", "js_comment", "js_string"]

_LAST = ("\\", "*", "/")
"""Characters that mean something else together with what follows a text."""


def c_comment(text: str) -> str:
    """Text inside a block comment of C, on one line.

    Neither trigraphs nor a backslash at its end are left: the compiler would join it with the next
    line, and what looks like two comments, or none, would be another thing.
    """
    plain = one_line(text)
    while "??" in plain:
        plain = plain.replace("??", "? ?")
    plain = plain.replace("*/", "* /").replace("/*", "/ *")
    return f"{plain}_" if plain.rstrip().endswith(_LAST) else plain


def c_string(text: str) -> str:
    """A string literal of C; other than printable characters of ASCII are bytes of UTF-8."""
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
