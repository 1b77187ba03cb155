"""Text to SymPy: arithmetic, the usual functions and the user's own names, and nothing else.

The text is parsed by :mod:`ast` and translated node by node, so that no text is ever evaluated as
Python, and names such as ``S``, ``N``, ``E``, ``I``, ``beta`` or ``lambda`` mean what the user
says they mean.
"""

from __future__ import annotations

import ast
import contextlib
import io
import itertools
import keyword
import re
import tokenize
from collections.abc import Callable, Mapping
from typing import Any

import sympy as sp

from rankone.expressions.numbers import check_size, exact
from rankone.support.budget import check_time
from rankone.support.errors import ProblemError
from rankone.support.wording import clip, did_you_mean, quote

__all__ = ["CONSTANTS", "FUNCTIONS", "parse_expression"]

_AS_IN_SYMPY = (
    *("sin", "cos", "tan", "asin", "acos", "atan", "sinh", "cosh", "tanh", "asinh", "acosh"),
    *("atanh", "exp", "log", "ln", "sqrt", "erf", "erfc", "gamma", "floor", "Abs", "sign"),
    *("Heaviside", "DiracDelta", "Min", "Max"),
)
FUNCTIONS: dict[str, Callable[..., sp.Expr]] = {
    **{name: getattr(sp, name) for name in _AS_IN_SYMPY},
    "ceil": sp.ceiling,
    "abs": sp.Abs,
    "min": sp.Min,
    "max": sp.Max,
    "Mod": sp.Mod,
}
"""Functions known by name; all take one argument but ``min``, ``max`` and ``Mod``."""

CONSTANTS: dict[str, sp.Expr] = {"pi": sp.pi}
"""Constants known by name, unless the user gives the name another meaning."""

_VARIADIC = {"min", "Min", "max", "Max", "Mod"}
_CHAINED = ((ast.Add, ast.Sub), (ast.Mult, ast.Div))
"""Operators of which a row is one sum or one product."""
_COMPARED: dict[type[ast.cmpop], Callable[[Any, Any], Any]] = {
    ast.Lt: sp.Lt,
    ast.LtE: sp.Le,
    ast.Gt: sp.Gt,
    ast.GtE: sp.Ge,
}
_LOGIC: dict[type[ast.operator], Callable[[Any, Any], Any]] = {ast.BitAnd: sp.And, ast.BitOr: sp.Or}
_WORD = re.compile(r"[^\W\d]\w*")
_KEYWORD_SUFFIX = "_as_a_name_"
_LONGEST_POWER_BITS, _LONGEST_SCALE_BITS = 4096, 100_000
"""Bits of a power of a number, and of one that a variable is multiplied by."""
_LARGEST = 10**300
_LARGEST_FLOAT = 10**308
_LONGEST_EXPONENT = 4
"""Digits of the exponent of a number."""
_FINEST_ROOT = 12
"""Largest denominator of an exponent for which powers of numbers stay as they are."""
_DEEPEST = 24
_LONG, _TOGETHER, _MOST_INSIDE = 1000, 50, 500
"""Characters from which a formula is parsed in pieces of so many terms, and how long a sum inside
parentheses may be at least."""
_LARGEST_GAMMA = 172
"""Beyond, the gamma function is larger than any floating-point number."""
_MOST_ARGUMENTS = 20
"""SymPy compares all pairs of the arguments of a maximum."""


def parse_expression(
    text: str,
    names: Mapping[str, sp.Expr],
    *,
    where: str,
    equation: int | None = None,
    further: Mapping[str, Callable[..., sp.Expr]] | None = None,
) -> sp.Expr:
    """Translate a formula into a SymPy expression.

    It is one in Python's arithmetic: ``+ - * / **``, parentheses, numbers, names and calls of
    :data:`FUNCTIONS`. What the user's ``names`` stand for comes before :data:`CONSTANTS`; one that
    stands for an applied function ``x(t)`` may be written ``x`` or ``x(t)``. Messages say
    ``where`` the formula is, ``"right-hand side of `x`"``, and the number of the equation. There
    may be ``further`` functions, of any number of arguments.

    Raises
    ------
    ProblemError
        If the text is not such a formula; the message quotes it.
    """
    translator = _Translator(text, names, where, equation, further)
    try:
        pieces = _pieces(_protect_keywords(" ".join(text.split())))
        values = [translator.translated(piece) for piece in pieces]
    except (RecursionError, MemoryError):
        raise translator.error(
            f"functions, powers or parentheses are nested too deep, or parentheses hold a sum of "
            f"more than {_MOST_INSIDE} terms,",
            "give parts of it names of their own: as unknowns, or as Python variables in SymPy",
        ) from None
    except (SyntaxError, ValueError, tokenize.TokenError) as error:
        if isinstance(error, ProblemError):
            raise
        reason = f" ({error.msg})" if isinstance(error, SyntaxError) else ""
        raise ProblemError(
            f"the {where}, {quote(text)}, is not a formula{reason}",
            equation=equation,
            term=text,
            remedy="write it as in Python, for example `-k*x**2 + sin(t)`",
        ) from None
    value: sp.Expr = values[0] if len(values) == 1 else sp.Add(*values)
    return value


def _pieces(text: str) -> list[str]:
    """A formula as sums of some of its terms each: Python's parser goes as deep as sums are long.

    What is inside parentheses stays together.
    """
    if len(text) < _LONG:
        return [text]
    starts, depth, before = [0], 0, ""
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if depth == 0 and token.string in ("+", "-") and (before.isalnum() or before in (")", "_")):
            starts.append(token.start[1])
        depth += (token.string in ("(", "[", "{")) - (token.string in (")", "]", "}"))
        before = token.string[-1:]
    return [text[a:b] for a, b in itertools.pairwise([*starts[::_TOGETHER], len(text)])]


def _depth(expression: sp.Basic) -> int:
    """How deep functions are nested in an expression."""
    inner = max(map(_depth, expression.args), default=0)
    return inner + (1 if isinstance(expression, sp.Function) else 0)


def _protect_keywords(text: str) -> str:
    """Turn ``lambda`` and its like into ordinary names."""

    def protect(match: re.Match[str]) -> str:
        word = match.group()
        return word + _KEYWORD_SUFFIX if keyword.iskeyword(word) else word

    return _WORD.sub(protect, text)


class _Translator(ast.NodeVisitor):
    """Translate the few kinds of nodes a formula consists of; refuse all others."""

    def visit(self, node: ast.AST) -> Any:
        check_time()
        return super().visit(node)

    def __init__(
        self,
        text: str,
        names: Mapping[str, sp.Expr],
        where: str,
        equation: int | None,
        further: Mapping[str, Callable[..., sp.Expr]] | None,
    ) -> None:
        self.text = text
        self.source = ""
        self.names = names
        self.where = where
        self.equation = equation
        self.further = further or {}

    def translated(self, source: str) -> sp.Expr:
        """A piece of the formula as an expression."""
        self.source = source
        value: sp.Expr = self.visit(ast.parse(source, mode="eval").body)
        return value

    def error(self, message: str, remedy: str | None = None) -> ProblemError:
        return ProblemError(
            f"{message} in the {self.where}, {quote(self.text)}",
            equation=self.equation,
            term=self.text,
            remedy=remedy,
        )

    def generic_visit(self, node: ast.AST) -> Any:
        shown = quote(ast.unparse(node).replace(_KEYWORD_SUFFIX, ""))
        raise self.error(
            f"{shown} is not understood",
            "use numbers, names, + - * / **, parentheses and functions such as sin, exp, sqrt",
        )

    def visit_Constant(self, node: ast.Constant) -> sp.Expr:
        if type(node.value) is int:
            return sp.Integer(node.value)
        if type(node.value) is float:
            return self._decimal(node, node.value)
        return self.generic_visit(node)

    def _decimal(self, node: ast.Constant, value: float) -> sp.Rational:
        """A decimal number, exactly as it is written."""
        text = (ast.get_source_segment(self.source, node) or repr(value)).replace("_", "")
        digits, _, exponent = text.lower().partition("e")
        if len(exponent.lstrip("+-")) <= _LONGEST_EXPONENT:
            decimal = sp.Rational(text)
            if decimal == 0 or 1 / _LARGEST_FLOAT <= decimal <= _LARGEST_FLOAT:
                return decimal
        elif not digits.strip("0."):
            return sp.S.Zero
        size = "small" if value < 1.0 else "large"
        raise self.error(f"the number {clip(text, 40)} is too {size}", "change the units")

    def visit_Name(self, node: ast.Name) -> sp.Expr:
        name = node.id.removesuffix(_KEYWORD_SUFFIX)
        if name in self.names:
            return self.names[name]
        if name in CONSTANTS:
            return CONSTANTS[name]
        if name in FUNCTIONS:
            raise self.error(f"function {quote(name)} has no argument", f"write {name}(...)")
        hint = did_you_mean(name, [*self.names, *CONSTANTS])
        raise self.error(
            f"unknown name {quote(name)}{hint}", "declare it in `parameters` or give it in `rhs`"
        )

    def visit_UnaryOp(self, node: ast.UnaryOp) -> sp.Expr:
        operand = self.visit(node.operand)
        if isinstance(node.op, ast.USub):
            return -operand
        if isinstance(node.op, ast.UAdd):
            return operand
        return self.generic_visit(node)

    def visit_BinOp(self, node: ast.BinOp) -> sp.Expr:
        if isinstance(node.op, ast.Pow):
            return self._power(self.visit(node.left), self.visit(node.right))
        if isinstance(node.op, ast.BitXor):
            raise self.error("`^` is not a power", "write `**`")
        alike = next((kinds for kinds in _CHAINED if isinstance(node.op, kinds)), None)
        if alike is None:
            return self.generic_visit(node)
        first: ast.expr = node
        chain = []
        while isinstance(first, ast.BinOp) and isinstance(first.op, alike):
            chain.append((first.op, first.right))
            first = first.left
        value, *others = self.visit(first), *((op, self.visit(right)) for op, right in chain[::-1])
        if isinstance(node.op, (ast.Add, ast.Sub)):
            signed = (-term if isinstance(op, ast.Sub) else term for op, term in others)
            return sp.Add(value, *signed)
        for op, factor in others:
            if isinstance(op, ast.Div) and factor.is_zero:
                raise self.error("division by zero")
            value = value / factor if isinstance(op, ast.Div) else value * factor
        return value

    def _power(self, base: sp.Expr, exponent: sp.Expr) -> sp.Expr:
        number = base.as_coeff_Mul()[0]  # SymPy takes its power
        if number.is_Rational and exponent.is_Rational:
            bits = max(int(number.p).bit_length(), int(number.q).bit_length())
            most = _LONGEST_POWER_BITS if base == number else _LONGEST_SCALE_BITS
            large = number != 1 and bits * abs(exponent) > most
            if large or (base == number and abs(sp.N(base**exponent)) > _LARGEST):
                power = sp.Pow(number, exponent, evaluate=False)
                raise self.error(f"{quote(power)} is too large a number")
        if base.is_Rational and exponent.is_Rational and exponent.q > _FINEST_ROOT:
            with contextlib.suppress(ArithmeticError, ValueError, TypeError):  # 0**(-1/13)
                return exact(sp.Float(float(base) ** float(exponent)))
        power = base**exponent
        if base.is_number and exponent.is_number:
            check_size(power)
        return power

    def visit_Call(self, node: ast.Call) -> sp.Expr:
        if not isinstance(node.func, ast.Name) or node.keywords:
            return self.generic_visit(node)
        name = node.func.id.removesuffix(_KEYWORD_SUFFIX)
        if name in self.names:
            return self._applied(name, [self.visit(argument) for argument in node.args])
        if name == "Piecewise":
            return self._piecewise(node.args)
        if name in self.further:
            return self._further(name, [self.visit(argument) for argument in node.args])
        if name not in FUNCTIONS:
            known = [*FUNCTIONS, *self.further, "Piecewise"]
            raise self.error(
                f"unknown function {quote(name)}{did_you_mean(name, [*known, *self.names])}",
                f"the functions known are {', '.join(sorted(known))}",
            )
        if len(node.args) > _MOST_ARGUMENTS:
            raise self.error(f"{quote(name)} has {len(node.args)} arguments")
        arguments = [self.visit(argument) for argument in node.args]
        if name == "Mod" and len(arguments) != 2:
            raise self.error(f"{quote(name)} takes two arguments, not {len(arguments)},")
        if not arguments or (len(arguments) > 1 and name not in _VARIADIC):
            raise self.error(f"{quote(name)} takes one argument, not {len(arguments)},")
        if name == "gamma" and arguments[0].is_number and not abs(arguments[0]) < _LARGEST_GAMMA:
            raise self.error(f"{quote(f'gamma({arguments[0]})')} is too large a number")
        return self._value(name, arguments)

    def _further(self, name: str, arguments: list[sp.Expr]) -> sp.Expr:
        """One of the further functions."""
        try:
            return self.further[name](*arguments)
        except ProblemError:
            raise
        except (TypeError, ValueError):
            called = f"{name}({', '.join(map(str, arguments))})"
            raise self.error(f"{quote(called)} is not understood") from None

    def _value(self, name: str, arguments: list[sp.Expr]) -> sp.Expr:
        """A function of arguments; SymPy takes exponentially long where functions are nested."""
        if max(map(_depth, arguments)) >= _DEEPEST:
            raise self.error(f"functions are nested more than {_DEEPEST} deep")
        try:
            value = FUNCTIONS[name](*arguments)
            if all(argument.is_number for argument in arguments):
                check_size(value)
            return value
        except (ArithmeticError, TypeError):
            called = f"{name}({', '.join(map(str, arguments))})"
            raise self.error(f"{quote(called)} has no value") from None

    def _piecewise(self, branches: list[ast.expr]) -> sp.Expr:
        """``Piecewise((value, condition), ..., (value, True))``."""
        pairs = []
        for branch in branches:
            if not isinstance(branch, ast.Tuple) or len(branch.elts) != 2:
                raise self.error(
                    f"{quote(ast.unparse(branch))} is no branch of a Piecewise",
                    "write Piecewise((value, condition), ..., (value, True))",
                )
            value, condition = branch.elts
            pairs.append((self.visit(value), self._condition(condition)))
        if not pairs:
            raise self.error("`Piecewise` has no branch")
        return sp.Piecewise(*pairs)

    def _condition(self, node: ast.expr) -> sp.Basic:
        """Comparisons, joined by ``&`` and ``|``; ``True``."""
        if isinstance(node, ast.Name) and node.id.removesuffix(_KEYWORD_SUFFIX) == "True":
            return sp.true
        if isinstance(node, ast.BinOp) and type(node.op) in _LOGIC:
            return _LOGIC[type(node.op)](self._condition(node.left), self._condition(node.right))
        if isinstance(node, ast.Compare) and all(type(op) in _COMPARED for op in node.ops):
            sides = [self.visit(side) for side in (node.left, *node.comparators)]
            pairs = zip(node.ops, itertools.pairwise(sides), strict=True)
            return sp.And(*(_COMPARED[type(op)](a, b) for op, (a, b) in pairs))
        raise self.error(
            f"{quote(ast.unparse(node).replace(_KEYWORD_SUFFIX, ''))} is no condition",
            "write for example (t > 1) & (t < 2), or 1 < t < 2",
        )

    def _applied(self, name: str, arguments: list[sp.Expr]) -> sp.Expr:
        """Accept ``x(t)`` for the unknown ``x``."""
        meant = self.names[name]
        if not arguments or list(meant.args) != arguments:
            called = f"{name}({', '.join(map(str, arguments))})"
            raise self.error(f"{quote(called)} is not understood", f"write {name} alone")
        return meant
