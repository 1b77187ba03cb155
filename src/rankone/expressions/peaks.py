"""Peaks and steps: where smooth expressions may change faster than samples may see.

Peaks are such as ``exp(-((t - 60)/1e-3)**2)``, ``1/(1 + (k/1e-4)**2)``, ``1/cosh(x/1e-3)**2`` and
``cos(x)**1000000``; steep steps are ``tanh``, ``erf``, ``atan`` and ``1/(1 + exp(...))``, two of
which make a pulse.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator

import sympy as sp

from rankone.expressions.derivatives import slope

Variables = Callable[[sp.Basic], Iterable[sp.Expr]]
"""The variables of an expression that count."""
# Functions that change most where their argument vanishes
_STEEPEST_AT_ZERO = (sp.tanh, sp.erf, sp.erfc, sp.atan, sp.cosh, sp.sech)
_PERIODIC = (sp.sin, sp.cos)
_HIGH_POWER = 100  # A power from which a function counts as a peak where its base is extreme
_SHIFT_DIGITS = 20  # Decimal digits of a logarithm in a threshold: more than a float holds


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
    nodes = {node for expression in expressions for node in expression.atoms(*functions)}
    return sorted(nodes, key=sp.default_sort_key)


def _thresholds(base: sp.Expr, variables: Variables) -> Iterator[sp.Expr]:
    """What vanishes where an exponential is as large as the only other addend."""
    for term in base.args if base.is_Add and len(base.args) == 2 else ():
        other_term = base - term
        for step in term.atoms(sp.exp):
            ratio = term / step / other_term
            if not variables(ratio) and not _squares(step.exp, variables):
                shift = sp.log(sp.Abs(ratio))
                if shift.is_number:
                    shift = sp.Rational(str(sp.N(shift, _SHIFT_DIGITS)))
                yield step.exp + shift


def extrema(expression: sp.Expr, variables: Variables) -> Iterator[sp.Expr]:
    """What vanishes where an expression is least or largest: what is squared, or its slope.

    A sum of several squares is least where no single function vanishes. The slope counts if it is
    linear or periodic.
    """
    squares = _squares(expression, variables)
    yield from squares if len(squares) == 1 else ()
    for variable in variables(expression) if not squares else ():
        rate = slope(expression, variable)
        linear = rate.has(variable) and not slope(rate, variable).has(variable)
        if linear or any(wave.has(variable) for wave in rate.atoms(*_PERIODIC)):
            yield rate


def _squares(expression: sp.Basic, variables: Variables) -> list[sp.Expr]:
    """What is raised to an even power, and is not inside another such power."""
    if not variables(expression):
        return []
    if expression.is_Pow and expression.exp.is_even and expression.exp.is_positive:
        return [expression.base]
    return [square for argument in expression.args for square in _squares(argument, variables)]
