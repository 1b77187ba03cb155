"""SBML and Antimony documents, and their formulas as SymPy expressions."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

import sympy as sp
from sympy.logic.boolalg import Boolean

from rankone.support.errors import (
    LISTED,
    ProblemError,
    did_you_mean,
    listing,
    optional_module,
    quote,
)
from rankone.support.files import as_path

if TYPE_CHECKING:
    import libsbml


SBML_SUFFIXES = (".xml", ".sbml")
ANTIMONY_SUFFIXES = (".ant", ".antimony")
_LEVEL, _VERSION = 3, 1  # Earlier levels are raised to this one
_HARMLESS = ("comp", "l3v2extendedmath", "layout", "render", "groups", "fbc", "distrib")
"""Packages that are understood, or that leave the meaning of equations as it is."""


def sbml_library() -> ModuleType:
    """The module ``libsbml``; a ProblemError says how to install it."""
    return optional_module(
        "libsbml",
        "reading SBML needs python-libsbml",
        'pip install python-libsbml, or pip install ".[sbml]" in the folder of the source',
        ProblemError,
    )


def is_model_file(path: Path) -> bool:
    """Whether the suffix says that a file is a model: SBML or Antimony."""
    return path.suffix in (*SBML_SUFFIXES, *ANTIMONY_SUFFIXES)


def open_document(path: object) -> tuple[libsbml.SBMLDocument, libsbml.Model]:
    """The libsbml document of a file and its model, which lives as long as the document does.

    Submodels are flattened, and Levels 1 and 2 are raised to Level 3. A ProblemError if the file
    cannot be read, or needs a package that changes the meaning of its equations.
    """
    file = as_path(path, ProblemError)
    if not is_model_file(file):
        raise ProblemError(
            f"`{file}` is neither an SBML nor an Antimony file",
            term=file,
            remedy=f"give a file that ends in {listing((*SBML_SUFFIXES, *ANTIMONY_SUFFIXES))}",
        )
    if not file.is_file():
        raise ProblemError(f"there is no file `{file}`", term=file)
    libsbml = sbml_library()
    if file.suffix in ANTIMONY_SUFFIXES:
        document = libsbml.readSBMLFromString(_sbml_of_antimony(file))
    else:
        document = libsbml.readSBMLFromFile(str(file.resolve()))  # external models
    _check_errors(document, libsbml, file)
    _check_packages(document, file)
    _flatten(document, libsbml, file)
    if document.getLevel() < _LEVEL and not document.setLevelAndVersion(_LEVEL, _VERSION, False):
        _check_errors(document, libsbml, file)
    model = document.getModel()
    if model is None:
        raise ProblemError(f"`{file}` has no model", term=file)
    return document, model


def _sbml_of_antimony(file: Path) -> str:
    """The SBML that the package ``antimony`` makes of a text."""
    antimony = optional_module(
        "antimony", "reading Antimony needs antimony", "pip install antimony", ProblemError
    )
    antimony.clearPreviousLoads()
    try:
        text = file.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ProblemError(f"`{file}` cannot be read: {error}", term=file) from None
    if antimony.loadAntimonyString(text) < 0:
        message = " ".join(antimony.getLastError().split())
        raise ProblemError(f"`{file}` is not readable Antimony: {message}", term=file)
    return str(antimony.getSBMLString(antimony.getMainModuleName()))


def _check_errors(document: libsbml.SBMLDocument, libsbml: ModuleType, file: Path) -> None:
    """Raise the errors that libsbml found while it read a file."""
    errors = [document.getError(k) for k in range(document.getNumErrors())]
    grave = [error for error in errors if error.getSeverity() >= libsbml.LIBSBML_SEV_ERROR]
    if grave:
        texts = [
            f"line {error.getLine()}: {' '.join(error.getMessage().split())}"
            for error in grave[:LISTED]
        ]
        raise ProblemError(
            f"`{file}` is not readable SBML: {'; '.join(texts)}",
            term=file,
            remedy="let an SBML validator check it",
        )


def _check_packages(document: libsbml.SBMLDocument, file: Path) -> None:
    """Raise for a required package that is not understood."""
    packages = [document.getPlugin(k).getPackageName() for k in range(document.getNumPlugins())]
    for name in packages:
        if name not in _HARMLESS and document.getPackageRequired(name):
            raise ProblemError(
                f"`{file}` requires the SBML package {quote(name)}, which is not supported",
                term=name,
                remedy="export the model without it",
            )
    for k in range(document.getNumUnknownPackages()):
        if document.getUnknownPackagePrefix(k):
            name = document.getUnknownPackagePrefix(k)
            raise ProblemError(
                f"`{file}` uses the unknown SBML package {quote(name)}",
                term=name,
                remedy="export the model without it",
            )


def _flatten(document: libsbml.SBMLDocument, libsbml: ModuleType, file: Path) -> None:
    """Put submodels into the model itself."""
    if document.getPlugin("comp") is None:
        return
    properties = libsbml.ConversionProperties()
    properties.addOption("flatten comp", True)
    properties.addOption("performValidation", False)
    if document.convert(properties) != libsbml.LIBSBML_OPERATION_SUCCESS:
        _check_errors(document, libsbml, file)
        raise ProblemError(
            f"the submodels of `{file}` cannot be put into one model",
            term=file,
            remedy="keep the models that it refers to beside it, or export a flat model",
        )


# -----------------------------------------------------------------------------
# Formulas of SBML as SymPy expressions.
#
# Truth values and numbers stand for each other where a formula mixes them, as SBML allows: a
# condition is 1 where it holds, and a number holds where it is not 0.


AVOGADRO = sp.Rational("6.02214179e23")
"""The constant that SBML Level 3 calls by that name."""

Expressions = Mapping[str, sp.Expr]


@dataclass(frozen=True)
class Vocabulary:
    """What the formulas of a model may name.

    Attributes
    ----------
    names : mapping of str to Expr
        What each id stands for.
    functions : mapping of str to ASTNode
        The definitions of functions.
    time : Symbol
        The time.
    rates : mapping of str to Symbol
        For each id a symbol of its rate of change, for ``rateOf``.
    """

    names: Expressions
    functions: Mapping[str, libsbml.ASTNode]
    time: sp.Symbol
    rates: Mapping[str, sp.Symbol]


@dataclass(frozen=True)
class Formula:
    """Reads the formulas of one element, which messages call the ``subject``.

    ``local`` names come before those of the vocabulary: local parameters of a reaction, and
    arguments of a function.
    """

    vocabulary: Vocabulary
    subject: str
    local: Expressions = field(default_factory=dict)
    calls: tuple[str, ...] = ()

    def expression(self, node: libsbml.ASTNode) -> sp.Expr:
        """The number that a node stands for."""
        kind, library = node.getType(), sbml_library()
        if kind in _numbers():
            return self._number(node)
        if kind == library.AST_NAME:
            return self._named(node.getName())
        if kind == library.AST_NAME_TIME:
            return self.vocabulary.time
        if kind == library.AST_NAME_AVOGADRO:
            return AVOGADRO
        if kind == library.AST_FUNCTION:
            return self._called(node).expression(_body(self._definition(node)))
        if kind == library.AST_FUNCTION_PIECEWISE:
            return self._piecewise(node)
        if kind == library.AST_FUNCTION_RATE_OF:
            return self._rate(node)
        if kind in _conditions():
            return sp.Piecewise((1, self.condition(node)), (0, True))
        if kind not in _functions():
            raise self._unsupported(node)
        return _functions()[kind](*map(self.expression, _children(node)))

    def condition(self, node: libsbml.ASTNode) -> Boolean:
        """The truth value that a node stands for."""
        kind, library = node.getType(), sbml_library()
        if kind == library.AST_FUNCTION:
            return self._called(node).condition(_body(self._definition(node)))
        if kind == library.AST_FUNCTION_PIECEWISE:
            return self._cases(node)
        if kind in _relations():
            sides = [self.expression(child) for child in _children(node)]
            return sp.And(*(_relations()[kind](a, b) for a, b in itertools.pairwise(sides)))
        if kind in _connectives():
            return _connectives()[kind](*map(self.condition, _children(node)))
        if kind in (library.AST_CONSTANT_TRUE, library.AST_CONSTANT_FALSE):
            return sp.true if kind == library.AST_CONSTANT_TRUE else sp.false
        return sp.Ne(self.expression(node), 0)

    def _number(self, node: libsbml.ASTNode) -> sp.Rational:
        library, kind = sbml_library(), node.getType()
        if kind == library.AST_INTEGER:
            return sp.Integer(node.getInteger())
        if kind == library.AST_RATIONAL:
            return sp.Rational(node.getNumerator(), node.getDenominator())
        if kind == library.AST_REAL_E:
            return sp.Rational(f"{node.getMantissa()!r}e{node.getExponent()}")
        return exact_number(node.getReal(), self.subject)

    def _named(self, name: str) -> sp.Expr:
        names = {**self.vocabulary.names, **self.local}
        if name not in names:
            raise self._error(f"the unknown name {quote(name)}{did_you_mean(name, names)}", name)
        return names[name]

    def _rate(self, node: libsbml.ASTNode) -> sp.Expr:
        """The rate of change of a quantity; local parameters do not change."""
        name = node.getChild(0).getName()
        quantity = self.local.get(name, sp.Symbol(name))
        rate = self.vocabulary.rates.get(str(quantity))
        if rate is not None:
            return rate
        if name in self.local and not self.calls:
            return sp.S.Zero
        raise self._error(f"the rate of {quote(name)}, which is no quantity of the model", name)

    def _definition(self, node: libsbml.ASTNode) -> libsbml.ASTNode:
        """The definition of the function that a node calls."""
        name = node.getName()
        definition = self.vocabulary.functions.get(name)
        if definition is None:
            hint = did_you_mean(name, self.vocabulary.functions)
            raise self._error(f"the unknown function {quote(name)}{hint}", name)
        if name in self.calls:
            raise self._error(f"the function {quote(name)}, which calls itself", name)
        return definition

    def _called(self, node: libsbml.ASTNode) -> Formula:
        """Reads the body of the function that a node calls, with its arguments as names."""
        definition = self._definition(node)
        count = definition.getNumChildren() - 1
        arguments = [self.expression(child) for child in _children(node)]
        if len(arguments) != count:
            name = quote(node.getName())
            raise self._error(f"{name} with {len(arguments)} arguments instead of {count}", name)
        names = [definition.getChild(k).getName() for k in range(count)]
        local = dict(zip(names, arguments, strict=True))
        return Formula(self.vocabulary, self.subject, local, (*self.calls, node.getName()))

    def _piecewise(self, node: libsbml.ASTNode) -> sp.Expr:
        children = _children(node)
        branches = [
            (self.expression(children[k]), self.condition(children[k + 1]))
            for k in range(0, len(children) - 1, 2)
        ]
        if len(children) % 2:
            branches.append((self.expression(children[-1]), sp.true))
        if not branches:
            raise self._error("a piecewise without branches", None)
        return sp.Piecewise(*branches)

    def _cases(self, node: libsbml.ASTNode) -> Boolean:
        """The truth value of a piecewise; false where it has no branch."""
        children = _children(node)
        truth = self.condition(children[-1]) if len(children) % 2 else sp.false
        for k in reversed(range(0, len(children) - 1, 2)):
            truth = sp.ITE(self.condition(children[k + 1]), self.condition(children[k]), truth)
        return sp.to_nnf(truth, simplify=False)

    def _unsupported(self, node: libsbml.ASTNode) -> ProblemError:
        if node.getType() == sbml_library().AST_FUNCTION_DELAY:
            return self._error("the csymbol `delay`: delay equations are not supported", node)
        name = node.getName() or sbml_library().formulaToL3String(node)
        return self._error(f"{quote(name)}, which is not supported", node)

    def _error(self, what: str, term: object) -> ProblemError:
        return ProblemError(f"{self.subject} has {what}", term=term)


def exact_number(number: float, subject: str) -> sp.Rational:
    """A number of a file as the decimal that it is written as; it has to be finite."""
    if not math.isfinite(number):
        raise ProblemError(
            f"{subject} has the number {number}", term=number, remedy="give finite numbers"
        )
    return sp.Rational(repr(number))


def _children(node: libsbml.ASTNode) -> list[libsbml.ASTNode]:
    return [node.getChild(k) for k in range(node.getNumChildren())]


def _body(definition: libsbml.ASTNode) -> libsbml.ASTNode:
    return definition.getChild(definition.getNumChildren() - 1)


def _typed(table: Mapping[str, Any]) -> dict[int, Any]:
    """The table by libsbml's numbers of types."""
    library = sbml_library()
    return {getattr(library, f"AST_{name}"): each for name, each in table.items()}


@cache
def _numbers() -> frozenset[int]:
    return frozenset(_typed(dict.fromkeys(("INTEGER", "REAL", "REAL_E", "RATIONAL"))))


@cache
def _relations() -> dict[int, Callable[[sp.Expr, sp.Expr], Boolean]]:
    return _typed(
        {
            "RELATIONAL_EQ": sp.Eq,
            "RELATIONAL_NEQ": sp.Ne,
            "RELATIONAL_LT": sp.Lt,
            "RELATIONAL_LEQ": sp.Le,
            "RELATIONAL_GT": sp.Gt,
            "RELATIONAL_GEQ": sp.Ge,
        }
    )


@cache
def _connectives() -> dict[int, Callable[..., Boolean]]:
    return _typed(
        {
            "LOGICAL_AND": sp.And,
            "LOGICAL_OR": sp.Or,
            "LOGICAL_NOT": sp.Not,
            "LOGICAL_XOR": sp.Xor,
            "LOGICAL_IMPLIES": sp.Implies,
        }
    )


@cache
def _conditions() -> frozenset[int]:
    """Types of nodes that are truth values."""
    constants = _typed(dict.fromkeys(("CONSTANT_TRUE", "CONSTANT_FALSE")))
    return frozenset({*_relations(), *_connectives(), *constants})


@cache
def _functions() -> dict[int, Callable[..., sp.Expr]]:
    named = ("SIN", "COS", "TAN", "SINH", "COSH", "TANH")
    table: dict[str, Callable[..., sp.Expr]] = {
        "PLUS": sp.Add,
        "TIMES": sp.Mul,
        "MINUS": lambda a, *b: a - b[0] if b else -a,
        "DIVIDE": lambda a, b: a / b,
        "POWER": sp.Pow,
        "FUNCTION_POWER": sp.Pow,
        "FUNCTION_ROOT": _root,
        "FUNCTION_EXP": sp.exp,
        "FUNCTION_LN": sp.log,
        "FUNCTION_LOG": _logarithm,
        "FUNCTION_ABS": sp.Abs,
        "FUNCTION_FLOOR": sp.floor,
        "FUNCTION_CEILING": sp.ceiling,
        "FUNCTION_FACTORIAL": lambda n: sp.gamma(n + 1),
        "FUNCTION_MIN": sp.Min,
        "FUNCTION_MAX": sp.Max,
        "FUNCTION_QUOTIENT": _quotient,
        "FUNCTION_REM": lambda a, b: a - b * _quotient(a, b),
        "CONSTANT_E": lambda: sp.E,
        "CONSTANT_PI": lambda: sp.pi,
    }
    for name in named:
        function = getattr(sp, name.lower())
        table[f"FUNCTION_{name}"] = function
        table[f"FUNCTION_ARC{name}"] = getattr(sp, f"a{name.lower()}")
    for name, inverse in (("SEC", "cos"), ("CSC", "sin"), ("COT", "tan")):
        for end in ("", "H"):
            table[f"FUNCTION_{name}{end}"] = _reciprocal(getattr(sp, inverse + end.lower()))
            arc = getattr(sp, f"a{inverse}{end.lower()}")
            table[f"FUNCTION_ARC{name}{end}"] = _of_reciprocal(arc)
    return _typed(table)


def _reciprocal(function: Callable[[sp.Expr], sp.Expr]) -> Callable[[sp.Expr], sp.Expr]:
    return lambda x: 1 / function(x)


def _of_reciprocal(function: Callable[[sp.Expr], sp.Expr]) -> Callable[[sp.Expr], sp.Expr]:
    return lambda x: function(1 / x)


def _root(*arguments: sp.Expr) -> sp.Expr:
    """The root of a degree, by default 2, which comes first."""
    *degree, radicand = arguments
    return radicand ** (1 / (degree[0] if degree else sp.Integer(2)))


def _logarithm(*arguments: sp.Expr) -> sp.Expr:
    """The logarithm of a base, by default 10, which comes first."""
    *base, argument = arguments
    return sp.log(argument) / sp.log(base[0] if base else sp.Integer(10))


def _quotient(a: sp.Expr, b: sp.Expr) -> sp.Expr:
    """The quotient without its fraction: towards zero."""
    ratio = a / b
    return sp.Piecewise((sp.floor(ratio), ratio >= 0), (sp.ceiling(ratio), True))


def members(container: libsbml.ListOf) -> list[Any]:
    """The elements of one of libsbml's lists."""
    return [container.get(k) for k in range(container.size())]
