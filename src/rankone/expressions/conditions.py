"""One form of conditions, whatever their spelling: comparisons of smooth functions, and, or, not.

A switch is where a function passes zero. ``Abs(t - a) < 1`` hides two of them, at ``t = a - 1`` and
``t = a + 1``, beside the kink of ``Abs``; so do a product of two functions, a saturation, and a
``Piecewise`` that is compared. Written as comparisons of what is inside, each switch is seen where
it is.
"""

from __future__ import annotations

from collections.abc import Callable

import sympy as sp
from sympy.core.function import AppliedUndef
from sympy.core.relational import Relational
from sympy.functions.elementary.piecewise import ExprCondPair
from sympy.logic.boolalg import Boolean, Xor

_MOST_PARTS = 32  # Comparisons that one is written as: more of them are no clearer
_SWITCHING = (sp.Piecewise, sp.Heaviside, sp.sign)
_ORDERED = (sp.Gt, sp.Ge, sp.Lt, sp.Le)


def with_plain_conditions(expression: sp.Expr) -> sp.Expr:
    """An expression whose conditions, steps and signs are those of functions that are smooth."""
    if not expression.has(*_SWITCHING):
        return expression
    done: dict[sp.Basic, sp.Basic] = {}

    def plain(node: sp.Basic) -> sp.Basic:
        if not isinstance(node, Boolean | ExprCondPair) and not node.has(*_SWITCHING):
            return node
        if node not in done:
            done[node] = _plain(node, plain)
        return done[node]

    return plain(expression)


def _plain(node: sp.Basic, plain: Callable[[sp.Basic], sp.Basic]) -> sp.Basic:
    if not node.args:
        return node
    args = [plain(each) for each in node.args]
    if isinstance(node, sp.ITE):
        return sp.Or(sp.And(args[0], args[1]), sp.And(sp.Not(args[0]), args[2]))
    if isinstance(node, Xor | sp.Equivalent | sp.Implies):
        return node.func(*args).to_nnf(simplify=False)
    if isinstance(node, _ORDERED):
        return compared(node.func, *args)
    if isinstance(node, sp.sign | sp.Heaviside):
        return _step(node, args)
    return node if tuple(args) == node.args else node.func(*args)


def _step(node: sp.Expr, args: list[sp.Expr]) -> sp.Expr:
    """A sign or a step of a smooth function, a product of signs, or two cases."""
    argument = args[0]
    factors = _factors(argument)
    if len(factors) > 1:
        product = sp.Mul(*(with_plain_conditions(sp.sign(each)) for each in factors))
        return product if isinstance(node, sp.sign) else (1 + product) / 2
    positive = compared(sp.Gt, argument, sp.S.Zero)
    if isinstance(positive, Relational):
        return node.func(*args)
    low = -1 if isinstance(node, sp.sign) else 0
    return sp.Piecewise((1, positive), (low, True))


def compared(relation: type[Relational], left: sp.Expr, right: sp.Expr) -> Boolean:
    """A comparison, as comparisons of smooth functions where it hides some."""
    difference = left - right
    height = -difference if relation in (sp.Lt, sp.Le) else difference
    parts = _positive(height, relation in (sp.Gt, sp.Lt), [_MOST_PARTS])
    return relation(left, right) if parts is None or isinstance(parts, Relational) else parts


def _positive(height: sp.Expr, strict: bool, left: list[int]) -> Boolean | None:
    """Where a height is positive, or zero if that is not ``strict``.

    None if that takes more comparisons than are ``left``.
    """

    def all_or_any(join: type, heights: list[sp.Expr]) -> Boolean | None:
        parts = [_positive(each, strict, left) for each in heights]
        return None if None in parts else join(*parts)

    left[0] -= 1
    if left[0] < 0:
        return None
    if (piecewise := _outermost(height)) is not None:
        return _of_cases(height, piecewise, strict, left)
    for term in sp.Add.make_args(height):
        number, function = term.as_coeff_Mul()
        if not number.is_number or not number.is_extended_real:
            continue
        if isinstance(function, sp.Abs):
            inner = (function.args[0], -function.args[0])
        elif isinstance(function, sp.Max | sp.Min):
            inner = function.args
        else:
            continue
        largest = isinstance(function, sp.Min) != bool(number > 0)
        heights = [height - term + number * each for each in inner]
        return all_or_any(sp.Or if largest else sp.And, heights)
    if (root := _root_of_square(height)) is not None:
        return _positive(root, strict, left)
    factors = _factors(height)
    if len(factors) > 1:
        first, rest = factors[0], sp.Mul(*factors[1:])
        both = all_or_any(sp.And, [first, rest]), all_or_any(sp.And, [-first, -rest])
        return None if None in both else sp.Or(*both)
    return height > 0 if strict else height >= 0


def _outermost(height: sp.Expr) -> sp.Piecewise | None:
    """A piecewise function in an expression that is inside of no other one."""
    functions = height.atoms(sp.Piecewise)
    inner = {each for f in functions for each in f.atoms(sp.Piecewise) if each is not f}
    return min(functions - inner, key=sp.default_sort_key, default=None)


def _of_cases(
    height: sp.Expr, piecewise: sp.Piecewise, strict: bool, left: list[int]
) -> Boolean | None:
    """Where a height with a piecewise function is positive."""
    cases, before = [], sp.true
    for value, condition in piecewise.args:
        part = _positive(height.xreplace({piecewise: value}), strict, left)
        if part is None:
            return None
        cases.append(sp.And(before, condition, part))
        before = sp.And(before, sp.Not(condition))
    return sp.Or(*cases)


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
