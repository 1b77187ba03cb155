"""Smooth functions that may be so narrow that they are stepped over, and where their middles are.

Peaks such as ``exp(-((t - 60)/1e-3)**2)``, ``1/(1 + (k/1e-4)**2)`` and ``1/cosh(x/1e-3)**2``, and
the steep steps ``tanh``, ``erf``, ``atan`` and ``1/(1 + exp(...))``, two of which make a pulse.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence

import sympy as sp
from sympy.core.function import AppliedUndef

from rankone.codegen.derivatives import slope
from rankone.ir.forms import Coordinate

__all__ = ["Variables", "moving_middles", "peaks", "steps", "valleys"]

Variables = Callable[[sp.Basic], Iterable[sp.Expr]]
"""The variables of an expression that count."""
_NARROW = 1e4
"""Curvature of an exponent, over the horizon squared, from which its peak may be stepped over."""
_DIGITS = 20
_STEEP = (sp.tanh, sp.erf, sp.erfc, sp.atan, sp.cosh, sp.sech)
"""Functions that change most where their argument vanishes."""


def moving_middles(
    coordinates: Sequence[Coordinate], expressions: Iterable[sp.Basic]
) -> Iterator[sp.Expr]:
    """Times, as functions of the parameters, of the peaks of narrow exponentials of squares."""
    clock, *parameters = coordinates
    t, known = clock.symbol, {c.symbol for c in coordinates}
    centre = {p.symbol: sp.Float(0.5 * (p.lower + p.upper)) for p in parameters}
    for part in _parts(expressions, sp.exp):
        rate = slope(part.exp, t)
        curve = slope(rate, t)
        moves = len(part.exp.free_symbols) > 1 and part.exp.free_symbols <= known
        if (
            moves
            and not part.exp.has(AppliedUndef)
            and curve not in (0, sp.nan)
            and not curve.has(t)
        ):
            size = abs(curve.subs(centre)) * (clock.upper - clock.lower) ** 2
            if size.is_number and size > _NARROW:
                yield -rate.subs(t, 0) / curve


def peaks(
    expressions: Iterable[sp.Basic], variables: Variables
) -> Iterator[tuple[sp.Expr, sp.Expr]]:
    """Functions that may be peaks, and what vanishes in the middle of each.

    How narrow they are is not known as long as the variables, such as the unknowns, are not.
    ``variables`` gives those of an expression.
    """
    for part in _parts(expressions, sp.exp, sp.Pow, *_STEEP):
        if isinstance(part, sp.exp):
            middles = list(_bottoms(part.exp, variables))
        elif not part.is_Pow:
            middles = list(_bottoms(part.args[0], variables))
            middles += [part.args[0]] if isinstance(part, sp.cosh | sp.sech) else []
        elif part.exp.is_number and part.exp.is_negative:
            middles = list(_bottoms(part.base, variables))
        else:
            continue
        yield from ((part, middle) for middle in middles)


def steps(
    expressions: Iterable[sp.Basic], variables: Variables
) -> Iterator[tuple[sp.Expr, sp.Expr]]:
    """Functions that may be steep steps, and what vanishes in the middle of each."""
    for part in _parts(expressions, sp.Pow, *_STEEP):
        if not part.is_Pow:
            yield part, part.args[0]
        elif part.exp.is_number and part.exp.is_negative:
            yield from ((part, middle) for middle in _thresholds(part.base, variables))


def valleys(expressions: Iterable[sp.Basic]) -> Iterator[sp.Expr]:
    """Functions that are least where an exponential or a reciprocal is largest."""
    for part in _parts(expressions, sp.exp, sp.Pow):
        if isinstance(part, sp.exp):
            yield -part.exp
        elif part.exp.is_number and part.exp.is_negative:
            yield part.base


def _thresholds(base: sp.Expr, variables: Variables) -> Iterator[sp.Expr]:
    """What vanishes where one of two addends is an exponential as large as the other."""
    for term in base.args if base.is_Add and len(base.args) == 2 else ():
        rest = base - term
        for step in term.atoms(sp.exp):
            ratio = term / step / rest
            if not variables(ratio) and not _squares(step.exp, variables):
                shift = sp.log(sp.Abs(ratio))
                yield step.exp + (
                    sp.Rational(str(sp.N(shift, _DIGITS))) if shift.is_number else shift
                )


def _bottoms(expression: sp.Expr, variables: Variables) -> Iterator[sp.Expr]:
    """What vanishes where an expression is least or largest: what is squared, or its slope.

    Sums of several squares have no middle that is a zero of one function.
    """
    squares = _squares(expression, variables)
    yield from squares if len(squares) == 1 else ()
    for variable in variables(expression) if not squares else ():
        rate = slope(expression, variable)
        if rate.has(variable) and not slope(rate, variable).has(variable):
            yield rate


def _squares(expression: sp.Basic, variables: Variables) -> list[sp.Expr]:
    """What is raised to an even power, and is not inside of another such power."""
    if not variables(expression):
        return []
    if expression.is_Pow and expression.exp.is_even and expression.exp.is_positive:
        return [expression.base]
    return [square for part in expression.args for square in _squares(part, variables)]


def _parts(expressions: Iterable[sp.Basic], *kinds: type) -> list[sp.Expr]:
    """The parts of some kinds, each once, in an order of their own."""
    found = {part for expression in expressions for part in expression.atoms(*kinds)}
    return sorted(found, key=sp.default_sort_key)
