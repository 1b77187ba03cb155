"""Unknowns as functions of time, and derivatives of expressions.

A system of a thousand states has thousands of them: SymPy takes a fifth of a millisecond for a
function and a third for a derivative that it then leaves as it is.
"""

from __future__ import annotations

from functools import lru_cache

import sympy as sp
from sympy.core.function import AppliedUndef, ArgumentIndexError

from rankone.problem.expressions.conditions import compared
from rankone.support.budget import check_time
from rankone.support.errors import ProblemError
from rankone.support.wording import quote

KEPT = 20_000
"""Functions of time, and numbers, that are kept: as many as a large system has."""


@lru_cache(KEPT)
def unknown_of(name: str, time: sp.Symbol) -> sp.Expr:
    """The function of time with a name: ``x(t)``."""
    return sp.Function(name)(time)


def rate_of(state: sp.Expr, time: sp.Symbol, order: int = 1) -> sp.Expr:
    """The derivative of an applied function of time, or of its derivative.

    >>> t = sp.Symbol("t")
    >>> x = unknown_of("x", t)
    >>> rate_of(x, t) == x.diff(t), rate_of(x.diff(t), t) == x.diff(t, 2)
    (True, True)
    """
    return sp.Derivative(state, (time, order), evaluate=False)


# -----------------------------------------------------------------------------
# Derivatives of expressions in real symbols, as a Jacobian needs them.
#
# The derivative of a jump is zero, and that at a kink is one-sided: a Jacobian never means the
# Dirac deltas and unevaluated derivatives that SymPy gives.


_STEPS = (sp.Heaviside, sp.sign, sp.floor, sp.ceiling)  # Constant between their jumps
_JUMPING = (*_STEPS, sp.Mod, sp.frac, sp.Piecewise)  # Functions that may jump
# What SymPy leaves in a derivative that it does not know
_UNEVALUATED = (sp.Derivative, sp.Subs, sp.DiracDelta, sp.Integral, sp.Sum)


def slope(expression: sp.Expr, variable: sp.Expr) -> sp.Expr:
    """The derivative of an expression of real quantities; NaN if unknown, or if it may jump.

    Real dummies stand for all symbols: with complex ones SymPy never finishes the absolute value of
    a remainder.
    """
    if expression.has(*_JUMPING):
        return sp.nan
    quantities = sorted({*expression.atoms(AppliedUndef), variable}, key=sp.default_sort_key)
    dummies = {u: sp.Dummy(real=True) for u in quantities}
    plain = expression.xreplace(dummies)
    symbols = sorted(plain.free_symbols - {*dummies.values()}, key=sp.default_sort_key)
    real = dummies | {symbol: sp.Dummy(real=True) for symbol in symbols}
    try:
        derivative = Differentiator(real[variable])(expression.xreplace(real))
    except ProblemError:
        return sp.nan
    return derivative.xreplace({dummy: quantity for quantity, dummy in real.items()})


class Differentiator:
    """Differentiates expressions with respect to one symbol, each subexpression once."""

    def __init__(self, symbol: sp.Symbol) -> None:
        self.symbol = symbol
        self._derivatives: dict[sp.Expr, sp.Expr] = {symbol: sp.S.One}

    def __call__(self, expression: sp.Expr) -> sp.Expr:
        """The derivative; a ProblemError if it is not known for some function."""
        if self.symbol not in expression.free_symbols:
            return sp.S.Zero
        if expression not in self._derivatives:
            check_time()
            self._derivatives[expression] = self._derived(expression)
        return self._derivatives[expression]

    def _derived(self, expression: sp.Expr) -> sp.Expr:
        args = expression.args
        if expression.is_Add:
            return sp.Add(*map(self, args))
        if expression.is_Mul:
            return sp.Add(
                *(
                    sp.Mul(*args[:k], self(arg), *args[k + 1 :])
                    for k, arg in enumerate(args)
                    if self.symbol in arg.free_symbols
                )
            )
        if expression.is_Pow:
            base, exponent = expression.base, expression.exp
            slope = exponent * base ** (exponent - 1) * self(base)
            if self.symbol in exponent.free_symbols:
                slope += expression * sp.log(base) * self(exponent)
            return slope
        if isinstance(expression, sp.Piecewise):
            return sp.Piecewise(*((self(branch), condition) for branch, condition in args))
        if isinstance(expression, sp.Max | sp.Min):
            first, *further = sorted(args, key=sp.default_sort_key)
            second = expression.func(*further)
            relation = sp.Ge if isinstance(expression, sp.Max) else sp.Le
            is_first = compared(relation, first, second)
            return sp.Piecewise((self(first), is_first), (self(second), True))
        if isinstance(expression, _STEPS):
            return sp.S.Zero
        if isinstance(expression, sp.Abs):
            return sp.sign(args[0]) * self(args[0])
        if isinstance(expression, sp.Mod):
            return self(args[0]) - sp.floor(args[0] / args[1]) * self(args[1])
        if isinstance(expression, sp.frac):
            return self(args[0])
        if isinstance(expression, sp.tanh):  # 1 - tanh**2 cancels
            return self(args[0]) / sp.cosh(args[0]) ** 2
        return self._function(expression)

    def _function(self, expression: sp.Expr) -> sp.Expr:
        """The chain rule."""
        slope = sp.S.Zero
        for k, arg in enumerate(expression.args):
            if self.symbol not in arg.free_symbols:
                continue
            try:
                partial = expression.fdiff(k + 1)
            except (ArgumentIndexError, AttributeError, NotImplementedError):
                partial = None
            if partial is None or partial.has(*_UNEVALUATED):
                raise ProblemError(
                    f"the derivative of {quote(expression.func.__name__)} in {quote(expression)} "
                    f"with respect to its argument {quote(arg)} is not known",
                    term=expression,
                    remedy="rewrite it with other functions, or give it with its derivative: "
                    "rankone.function(name, value, derivative)",
                )
            if isinstance(expression, sp.sinc):
                partial = sp.Piecewise((partial, sp.Ne(arg, 0)), (0, True))
            slope += partial * self(arg)
        return slope
