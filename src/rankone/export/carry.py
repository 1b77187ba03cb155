"""Carrying definitions of the library over into one file.

Starting from a few roots, every function, class and constant they reach is selected. The text is
taken as it stands, with its comments and docstrings. What changes is little: imports from the
library, markup of cross references and marks for linters go, module docstrings become the titles of
sections, and a name that two modules use gets the name of its module in front.
"""

from __future__ import annotations

import ast
import builtins
import re
import textwrap
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass

from rankone.codegen.text import WIDTH, tuple_lines
from rankone.export.modules import Import, SourceModule, Statement, read_module, resolve
from rankone.support.errors import ExportError

__all__ = ["Section", "banner", "carry", "import_lines"]

Key = tuple[str, str]
"""(module, name) of a definition."""

_ROLE = re.compile(r":(?:class|func|meth|mod|attr|data):`~?(?:[\w.]*\.)?(\w+)`")
_MARK = re.compile(r"  # (?:noqa|type: ignore)\b.*")


@dataclass(frozen=True)
class Section:
    """The definitions of one module, ready to be written.

    Title and prose are those of its docstring unless a title was asked for.
    """

    module: str
    title: str
    prose: tuple[str, ...]
    text: str

    def __str__(self) -> str:
        comment = [f"# {line}".rstrip() for line in ("", *self.prose)] if self.prose else []
        return "\n".join([banner(self.title), *comment, "", "", self.text])


def banner(title: str) -> str:
    """A comment that opens a section."""
    start = f"# == {title} "
    return start + "=" * max(WIDTH - 1 - len(start), 3)


def carry(
    roots: Iterable[str],
    *,
    reserved: Collection[str] = (),
    renamed: Mapping[str, str] | None = None,
    order: Callable[[str], int] = lambda module: 0,
    titles: Mapping[str, str] | None = None,
) -> tuple[list[Section], set[Import]]:
    """Select what the roots need and write it as sections, each after those it needs.

    Roots are given as ``"module:name"``. ``reserved`` names are taken by the text beside the
    sections, and ``renamed`` gives definitions new names, which are not used otherwise. Modules of
    a smaller ``order`` come first; those of which only a part is carried over have ``titles``.
    Returned as well is what the sections import from elsewhere.

    Raises
    ------
    ExportError
        If a definition cannot be carried over.
    """
    selection = _Selection()
    selection.take(roots)
    modules = sorted(selection.order(), key=lambda module: order(module.name))
    names = _new_names(selection, modules, reserved)
    sections = []
    for module in modules:
        text = _words(_ModuleText(module, selection, names).write(), renamed or {})
        sections.append(_section(module, text, (titles or {}).get(module.name)))
    return sections, selection.imports


def _words(text: str, changes: Mapping[str, str]) -> str:
    """Text with whole words replaced, in code and documentation alike."""
    for old, new in changes.items():
        text = re.sub(rf"\b{old}\b", new, text)
    return text


def _section(module: SourceModule, text: str, title: str | None) -> Section:
    """A section with the title asked for, or else with the docstring of its module."""
    if title is not None:
        return Section(module.name, title, (), text)
    first, *rest = _plain(module.docstring).splitlines()
    first, _, after = first.partition(": ") if len(first) > WIDTH - 12 else (first, "", "")
    paragraphs = "\n".join(rest).strip("\n").split("\n\n")
    if after:
        paragraphs.insert(0, f"{after[:1].upper()}{after[1:]}")
    prose = "\n\n".join(_narrow(paragraph) for paragraph in paragraphs if paragraph)
    return Section(module.name, first.rstrip("."), tuple(prose.splitlines()), text)


def _narrow(paragraph: str) -> str:
    """A paragraph that leaves room for the comment sign; only running text is filled anew."""
    lines = paragraph.splitlines()
    laid_out = any(line.startswith(" ") or "===" in line for line in lines)
    if laid_out or all(len(line) <= WIDTH - 2 for line in lines):
        return paragraph
    return textwrap.fill(paragraph, WIDTH - 2, break_on_hyphens=False)


def import_lines(imports: Collection[Import]) -> list[str]:
    """Import statements in the order of isort, standard library first."""
    result: list[str] = []
    for standard in (True, False):
        own = [found for found in imports if found.standard == standard]
        block = sorted(f"import {found.text}" for found in own if found.name is None)
        for module in sorted({found.module for found in own if found.name is not None}):
            texts = (found.text for found in own if found.name and found.module == module)
            names = sorted(texts, key=_member_order)
            line = f"from {module} import {', '.join(names)}"
            long = len(line) > WIDTH
            block += tuple_lines(f"from {module} import ", names, "", "") if long else [line]
        if block:
            result += [*block, ""]
    return result[:-1]


def _member_order(name: str) -> tuple[int, str]:
    """Constants, then classes, then functions, as isort has them."""
    kind = 0 if name.isupper() and len(name) > 1 else 1 if name[0].isupper() else 2
    return kind, name.lower()


# --- selection ---------------------------------------------------------------------------------


class _Selection:
    """What is carried over: top-level names by module."""

    def __init__(self) -> None:
        self.names: dict[str, set[str]] = {}
        self.imports: set[Import] = set()
        self.needs: dict[str, set[str]] = {}

    def take(self, roots: Iterable[str]) -> None:
        """Select the roots and everything they reach."""
        for module, name in map(_key, roots):
            if resolve(read_module(module), name) is None:
                raise ExportError(f"`{module}` does not define `{name}`")
            self._take_name(read_module(module), name)

    def order(self) -> list[SourceModule]:
        """The modules, each after those whose definitions it uses where there is no cycle."""
        done: list[str] = []
        open_: set[str] = set()

        def visit(name: str) -> None:
            if name in done or name in open_:
                return
            open_.add(name)
            for other in sorted(self.needs.get(name, ())):
                visit(other)
            open_.discard(name)
            done.append(name)

        for name in self.names:
            visit(name)
        return [read_module(name) for name in done if name in self.names]

    def _take_name(self, module: SourceModule, name: str) -> None:
        found = resolve(module, name)
        if found is None:
            return
        if isinstance(found, Import):
            self.imports.add(found)
            return
        owner, own_name = found
        statement = owner.definitions[own_name]
        if owner is not module and name not in module.typing_imports:
            self.needs.setdefault(module.name, set()).add(owner.name)
        known = self.names.setdefault(owner.name, set())
        if own_name in known:
            return
        known.update(statement.names)
        self._take_node(owner, statement.node)

    def _take_node(self, module: SourceModule, node: ast.AST) -> None:
        """Select what a piece of code refers to."""
        for inner in ast.walk(node):
            if isinstance(inner, ast.Attribute):
                dotted = ast.unparse(inner)
                for found in module.imports.values():
                    if found.name is None and dotted.startswith(f"{found.alias}."):
                        self.imports.add(found)
            elif isinstance(inner, ast.ImportFrom):
                raise ExportError(f"`{module.name}` imports `{inner.module}` in a function")
            elif isinstance(inner, ast.Name) and not hasattr(builtins, inner.id):
                self._take_name(module, inner.id)


def _key(text: str) -> Key:
    module, _, name = text.partition(":")
    return module, name


def _new_names(
    selection: _Selection, order: Sequence[SourceModule], reserved: Collection[str]
) -> dict[Key, str]:
    """New names for those that are taken: the module's name goes in front."""
    taken = {*reserved, *(found.alias.split(".")[0] for found in selection.imports)}
    renamed: dict[Key, str] = {}
    for module in order:
        for name in module.definitions:
            if name not in selection.names[module.name]:
                continue
            new = _prefixed(name, module.stem) if name in taken else name
            if new in taken:
                raise ExportError(f"`{name}` of `{module.name}` is taken, so is `{new}`")
            if new != name:
                renamed[module.name, name] = new
            taken.add(new)
    return renamed


def _prefixed(name: str, stem: str) -> str:
    if name.startswith("_"):
        return f"_{_prefixed(name.strip('_'), stem)}"
    if name.isupper():
        return f"{stem.upper()}_{name}"
    return f"{stem.title() if name[0].isupper() else f'{stem}_'}{name}"


# --- text --------------------------------------------------------------------------------------


class _ModuleText:
    """The text of the selected definitions of one module."""

    def __init__(
        self, module: SourceModule, selection: _Selection, renamed: Mapping[Key, str]
    ) -> None:
        self.module = module
        self.selection = selection
        self.lines = [*module.lines]
        self.renamed = self._local_names(renamed)

    def write(self) -> str:
        """The definitions in their order."""
        parts: list[str] = []
        last: Statement | None = None
        kept = self.selection.names[self.module.name]
        for statement in self.module.statements:
            if kept.intersection(statement.names):
                if last is not None:
                    parts += [""] * self._gap(last, statement)
                parts.append(self._statement(statement))
                last = statement
        return "\n".join(parts)

    def _gap(self, last: Statement, statement: Statement) -> int:
        definitions = (ast.FunctionDef, ast.ClassDef)
        if isinstance(last.node, definitions) or isinstance(statement.node, definitions):
            return 2
        between = self.module.lines[last.last : statement.first - 1]
        return 0 if not between else 1

    def _statement(self, statement: Statement) -> str:
        self._rename(statement.node)
        text = self.lines[statement.first - 1 : statement.last]
        if statement.last > (end := statement.node.end_lineno or 0):
            text = _beside(text, end - statement.last)
        return "\n".join(_plain(_MARK.sub("", line)) for line in text)

    def _local_names(self, renamed: Mapping[Key, str]) -> dict[str, str]:
        """Names of this module that have to be written differently."""
        local = {}
        for name in {*self.module.definitions, *self.module.imports}:
            found = resolve(self.module, name)
            if isinstance(found, tuple) and (found[0].name, found[1]) in renamed:
                local[name] = renamed[found[0].name, found[1]]
        return local

    def _rename(self, node: ast.stmt) -> None:
        places: dict[int, list[tuple[int, str]]] = {}
        for inner in ast.walk(node):
            if isinstance(inner, ast.Name) and inner.id in self.renamed:
                places.setdefault(inner.lineno, []).append((inner.col_offset, inner.id))
            elif isinstance(inner, ast.FunctionDef | ast.ClassDef) and inner.name in self.renamed:
                if inner is node:
                    offset = 4 if isinstance(inner, ast.FunctionDef) else 6
                    places.setdefault(inner.lineno, []).append((offset, inner.name))
            elif isinstance(inner, ast.arg) and inner.arg in self.renamed:
                raise ExportError(f"`{inner.arg}` of `{self.module.name}` is also an argument")
        for number, found in places.items():
            line = self.lines[number - 1].encode()
            for offset, name in sorted(found, reverse=True):
                end = offset + len(name.encode())
                line = line[:offset] + self.renamed[name].encode() + line[end:]
            self.lines[number - 1] = line.decode()


def _beside(lines: list[str], count: int) -> list[str]:
    """A constant with the text below it, its last ``-count`` lines, as a comment if that fits."""
    text = " ".join(line.strip() for line in lines[count:]).strip('"')
    line = f"{lines[count - 1]}  # {text if text.endswith('...') else text.rstrip('.')}"
    return [*lines[: count - 1], line] if len(line) <= WIDTH else lines


def _plain(text: str) -> str:
    """Text without the markup of cross references."""
    return _ROLE.sub(r"`\1`", text)
