"""What vanishes by the equations at a surface: speeds of states that rest there, jumps of rates.

A tank ``Piecewise((0, (h >= 1) & (net > 0)), (net, True))`` rests full while ``net`` is positive.
The rates are the same on both sides of ``net = 0``, where it begins to empty: that is a kink.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence

import numpy as np
import sympy as sp
from sympy.core.function import AppliedUndef
from sympy.logic.boolalg import Boolean

_MOST_SIDES = 5  # Most sides of others of which all combinations are looked at
_ROUNDING = 1e-9  # Value at a random place, from which an expression is not zero

Sides = Mapping[sp.Dummy, sp.Expr]
"""What stands for sides in rates, with the states that hold them."""


def zero_where(expression: sp.Expr, sides: Sides) -> Boolean:
    """On which sides an expression is zero whatever the unknowns are: a condition on the states."""
    used = _used([expression], sides)
    if len(used) > _MOST_SIDES:
        return sp.false
    where = [
        (_vanishes(expression.xreplace(values)), signs) for signs, values in _choices(used, sides)
    ]
    if all(zero == sp.true for zero, _ in where):
        return sp.true
    return sp.Or(
        *(
            sp.And(
                zero,
                *(sign * sides[side] > sp.S.Half for side, sign in zip(used, signs, strict=True)),
            )
            for zero, signs in where
        )
    )


def only_kinks(rates: Sequence[sp.Expr], surface: sp.Expr, side: sp.Dummy, others: Sides) -> bool:
    """Whether rates are the same on both sides of a surface, wherever it is crossed."""
    used = _used([*rates, surface], others)
    if len(used) > _MOST_SIDES:
        return False
    for _, values in _choices(used, others):
        root = _root(surface.xreplace(values))
        if root is None:
            return False
        above, below = ({**values, side: sp.Integer(sign)} for sign in (1, -1))
        for rate in rates:
            change = rate.xreplace(above) - rate.xreplace(below)
            if _vanishes(change.xreplace(root)) != sp.true:
                return False
    return True


def _used(expressions: Sequence[sp.Expr], sides: Sides) -> list[sp.Dummy]:
    """The sides in expressions."""
    return [s for s, state in sides.items() if any(each.has(s, state) for each in expressions)]


def _choices(
    used: Sequence[sp.Dummy], sides: Sides
) -> Iterator[tuple[tuple[int, ...], dict[sp.Expr, sp.Expr]]]:
    """All combinations of sides, as signs and as values of what stands for them."""
    for signs in itertools.product((1, -1), repeat=len(used)):
        pairs = list(zip(used, map(sp.Integer, signs), strict=True))
        yield signs, {**dict(pairs), **{sides[side]: sign for side, sign in pairs}}


def _root(surface: sp.Expr) -> dict[sp.Expr, sp.Expr] | None:
    """An unknown or symbol where a surface is zero; None where it is linear in none of them."""
    for each in sorted({*surface.atoms(AppliedUndef), *surface.free_symbols}, key=str):
        dummy = sp.Dummy(real=True)
        plain = surface.xreplace({each: dummy})
        slope = sp.diff(plain, dummy)
        if slope != 0 and not slope.has(dummy):
            return {each: -plain.xreplace({dummy: sp.S.Zero}) / slope}
    return None


def _vanishes(expression: sp.Expr) -> Boolean:
    """Where an expression without sides is zero whatever the unknowns are."""
    if expression.has(sp.Piecewise):
        expression = sp.piecewise_fold(expression)
    if not isinstance(expression, sp.Piecewise):
        return sp.true if _is_zero(expression) else sp.false
    where, before = sp.false, sp.false
    for piece, condition in expression.args:
        where = sp.Or(where, sp.And(condition, sp.Not(before), _vanishes(piece)))
        before = sp.Or(before, condition)
    return where


def _is_zero(expression: sp.Expr) -> bool:
    """Whether an expression is zero everywhere; at a random place most others are not."""
    if expression.is_number:
        return bool(expression == 0)
    random = np.random.default_rng(4021)
    atoms = sorted({*expression.atoms(AppliedUndef), *expression.free_symbols}, key=str)
    value = expression.xreplace({each: sp.Float(random.uniform(0.5, 1.5)) for each in atoms})
    if value.is_number:
        size = abs(sp.N(value))
        if not size.is_finite or size > _ROUNDING:
            return False
    return bool(sp.expand(expression) == 0)
