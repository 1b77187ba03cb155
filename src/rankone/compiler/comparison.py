"""Values of expressions at a hundred digits, and residuals that are more than rounding.

The values come from the expression tree alone, by mpmath. Nothing here is shared with the printer
of generated code: this is what that code is compared with.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Container, Iterable, Mapping, Sequence, Set
from typing import cast

import mpmath
import numpy as np
import sympy as sp
from mpmath.libmp import (
    fone,
    from_float,
    fzero,
    mpf_abs,
    mpf_add,
    mpf_div,
    mpf_mul,
    mpf_neg,
    mpf_pow_int,
    mpf_sub,
    to_float,
)
from sympy.core.relational import Relational

from rankone.support.arrays import ACCUMULATED, EPSILON, SEED, TINY, Array

Number = tuple[int, int, int, int]
"""A floating-point number of mpmath: sign, mantissa, exponent, bits."""
Operation = Callable[..., Number | bool]
"""A function of the values of subexpressions; conditions have truth values."""

_CONTEXT = mpmath.MPContext()
# Decimal digits of the numbers: where terms cancel over many decades, more digits remain than the
# sixteen of floating point
_CONTEXT.dps = 100
PRECISION = _CONTEXT.prec
"""Bits of the numbers."""
_LARGEST_ARGUMENT = 1e100  # Of functions that grow or take seconds beyond
_MOST_MULTIPLIED_POWER = 1000  # Integer exponents up to which powers are products
_STEP = from_float(1e-35)  # Of difference quotients: half of the digits remain in the difference
# Relative error of the evaluation: log(1 + 1e-178) has no digits either
_LAST_DIGITS = 10.0 ** (10 - _CONTEXT.dps)
# Residuals below the accumulated error, as a share of the terms, are rounding. A larger one is
# compared with the effect of relative errors of this size in all intermediate results.
_RUNS = 4  # Evaluations with disturbed intermediate results: few, as only the largest effect counts
_SPREAD_RATIO = 10.0  # Largest residual over that effect: a few runs do not meet the worst errors
LOST_SHARE = 0.01
"""A residual above this share of the largest value leaves no digits that count."""
_NEGLIGIBLE_SHARE = 1e-30  # Of the terms: smaller residuals, as between steep steps, do not matter
_TINY_SHARE = 1e-120  # Residuals below this share of the largest terms are underflow


class NoValueError(Exception):
    """An expression has no real value, or one that is too large to be computed."""


class Program:
    """Expressions as a list of operations, each subexpression once.

    The ``leaves`` are symbols, functions of time and derivatives, whose values are given.
    """

    def __init__(self, expressions: Sequence[sp.Basic], leaves: Iterable[sp.Basic]) -> None:
        self._register: dict[sp.Basic, int] = {leaf: i for i, leaf in enumerate(leaves)}
        self._inputs = len(self._register)
        self.steps: list[tuple[Operation, tuple[int, ...]]] = []
        self._outputs = [self._added(expression) for expression in expressions]

    def __call__(
        self, leaves: Sequence[Number], noise: np.random.Generator | None = None, size: float = 0.0
    ) -> list[Number]:
        """The values of the expressions from those of the leaves.

        With ``noise``, every intermediate result is off by a random part of up to ``size``: this
        shows what rounding does to the final ones (Parker, Monte Carlo arithmetic, UCLA 1997).
        """
        registers: list[Number | bool] = list(leaves)
        if noise is not None:
            errors = noise.uniform(-size, size, len(leaves) + len(self.steps)).tolist()
            registers = [_disturbed(x, e) for x, e in zip(leaves, errors, strict=False)]
        for step, (function, sources) in enumerate(self.steps):
            try:
                outcome = function(*(registers[i] for i in sources))
            except (ArithmeticError, ValueError, MemoryError) as error:
                raise NoValueError from error
            if noise is not None and type(outcome) is tuple:
                outcome = _disturbed(outcome, errors[self._inputs + step])
            registers.append(outcome)
        return cast(list[Number], [registers[i] for i in self._outputs])

    def _added(self, root: sp.Basic) -> int:
        """The register of an expression, after those of its operands; without recursion."""
        waiting = [root]
        while waiting:
            expression = waiting[-1]
            if expression in self._register:
                waiting.pop()
                continue
            operands = _operands(expression)
            missing = [operand for operand in operands if operand not in self._register]
            if missing:
                waiting += missing
                continue
            self._register[expression] = self._inputs + len(self.steps)
            sources = tuple(self._register[operand] for operand in operands)
            self.steps.append((_operation(expression), sources))
            waiting.pop()
        return self._register[root]


def number(real: float) -> Number:
    """A floating-point number as one of mpmath."""
    return cast(Number, from_float(float(real)))


def _folding(operation: Callable[..., Number], neutral: Number) -> Callable[..., Number]:
    """A sum or a product of any number of operands."""

    def fold(*operands: Number) -> Number:
        accumulated = neutral
        for operand in operands:
            accumulated = operation(accumulated, operand, PRECISION, "n")
        return accumulated

    return fold


total = _folding(mpf_add, fzero)
product = _folding(mpf_mul, fone)


def _disturbed(exact: Number, error: float) -> Number:
    disturbed: Number = mpf_mul(exact, mpf_add(fone, from_float(error)), PRECISION, "n")
    return disturbed


def _operands(expression: sp.Basic) -> tuple[sp.Basic, ...]:
    """The subexpressions that an operation is applied to."""
    if isinstance(expression, sp.Piecewise):
        return tuple(operand for branch in expression.args for operand in branch.args)
    if isinstance(expression, sp.Number | sp.NumberSymbol):
        return ()
    return expression.args[:1] if _is_integer_power(expression) else tuple(expression.args)


def _is_integer_power(expression: sp.Basic) -> bool:
    """Whether the exponent of a power is an integer that allows multiplication."""
    whole = expression.is_Pow and expression.exp.is_Integer
    return bool(whole and abs(expression.exp) <= _MOST_MULTIPLIED_POWER)


def _operation(expression: sp.Basic) -> Operation:
    """The function of the values of the operands."""
    if not _operands(expression):
        return _constant(expression)
    if expression.is_Add:
        return total
    if expression.is_Mul:
        return product
    if expression.is_Pow:
        return _integer_power(int(expression.exp)) if _is_integer_power(expression) else _power
    if isinstance(expression, Relational):
        return _RELATIONS[expression.rel_op]
    if hasattr(expression, "_imp_"):
        return _of_user(expression)
    return _FUNCTIONS.get(type(expression).__name__) or _by_sympy(expression.func)


def _constant(expression: sp.Basic) -> Operation:
    if expression in (sp.true, sp.false):
        truth = bool(expression)
        return lambda: truth
    if isinstance(expression, sp.Rational):
        p, q = (_CONTEXT.mpf(int(n))._mpf_ for n in (expression.p, expression.q))
        constant: Number = mpf_div(p, q, PRECISION, "n")
    else:
        constant = _real(sp.N(expression, _CONTEXT.dps))
    return lambda: constant


def _real(decimal: sp.Expr) -> Number:
    """A number of SymPy as one of mpmath."""
    if not decimal.is_Float and not decimal.is_Rational:
        raise NoValueError
    return cast(Number, _CONTEXT.mpf(decimal._to_mpmath(PRECISION))._mpf_)


def _integer_power(exponent: int) -> Operation:
    def power(base: Number) -> Number:
        if exponent < 0 and base == fzero:
            raise NoValueError
        raised: Number = mpf_pow_int(base, exponent, PRECISION, "n")
        return raised

    return power


def _power(base: Number, exponent: Number) -> Number:
    x, n = _CONTEXT.make_mpf(base), _CONTEXT.make_mpf(exponent)
    if x and abs(n * _CONTEXT.log(abs(x))) > _LARGEST_ARGUMENT:
        raise NoValueError
    return _unwrapped(x**n)


def _unwrapped(wrapped: mpmath.mpf) -> Number:
    """A real number of mpmath as a tuple."""
    if not isinstance(wrapped, _CONTEXT.mpf) or not _CONTEXT.isfinite(wrapped):
        raise NoValueError
    unwrapped: Number = wrapped._mpf_
    return unwrapped


def _called(function: Callable[..., mpmath.mpf], *, growing: bool = False) -> Operation:
    """A function of mpmath; growing ones have arguments up to a limit."""

    def call(*arguments: Number) -> Number:
        wrapped = [_CONTEXT.make_mpf(argument) for argument in arguments]
        if growing and abs(wrapped[0]) > _LARGEST_ARGUMENT:
            raise NoValueError
        return _unwrapped(function(*wrapped))

    return call


def _by_sympy(function: Callable[..., sp.Expr]) -> Operation:
    """A function that SymPy evaluates, of arguments up to a limit."""

    def call(*arguments: Number) -> Number:
        wrapped = [_CONTEXT.make_mpf(argument) for argument in arguments]
        if any(abs(argument) > _LARGEST_ARGUMENT for argument in wrapped):
            raise NoValueError
        floats = [sp.Float(argument, _CONTEXT.dps) for argument in wrapped]
        return _real(sp.N(function(*floats), _CONTEXT.dps))

    return call


def _of_user(expression: sp.Basic) -> Operation:
    """A function of the user, or a table, at ordinary precision."""
    function = type(expression)._imp_

    def call(*arguments: Number) -> Number:
        height = function(*(float(_CONTEXT.make_mpf(argument)) for argument in arguments))
        return _unwrapped(_CONTEXT.mpf(float(np.asarray(height))))

    return call


def _piecewise(*branches: Number | bool) -> Number:
    for expression, condition in zip(branches[::2], branches[1::2], strict=True):
        if condition:
            return cast(Number, expression)
    raise NoValueError


def _compared(relation: Callable[[mpmath.mpf, mpmath.mpf], bool]) -> Operation:
    return lambda a, b: bool(relation(_CONTEXT.make_mpf(a), _CONTEXT.make_mpf(b)))


_RELATIONS = {
    "<": _compared(operator.lt),
    "<=": _compared(operator.le),
    ">": _compared(operator.gt),
    ">=": _compared(operator.ge),
    "==": _compared(operator.eq),
    "!=": _compared(operator.ne),
}
_ALIKE = ("sin", "cos", "tan", "asin", "acos", "atan", "tanh", "asinh", "acosh", "atanh", "log")
_FUNCTIONS: dict[str, Operation] = {
    **{name: _called(getattr(_CONTEXT, name)) for name in (*_ALIKE, "erf", "erfc", "sign")},
    **{name: _called(getattr(_CONTEXT, name), growing=True) for name in ("exp", "sinh", "cosh")},
    "gamma": _called(_CONTEXT.gamma, growing=True),
    "Abs": _called(abs),
    "floor": _called(_CONTEXT.floor),
    "ceiling": _called(_CONTEXT.ceil),
    "Max": _called(max),
    "Min": _called(min),
    "Mod": _called(lambda a, b: a - b * _CONTEXT.floor(a / b)),
    "frac": _called(lambda a: a - _CONTEXT.floor(a)),
    "atan2": _called(_CONTEXT.atan2),
    "Heaviside": _called(lambda x, middle: middle if x == 0 else _CONTEXT.mpf(int(x > 0))),
    "DiracDelta": lambda *_: fzero,  # impulses are jumps
    "Piecewise": _piecewise,
    "And": lambda *truths: all(truths),
    "ITE": lambda condition, yes, no: yes if condition else no,
    "Xor": lambda *truths: sum(truths) % 2 == 1,
    "Or": lambda *truths: any(truths),
    "Not": lambda truth: not truth,
}


def _occurring(expression: sp.Basic, leaves: Container[sp.Basic]) -> set[sp.Basic]:
    """The leaves that an expression has; what is inside of a leaf does not count."""
    occurring: set[sp.Basic] = set()
    waiting = [expression]
    while waiting:
        node = waiting.pop()
        if node in leaves:
            occurring.add(node)
        else:
            waiting += node.args
    return occurring


class Comparison:
    """The difference of two expressions where their leaves have values.

    ``places`` are those of the leaves in points, which are arrays of numbers. Generated code has
    computed the values of the leaves ``computed``. Only the leaves that the expressions have are
    looked at.
    """

    def __init__(
        self,
        left: sp.Expr,
        right: sp.Expr,
        places: Mapping[sp.Basic, int],
        computed: Set[sp.Basic],
    ) -> None:
        terms = [*sp.Add.make_args(left), *sp.Add.make_args(right)]
        self._left = len(sp.Add.make_args(left))
        occurring = [_occurring(term, places) for term in terms]
        self._computed = [i for i, some in enumerate(occurring) if not computed.isdisjoint(some)]
        leaves = sorted(set().union(*occurring), key=places.__getitem__)
        self._is_computed = [leaf in computed for leaf in leaves]
        self._places = np.array([places[leaf] for leaf in leaves], dtype=int)
        self.program = Program(terms, leaves)

    def residual(self, point: Array) -> tuple[float, float]:
        """The difference, and the sum of the absolute values of all terms."""
        residual, size, _ = self._sums(self.program(self._own(point)))
        return to_float(residual), to_float(size)

    def slope(self, here: Array, direction: Array, seed: int | None = None) -> Number:
        """The derivative of the residual along a direction, from a difference of tiny step.

        With a ``seed``, intermediate results are disturbed, in the same way at both points.
        """
        start, along = self._own(here), self._own(direction)
        pairs = zip(start, along, strict=True)
        there = [mpf_add(x, mpf_mul(_STEP, v, PRECISION, "n"), PRECISION, "n") for x, v in pairs]
        residuals = []
        for point in (start, there):
            noise = None if seed is None else np.random.default_rng([SEED, seed])
            residuals.append(self._sums(self.program(point, noise, ACCUMULATED))[0])
        change = mpf_sub(residuals[1], residuals[0], PRECISION, "n")
        return cast(Number, mpf_div(change, _STEP, PRECISION, "n"))

    def slope_spread(self, here: Array, directions: Sequence[Array], exact: float) -> float:
        """How far rounding moves the sum of the derivatives along directions."""
        sums = [
            sum(to_float(self.slope(here, direction, run)) for direction in directions)
            for run in range(_RUNS)
        ]
        return float(max(abs(disturbed - exact) for disturbed in sums))

    def beyond_rounding(
        self,
        points: Iterable[Array],
        lost: float = LOST_SHARE,
        negligible: float | None = None,
        *,
        rounded_leaves: bool = False,
    ) -> tuple[int, float] | None:
        """The first point at which rounding does not explain the residual, and the residual.

        A residual above the share ``lost`` of the largest computed value is never rounding, unless
        it is below ``negligible``. If that is zero, each point counts on its own. Points at which
        the expressions have no value are left out. Where nothing is computed, rounding is that of
        the other leaves. With ``rounded_leaves`` these are no exact numbers: digits that their last
        ones decide are not lost.
        """
        leaves = list(points)
        exact_sums = [self._sums_at(point) for point in leaves]
        sums = {k: tuple(map(to_float, s)) for k, s in enumerate(exact_sums) if s is not None}
        largest_size = max((size for _, size, _ in sums.values()), default=0.0)
        floor = max(_TINY_SHARE * largest_size, TINY / EPSILON**2)
        for k, (residual, size, _) in sums.items():
            if abs(residual) > max(ACCUMULATED * size, floor):
                spread = self._spread(leaves[k], residual)
                if spread is not None and abs(residual) > _SPREAD_RATIO * spread:
                    return k, residual
        if not self._computed:
            return None
        largest = max((abs(computed) for *_, computed in sums.values()), default=0.0)
        least = max(floor, negligible or 0.0, _NEGLIGIBLE_SHARE * largest_size)
        for k, (residual, _, computed) in sums.items():
            scale = abs(computed) if negligible == 0.0 else largest
            if abs(residual) > max(lost * scale, least):
                spread = self._spread(leaves[k], residual, _LAST_DIGITS)
                if spread is not None and rounded_leaves:
                    spread = max(spread, self._spread_of_leaves(leaves[k], residual))
                if spread is not None and abs(residual) > _SPREAD_RATIO * spread:
                    return k, residual
        return None

    def _spread_of_leaves(self, point: Array, exact: float) -> float:
        """How far the last digits of leaves that are not computed move the residual."""
        noise, own = np.random.default_rng(SEED), self._own(point)
        spread = 0.0
        for _ in range(_RUNS):
            errors = noise.uniform(-EPSILON, EPSILON, len(own)).tolist()
            leaves = [
                leaf if computed else _disturbed(leaf, error)
                for leaf, error, computed in zip(own, errors, self._is_computed, strict=True)
            ]
            try:
                residual = to_float(self._sums(self.program(leaves))[0])
            except (NoValueError, OverflowError):
                continue
            spread = max(spread, abs(residual - exact))
        return spread

    def _spread(self, point: Array, exact: float, size: float = ACCUMULATED) -> float | None:
        """How far rounding of a size moves the residual; None if that cannot be told."""
        noise = np.random.default_rng(SEED)
        spread = 0.0
        for _ in range(_RUNS):
            sums = self._sums_at(point, noise, size)
            if sums is None:
                return None
            spread = max(spread, abs(to_float(sums[0]) - exact))
        return spread

    def _sums_at(
        self,
        point: Array,
        noise: np.random.Generator | None = None,
        size: float = ACCUMULATED,
    ) -> tuple[Number, Number, Number] | None:
        """Residual, size of the terms, computed terms; None where they have no value."""
        try:
            sums = self._sums(self.program(self._own(point), noise, size))
            for each in sums:
                to_float(each)
            return sums
        except (NoValueError, OverflowError):
            return None

    def _own(self, point: Array) -> list[Number]:
        """The values of the leaves that the expressions have."""
        return [number(real) for real in point[self._places].tolist()]

    def _sums(self, terms: Sequence[Number]) -> tuple[Number, Number, Number]:
        residual, size, computed = fzero, fzero, fzero
        for i, term in enumerate(terms):
            signed = term if i < self._left else mpf_neg(term)
            residual = mpf_add(residual, signed, PRECISION, "n")
            size = mpf_add(size, mpf_abs(term), PRECISION, "n")
            if i in self._computed:
                computed = mpf_add(computed, signed, PRECISION, "n")
        return residual, size, computed
