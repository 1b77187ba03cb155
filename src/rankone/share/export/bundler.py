"""The bundler: whole modules of the library inside one readable file.

A bundled module is a function without arguments: ``tensors__trains__train`` holds the text of
``tensors.train``. It begins by declaring every name of the module global. :func:`module` runs it
once, with the namespace of a new module as its globals. So each module keeps its own namespace, and
classes and functions keep the plain names that dataclasses and pickle look up. Nothing is compiled
from a string: tracebacks, debuggers, linters and cached bytecode refer to the lines that a person
reads.

Three things change in the text. Imports from the library become relative, the file has one ``from
__future__`` line for all modules, and module constants lose their annotations, which Python forbids
for global names. Imports inside functions or for type checkers add no module.
"""

from __future__ import annotations

import ast
import importlib.machinery
import importlib.util
import inspect
import re
import symtable
import sys
import textwrap
import types
from collections.abc import Callable, Iterable
from functools import cache

from rankone.compiler.codegen.layout import INDENT, WIDTH
from rankone.support.errors import ExportError

_PACKAGE = "rankone"
_FUTURE = re.compile(r"^from __future__ import annotations\n+", re.MULTILINE)
_INTERNAL = re.compile(rf"^(\s*)from {_PACKAGE}\.", re.MULTILINE)


def module(body: Callable[[], None]) -> types.ModuleType:
    """Run the body of a bundled module: ``tensors__trains__train`` becomes ``tensors.train``."""
    name = f"{__name__}.{body.__name__.replace('__', '.')}"
    namespace = importlib.util.module_from_spec(importlib.machinery.ModuleSpec(name, None))
    vars(namespace).update(__file__=__file__, __doc__=body.__doc__, __builtins__=__builtins__)
    sys.modules[name] = namespace
    while (name := name.rpartition(".")[0]) != __name__:
        sys.modules.setdefault(name, types.ModuleType(name))
    types.FunctionType(body.__code__, vars(namespace))()
    return namespace


def bundle(roots: Iterable[str]) -> list[str]:
    """The blocks of text that run the roots and all modules they need, in order of import."""
    blocks = [inspect.getsource(module).rstrip()]
    return blocks + [block(name, source_text(name)) for name in needed_modules(roots)]


def banner(title: str) -> str:
    start = f"# == {title} "
    return start + "=" * max(WIDTH - 1 - len(start), 3)


def bundled_name(name: str) -> str:
    """Name of the function that holds a module."""
    return name.removeprefix(f"{_PACKAGE}.").replace(".", "__")


def needed_modules(roots: Iterable[str]) -> list[str]:
    """The roots and all modules of the library that they import, each after what it imports."""
    order: dict[str, None] = {}

    def visit(name: str) -> None:
        if name not in order:
            for needed in _imports(name):
                visit(needed)
            order[name] = None

    for root in roots:
        visit(root)
    return list(order)


@cache
def source_text(name: str) -> str:
    """Source of a module, found without running it, or an ExportError."""
    spec = importlib.util.find_spec(name)
    if spec is None or not isinstance(spec.loader, importlib.machinery.SourceFileLoader):
        raise ExportError(f"the source of `{name}` is not at hand", term=name)
    return spec.loader.get_source(name) or ""


@cache
def _imports(name: str) -> list[str]:
    """The modules of the library that a module imports when it runs, in their order."""
    needed = []
    for node in ast.parse(source_text(name)).body:
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith(f"{_PACKAGE}."):
            inner = (f"{node.module}.{alias.name}" for alias in node.names)
            needed += [module if _exists(module) else str(node.module) for module in inner]
    return list(dict.fromkeys(needed))


@cache
def _exists(name: str) -> bool:
    try:
        return importlib.util.find_spec(name) is not None
    except ModuleNotFoundError:  # the part before the last dot is not a package
        return False


@cache
def block(name: str, source: str) -> str:
    """A module as a function of the exported file, under a banner."""
    tree = ast.parse(source)
    lines = _without_annotations(source, tree)
    opening = (tree.body[0].end_lineno or 0) if ast.get_docstring(tree) else 0
    body = _FUTURE.sub("", "\n".join(lines[opening:]))
    body = _INTERNAL.sub(rf"\1from {'.' * name.count('.')}", body)
    sections = ["\n".join(lines[:opening]), _declarations(source), body.strip("\n")]
    text = "\n\n".join(section for section in sections if section)
    head = f"{banner(name)}\n\n\n@module\ndef {bundled_name(name)}() -> None:\n"
    return head + textwrap.indent(text, INDENT)


def _without_annotations(source: str, tree: ast.Module) -> list[str]:
    """The lines of a module, without the annotations of its constants."""
    lines = source.splitlines()
    for node in tree.body:
        if isinstance(node, ast.AnnAssign):
            first, last = node.target.end_lineno or 0, node.annotation.end_lineno or 0
            line = lines[first - 1].encode()[: node.target.end_col_offset].decode()
            end = lines[last - 1].encode()[node.annotation.end_col_offset :].decode()
            lines[first - 1 : last] = [line + end, *[""] * (last - first)]
    return lines


def _declarations(source: str) -> str:
    """Statements that declare the names of a module global."""
    symbols = symtable.symtable(source, "module", "exec").get_symbols()
    names = [s.get_name() for s in symbols if s.is_assigned() or s.is_imported()]
    names = [name for name in names if name != "annotations"]
    return textwrap.fill(
        ", ".join(names),
        WIDTH - len(INDENT),
        initial_indent="global ",
        subsequent_indent="global ",
        break_long_words=False,
    ).replace(",\n", "\n")
