"""Where functions kink, jump, or are narrow, and expressions as numbers."""

from __future__ import annotations

import ast
import itertools
import math
import operator
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import reduce

import numpy as np
import scipy.special
import sympy as sp
from sympy.core.relational import Relational

from rankone.problem.expressions.conditions import slope
from rankone.problem.functions import Table, nodes_of
from rankone.support.arrays import EXACT_DIGITS, FEW, Array

CONTINUOUS = (sp.Abs, sp.Max, sp.Min, sp.asin, sp.acos, sp.Pow)
"""Functions that are continuous, but not smooth everywhere."""
DISCONTINUOUS = (Relational, sp.Heaviside, sp.sign, sp.floor, sp.ceiling, sp.frac, sp.Mod, Table)
"""Functions that may jump."""


def boundaries(
    expressions: Iterable[sp.Basic], functions: tuple[type, ...] = (*CONTINUOUS, *DISCONTINUOUS)
) -> Iterator[tuple[sp.Expr, Sequence[float] | None]]:
    """Where some functions are not smooth: expressions, and the levels that they take there.

    The levels are None for all integers.
    """
    zero = (0.0,)
    for node in nodes_of(expressions, *functions):
        if isinstance(node, Relational):
            yield node.lhs - node.rhs, zero
        elif isinstance(node, sp.Heaviside | sp.sign | sp.Abs):
            yield node.args[0], zero
        elif isinstance(node, sp.Max | sp.Min):
            for pair in itertools.combinations(node.args, 2):
                yield from ((a - b, zero) for a, b in itertools.product(*map(_compared, pair)))
        elif isinstance(node, sp.floor | sp.ceiling | sp.frac):
            yield node.args[0], None
        elif isinstance(node, sp.Mod):
            yield node.args[0] / node.args[1], None
        elif isinstance(node, sp.asin | sp.acos):
            yield node.args[0], (-1.0, 1.0)
        elif node.is_Pow and node.exp.is_number and not node.exp.is_integer:
            yield node.base, zero
        elif isinstance(node, Table) and node.kind != "cubic":
            yield node.args[0], node.points


def _compared(argument: sp.Expr) -> Sequence[sp.Expr]:
    """What an argument of an extreme is where it is smooth: of nested extremes their arguments."""
    if not isinstance(argument, sp.Max | sp.Min):
        return (argument,)
    return [each for inner in argument.args for each in _compared(inner)]


# -----------------------------------------------------------------------------
# Peaks and steps: where smooth expressions may change faster than samples may see.
#
# Peaks are such as ``exp(-((t - 60)/1e-3)**2)``, ``1/(1 + (k/1e-4)**2)``, ``1/cosh(x/1e-3)**2`` and
# ``cos(x)**1000000``; steep steps are ``tanh``, ``erf``, ``atan`` and ``1/(1 + exp(...))``, two of
# which make a pulse.


Variables = Callable[[sp.Basic], Iterable[sp.Expr]]
"""The variables of an expression that count."""
# Functions that change most where their argument vanishes
_STEEPEST_AT_ZERO = (sp.tanh, sp.erf, sp.erfc, sp.atan, sp.cosh, sp.sech)
_PERIODIC = (sp.sin, sp.cos)
_HIGH_POWER = 100  # A power from which a function counts as a peak where its base is extreme


def peaks(
    expressions: Iterable[sp.Basic], variables: Variables
) -> Iterator[tuple[sp.Expr, sp.Expr]]:
    """Functions that may be peaks, and what vanishes in the middle of each.

    How narrow they are depends on the values of the variables. ``variables`` gives those of an
    expression.
    """
    for node in subexpressions(expressions, sp.exp, sp.Pow, *_STEEPEST_AT_ZERO):
        if isinstance(node, sp.exp):
            surfaces = list(extrema(node.exp, variables))
        elif not node.is_Pow:
            surfaces = list(extrema(node.args[0], variables))
            surfaces += [node.args[0]] if isinstance(node, sp.cosh | sp.sech) else []
        elif node.exp.is_number and not node.exp.is_negative and node.exp < _HIGH_POWER:
            continue
        else:
            surfaces = list(extrema(node.base, variables))
        yield from ((node, surface) for surface in surfaces)


def steps(
    expressions: Iterable[sp.Basic], variables: Variables
) -> Iterator[tuple[sp.Expr, sp.Expr]]:
    """Functions that may be steep steps, and what vanishes in the middle of each."""
    for node in subexpressions(expressions, sp.Pow, *_STEEPEST_AT_ZERO):
        if not node.is_Pow:
            yield node, node.args[0]
        elif node.exp.is_number and node.exp.is_negative:
            yield from ((node, surface) for surface in _thresholds(node.base, variables))


def valleys(expressions: Iterable[sp.Basic]) -> Iterator[sp.Expr]:
    """Functions that are least where an exponential or a reciprocal is largest."""
    for node in subexpressions(expressions, sp.exp, sp.Pow):
        if isinstance(node, sp.exp):
            yield -node.exp
        elif node.exp.is_number and node.exp.is_negative:
            yield node.base


def subexpressions(expressions: Iterable[sp.Basic], *functions: type) -> list[sp.Expr]:
    """The applications of some functions, each once, in SymPy's order."""
    return sorted(nodes_of(expressions, *functions), key=sp.default_sort_key)


def _thresholds(base: sp.Expr, variables: Variables) -> Iterator[sp.Expr]:
    """What vanishes where an exponential is as large as another addend of a short sum."""
    addends = base.args if base.is_Add and len(base.args) <= FEW else ()
    for first, second in itertools.combinations(addends, 2):
        (rest, exponent), (other_rest, other) = map(_without_exponentials, (first, second))
        step = exponent - other
        ratio = rest / other_rest
        if variables(step) and not _squares(step, variables):
            shift = sp.log(sp.Abs(ratio))
            if shift.is_number:
                shift = sp.Rational(str(sp.N(shift, EXACT_DIGITS)))
            yield step + shift


def _without_exponentials(term: sp.Expr) -> tuple[sp.Expr, sp.Expr]:
    """A product but for its exponentials, and the sum of their exponents."""
    factors = sp.Mul.make_args(term)
    exponents = [f.exp for f in factors if isinstance(f, sp.exp)]
    return sp.Mul(*(f for f in factors if not isinstance(f, sp.exp))), sp.Add(*exponents)


def extrema(expression: sp.Expr, variables: Variables) -> Iterator[sp.Expr]:
    """What vanishes where an expression is least or largest: what is squared, and slopes.

    In a sum of several squares the steepest one tells where it is least. A slope counts if it is a
    polynomial or periodic, and does not vanish with a square; of one with exponentials it is known
    where two of its addends are as large.
    """
    squares = _squares(expression, variables)
    yield from squares
    for variable in variables(expression):
        rate = slope(expression, variable)
        if not rate.has(variable):
            continue
        if not _is_polynomial(rate, variable) and not any(
            wave.has(variable) for wave in rate.atoms(*_PERIODIC)
        ):
            yield from _thresholds(rate, variables)
        elif not any(_vanishes(rate, square, variable) for square in squares):
            yield rate


def _is_polynomial(expression: sp.Expr, variable: sp.Expr) -> bool:
    """Whether an expression is one in a symbol or an unknown."""
    plain = sp.Dummy()
    return bool(expression.xreplace({variable: plain}).is_polynomial(plain))


def _vanishes(rate: sp.Expr, base: sp.Expr, variable: sp.Expr) -> bool:
    """Whether a slope is zero only where something squared is, as far as that can be seen."""
    factors = sp.Mul.make_args(rate)
    others = [f for f in factors if f.as_base_exp()[0] not in (base, -base)]
    if len(others) < len(factors):
        ascent = slope(base, variable)
        return not any(f.has(variable) for f in others if f not in (ascent, -ascent))
    ascent = slope(base, variable)
    if ascent.has(variable):
        return False
    linear = ascent != 0 and not slope(rate, variable).has(variable)
    return linear and bool(rate.subs(variable, variable - base / ascent).expand() == 0)


def _squares(expression: sp.Basic, variables: Variables) -> list[sp.Expr]:
    """What is raised to an even power, and is not inside another such power.

    Also two factors of which one is the other but for its sign.
    """
    if not variables(expression):
        return []
    if expression.is_Pow and expression.exp.is_even and expression.exp.is_positive:
        return [expression.base]
    squares = [square for argument in expression.args for square in _squares(argument, variables)]
    factors = {f for f in expression.args if f.is_Add} if expression.is_Mul else set()
    pairs = [f for f in expression.args if f in factors and -f in factors and variables(f)]
    return squares + pairs[::2]


# -----------------------------------------------------------------------------
# Expressions and formulas as numbers: their trees evaluated with arrays.


_NAMES = ("sin", "cos", "tan", "exp", "sinh", "cosh", "tanh", "log")
_OF_SYMPY = {
    **{getattr(sp, name): getattr(np, name) for name in _NAMES},
    sp.atan: np.arctan,
    sp.erf: scipy.special.erf,
}


class ArrayProgram:
    """Evaluates expressions of leaves with known values, each subexpression once.

    The value is not a number where there are other functions than smooth ones.
    """

    def __init__(self, leaves: Mapping[sp.Basic, Array]) -> None:
        self._values: dict[sp.Basic, Array | float] = dict(leaves)

    def __call__(self, expression: sp.Expr) -> Array | float:
        """The value of an expression."""
        if expression not in self._values:
            self._values[expression] = self._value(expression)
        return self._values[expression]

    def _value(self, expression: sp.Expr) -> Array | float:
        if expression.is_number:
            return float(expression)
        arguments = [self(argument) for argument in expression.args]
        if expression.is_Add:
            return reduce(operator.add, arguments)
        if expression.is_Mul:
            return reduce(operator.mul, arguments)
        if isinstance(expression, sp.exp):
            return np.exp(arguments[0])
        if expression.is_Pow:
            base, exponent = arguments
            return base**exponent
        function = _OF_SYMPY.get(type(expression))
        return math.nan if function is None else function(*arguments)


# -----------------------------------------------------------------------------
# Formulas as numbers: the syntax tree of a text evaluated with arrays in place of names.


Value = Array | np.float64
_OPERATORS: dict[type[ast.operator], Callable[[Value, Value], Value]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.Pow: operator.pow,
}
_AS_IN_NUMPY = ("sin", "cos", "tan", "exp", "sinh", "cosh", "tanh", "sqrt", "log", "arctan")
_OF_TEXT: dict[str, Callable[[Value], Value]] = {
    **{name: getattr(np, name) for name in _AS_IN_NUMPY},
    "atan": np.arctan,
    "erf": scipy.special.erf,
    "ln": np.log,
}
_PI, _NO_VALUE = np.float64(np.pi), np.float64(np.nan)


def value_of(tree: ast.expr, values: Mapping[str, Array]) -> Value:
    """The value of arithmetic of names and smooth functions; not a number for all else."""
    match tree:
        case ast.Constant(value=int() | float() as number):
            return np.float64(number)
        case ast.Name(id=name):
            return values.get(name, _PI if name == "pi" else _NO_VALUE)
        case ast.UnaryOp(op=ast.USub(), operand=operand):
            return -value_of(operand, values)
        case ast.UnaryOp(op=ast.UAdd(), operand=operand):
            return value_of(operand, values)
        case ast.BinOp(left=left, op=op, right=right) if type(op) in _OPERATORS:
            return _OPERATORS[type(op)](value_of(left, values), value_of(right, values))
        case ast.Call(func=ast.Name(id=name), args=[argument]) if name in _OF_TEXT:
            return _OF_TEXT[name](value_of(argument, values))
    return _NO_VALUE
