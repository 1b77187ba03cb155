"""Modules of the library as text: their top-level statements and what names stand for.

The exporter carries definitions over, not modules: it reads the source of a module without
importing it and follows ``from rankone... import name`` to where the name is defined.
"""

from __future__ import annotations

import ast
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from importlib.util import find_spec
from typing import Any, cast

from rankone.support.errors import ExportError

__all__ = ["PACKAGE", "Import", "SourceModule", "Statement", "read_module", "resolve"]

PACKAGE = "rankone"


@dataclass(frozen=True)
class Import:
    """One imported name: ``from module import name as alias``, or ``import module as alias``."""

    module: str
    name: str | None
    alias: str

    @property
    def internal(self) -> bool:
        """Whether it comes from the library itself."""
        return self.module.split(".")[0] == PACKAGE

    @property
    def standard(self) -> bool:
        """Whether it comes from the standard library."""
        return self.module.split(".")[0] in sys.stdlib_module_names

    @property
    def text(self) -> str:
        """The name as an import statement has it: ``numpy as np``."""
        own = self.name or self.module
        return own if own == self.alias else f"{own} as {self.alias}"


@dataclass(frozen=True)
class Statement:
    """A top-level statement that binds names, with the comments before it.

    Attributes
    ----------
    names : tuple of str
        The names it binds.
    first, last : int
        Its lines, counted from 1: with leading comments, decorators and the text that documents a
        constant.
    """

    node: ast.stmt
    names: tuple[str, ...]
    first: int
    last: int


class SourceModule:
    """The text of one module and what its top level binds.

    Parameters
    ----------
    name : str
        Full name; the module is found but not run.
    """

    def __init__(self, name: str) -> None:
        spec = find_spec(name)
        loader = cast(Any, spec.loader if spec else None)
        source = loader.get_source(name) if loader else None
        if source is None:
            raise ExportError(f"the source of `{name}` is not at hand", term=name)
        self.name = name
        self.lines: list[str] = source.splitlines()
        self.tree = ast.parse(source)
        self.imports: dict[str, Import] = {}
        self.typing_imports: set[str] = set()
        self.statements: list[Statement] = []
        self._read()

    @property
    def stem(self) -> str:
        return self.name.rsplit(".", 1)[-1]

    @cached_property
    def docstring(self) -> str:
        return ast.get_docstring(self.tree) or ""

    @cached_property
    def definitions(self) -> dict[str, Statement]:
        """The statement that binds each name."""
        return {name: s for s in self.statements for name in s.names}

    def _read(self) -> None:
        previous = 0
        for node in self.tree.body:
            if isinstance(node, ast.Import | ast.ImportFrom | ast.If):
                found = {name.alias: name for inner in ast.walk(node) for name in imported(inner)}
                self.imports |= found
                self.typing_imports |= found.keys() if isinstance(node, ast.If) else set()
            elif isinstance(node, ast.Expr):
                if self.statements and _documents(node, self.statements[-1]):
                    last = self.statements.pop()
                    end = node.end_lineno or 0
                    self.statements.append(Statement(last.node, last.names, last.first, end))
            elif names := tuple(name for name in bound_names(node) if name != "__all__"):
                first = self._leading(node, previous)
                self.statements.append(Statement(node, names, first, node.end_lineno or 0))
            previous = node.end_lineno or 0

    def _leading(self, node: ast.stmt, previous: int) -> int:
        """First line of the decorators of a statement and of the comments right before it."""
        decorators: list[ast.expr] = getattr(node, "decorator_list", [])
        first = min([node.lineno, *(item.lineno for item in decorators)])
        while first - 1 > previous and self.lines[first - 2].startswith("#"):
            first -= 1
        return first


def bound_names(node: ast.stmt) -> Iterator[str]:
    """Names that a top-level statement binds."""
    if isinstance(node, ast.FunctionDef | ast.ClassDef):
        yield node.name
    elif isinstance(node, ast.Assign | ast.AnnAssign):
        targets: Sequence[ast.expr]
        targets = node.targets if isinstance(node, ast.Assign) else [node.target]
        for target in targets:
            yield from (leaf.id for leaf in ast.walk(target) if isinstance(leaf, ast.Name))


def imported(node: ast.AST) -> Iterator[Import]:
    """Names that a node binds, if it is an import statement."""
    if isinstance(node, ast.Import | ast.ImportFrom):
        for alias in node.names:
            own = alias.asname or alias.name
            if isinstance(node, ast.Import):
                yield Import(alias.name, None, own)
            else:
                yield Import(node.module or "", alias.name, own)


def _documents(node: ast.Expr, last: Statement) -> bool:
    """Whether the statement is the text below a constant."""
    is_text = isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)
    return is_text and isinstance(last.node, ast.Assign | ast.AnnAssign)


@cache
def read_module(name: str) -> SourceModule:
    """The module of that name; read once."""
    return SourceModule(name)


def resolve(module: SourceModule, name: str) -> tuple[SourceModule, str] | Import | None:
    """What a name of a module stands for.

    Returns
    -------
    (SourceModule, str)
        A definition of the library, followed through the packages that pass it on.
    Import
        A name from outside of the library.
    None
        Neither: a builtin or a local variable.
    """
    if name in module.definitions:
        return module, name
    found = module.imports.get(name)
    if found is None:
        return None
    if not found.internal:
        return found
    if found.name is None or found.alias != found.name:
        raise ExportError(
            f"`{module.name}` imports `{found.alias}` from `{found.module}` in a way that cannot "
            "be carried over",
            remedy="import it by its own name: from rankone.x import name",
        )
    return resolve(read_module(found.module), found.name)
