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
import math
import re
import sys
import tokenize
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NoReturn

import sympy as sp

from rankone.problem.expressions.notation import LARGEST_SCALE_BITS, check_size, exact
from rankone.support.budget import check_time
from rankone.support.errors import ProblemError, clip, did_you_mean, quote

_AS_IN_SYMPY = (
    *("sin", "cos", "tan", "asin", "acos", "atan", "sinh", "cosh", "tanh", "asinh", "acosh"),
    *("atanh", "exp", "log", "ln", "sqrt", "erf", "erfc", "gamma", "floor", "Abs", "sign"),
    *("Heaviside", "DiracDelta", "Min", "Max", "sec", "csc", "cot", "asec", "acsc", "acot"),
    *("sech", "csch", "coth", "asech", "acsch", "acoth", "atan2"),
)
_INVERSE = ("sin", "cos", "tan", "sinh", "cosh", "tanh")
FUNCTIONS: dict[str, Callable[..., sp.Expr]] = {
    **{name: getattr(sp, name) for name in _AS_IN_SYMPY},
    "ceil": sp.ceiling,
    "abs": sp.Abs,
    "min": sp.Min,
    "max": sp.Max,
    "Mod": sp.Mod,
    **{f"arc{name}": getattr(sp, f"a{name}") for name in _INVERSE},
    "arctan2": sp.atan2,
    "ceiling": sp.ceiling,
    "heaviside": sp.Heaviside,
    "log10": lambda x: sp.log(x) / sp.log(10),
    "log2": lambda x: sp.log(x) / sp.log(2),
    "pow": sp.Pow,
}
"""Functions by name; all take one argument, but for those of two and ``min`` and ``max``."""

CONSTANTS: dict[str, sp.Expr] = {"pi": sp.pi}
"""Constants by name, unless the user gives the name another meaning."""

_OF_TWO = {"Mod", "atan2", "arctan2", "pow"}
_VARIADIC = {"min", "Min", "max", "Max", *_OF_TWO}
# Operators that join any number of terms to one sum, or of factors to one product
_CHAINED = ((ast.Add, ast.Sub), (ast.Mult, ast.Div))
_COMPARED: dict[type[ast.cmpop], Callable[[sp.Expr, sp.Expr], sp.Basic]] = {
    ast.Lt: sp.Lt,
    ast.LtE: sp.Le,
    ast.Gt: sp.Gt,
    ast.GtE: sp.Ge,
}
_LOGIC: dict[type[ast.operator], Callable[[sp.Basic, sp.Basic], sp.Basic]] = {
    ast.BitAnd: sp.And,
    ast.BitOr: sp.Or,
}
_LOGICAL: dict[str, Callable[..., sp.Basic]] = {"And": sp.And, "Or": sp.Or, "Not": sp.Not}
_WORD = re.compile(r"[^\W\d]\w*")
_KEYWORD_SUFFIX = "_as_a_name_"
_LARGEST_LOGARITHM = 300 * math.log(
    10
)  # Of a power of numbers: near the largest float, with room for a factor
# Range of decimal numbers, with its reciprocal: that of floats
_LARGEST_DECIMAL = 10**sys.float_info.max_10_exp
_LARGEST_EXPONENT_DIGITS = 4  # Digits of the exponent of a decimal number; more take SymPy forever
# Largest denominator of an exponent for which SymPy keeps powers of numbers exact in no time
_LARGEST_ROOT = 12
_DEEPEST_NESTING = 24  # Functions inside one another; SymPy takes exponentially long for more
_LONG_FORMULA = 1000  # Formulas of this many characters and more are parsed in pieces
_TERMS_PER_PIECE = 50  # Terms of one piece: Python's parser recurses as deep as a sum is long
_SAFE_INNER_TERMS = 500  # Terms inside parentheses that Python's parser takes in any case
_LARGEST_GAMMA_ARGUMENT = 172  # Beyond it the gamma function exceeds all floating-point numbers
_MOST_ARGUMENTS = 20  # Arguments of a maximum; SymPy compares all pairs of them


def parse_expression(
    text: str,
    names: Mapping[str, sp.Expr],
    *,
    where: str,
    equation: int | None = None,
    further: Mapping[str, Callable[..., sp.Expr]] | None = None,
    unknown_name_remedy: str = "declare it in `parameters`, or give it in `rhs` or `unknowns`",
) -> sp.Expr:
    """Translate a formula into a SymPy expression.

    A formula is Python's arithmetic: ``+ - * / **``, parentheses, numbers, names and calls of
    :data:`FUNCTIONS`; ``^`` is a power too. The user's ``names`` come before :data:`CONSTANTS`; a
    name that stands for an applied function ``x(t)`` may be written ``x`` or ``x(t)``. Messages say
    ``where`` the formula is, ``"right-hand side of `x`"``, and the number of the equation.
    ``further`` functions take any number of arguments. Anything else is a ProblemError that quotes
    the text; for an unknown name its remedy is ``unknown_name_remedy``.
    """
    translator = _Translator(text, names, where, equation, further or {}, unknown_name_remedy)
    try:
        terms = [translator.translated(*piece) for piece in syntax_trees(text)]
    except (RecursionError, MemoryError):
        raise translator.error(
            f"functions, powers or parentheses are nested too deep, or parentheses hold a sum of "
            f"more than {_SAFE_INNER_TERMS} terms,",
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
            remedy=_remedy(text),
        ) from None
    return terms[0] if len(terms) == 1 else sp.Add(*terms)


def syntax_trees(text: str) -> list[tuple[str, ast.expr]]:
    """A formula as pieces of text that add up to it, each with its syntax tree.

    Python would leave out what follows a ``#``, which no formula has.
    """
    if "#" in text:
        raise SyntaxError("`#` begins no comment in a formula")
    one_line = " ".join(text.split()).replace("^", "**")
    # with lambda and other keywords as ordinary names
    names_only = _WORD.sub(lambda m: m[0] + _KEYWORD_SUFFIX * keyword.iskeyword(m[0]), one_line)
    return [(piece, ast.parse(piece, mode="eval").body) for piece in _pieces(names_only)]


def _remedy(text: str) -> str:
    """What to do about a text that is no formula."""
    if "#" in text:
        return "leave comments out"
    if re.search(r"(?<![<>=!])=(?!=)", text):
        return "give what stands on the right of `=` alone"
    if re.search(r"(?<![\w.])\d+\.?\d*[^\W\d_]", re.sub(r"\d[eE][-+]?\d", "0", text)):
        return "write products with `*`, for example `2*x`"
    if re.search(r"\bif\b", text):
        return "write Piecewise((-k*x, x > 1), (0, True))"
    return "write it as in Python, for example `-k*x**2 + sin(t)`"


def _pieces(text: str) -> list[str]:
    """Cut a long formula into sums of some of its terms; parentheses stay whole."""
    if len(text) < _LONG_FORMULA:
        return [text]
    starts, depth, last = [0], 0, ""
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if depth == 0 and token.string in ("+", "-") and (last.isalnum() or last in (")", "_")):
            starts.append(token.start[1])
        depth += (token.string in ("(", "[", "{")) - (token.string in (")", "]", "}"))
        last = token.string[-1:]
    return [text[a:b] for a, b in itertools.pairwise([*starts[::_TERMS_PER_PIECE], len(text)])]


def _depth(expression: sp.Basic) -> int:
    """How deep functions are nested in an expression."""
    deepest = max(map(_depth, expression.args), default=0)
    return deepest + (1 if isinstance(expression, sp.Function) else 0)


@dataclass
class _Translator(ast.NodeVisitor):
    """Translate the few kinds of nodes a formula consists of; refuse all others."""

    text: str
    names: Mapping[str, sp.Expr]
    where: str
    equation: int | None
    further: Mapping[str, Callable[..., sp.Expr]]
    unknown_name_remedy: str
    source: str = ""
    """The piece that is translated."""

    def visit(self, node: ast.AST) -> Any:
        check_time()
        return super().visit(node)

    def translated(self, source: str, tree: ast.expr) -> sp.Expr:
        """A piece of the formula as an expression."""
        self.source = source
        expression: sp.Expr = self.visit(tree)
        return expression

    def error(self, message: str, remedy: str | None = None) -> ProblemError:
        text = quote(self.text)
        place = self.where if self.where.endswith(text) else f"{self.where}, {text}"
        return ProblemError(
            f"{message} in the {place}",
            equation=self.equation,
            term=self.text,
            remedy=remedy,
        )

    def generic_visit(self, node: ast.AST) -> NoReturn:
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
        if len(exponent.lstrip("+-")) <= _LARGEST_EXPONENT_DIGITS:
            decimal = sp.Rational(text)
            if decimal == 0 or 1 / _LARGEST_DECIMAL <= decimal <= _LARGEST_DECIMAL:
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
        raise self.error(f"unknown name {quote(name)}{hint}", self.unknown_name_remedy)

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
        alike = next((kinds for kinds in _CHAINED if isinstance(node.op, kinds)), None)
        if alike is None:
            return self.generic_visit(node)
        first: ast.expr = node
        chain = []
        while isinstance(first, ast.BinOp) and isinstance(first.op, alike):
            chain.append((first.op, first.right))
            first = first.left
        product = self.visit(first)
        operands = [(op, self.visit(right)) for op, right in chain[::-1]]
        if isinstance(node.op, (ast.Add, ast.Sub)):
            signed = (-term if isinstance(op, ast.Sub) else term for op, term in operands)
            return sp.Add(product, *signed)
        for op, factor in operands:
            if isinstance(op, ast.Div) and factor.is_zero:
                raise self.error("division by zero")
            product = product / factor if isinstance(op, ast.Div) else product * factor
        return product

    def _power(self, base: sp.Expr, exponent: sp.Expr) -> sp.Expr:
        scale = base.as_coeff_Mul()[0]  # SymPy takes its power
        if scale.is_Rational and exponent.is_Rational:
            bits = max(int(scale.p).bit_length(), int(scale.q).bit_length())
            large = scale != 1 and bits * abs(exponent) > LARGEST_SCALE_BITS
            if large or (base == scale and _logarithm(base, exponent) > _LARGEST_LOGARITHM):
                power = sp.Pow(scale, exponent, evaluate=False)
                raise self.error(f"{quote(power)} is too large a number")
        if base.is_Rational and exponent.is_Rational and exponent.q > _LARGEST_ROOT:
            with contextlib.suppress(ArithmeticError, ValueError, TypeError):  # 0**(-1/13)
                return exact(sp.Float(float(base) ** float(exponent)))
        power = base**exponent
        if base.is_number and exponent.is_number:
            check_size(power)
        return power

    def visit_Call(self, node: ast.Call) -> sp.Expr:
        if isinstance(node.func, ast.Attribute) and node.func.attr in FUNCTIONS:
            plain = node.func.attr
            raise self.error(f"{quote(ast.unparse(node.func))} is not understood", f"write {plain}")
        if not isinstance(node.func, ast.Name) or node.keywords:
            return self.generic_visit(node)
        name = node.func.id.removesuffix(_KEYWORD_SUFFIX)
        if name in self.names:
            arguments = [self.visit(argument) for argument in node.args]
            if list(self.names[name].args) != arguments or not arguments:
                raise self._wrong_argument(name, arguments)
            return self.names[name]
        if name == "Piecewise":
            return self._piecewise(node.args)
        if name in self.further:
            arguments = [self.visit(argument) for argument in node.args]
            try:
                return self.further[name](*arguments)
            except ProblemError:
                raise
            except (TypeError, ValueError):
                raise self.error(f"{_call(name, arguments)} is not understood") from None
        if name not in FUNCTIONS:
            functions = [*FUNCTIONS, *self.further, "Piecewise"]
            raise self.error(
                f"unknown function {quote(name)}{did_you_mean(name, [*functions, *self.names])}",
                f"the functions known are {', '.join(sorted(functions))}",
            )
        return self._function(name, node.args)

    def _function(self, name: str, nodes: list[ast.expr]) -> sp.Expr:
        """A function of mathematics at what some nodes stand for."""
        if len(nodes) > _MOST_ARGUMENTS:
            raise self.error(f"{quote(name)} has {len(nodes)} arguments")
        arguments = [self.visit(node) for node in nodes]
        if name in _OF_TWO and len(arguments) != 2:
            raise self.error(f"{quote(name)} takes two arguments, not {len(arguments)},")
        if name == "pow":
            return self._power(*arguments)
        if not arguments or (len(arguments) > 1 and name not in _VARIADIC):
            raise self.error(f"{quote(name)} takes one argument, not {len(arguments)},")
        if (
            name == "gamma"
            and arguments[0].is_number
            and not abs(arguments[0]) < _LARGEST_GAMMA_ARGUMENT
        ):
            raise self.error(f"{quote(f'gamma({arguments[0]})')} is too large a number")
        return self._called(name, arguments)

    def _wrong_argument(self, name: str, arguments: list[sp.Expr]) -> ProblemError:
        """The error for a name of the user that is called: x(2), or x(t - 1) for a delay."""
        call, proper = _call(name, arguments), self.names[name].args
        if not proper or len(arguments) != 1 or proper[0] not in arguments[0].free_symbols:
            return self.error(f"{call} is not understood", f"write {name} alone")
        return self.error(
            f"{call} is an unknown at another time",
            f"delays are not supported; unknowns are at the time {proper[0]} alone",
        )

    def _called(self, name: str, arguments: list[sp.Expr]) -> sp.Expr:
        """One of :data:`FUNCTIONS` of arguments."""
        if max(map(_depth, arguments)) >= _DEEPEST_NESTING:
            raise self.error(f"functions are nested more than {_DEEPEST_NESTING} deep")
        try:
            expression = FUNCTIONS[name](*arguments)
            if all(argument.is_number for argument in arguments):
                check_size(expression)
            return expression
        except (ArithmeticError, TypeError):
            raise self.error(f"{_call(name, arguments)} has no value") from None

    def _piecewise(self, branches: list[ast.expr]) -> sp.Expr:
        """``Piecewise((value, condition), ..., (value, True))``."""
        pairs = []
        for branch in branches:
            if not isinstance(branch, ast.Tuple) or len(branch.elts) != 2:
                raise self.error(
                    f"{quote(ast.unparse(branch))} is not a branch of a Piecewise",
                    "write Piecewise((value, condition), ..., (value, True))",
                )
            expression, condition = branch.elts
            pairs.append((self.visit(expression), self._condition(condition)))
        if not pairs:
            raise self.error("`Piecewise` has no branch")
        return sp.Piecewise(*pairs)

    def _condition(self, node: ast.expr) -> sp.Basic:
        """Comparisons, with ``&``, ``|`` and ``~`` or as arguments of functions; ``True``."""
        if isinstance(node, ast.Name) and node.id.removesuffix(_KEYWORD_SUFFIX) == "True":
            return sp.true
        if isinstance(node, ast.BinOp) and type(node.op) in _LOGIC:
            return _LOGIC[type(node.op)](self._condition(node.left), self._condition(node.right))
        if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Invert):
            return sp.Not(self._condition(node.operand))
        if isinstance(node, ast.Call) and ast.unparse(node.func) in _LOGICAL and not node.keywords:
            conditions = [self._condition(argument) for argument in node.args]
            if ast.unparse(node.func) != "Not" or len(conditions) == 1:
                return _LOGICAL[ast.unparse(node.func)](*conditions)
        if isinstance(node, ast.Compare) and all(type(op) in _COMPARED for op in node.ops):
            sides = [self.visit(side) for side in (node.left, *node.comparators)]
            pairs = zip(node.ops, itertools.pairwise(sides), strict=True)
            return sp.And(*(_COMPARED[type(op)](a, b) for op, (a, b) in pairs))
        raise self.error(
            f"{quote(ast.unparse(node).replace(_KEYWORD_SUFFIX, ''))} is not a condition",
            "write for example (t > 1) & (t < 2), or 1 < t < 2",
        )


def _logarithm(base: sp.Rational, exponent: sp.Rational) -> float:
    """The logarithm of the size of a power, whose exact value takes SymPy long."""
    if base == 0:
        return -math.inf if exponent > 0 else math.inf if exponent < 0 else 0.0
    return float(exponent) * (math.log(abs(int(base.p))) - math.log(int(base.q)))


def _call(name: str, arguments: list[sp.Expr]) -> str:
    """A call as messages quote it."""
    return quote(f"{name}({', '.join(map(str, arguments))})")
