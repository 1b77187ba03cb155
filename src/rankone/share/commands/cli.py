"""The command line: parsing, dispatch, and messages in its own words.

Exit status: 0 if the measured error is within the tolerance, 1 if it is not or is not known,
2 for bad input, 130 after an interrupt.
"""

from __future__ import annotations

import argparse
import os
import re
import signal
import sys
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NoReturn

from rankone.share.commands import solve_files, solved_files
from rankone.share.commands.common import BAD_INPUT, FAILURE, complain, spelled
from rankone.support.errors import SIMILAR

_INTERRUPTED = 128 + signal.SIGINT  # Exit status after an interrupt, as shells have it
_BROKEN_PIPE = 141  # Exit status when the reader of the output has gone


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line, with these arguments or those of the process; the exit status."""
    try:
        arguments = _parser().parse_args(argv)
        spelled.set(spelling(arguments))
        with warnings.catch_warnings():
            warnings.showwarning = lambda message, *_, **__: complain(f"warning: {message}")
            return int(arguments.run(arguments))
    except SystemExit as stop:  # of argparse
        return stop.code if isinstance(stop.code, int) else BAD_INPUT
    except KeyboardInterrupt:
        complain("interrupted")
        return _INTERRUPTED
    except BrokenPipeError:
        # the reader has gone (`| head`); keep Python from flushing into the closed pipe at exit
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return _BROKEN_PIPE
    except Exception as error:
        from rankone.support.errors import ConvergenceError, RankoneError

        if not isinstance(error, RankoneError):
            raise
        complain(f"error: {error}")
        return FAILURE if isinstance(error, ConvergenceError) else BAD_INPUT


class _Parser(argparse.ArgumentParser):
    """Errors in one line; unknown options are told the one that is like them."""

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> tuple[Any, list[str]]:
        arguments, unknown = super().parse_known_args(args, namespace)
        if unknown:
            from rankone.support.errors import did_you_mean

            options = [option for action in self._actions for option in action.option_strings]
            named = (each.partition("=")[0] for each in unknown if each.startswith("--"))
            hint = next(filter(None, (did_you_mean(each, options, SIMILAR) for each in named)), "")
            self.error(f"unrecognized arguments: {' '.join(unknown)}{hint}")
        return arguments, unknown

    def error(self, message: str) -> NoReturn:
        self.exit(BAD_INPUT, f"{self.prog}: error: {message} (see {self.prog} --help)\n")


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(
        prog="rankone",
        description="Solve a parametric ODE system once, for every parameter value of a box.",
    )
    parser.add_argument("--version", action=_Version, nargs=0, help="print the version and exit")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    solve_files.register(commands)
    solved_files.register_evaluation(commands)
    solved_files.register_report(commands)
    solve_files.register_fit(commands)
    solved_files.register_exports(commands)
    return parser


class _Version(argparse.Action):
    """Look the version up only when it is asked for."""

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> None:
        from rankone.support import __version__

        print(f"rankone {__version__}")
        parser.exit()


# -----------------------------------------------------------------------------
# Messages as the command line and TOML files are written, not as Python is.
#
# Errors and summaries say what to write in Python: ``{x: 1e-6}``, ``rtol=1e-3``. A command shows
# its options instead, and the tables of a problem file in TOML.


_TABLES = ("parameters", "initial", "rhs", "units", "constants", "definitions", "atol")
# Arguments that stand in a table of another name
_PLACES = {"jumps": "[[jumps]]", "start": "[initial]", "settle": "[steady_state]"}
_PLACES |= {"conditions": "[steady_state]", **{name: f"[{name}]" for name in _TABLES}}
_PLACEHOLDER = re.compile(r"[a-z]{4,}( \w+)*|\.\.\.")  # What stands for something in an example
_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)(e[-+]?\d+)?")
_CALL = re.compile(r"(?:ro\.|rankone\.)?(?:Problem|SteadyState)\(\.\.\., (\w+=)")
_ARGUMENT = re.compile(r"""(?<![\w.\-'"])([a-z]\w*)=(?!=)""")
_VALUE = re.compile(r"[-+]?[\w.+]*\w(?:e[-+]?\d+)?")
_PAIR = re.compile(r"\b(box|numbers|give|write) \(([^(),]+), ([^(),]+)\)")
_BRACKETS = {"(": ")", "[": "]", "{": "}"}
# What only Python has: attributes of the error and of the solution
_PYTHON_ALONE = re.compile(r"; the error has the solution .*$| \(print solution\.\w+\)", re.S)


def spelling(arguments: argparse.Namespace) -> Callable[[str], str]:
    """How messages of a command are written, from its arguments."""
    options = {name: f"--{name.replace('_', '-')}" for name in vars(arguments)}
    if getattr(arguments, "model_rtol", None) is not None and arguments.rtol is None:
        options["rtol"] = options["model_rtol"]
    is_toml = str(getattr(arguments, "file", "")).endswith(".toml")

    def spelled(text: str) -> str:
        text = _with_options(_PYTHON_ALONE.sub("", text), options)
        return _in_toml(text) if is_toml else text

    return spelled


def _with_options(text: str, options: Mapping[str, str]) -> str:
    """Arguments of functions as options, ``rtol=1e-3`` as ``--rtol 1e-3``."""

    def option(name: str, value: str) -> str | None:
        if name.startswith("max_") and name not in options and "options" in options:
            return f"--options {name}={_words(value)}"
        if name not in options:
            return None
        return options[name] if value == "True" else f"{options[name]} {_words(value)}".rstrip()

    def bare(match: re.Match[str]) -> str:
        verb, name = match.groups()
        return f"{verb} {option(name, 'N') or name}".removesuffix(" N")

    text = _replaced(text, option)
    text = re.sub(r"\b(raise|loosen|lower|larger)\s+(\w+)\b(?!=)", bare, text)
    return re.sub(r"`(t_final)`", lambda m: options.get(m[1], m[0]), text)


def _in_toml(text: str) -> str:
    """Mappings as tables, ``atol={x: 1e-6}`` as ``x = 1e-6 in [atol]``."""

    def table(name: str, value: str) -> str | None:
        if name not in _PLACES:
            return None
        where = _PLACES[name]
        if value.startswith("{"):
            return f"{_entries(value, name == 'jumps')} in {where}"
        own = name if where == "[steady_state]" else ""
        entry = own and f"{own} = {value}" if value not in ("", "...") else own
        return f"{entry} in {where}" if entry else where

    text = _replaced(_without_calls(text), table)
    text = _without_mappings(text)
    text = _PAIR.sub(r"\1 [\2, \3]", text)
    text = re.sub(r" in \[steady_state\] to SteadyState", " in [steady_state]", text)
    text = text.replace("SteadyState", "[steady_state]").replace("an Event", "in [[events]]")
    text = text.replace("terminal=True", "terminal = true")
    return re.sub(rf"`({'|'.join(_TABLES)})`", r"[\1]", text)


def _replaced(text: str, spelled: Callable[[str, str], str | None]) -> str:
    """A text with each ``name=value`` in other words, where there are any."""
    pieces, end = [], 0
    for match in _ARGUMENT.finditer(text):
        if match.start() < end:
            continue
        stop = _end_of_value(text, match.end())
        words = spelled(match[1], text[match.end() : stop])
        if words is not None:
            pieces += [text[end : match.start()], words]
            end = stop
    return "".join([*pieces, text[end:]])


def _end_of_value(text: str, begin: int) -> int:
    """Where a value ends that begins at a place: a bracket, a quote or a word."""
    first = text[begin : begin + 1]
    if first in _BRACKETS:
        return _closing(text, begin)
    if first in ("'", '"', "`"):
        return text.find(first, begin + 1) + 1 or len(text)
    if text.startswith("...", begin):
        return begin + 3
    word = _VALUE.match(text, begin)
    return begin if word is None else word.end()


def _closing(text: str, begin: int) -> int:
    """The place behind the bracket that closes the one at a place; the end if there is none."""
    depth = 0
    for k, letter in enumerate(text[begin:], begin):
        depth += (letter in _BRACKETS) - (letter in _BRACKETS.values())
        if not depth:
            return k + 1
    return len(text)


def _without_calls(text: str) -> str:
    """A text with ``atol=...`` for ``Problem(..., atol=...)``."""
    while match := _CALL.search(text):
        close = _closing(text, text.index("(", match.start()))
        text = text[: match.start()] + text[match.start(1) : close - 1] + text[close:]
    return text


def _without_mappings(text: str) -> str:
    """A text with ``x = 1e-6`` for ``{x: 1e-6}``."""
    begin = text.find("{")
    while begin >= 0:
        end = _closing(text, begin)
        fragment = text[begin:end]
        if re.match(r"\{[^{}=]+: ", fragment):
            text = text[:begin] + _entries(fragment) + text[end:]
        begin = text.find("{", begin + 1)
    return text


def _entries(mapping: str, timed: bool = False) -> str:
    """The entries of a mapping as lines of a table, in one; ``timed`` ones are reset at a time."""
    lines = []
    for key, value in _pairs(mapping):
        if timed or (value.startswith("{") and not value.startswith("{ ")):
            time = f'"{key}"' if key.isidentifier() and not _PLACEHOLDER.fullmatch(key) else key
            lines.append(f"time = {time}, {_entries(value)}")
        else:
            lines.append(f"{key} = {_cell(value)}")
    return ", ".join(lines)


def _cell(value: str) -> str:
    """A value in TOML: formulas in quotes."""
    if value.startswith("("):
        return f"[{value[1:-1]}]"
    if value[:1] in ("'", '"'):
        return f'"{value[1:-1]}"'
    return value if _NUMBER.fullmatch(value) or _PLACEHOLDER.fullmatch(value) else f'"{value}"'


def _pairs(mapping: str) -> Iterator[tuple[str, str]]:
    """Keys and values of a mapping; ``...`` is left out, and ``(t)`` behind unknowns."""
    for item in _items(mapping):
        key, colon, value = item.partition(": ")
        if colon:
            yield re.sub(r"\(\w+\)$", "", key.strip("'\"")), value


def _items(bracket: str) -> Iterator[str]:
    """What is between the commas of a bracket, outside of brackets within."""
    item, depth = "", 0
    for letter in bracket[1:-1]:
        depth += (letter in _BRACKETS) - (letter in _BRACKETS.values())
        if letter == "," and not depth:
            yield item.strip()
            item = ""
        else:
            item += letter
    if item.strip():
        yield item.strip()


def _words(value: str) -> str:
    """A value as words of a command: ``k=0.5:1`` for ``{"k": (0.5, 1)}``."""
    if value.startswith("{"):
        texts = [f"{key}={':'.join(_each(one)) or one}" for key, one in _pairs(value)]
        return " ".join(texts)
    word = value.strip("'\"`")
    return " ".join(_each(value)) or (f"'{word}'" if " " in word else word)


def _each(value: str) -> list[str]:
    """The entries of a list or a pair, without quotes."""
    return [item.strip("'\"") for item in _items(value)] if value[:1] in ("(", "[") else []
