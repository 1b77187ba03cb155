"""Values of expressions at a hundred digits, by mpmath and from the expression tree alone.

Nothing here is shared with the printer of generated code: this is what that code is compared with.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import mpmath
import numpy as np
import sympy as sp
from mpmath.libmp import fone, from_float, fzero, mpf_add, mpf_div, mpf_mul, mpf_pow_int
from sympy.core.relational import Relational

__all__ = ["PRECISION", "NoValueError", "Number", "Program", "number"]

_DIGITS = 100
PRECISION = 336
"""Bits of the numbers."""
_CONTEXT = mpmath.MPContext()
_CONTEXT.dps = _DIGITS
_LARGEST_EXPONENT = 1e300
"""Logarithms up to which a number is computed."""
_SMALL_POWER = 1000
"""Integer exponents up to which powers are products."""

Number = tuple[int, int, int, int]
"""A floating-point number of mpmath: sign, mantissa, exponent, bits."""


class NoValueError(Exception):
    """An expression has no real value, or one that is too large to be computed."""


class Program:
    """Expressions as a list of operations, each subexpression once.

    Parameters
    ----------
    expressions : sequence of Expr
    leaves : sequence of Expr
        What has values: symbols, functions of time, derivatives.
    """

    def __init__(self, expressions: Sequence[sp.Basic], leaves: Sequence[sp.Expr]) -> None:
        self._place: dict[sp.Basic, int] = {leaf: i for i, leaf in enumerate(leaves)}
        self._inputs = len(self._place)
        self._steps: list[tuple[Callable[..., Any], tuple[int, ...]]] = []
        self._results = [self._added(expression) for expression in expressions]

    @property
    def operations(self) -> int:
        """How many operations there are."""
        return len(self._steps)

    def __call__(
        self, values: Sequence[Number], noise: np.random.Generator | None = None, size: float = 0.0
    ) -> list[Number]:
        """The values of the expressions.

        Parameters
        ----------
        values : sequence of Number
            Those of the leaves.
        noise : Generator, optional
            Every intermediate result is off by a random part of up to ``size``, so that the
            results show what rounding does to them (Parker, Monte Carlo arithmetic, UCLA 1997).

        Raises
        ------
        NoValueError
            If there is no real value, or none that can be computed.
        """
        results: list[Any] = list(values)
        if noise is not None:
            errors = noise.uniform(-size, size, len(results) + len(self._steps)).tolist()
            results = [_disturbed(v, e) for v, e in zip(results, errors, strict=False)]
        for step, (function, places) in enumerate(self._steps):
            try:
                value = function(*(results[i] for i in places))
            except (ArithmeticError, ValueError, MemoryError) as error:
                raise NoValueError from error
            if noise is not None and type(value) is tuple:
                value = _disturbed(value, errors[self._inputs + step])
            results.append(value)
        return [results[i] for i in self._results]

    def _added(self, root: sp.Basic) -> int:
        """The place of an expression, after those of its parts; without recursion."""
        waiting = [root]
        while waiting:
            expression = waiting[-1]
            if expression in self._place:
                waiting.pop()
                continue
            parts = _parts(expression)
            missing = [part for part in parts if part not in self._place]
            if missing:
                waiting += missing
                continue
            self._place[expression] = self._inputs + len(self._steps)
            self._steps.append((_operation(expression), tuple(self._place[p] for p in parts)))
            waiting.pop()
        return self._place[root]


def number(value: float) -> Number:
    """A floating-point number as one of mpmath."""
    converted: Number = from_float(float(value))
    return converted


def _disturbed(value: Number, error: float) -> Number:
    result: Number = mpf_mul(value, mpf_add(fone, from_float(error)), PRECISION, "n")
    return result


def _parts(expression: sp.Basic) -> tuple[sp.Basic, ...]:
    """What an operation is applied to."""
    if isinstance(expression, sp.Piecewise):
        return tuple(part for pair in expression.args for part in pair.args)
    if isinstance(expression, sp.Number | sp.NumberSymbol):
        return ()
    return expression.args[:1] if _is_product(expression) else tuple(expression.args)


def _is_product(expression: sp.Basic) -> bool:
    """Whether a power is that of an ordinary integer."""
    whole = expression.is_Pow and expression.exp.is_Integer
    return bool(whole and abs(expression.exp) <= _SMALL_POWER)


def _operation(expression: sp.Basic) -> Callable[..., Any]:
    """The function of the values of the parts."""
    if not _parts(expression):
        return _constant(expression)
    if expression.is_Add:
        return _sum
    if expression.is_Mul:
        return _product
    if expression.is_Pow:
        return _integer_power(int(expression.exp)) if _is_product(expression) else _power
    kind = type(expression).__name__
    if isinstance(expression, Relational):
        return _RELATIONS[expression.rel_op]
    if hasattr(expression, "_imp_"):
        return _of_user(expression)
    return _FUNCTIONS[kind] if kind in _FUNCTIONS else _by_sympy(expression.func)


def _constant(expression: sp.Basic) -> Callable[[], Any]:
    if expression in (sp.true, sp.false):
        truth = bool(expression)
        return lambda: truth
    if isinstance(expression, sp.Rational):
        p, q = (_CONTEXT.mpf(int(part))._mpf_ for part in (expression.p, expression.q))
        value = mpf_div(p, q, PRECISION, "n")
    else:
        value = _real(sp.N(expression, _DIGITS))
    return lambda: value


def _real(value: sp.Expr) -> Number:
    """A number of SymPy as one of mpmath."""
    if not value.is_Float and not value.is_Rational:
        raise NoValueError
    result: Number = _CONTEXT.mpf(value._to_mpmath(PRECISION))._mpf_
    return result


def _sum(*terms: Number) -> Number:
    total = fzero
    for term in terms:
        total = mpf_add(total, term, PRECISION, "n")
    result: Number = total
    return result


def _product(*factors: Number) -> Number:
    total = fone
    for factor in factors:
        total = mpf_mul(total, factor, PRECISION, "n")
    result: Number = total
    return result


def _integer_power(exponent: int) -> Callable[[Number], Number]:
    def power(base: Number) -> Number:
        if exponent < 0 and base == fzero:
            raise NoValueError
        result: Number = mpf_pow_int(base, exponent, PRECISION, "n")
        return result

    return power


def _power(base: Number, exponent: Number) -> Number:
    x, n = _CONTEXT.make_mpf(base), _CONTEXT.make_mpf(exponent)
    if x and abs(n * _CONTEXT.log(abs(x))) > _LARGEST_EXPONENT:
        raise NoValueError
    return _wrapped(x**n)


def _wrapped(value: Any) -> Number:
    """A value of mpmath as a plain number."""
    if not isinstance(value, _CONTEXT.mpf) or not _CONTEXT.isfinite(value):
        raise NoValueError
    result: Number = value._mpf_
    return result


def _called(function: Callable[..., Any], *, growing: bool = False) -> Callable[..., Number]:
    """A function of mpmath; growing ones have arguments up to a limit."""

    def call(*arguments: Number) -> Number:
        values = [_CONTEXT.make_mpf(argument) for argument in arguments]
        if growing and abs(values[0]) > _LARGEST_EXPONENT:
            raise NoValueError
        return _wrapped(function(*values))

    return call


def _by_sympy(function: Callable[..., sp.Expr]) -> Callable[..., Number]:
    """A function that SymPy evaluates."""

    def call(*arguments: Number) -> Number:
        values = [sp.Float(_CONTEXT.make_mpf(a), _DIGITS) for a in arguments]
        return _real(sp.N(function(*values), _DIGITS))

    return call


def _of_user(expression: sp.Basic) -> Callable[..., Number]:
    """A function of the user, or a table, at ordinary precision."""
    function = type(expression)._imp_

    def call(*arguments: Number) -> Number:
        value = function(*(float(_CONTEXT.make_mpf(a)) for a in arguments))
        return _wrapped(_CONTEXT.mpf(float(np.asarray(value))))

    return call


def _heaviside(x: Any, middle: Any) -> Any:
    return middle if x == 0 else _CONTEXT.mpf(1 if x > 0 else 0)


def _piecewise(*parts: Any) -> Number:
    for value, condition in zip(parts[::2], parts[1::2], strict=True):
        if condition:
            result: Number = value
            return result
    raise NoValueError


def _compared(relation: Callable[[Any, Any], bool]) -> Callable[[Number, Number], bool]:
    return lambda a, b: relation(_CONTEXT.make_mpf(a), _CONTEXT.make_mpf(b))


_RELATIONS = {
    "<": _compared(lambda a, b: bool(a < b)),
    "<=": _compared(lambda a, b: bool(a <= b)),
    ">": _compared(lambda a, b: bool(a > b)),
    ">=": _compared(lambda a, b: bool(a >= b)),
    "==": _compared(lambda a, b: bool(a == b)),
    "!=": _compared(lambda a, b: bool(a != b)),
}
_ALIKE = ("sin", "cos", "tan", "asin", "acos", "atan", "tanh", "asinh", "acosh", "atanh", "log")
_FUNCTIONS: dict[str, Callable[..., Any]] = {
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
    "Heaviside": _called(_heaviside),
    "DiracDelta": lambda *_: fzero,  # impulses are jumps
    "Piecewise": _piecewise,
    "And": lambda *truths: all(truths),
    "Or": lambda *truths: any(truths),
    "Not": lambda truth: not truth,
}
