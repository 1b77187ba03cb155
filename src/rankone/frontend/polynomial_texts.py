"""Right-hand sides as text, read straight into a table of terms where they are polynomials.

An expression of SymPy for each of a thousand right-hand sides takes seconds to build and to take
apart again. Sums of numbers times functions of time and parameters times products of unknowns need
none; whatever else a text has leaves the problem to the general way.
"""

from __future__ import annotations

import ast
from collections.abc import Mapping
from fractions import Fraction

import sympy as sp

from rankone.expressions.parsing import parse_expression, syntax_trees
from rankone.frontend.term_table import Entry, TermTable, is_smooth
from rankone.support.budget import check_time
from rankone.support.errors import ProblemError

_MOST_TERMS = 2000  # Terms of one right-hand side; longer ones are for the general way to judge
_HIGHEST_POWER = 8  # Of an unknown

_Product = tuple[int, tuple[int, ...]]
"""Number of the function, and the states multiplied, ascending."""
_Sum = dict[_Product, Fraction]
"""A coefficient for each product."""


class NotTabulated(Exception):
    """A text that is no polynomial of the unknowns, or is better not multiplied out."""


def table_of_texts(
    rhs: Mapping[str, object], states: Mapping[str, sp.Expr], coordinates: Mapping[str, sp.Symbol]
) -> TermTable | None:
    """The table of right-hand sides of states; None where the general way has to read them.

    ``coordinates`` are time and the parameters by name.
    """
    reader = _Reader({name: i for i, name in enumerate(states)}, coordinates)
    texts = [rate for rate in rhs.values() if isinstance(rate, str)]
    terms: list[Entry] = []
    if len(texts) < len(rhs):
        return None
    try:
        for i, text in enumerate(texts):
            for (function, multiplied), coefficient in reader.terms(text).items():
                terms.append((coefficient, i, function, multiplied))
    except (NotTabulated, ProblemError, SyntaxError, ValueError, RecursionError, MemoryError):
        return None
    return TermTable(tuple(states.values()), tuple(reader.functions), tuple(terms), tuple(texts))


class _Reader(ast.NodeVisitor):
    """Evaluates texts in sums of products."""

    def __init__(self, places: Mapping[str, int], coordinates: Mapping[str, sp.Symbol]) -> None:
        self.places, self.coordinates = places, coordinates
        self.functions: list[sp.Expr] = [sp.S.One]
        self._numbers: dict[sp.Expr, int] = {sp.S.One: 0}
        self._products: dict[tuple[int, int], int] = {}
        self._source = ""

    def terms(self, text: str) -> _Sum:
        """The terms of a text."""
        check_time()
        total: _Sum = {}
        for self._source, tree in syntax_trees(text):
            _add(total, self.visit(tree))
        if len(total) > _MOST_TERMS:
            raise NotTabulated
        return {product: number for product, number in total.items() if number}

    def generic_visit(self, node: ast.AST) -> _Sum:
        raise NotTabulated

    def visit_Constant(self, node: ast.Constant) -> _Sum:
        if type(node.value) is int:
            return {(0, ()): Fraction(node.value)}
        if type(node.value) is float and self._source.isascii():
            digits = self._source[node.col_offset : node.end_col_offset]
            if abs(node.value) < 1e100 and "e" not in digits.lower():
                return {(0, ()): Fraction(digits.replace("_", ""))}
        return self._function(self._read(node))

    def visit_Name(self, node: ast.Name) -> _Sum:
        if node.id in self.places:
            return {(0, (self.places[node.id],)): Fraction(1)}
        if node.id in self.coordinates:
            return self._function(self.coordinates[node.id])
        return self._function(self._read(node))

    def visit_UnaryOp(self, node: ast.UnaryOp) -> _Sum:
        operand: _Sum = self.visit(node.operand)
        if isinstance(node.op, ast.USub):
            return {product: -number for product, number in operand.items()}
        if isinstance(node.op, ast.UAdd):
            return operand
        raise NotTabulated

    def visit_BinOp(self, node: ast.BinOp) -> _Sum:
        if isinstance(node.op, ast.Pow):
            return self._power(node)
        left, right = self.visit(node.left), self.visit(node.right)
        match node.op:
            case ast.Add():
                return _add(left, right)
            case ast.Sub():
                return _add(left, right, -1)
            case ast.Mult():
                return self._product(left, right)
            case ast.Div():
                divisor = self._expression(right)
                if divisor.is_zero:
                    raise NotTabulated
                return self._product(left, self._function(1 / divisor))
        raise NotTabulated

    def visit_Call(self, node: ast.Call) -> _Sum:
        return self._function(self._read(node))

    def _power(self, node: ast.BinOp) -> _Sum:
        """A whole power of one product; of functions alone, any."""
        base: _Sum = self.visit(node.left)
        exponent = node.right
        if not any(states for _, states in base):
            return self._function(self._read(node))
        power = exponent.value if isinstance(exponent, ast.Constant) else None
        if len(base) != 1 or type(power) is not int or not 1 <= power <= _HIGHEST_POWER:
            raise NotTabulated
        result = base
        for _ in range(power - 1):
            result = self._product(result, base)
        return result

    def _product(self, left: _Sum, right: _Sum) -> _Sum:
        """A product of sums of which at most one has several products of states.

        ``(x - 310)*(y - 310)`` multiplied out is a difference of large numbers.
        """
        if len(left) > 1 and len(right) > 1:
            if any(states for _, states in right):
                left, right = right, left
            right = self._function(self._expression(right))
        if len(left) == 1:
            left, right = right, left
        total: _Sum = {}
        for (f, states), number in left.items():
            for (g, others), factor in right.items():
                both = tuple(sorted(states + others)) if others else states
                product = self._multiplied(f, g), both
                total[product] = total.get(product, 0) + number * factor
        return total

    def _multiplied(self, f: int, g: int) -> int:
        """The number of the product of two functions."""
        if not f or not g:
            return f or g
        if (f, g) not in self._products:
            number, function = (self.functions[f] * self.functions[g]).as_coeff_Mul()
            if number != 1:
                raise NotTabulated
            self._products[f, g] = self._place(function)
        return self._products[f, g]

    def _expression(self, functions: _Sum) -> sp.Expr:
        """A sum without states as an expression."""
        if any(states for _, states in functions):
            raise NotTabulated
        return sp.Add(
            *(
                sp.Rational(number.numerator, number.denominator) * self.functions[f]
                for (f, _), number in functions.items()
            )
        )

    def _place(self, function: sp.Expr) -> int:
        """The number of a function."""
        place = self._numbers.setdefault(function, len(self.functions))
        if place == len(self.functions):
            self.functions.append(function)
        return place

    def _function(self, expression: sp.Expr) -> _Sum:
        """A function of time and parameters, with its number in front."""
        number, function = expression.as_coeff_Mul()
        if not number.is_Rational:
            number, function = sp.S.One, expression
        return {(self._place(function), ()): Fraction(int(number.p), int(number.q))}

    def _read(self, node: ast.expr) -> sp.Expr:
        """A part of a text as an expression of time and parameters."""
        text = ast.get_source_segment(self._source, node) or ast.unparse(node)
        expression = parse_expression(text, self.coordinates, where="formula")
        if not is_smooth(expression):
            raise NotTabulated
        return expression


def _add(left: _Sum, right: _Sum, sign: int = 1) -> _Sum:
    """The first sum with the second added to it."""
    for product, number in right.items():
        left[product] = left.get(product, 0) + sign * number
    return left
