"""SymPy expressions as NumPy text."""

from __future__ import annotations

import math
import re
import sys
from collections.abc import Iterator, Sequence
from fractions import Fraction

import sympy as sp
from sympy.printing.precedence import PRECEDENCE, precedence
from sympy.printing.printer import Printer

from rankone.compiler.codegen.layout import MOST_TERMS, literal, quoted
from rankone.problem.expressions.notation import NamedConstant, plain_text
from rankone.problem.expressions.stable import fraction, scaled_power, stable
from rankone.support.errors import ProblemError, SeparationError, quote

_MAX_INTEGER = 10**15  # Every integer up to this is a floating-point number
# Whole powers that are written by squares: NumPy takes ten times as long for others as for these
_SQUARED, _TIMES_BASE = (4, 6, 8), (3, 5, 7)
_SAME_IN_NUMPY = ("cos", "cosh", "exp", "floor", "log", "sign", "sin", "sinh", "tan", "tanh")
_INVERSE = ("cos", "cosh", "sin", "sinh", "tan", "tan2", "tanh")
_SAME_IN_SPECIAL = ("beta", "erf", "erfc", "erfcinv", "erfi", "erfinv", "gamma", "zeta")
FUNCTIONS = {
    **{name: f"np.{name}({{}})" for name in _SAME_IN_NUMPY},
    **{f"a{name}": f"np.arc{name}({{}})" for name in _INVERSE},
    **{name: f"special.{name}({{}})" for name in _SAME_IN_SPECIAL},
    "Abs": "np.abs({})",
    "airyai": "special.airy({})[0]",
    "airyaiprime": "special.airy({})[1]",
    "airybi": "special.airy({})[2]",
    "airybiprime": "special.airy({})[3]",
    "besseli": "special.iv({})",
    "besselj": "special.jv({})",
    "besselk": "special.kv({})",
    "bessely": "special.yv({})",
    "ceiling": "np.ceil({})",
    "cosm1": "special.cosm1({})",
    "Chi": "special.shichi({})[1]",
    "Ci": "special.sici({})[1]",
    "Ei": "special.expi({})",
    "elliptic_e": "special.ellipe({})",
    "elliptic_k": "special.ellipk({})",
    "expint": "special.expn({})",
    "expit": "special.expit({})",
    "expm1": "np.expm1({})",
    "factorial": "special.gamma({} + 1)",
    "frac": "np.mod({}, 1.0)",
    "fresnelc": "special.fresnel({})[1]",
    "fresnels": "special.fresnel({})[0]",
    "Heaviside": "np.heaviside({})",
    "log1p": "np.log1p({})",
    "logaddexp": "np.logaddexp({})",
    "loggamma": "special.gammaln({})",
    "Mod": "np.mod({})",
    "Shi": "special.shichi({})[0]",
    "Si": "special.sici({})[0]",
}
"""Calls of NumPy, and of ``scipy.special`` for real arguments, by the name of SymPy's function."""
NESTED = {"And": "logical_and", "Or": "logical_or", "Min": "minimum", "Max": "maximum"}
"""Binary functions of NumPy for SymPy's functions of two or more arguments."""

RECIPROCALS = {
    sp.sec: sp.cos,
    sp.csc: sp.sin,
    sp.cot: sp.tan,
    sp.sech: sp.cosh,
    sp.csch: sp.sinh,
    sp.coth: sp.tanh,
}
"""Functions that NumPy lacks, and those that they are the reciprocals of."""


class NumPyText(Printer):  # type: ignore[misc]
    """Prints an expression of real symbols, written under ``names``, as a NumPy expression."""

    printmethod = "_numpy_text"

    def __init__(self, names: dict[sp.Symbol, str]) -> None:
        super().__init__()
        self.names = names

    def operand(self, expr: sp.Expr, level: int, *, strict: bool = False) -> str:
        """Text of an operand, in parentheses unless it binds tighter than ``level``."""
        text = str(self._print(expr))
        binding = PRECEDENCE["Add"] if text.startswith("-") else precedence(expr)
        if isinstance(expr, sp.Rational) and expr.q != 1:
            binding = min(binding, PRECEDENCE["Atom" if _is_decimal(expr) else "Mul"])
        if isinstance(expr, sp.Pow) and (expr.exp == -1 or text.startswith("1 / ")):
            binding = PRECEDENCE["Mul"]
        if isinstance(expr, sp.Pow) and _is_product(expr):
            binding = PRECEDENCE["Mul"]
        if isinstance(expr, CALLS):
            binding = PRECEDENCE["Atom"]
        if isinstance(expr, scaled_power):
            binding = PRECEDENCE["Pow"]
        if isinstance(expr, fraction):
            binding = PRECEDENCE["Mul"]
        return f"({text})" if binding < level or (strict and binding == level) else text

    def arguments(self, expr: sp.Basic) -> str:
        return ", ".join(str(self._print(arg)) for arg in expr.args)

    def _print_Symbol(self, expr: sp.Symbol) -> str:
        return self.names[expr] if expr in self.names else str(expr.name)

    def _print_Rational(self, expr: sp.Rational) -> str:
        if _is_decimal(expr):
            return literal(_float(expr))
        return str(expr.p) if expr.q == 1 else f"{expr.p} / {expr.q}"

    _print_Integer = _print_Rational

    def _print_Float(self, expr: sp.Float) -> str:
        return literal(float(expr))

    _print_NumberSymbol = _print_Float

    def _print_NamedConstant(self, expr: NamedConstant) -> str:
        return f"CONSTANTS[{quoted(expr.name)}]"

    def _print_Pi(self, expr: sp.Expr) -> str:
        return "np.pi"

    def _print_Exp1(self, expr: sp.Expr) -> str:
        return "np.e"

    def _print_BooleanAtom(self, expr: sp.Basic) -> str:
        return str(expr)

    def _print_Add(self, expr: sp.Add) -> str:
        terms = sorted(expr.as_ordered_terms(), key=lambda term: term.could_extract_minus_sign())
        if len(terms) > MOST_TERMS:  # Python compiles long sums by recursion
            starts = range(0, len(terms), MOST_TERMS)
            groups = (sp.Add(*terms[k : k + MOST_TERMS], evaluate=False) for k in starts)
            return " + ".join(f"({self._print(group)})" for group in groups)
        text = self.operand(terms[0], PRECEDENCE["Add"])
        if text.startswith("(-"):
            text = str(self._print(terms[0]))
        for term in terms[1:]:
            if term.could_extract_minus_sign():
                text += f" - {self.operand(-term, PRECEDENCE['Add'], strict=True)}"
            else:
                text += f" + {self.operand(term, PRECEDENCE['Add'])}"
        return text

    def _print_Mul(self, expr: sp.Mul) -> str:
        coefficient, product = expr.as_coeff_Mul()
        if coefficient.is_negative:
            return f"-{self.operand(sp.Mul(-coefficient, product), PRECEDENCE['Mul'])}"
        above: list[sp.Expr] = []
        below: list[sp.Expr] = []
        for factor in expr.as_ordered_factors():
            base, exponent = factor.as_base_exp()
            if isinstance(factor, sp.Rational) and factor.q != 1 and not _is_decimal(factor):
                above += [] if factor.p == 1 else [sp.Integer(factor.p)]
                below.append(sp.Integer(factor.q))
            elif isinstance(factor, sp.Pow) and exponent.is_number and exponent.is_negative:
                below.append(base**-exponent)
            else:
                above.append(factor)
        top = " * ".join(self.operand(factor, PRECEDENCE["Mul"]) for factor in above) or "1"
        if not below:
            return top
        bottom = " * ".join(self.operand(factor, PRECEDENCE["Mul"]) for factor in below)
        strict = len(below) > 1 or self.operand(below[0], PRECEDENCE["Mul"], strict=True) != bottom
        return f"{top} / ({bottom})" if strict else f"{top} / {bottom}"

    def _print_Pow(self, expr: sp.Pow) -> str:
        base, exponent = expr.base, expr.exp
        if exponent.is_number and exponent.is_negative:
            below = self.operand(base**-exponent, PRECEDENCE["Mul"], strict=True)
            return f"1 / {below}"
        if exponent == sp.Rational(1, 2):
            return f"np.sqrt({self._print(base)})"
        if base == sp.E:
            return f"np.exp({self._print(exponent)})"
        if exponent in _SQUARED and not isinstance(base, sp.Rational):
            return f"({self._print(base ** (exponent / 2))})**2"
        if _is_product(expr):
            return f"{self._print(base ** (exponent - 1))} * {self._print(base)}"
        return self.power(base, exponent)

    def _print_fraction(self, expr: sp.Expr) -> str:
        numerator, addend = expr.args
        above, below = self.operand(numerator, PRECEDENCE["Mul"]), self._print(numerator)
        text = str(self._print(addend))
        sum_ = f"{below} - {text[1:]}" if text.startswith("-") else f"{below} + {text}"
        return f"{above} / ({sum_})"

    def _print_scaled_power(self, expr: sp.Expr) -> str:
        return self.power(*expr.args)

    def power(self, base: sp.Expr, exponent: sp.Expr) -> str:
        """A power as Python writes it."""
        left = self.operand(base, PRECEDENCE["Pow"], strict=True)
        right = self.operand(exponent, PRECEDENCE["Pow"], strict=True)
        simple = re.fullmatch(r"[\w.]+", left) and re.fullmatch(r"[\w.]+", right)
        return f"{left}**{right}" if simple else f"{left} ** {right}"

    def _print_Function(self, expr: sp.Function) -> str:
        name = type(expr).__name__
        if name not in FUNCTIONS:
            raise unprintable(name, expr)
        return FUNCTIONS[name].format(self.arguments(expr))

    def _print_sinc(self, expr: sp.Function) -> str:
        return f"np.sinc({self.operand(expr.args[0], PRECEDENCE['Mul'])} / np.pi)"

    def _print_LambertW(self, expr: sp.Function) -> str:
        if len(expr.args) > 1:
            raise unprintable("LambertW", expr)
        text = self._print(expr.args[0])
        return f"np.where({text} >= -1 / np.e, special.lambertw({text}).real, np.nan)"

    def _print_polygamma(self, expr: sp.Function) -> str:
        order, argument = expr.args
        if order == 0:
            return f"special.digamma({self._print(argument)})"
        return f"special.polygamma({self.arguments(expr)})"

    def nested(self, expr: sp.Basic) -> str:
        """A binary function of two or more arguments, in a deterministic order."""
        function = f"np.{NESTED[type(expr).__name__]}"
        first, *further = sorted(expr.args, key=sp.default_sort_key)
        text = str(self._print(first))
        for argument in further:
            text = f"{function}({text}, {self._print(argument)})"
        return text

    _print_And = _print_Or = _print_Min = _print_Max = nested

    def _print_Not(self, expr: sp.Not) -> str:
        return f"np.logical_not({self._print(expr.args[0])})"

    def _print_Relational(self, expr: sp.Basic) -> str:
        return f"{self._print(expr.lhs)} {expr.rel_op} {self._print(expr.rhs)}"

    def _print_Piecewise(self, expr: sp.Piecewise) -> str:
        *branches, (default, condition) = expr.args
        text = str(self._print(default))
        if condition != sp.true:
            text = f"np.where({self._print(condition)}, {text}, np.nan)"
        for branch, condition in reversed(branches):
            text = f"np.where({self._print(condition)}, {self._print(branch)}, {text})"
        return text

    def emptyPrinter(self, expr: sp.Basic) -> str:
        raise unprintable(type(expr).__name__, expr)


CALLS = (sp.Piecewise, sp.Min, sp.Max, sp.Mod, sp.Heaviside, sp.LambertW, sp.frac, sp.sinc)
"""Expressions printed as a call, whatever SymPy says of their precedence."""


def unprintable(name: str, expr: sp.Basic) -> SeparationError:
    """The error for a function without a NumPy counterpart."""
    return SeparationError(
        f"the function `{name}` in {quote(expr)} cannot be written with NumPy",
        term=expr,
        remedy="rewrite it with elementary functions or Piecewise, or approximate it beforehand",
    )


def numpy_text(expr: sp.Expr, names: dict[sp.Symbol, str]) -> str:
    """NumPy text of an expression; a SeparationError if a function has no NumPy counterpart.

    >>> k = sp.Symbol("k")
    >>> numpy_text(sp.exp(-k) / (3 * k**2), {k: "k"})
    'np.exp(-k) / (3 * k**2)'
    """
    for function, inverse in RECIPROCALS.items():
        if expr.has(function):
            expr = expr.replace(function, lambda arg, inverse=inverse: 1 / inverse(arg))
    return str(NumPyText(names).doprint(expr))


def factor_text(expr: sp.Expr) -> str:
    """Text for people, in parentheses if it is a sum or a quotient other than ``1/k``."""
    text = plain_text(expr)
    quotient = isinstance(expr, sp.Mul | sp.Pow | sp.Rational) and "/" in text
    quotient = quotient and not text.startswith("1/")
    return f"({text})" if quotient or isinstance(expr, sp.Add) else text


def common_subexpressions(
    expressions: Sequence[sp.Expr], names: dict[sp.Symbol, str], temporaries: Iterator[str]
) -> tuple[list[tuple[str, str]], list[str]]:
    """NumPy text of several expressions, after the names and texts of what they share.

    Names are taken from ``temporaries``; each text uses only what precedes it.
    """
    symbols = (sp.Dummy(name) for name in temporaries)
    expressions = [stable(expression) for expression in expressions]
    replacements, reduced = sp.cse(expressions, symbols=symbols, order="canonical", list=True)
    written = {**names, **{symbol: symbol.name for symbol, _ in replacements}}
    shared = [(symbol.name, numpy_text(term, written)) for symbol, term in replacements]
    return shared, [numpy_text(term, written) for term in reduced]


def _is_product(expr: sp.Pow) -> bool:
    """Whether a power is written as a square, or a square of a square, times the base."""
    return bool(expr.exp in _TIMES_BASE) and isinstance(expr.base, sp.Symbol)


def _is_decimal(rational: sp.Rational) -> bool:
    """Whether a number is a short decimal, or has more digits than floating point holds."""
    if max(abs(rational.p), rational.q) > _MAX_INTEGER:
        return True
    exact = Fraction(int(rational.p), int(rational.q))
    return exact.denominator > 1 and Fraction(repr(float(exact))) == exact


def _float(rational: sp.Rational) -> float:
    """The nearest number; a ProblemError if it is too large, or too small to keep its digits."""
    try:
        nearest = int(rational.p) / int(rational.q)
    except OverflowError:
        nearest = math.inf
    if not sys.float_info.min <= abs(nearest) < math.inf:
        size = "large" if nearest else "small"
        raise ProblemError(
            f"the number {rational.evalf(6)} is too {size}",
            term=rational,
            remedy="change the units",
        )
    return nearest
