"""Layout of generated text, as ``ruff format`` would write it, and how it becomes a system."""

from __future__ import annotations

import hashlib
import itertools
import json
import keyword
import linecache
import os
import re
import textwrap
import unicodedata
import uuid
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from fractions import Fraction
from functools import cache, cached_property, lru_cache
from typing import TypeAlias, TypeVar, cast

import numpy as np
from scipy import special
from threadpoolctl import threadpool_limits

from rankone.support.arrays import Array
from rankone.support.errors import OptionError, check_kind, number, quote
from rankone.support.files import WIDTH
from rankone.support.tasks import KEPT
from rankone.trajectories.bifurcations import started
from rankone.trajectories.system.system import System, UserFunction, system_of

MOST_TERMS = 200
"""Terms of a sum in one expression: Python compiles longer sums by deep recursion."""
INDENT = "    "
"""One level of indentation."""

Nested: TypeAlias = "str | Sequence[Nested]"
"""A text, or a tuple of them."""


class Formula(str):
    """Text of an expression, which stands in a table as it is."""


def literal(constant: object) -> str:
    """A number, or a tuple of them, as ``ruff format`` writes it; fractions stay exact.

    >>> literal((1e200, 0.5)), literal(Fraction(3, 2)), literal(Fraction(1, 3))
    ('(1e200, 0.5)', '1.5', '1 / 3')
    """
    if isinstance(constant, Fraction):
        text = number(constant)
        return text.replace("/", " / ") if "/" in text else literal(float(constant))
    if isinstance(constant, tuple):
        return f"({', '.join(map(literal, constant))}{',' * (len(constant) == 1)})"
    if isinstance(constant, Formula):
        return str(constant)
    return quoted(constant) if isinstance(constant, str) else repr(constant).replace("e+", "e")


def assignment(target: str, terms: Sequence[str], meaning: str = "") -> list[str]:
    """``target = sum of terms``; all terms but the first start with their sign.

    >>> assignment("y", ["a * b", "- c"], "x'")
    ["    y = a * b - c  # x'"]
    """
    lines = statement(f"{target} =", terms[:MOST_TERMS])
    for k in range(MOST_TERMS, len(terms), MOST_TERMS):
        lines += statement(f"{target} =", [target, *terms[k : k + MOST_TERMS]])
    return [commented(lines[0], meaning)] if meaning and len(lines) == 1 else lines


def statement(start: str, terms: Sequence[str]) -> list[str]:
    """A statement that ends in a sum, such as ``return a - b``, wrapped if it is long."""
    joined = " ".join(terms)
    line = f"{INDENT}{start} {joined}"
    if len(line) <= WIDTH:
        return [line]
    inner = INDENT * 2
    body = [inner + joined] if len(inner + joined) <= WIDTH else [inner + term for term in terms]
    return [f"{INDENT}{start} (", *body, f"{INDENT})"]


def one_line(text: str) -> str:
    """Text that ends neither a line nor a file: what cannot be printed becomes an underscore."""
    return text if text.isprintable() else "".join(c if c.isprintable() else "_" for c in text)


def commented(line: str, comment: str) -> str:
    """The line with a comment, left out if it does not fit."""
    longer = f"{line}  # {one_line(comment)}"
    return longer if len(longer) <= WIDTH else line


def unpacking(names: Sequence[str], source: str) -> list[str]:
    """``a, b = source``; nothing if every name is ``_``."""
    if all(name == "_" for name in names):
        return []
    targets = f"({names[0]},)" if len(names) == 1 else ", ".join(names)
    line = f"{INDENT}{targets} = {source}"
    if len(line) <= WIDTH:
        return [line]
    return [f"{INDENT}(", *(f"{INDENT * 2}{name}," for name in names), f"{INDENT}) = {source}"]


def table(name: str, items: Sequence[Nested]) -> list[str]:
    """A tuple bound to a name, on one line if it fits.

    >>> table("PAIRED", [["0", "2"], ["1"]])
    ['PAIRED = ((0, 2), (1,))']
    """
    return tuple_lines(f"{name} = ", items, "", indent="")


def constants_table(constants: Mapping[str, float]) -> list[str]:
    """The table of constants that other code reads, by name.

    >>> constants_table({"m": 3.0})
    ['CONSTANTS = {', '    "m": 3.0,', '}']
    """
    lines = (f"{INDENT}{quoted(name)}: {literal(value)}," for name, value in constants.items())
    return ["CONSTANTS = {", *lines, "}"]


def with_constants(source: str, constants: Mapping[str, float]) -> str:
    """The text of a module with other numbers in its table of constants."""
    before = re.search(r"^CONSTANTS = \{\n(?: .*\n)*\}$", source, re.M)
    if before is None:
        return source
    names = re.findall(r"^ +(\".*\"): ", before[0], re.M)
    after = constants_table({name: constants[name] for name in map(json.loads, names)})
    return source[: before.start()] + "\n".join(after) + source[before.end() :]


def described_table(name: str, rows: Sequence[object], comments: Sequence[str]) -> list[str]:
    """A tuple of tuples bound to a name, one in a line, each with a comment.

    >>> described_table("TERMS", [(1.5, 0)], ["x': 1.5"])
    ['TERMS = (', "    (1.5, 0),  # x': 1.5", ')']
    """
    lines = []
    for row, comment in zip(nested(rows), comments, strict=True):
        written = tuple_lines("", row, ",", INDENT)
        lines += [commented(written[0], comment)] if len(written) == 1 else written
    return [f"{name} = (", *lines, ")"] if lines else [f"{name} = ()"]


def tuple_lines(start: str, item: Nested, end: str, indent: str) -> list[str]:
    """A text, or a tuple between two texts: one line for each item if it is too long for one."""
    line = f"{indent}{start}{_one_line(item)}{end}"
    if len(line) <= WIDTH or isinstance(item, str):
        return [line]
    inner = [line for element in item for line in tuple_lines("", element, ",", indent + INDENT)]
    return [f"{indent}{start}(", *inner, f"{indent}){end}"]


def _one_line(item: Nested) -> str:
    """A text as it is, or a tuple in one line."""
    if isinstance(item, str):
        return item
    texts = [_one_line(element) for element in item]
    return f"({texts[0]},)" if len(texts) == 1 else f"({', '.join(texts)})"


def docstring(lines: Sequence[str], indent: str = INDENT) -> list[str]:
    """A docstring of a summary and further lines, safe for backslashes and quotes."""
    plain = map(one_line, lines)
    safe = [line.replace("\\", "\\\\").replace('"""', r"\"\"\"") for line in plain]
    if len(safe) == 1 and not safe[0].endswith('"'):
        return [f'{indent}"""{safe[0]}"""']
    body = [(indent + line).rstrip() for line in safe[1:]]
    return [f'{indent}"""{safe[0]}', *body, f'{indent}"""']


def paragraph(text: str, width: int = WIDTH) -> list[str]:
    """Text wrapped to a width, continuation lines indented further; an empty line for none."""
    lines = textwrap.wrap(
        text,
        width,
        subsequent_indent=" " * (len(text) - len(text.lstrip()) + 4),
        break_long_words=False,
        break_on_hyphens=False,
    )
    return lines or [""]


def nested(items: Iterable[object]) -> list[Nested]:
    """Text of nested tuples of numbers."""
    return [nested(item) if isinstance(item, tuple) else literal(item) for item in items]


def quoted(text: str) -> str:
    r"""A string literal in double quotes.

    >>> print(quoted("k'"), quoted(r"\alpha"))
    "k'" "\\alpha"
    """
    text = json.dumps(text, ensure_ascii=False)
    return text if text.isprintable() else "".join(map(_escaped, text))


def _escaped(letter: str) -> str:
    """A character of a string literal; one that cannot be printed by its code point."""
    code = ord(letter)
    escape = f"\\u{code:04x}" if code < 0x10000 else f"\\U{code:08x}"
    return letter if letter.isprintable() else escape


class Names:
    r"""Hands out distinct identifiers, as close to the names asked for as possible.

    Those ``reserved`` are never handed out, nor are Python's keywords.

    >>> names = Names(reserved=["np"])
    >>> [names(name) for name in ["x_{0}", "\\alpha", "k'", "lambda", "x_0", "2a", "np"]]
    ['x_0', 'alpha', 'k_prime', 'lambda_', 'x_0_', '_2a', 'np_']
    """

    def __init__(self, reserved: Iterable[str] = ()) -> None:
        ambiguous = ["l", "O", "I"]  # linters object
        self.taken = {*reserved, *ambiguous, *keyword.kwlist, *keyword.softkwlist}

    def __call__(self, name: str) -> str:
        """A new identifier that resembles ``name``."""
        text = unicodedata.normalize("NFKC", name).replace("'", "_prime")
        text = "".join(letter if f"_{letter}".isidentifier() else " " for letter in text)
        text = re.sub(r"_* +_*", "_", text).strip("_") or "symbol"
        if not text.isidentifier():
            text = f"_{text}"
        while text in self.taken:
            text += "_"
        self.taken.add(text)
        return text

    def numbered(self, prefix: str) -> Iterator[str]:
        """New identifiers ``prefix0``, ``prefix1``, …"""
        return (self(name) for k in itertools.count() if (name := f"{prefix}{k}") not in self.taken)


def is_identifier(name: str) -> bool:
    """Whether Python reads the name as it stands."""
    normal = unicodedata.normalize("NFKC", name) == name
    return normal and name.isidentifier() and not keyword.iskeyword(name)


# -----------------------------------------------------------------------------
# How generated source becomes a system, and the functions of arrays made of outputs.


Answer = TypeVar("Answer")


def load_module(
    source: str, name: str, namespace: Mapping[str, UserFunction] | None = None
) -> System:
    """The system that generated source defines, without a file or an entry in ``sys.modules``.

    Tracebacks show the generated lines.

    Parameters
    ----------
    source : str
        Text written by :func:`generate_source`.
    name : str
        Name of the module.
    namespace : mapping of str to callable, optional
        Functions of the user that the source calls by these names.

    Raises
    ------
    OptionError
        If the source or the name is not a text.
    """
    check_kind("load_module", source, str, remedy="give the text of generate_source(form)")
    check_kind("load_module", name, str, remedy="give the name of the module as text")
    digest = hashlib.sha256(source.encode(errors="replace")).hexdigest()[:8]
    filename = f"<rankone {name} {digest}>"
    names = {"__name__": name, "__file__": filename, **(namespace or {})}
    try:
        code = compile(source, filename, "exec")
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        raise OptionError(
            f"the source of {quote(name)} is not a module that Python can compile: {error}",
            remedy="give the text of generate_source(form)",
        ) from None
    exec(code, names)
    linecache.cache[filename] = (len(source), None, source.splitlines(keepends=True), filename)
    return started(system_of(names))


@dataclass(frozen=True)
class ModuleSpecification:
    """What a generated module is loaded from; modules cannot be pickled, their source can.

    Fulfils :class:`rankone.trajectories.system.system.ModuleSpecification`, with the arguments of
    :func:`load_module`. Specifications are equal if their keys are; ``home`` is the process that
    made it.
    """

    source: str = field(compare=False)
    name: str = field(compare=False)
    namespace: Mapping[str, UserFunction] = field(compare=False)
    key: str = field(default_factory=lambda: uuid.uuid4().hex)
    home: int = field(default_factory=os.getpid, compare=False)

    def load(self) -> System:
        """The system, with this specification as its own."""
        return replace(load_module(self.source, self.name, self.namespace), specification=self)

    def call(self, function: Callable[..., Answer], *arguments: object) -> Answer:
        """``function(system, *arguments)``; a process loads the module once.

        In a process other than its own the BLAS is set to one thread, as it is in a solve.
        """
        if os.getpid() != self.home:
            _one_blas_thread()
        return function(_loaded(self), *arguments)


@lru_cache(KEPT)
def _loaded(specification: ModuleSpecification) -> System:
    return specification.load()


@cache
def _one_blas_thread() -> None:
    """For good: other tasks of this process may run at the same time."""
    threadpool_limits(1, user_api="blas")


# -----------------------------------------------------------------------------
# Quantities of interest as functions of arrays, without symbols.


@dataclass(frozen=True)
class WrittenFunction:
    """A function of arrays as text: the expressions, and the names of its arguments.

    ``called`` are functions of the user and tables by the names that the text calls them by. The
    text is compiled when it is first called, also in another process.
    """

    arguments: str
    texts: tuple[str, ...]
    called: Mapping[str, Callable[..., Array]] = field(default_factory=dict)

    @cached_property
    def function(self) -> Callable[..., Sequence[Array]]:
        """The function that the text says."""
        namespace = {"np": np, "special": special, **self.called}
        text = f"lambda {self.arguments}: [{', '.join(self.texts)}]"
        return cast(Callable[..., Sequence[Array]], eval(text, namespace))

    def __call__(self, *arguments: object) -> Sequence[Array]:
        return self.function(*arguments)

    def __getstate__(self) -> dict[str, object]:
        return {name: held for name, held in vars(self).items() if name != "function"}


class Kind(Enum):
    """How a function of time is reduced."""

    INTEGRAL = "integral"
    RUNNING = "running integral"
    MAXIMUM = "maximum"
    MINIMUM = "minimum"
    CROSSING = "first crossing"
    DURATION = "duration"
    INSTANT = "value at an instant"


@dataclass(frozen=True)
class Border:
    """The end of a stretch of a timeline, by its place from 1, or behind it the next beginning."""

    place: int
    after: bool = False


@dataclass(frozen=True)
class Reduction:
    """A reduction of the integrand at a position, a function of time.

    It has the limits of an integral or else of the horizon; a running integral has no end. The
    value at an instant, which is its start, is asked for over stretches alone.
    """

    kind: Kind
    integrand: int
    start: float | Border
    end: float | Border
    direction: int  # of a crossing of zero: 1 upwards, -1 downwards, 0 either
    text: str  # in messages


@dataclass(frozen=True)
class Source:
    """A state of the solution, or its time derivative of some order.

    Or, of solutions with events, the derivative by the parameter at a position, at fixed time.
    """

    row: int
    order: int = 0
    parameter: int | None = None

    @property
    def is_state(self) -> bool:
        return self.order == 0 and self.parameter is None


@dataclass(frozen=True)
class Quantities:
    """Functions of states, time and parameters, with their definitions as texts.

    They take times (T, 1), the sources (k, T, m) and parameters (d, m), those of surfaces of
    parameters the last alone, and ``values`` also the reductions, (m,) or (T, m). They give
    sequences of arrays that broadcast to (T, m). Surfaces are zero where a narrow feature is
    largest or steepest, or kinks; the ``state_surfaces`` behind the first ``n_state_surfaces`` are
    zero where something jumps. Those of parameters are functions of several of them.
    """

    names: tuple[str, ...]
    texts: tuple[str, ...]
    timeless: bool
    sources: tuple[Source, ...]
    integrands: Callable[[Array, Array, Array], Sequence[Array]]
    reductions: tuple[Reduction, ...]
    n_state_surfaces: int
    state_surfaces: Callable[[Array, Array, Array], Sequence[Array]]
    parameter_surfaces: Callable[[Array], Sequence[Array]]
    # for time and each parameter the places where functions of it alone are narrow, kink or jump
    cuts: tuple[tuple[float, ...], ...]
    values: Callable[[Array, Array, Array, Sequence[Array]], Sequence[Array]]
    # one where a piecewise function of the states has no branch, and zero elsewhere
    gaps: Callable[[Array, Array, Array], Sequence[Array]]
    gap_texts: tuple[str, ...]
    # pairs of a state and a number, which are summed: rows of sources behind those of the states
    sums: tuple[tuple[tuple[int, float], ...], ...] = ()
