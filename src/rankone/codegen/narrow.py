"""Smooth functions that may be so narrow that they are stepped over, and where their middles are.

Peaks such as ``exp(-((t - 60)/1e-3)**2)``, ``1/(1 + (k/1e-4)**2)`` and ``1/cosh(x/1e-3)**2``, and
the steep steps ``tanh``, ``erf``, ``atan`` and ``1/(1 + exp(...))``, two of which make a pulse.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence

import sympy as sp
from sympy.core.function import AppliedUndef

from rankone.ir import Coordinate

__all__ = ["Variables", "moving_middles", "narrow_places", "peaks", "steps"]

Variables = Callable[[sp.Basic], Iterable[sp.Expr]]
"""The variables of an expression that count."""
_SHARP = 3e3
"""Steepness over the interval from which a smooth function may be missed by samples of it."""
_NARROW = 1e4
"""Curvature of an exponent, over the horizon squared, from which its peak may be stepped over."""
_STEEP = (sp.tanh, sp.erf, sp.erfc, sp.atan, sp.cosh, sp.sech)
"""Functions that change most where their argument vanishes."""


def narrow_places(coordinate: Coordinate, expressions: Iterable[sp.Basic]) -> Iterator[float]:
    """Where functions of one coordinate are so narrow that samples may miss them.

    Functions of a linear argument, and exponentials and reciprocals of a square.
    """
    x, width = coordinate.symbol, coordinate.upper - coordinate.lower
    for part in _parts(expressions, sp.exp, sp.Pow, *_STEEP):
        if part.free_symbols != {x} or part.has(AppliedUndef):
            continue
        base, exponent = part.as_base_exp() if part.is_Pow else (part, sp.S.One)
        argument = part.exp if isinstance(part, sp.exp) else base if part.is_Pow else part.args[0]
        slope, curve = argument.diff(x), argument.diff(x, 2)
        if slope.is_number and slope != 0 and not part.is_Pow:
            if abs(float(slope)) * width > _SHARP:
                yield -float(argument.subs(x, 0)) / float(slope)
        elif curve.is_number and curve != 0:
            middle = -float(slope.subs(x, 0)) / float(curve)
            size = 1.0 if not part.is_Pow else abs(float(argument.subs(x, middle)))
            sharp = abs(float(curve)) * width**2 > _SHARP**2 * size
            if sharp and (not part.is_Pow or (exponent.is_number and exponent < 0)):
                yield middle


def moving_middles(
    coordinates: Sequence[Coordinate], expressions: Iterable[sp.Basic]
) -> Iterator[sp.Expr]:
    """Times, as functions of the parameters, of the peaks of narrow exponentials of squares."""
    clock, *parameters = coordinates
    t, known = clock.symbol, {c.symbol for c in coordinates}
    centre = {p.symbol: sp.Float(0.5 * (p.lower + p.upper)) for p in parameters}
    for part in _parts(expressions, sp.exp):
        curve = part.exp.diff(t, 2)
        moves = len(part.exp.free_symbols) > 1 and part.exp.free_symbols <= known
        if moves and not part.exp.has(AppliedUndef) and curve != 0 and not curve.has(t):
            size = abs(curve.subs(centre)) * (clock.upper - clock.lower) ** 2
            if size.is_number and size > _NARROW:
                yield -part.exp.diff(t).subs(t, 0) / curve


def peaks(expressions: Iterable[sp.Basic], variables: Variables) -> Iterator[sp.Expr]:
    """Functions that vanish in the middle of peaks; ``variables`` are those of an expression.

    How narrow they are is not known as long as the variables, such as the unknowns, are not.
    """
    for part in _parts(expressions, sp.exp, sp.Pow, sp.cosh, sp.sech):
        if isinstance(part, sp.exp):
            yield from _bottoms(part.exp, variables)
        elif not part.is_Pow:
            yield part.args[0]
        elif part.exp.is_number and part.exp.is_negative:
            yield from _bottoms(part.base, variables)


def steps(expressions: Iterable[sp.Basic], variables: Variables) -> Iterator[sp.Expr]:
    """Functions that vanish in the middle of smooth steps."""
    for part in _parts(expressions, sp.Pow, *_STEEP):
        if not part.is_Pow:
            yield part.args[0]
        elif part.exp.is_number and part.exp.is_negative:
            yield from _thresholds(part.base, variables)


def _thresholds(base: sp.Expr, variables: Variables) -> Iterator[sp.Expr]:
    """What vanishes where one of two addends is an exponential as large as the other."""
    for term in base.args if base.is_Add and len(base.args) == 2 else ():
        rest = base - term
        for step in term.atoms(sp.exp):
            ratio = term / step / rest
            if not variables(ratio) and not _squares(step.exp, variables):
                yield step.exp + sp.log(sp.Abs(ratio))


def _bottoms(expression: sp.Expr, variables: Variables) -> Iterator[sp.Expr]:
    """What vanishes where an expression is least or largest: what is squared, or its slope.

    Sums of several squares have no middle that is a zero of one function.
    """
    squares = _squares(expression, variables)
    yield from squares if len(squares) == 1 else ()
    for variable in variables(expression) if not squares else ():
        slope = expression.diff(variable)
        if slope.has(variable) and not slope.diff(variable).has(variable):
            yield slope


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
