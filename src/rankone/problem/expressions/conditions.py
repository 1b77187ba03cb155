"""Unknowns as functions of time, derivatives, and one form of conditions.

A switch is where a function passes zero. ``Abs(t - a) < 1`` hides two of them, at ``t = a - 1`` and
``t = a + 1``, beside the kink of ``Abs``; so do a product of two functions, a saturation, and a
``Piecewise`` that is compared. Written as comparisons of what is inside, each switch is seen where
it is. A saturation that is written as a ``Piecewise`` becomes one of ``Max`` and ``Min``.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import lru_cache

import sympy as sp
from sympy.core.function import AppliedUndef, ArgumentIndexError
from sympy.core.relational import Relational
from sympy.functions.elementary.piecewise import ExprCondPair
from sympy.logic.boolalg import Boolean, Xor

from rankone.problem.forms import Coordinate
from rankone.support.arrays import FEW
from rankone.support.budget import check_time
from rankone.support.errors import ProblemError, quote

_MOST_PARTS = 32  # Comparisons that one is written as: more of them are no clearer
_MOST_MIXED = 6  # Parameters of products of them, whose corners are all looked at
_SWITCHING = (sp.Piecewise, sp.Heaviside, sp.sign)
_ORDERED = (sp.Gt, sp.Ge, sp.Lt, sp.Le)


def with_plain_conditions(expression: sp.Expr, parameters: Sequence[Coordinate] = ()) -> sp.Expr:
    """An expression whose conditions, steps and signs are those of functions that are smooth.

    Comparisons that have one outcome for all ``parameters`` are decided.
    """
    if not expression.has(*_SWITCHING):
        return expression
    done: dict[sp.Basic, sp.Basic] = {}

    def plain(node: sp.Basic) -> sp.Basic:
        if not isinstance(node, Boolean | ExprCondPair) and not node.has(*_SWITCHING):
            return node
        if node not in done:
            done[node] = _plain(node, plain, parameters)
        return done[node]

    return plain(expression)


def compared(
    relation: type[Relational],
    left: sp.Expr,
    right: sp.Expr,
    parameters: Sequence[Coordinate] = (),
) -> Boolean:
    """A comparison, as comparisons of smooth functions where it hides some."""
    height = right - left if relation in (sp.Lt, sp.Le) else left - right
    positive = _Comparison(relation in (sp.Gt, sp.Lt), parameters).positive(height)
    if positive is None or isinstance(positive, Relational):
        return relation(left, right)
    return positive


def definite_sign(expression: sp.Expr, parameters: Sequence[Coordinate]) -> sp.Expr | None:
    """The sign of an expression if it is a number, or linear in each parameter and never zero."""
    used = [c for c in parameters if c.symbol in expression.free_symbols]
    symbols = [c.symbol for c in used]
    if expression.has(AppliedUndef) or not expression.free_symbols <= {*symbols}:
        return None
    slopes = [sp.diff(expression, symbol) for symbol in symbols]
    if any(slope.has(symbol) for slope, symbol in zip(slopes, symbols, strict=True)):
        return None
    if all(slope.is_number for slope in slopes):
        # the least and the largest value are at two opposite corners
        rising = [(c, slope > 0) for c, slope in zip(used, slopes, strict=True)]
        least = tuple(c.lower if up else c.upper for c, up in rising)
        largest = tuple(c.upper if up else c.lower for c, up in rising)
        corners = iter([least, largest])
    elif len(used) <= _MOST_MIXED:
        corners = itertools.product(*((c.lower, c.upper) for c in used))
    else:
        return None
    signs = {sp.sign(expression.subs(dict(zip(symbols, at, strict=True)))) for at in corners}
    return signs.pop() if len(signs) == 1 and signs <= {sp.S.One, sp.S.NegativeOne} else None


def _plain(
    node: sp.Basic, plain: Callable[[sp.Basic], sp.Basic], parameters: Sequence[Coordinate]
) -> sp.Basic:
    if not node.args:
        return node
    args = [plain(each) for each in node.args]
    if isinstance(node, sp.ITE):
        return sp.Or(sp.And(args[0], args[1]), sp.And(sp.Not(args[0]), args[2]))
    if isinstance(node, Xor | sp.Equivalent | sp.Implies):
        return node.func(*args).to_nnf(simplify=False)
    if isinstance(node, _ORDERED):
        return compared(node.func, args[0], args[1], parameters)
    if isinstance(node, sp.sign | sp.Heaviside):
        return _step(node, args, parameters)
    rebuilt = node if tuple(args) == node.args else node.func(*args)
    return _saturation(rebuilt, parameters) if isinstance(rebuilt, sp.Piecewise) else rebuilt


def _step(node: sp.Expr, args: list[sp.Expr], parameters: Sequence[Coordinate]) -> sp.Expr:
    """A sign or a step of a smooth function, a product of signs, or two cases."""
    argument = args[0]
    factors = _factors(argument)
    if len(factors) > 1:
        signs = (with_plain_conditions(sp.sign(each), parameters) for each in factors)
        product = sp.Mul(*signs)
        return product if isinstance(node, sp.sign) else (1 + product) / 2
    positive = compared(sp.Gt, argument, sp.S.Zero, parameters)
    if isinstance(positive, Relational):
        return node.func(*args)
    low = -1 if isinstance(node, sp.sign) else 0
    return sp.Piecewise((1, positive), (low, True))


def _saturation(piecewise: sp.Piecewise, parameters: Sequence[Coordinate]) -> sp.Expr:
    """A piecewise function whose branches meet where they change, as extremes of them."""
    *cases, (rest, otherwise) = piecewise.args
    if otherwise is not sp.true or len(cases) >= FEW:
        return piecewise
    for branch, condition in reversed(cases):
        if not isinstance(condition, _ORDERED):
            return piecewise
        larger = _Comparison(True, parameters).positive(branch - rest)
        if not isinstance(larger, _ORDERED):
            return piecewise
        sign = _common_sign(condition.gts - condition.lts, larger.gts - larger.lts)
        if not sign:
            return piecewise
        rest = sp.Max(branch, rest) if sign > 0 else sp.Min(branch, rest)
    return rest


def _common_sign(one: sp.Expr, other: sp.Expr) -> int:
    """1 if two expressions have one sign everywhere, -1 if they have opposite ones, else 0."""
    one, other = sp.expand(one), sp.expand(other)
    terms, further = one.as_coefficients_dict(), other.as_coefficients_dict()
    if terms.keys() != further.keys() or not terms:
        return 0
    ratios = {further[term] / terms[term] for term in terms}
    return int(sp.sign(ratios.pop())) if len(ratios) == 1 else 0


@dataclass
class _Comparison:
    """Where heights are positive, or zero if that is not ``strict``, for some ``parameters``.

    ``left`` is how many more comparisons it may become.
    """

    strict: bool
    parameters: Sequence[Coordinate]
    left: int = field(default=_MOST_PARTS)

    def positive(self, height: sp.Expr) -> Boolean | None:
        """Where a height is positive; None if that takes too many comparisons."""
        self.left -= 1
        if self.left < 0:
            return None
        if (piecewise := _outermost(height)) is not None:
            return self._of_cases(height, piecewise)
        for term in sp.Add.make_args(height):
            number, function = term.as_coeff_Mul()
            if isinstance(function, sp.Abs):
                inner = (function.args[0], -function.args[0])
            elif isinstance(function, sp.Max | sp.Min):
                inner = function.args
            else:
                continue
            largest = isinstance(function, sp.Min) != bool(number > 0)
            heights = [height - term + number * each for each in inner]
            return self._joined(sp.Or if largest else sp.And, heights)
        if (root := _root_of_square(height)) is not None:
            return self.positive(root)
        factors = _factors(height)
        if len(factors) > 1:
            first, rest = factors[0], sp.Mul(*factors[1:])
            both = self._joined(sp.And, [first, rest]), self._joined(sp.And, [-first, -rest])
            return None if None in both else sp.Or(*both)
        if (sign := definite_sign(height, self.parameters)) is not None:
            return sp.true if sign > 0 else sp.false
        return height > 0 if self.strict else height >= 0

    def _joined(self, join: type[Boolean], heights: Sequence[sp.Expr]) -> Boolean | None:
        comparisons = [self.positive(each) for each in heights]
        return None if None in comparisons else join(*comparisons)

    def _of_cases(self, height: sp.Expr, piecewise: sp.Piecewise) -> Boolean | None:
        """Where a height with a piecewise function is positive."""
        cases, before = list[Boolean](), sp.true
        for value, condition in piecewise.args:
            part = self.positive(height.xreplace({piecewise: value}))
            if part is None:
                return None
            cases.append(sp.And(before, condition, part))
            before = sp.And(before, sp.Not(condition))
        return sp.Or(*cases)


def _outermost(height: sp.Expr) -> sp.Piecewise | None:
    """A piecewise function in an expression that is inside of no other one."""
    functions = height.atoms(sp.Piecewise)
    inner = {each for f in functions for each in f.atoms(sp.Piecewise) if each != f}
    return min(functions - inner, key=sp.default_sort_key, default=None)


def _factors(height: sp.Expr) -> list[sp.Expr]:
    """Factors whose signs tell that of a product: several only if unknowns or sums are in each."""
    moving, others = list[sp.Expr](), list[sp.Expr]()
    for factor in sp.Mul.make_args(height):
        base, exponent = factor.as_base_exp()
        if not (factor.has(AppliedUndef) or base.is_Add):
            others.append(factor)
        elif exponent.is_Integer and exponent % 2:
            moving.append(base)
        elif not isinstance(factor, sp.exp):  # that is positive
            return [height]
    return [sp.Mul(*others, moving[0]), *moving[1:]] if len(moving) > 1 else [height]


def _root_of_square(height: sp.Expr) -> sp.Expr | None:
    """What has the sign of c*(b - g**2) where g is a function of the clock or of parameters."""
    constant, square = height.as_coeff_Add()
    number, power = square.as_coeff_Mul()
    if not (power.is_Pow and power.exp == 2 and number.is_number and constant.is_number):
        return None
    if power.base.has(AppliedUndef) or not (constant / number).is_negative:
        return None
    return number * (sp.Abs(power.base) - sp.sqrt(-constant / number))


# -----------------------------------------------------------------------------
# Unknowns as functions of time, and derivatives of expressions.
#
# A system of a thousand states has thousands of them: SymPy takes a fifth of a millisecond for a
# function and a third for a derivative that it then leaves as it is.


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
