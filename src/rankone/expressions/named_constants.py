"""Numbers with a name: to every symbolic pass a number like pi, in generated code a run-time value.

A constant of a problem that enters smoothly keeps its name up to the generated module, which reads
its number from a table. So another number needs no new module, only another table.

Where the number decides what is generated it is written in instead: exponents, conditions,
thresholds and times of switches, centres and widths of peaks, logarithms and roots of sums.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import sympy as sp
from sympy.core.function import AppliedUndef

from rankone.expressions.peaks import peaks, steps
from rankone.ir.functions import nodes_of

# Functions without thresholds: they are smooth wherever they are finite
_SMOOTH = (sp.sin, sp.cos, sp.tan, sp.exp, sp.sinh)
_STEPS = (sp.tanh, sp.atan, sp.erf, sp.erfc, sp.cosh, sp.sech)


class NamedConstant(sp.NumberSymbol):  # type: ignore[misc]
    """A real number with a name; two are equal if both agree.

    >>> m = NamedConstant("m", sp.Integer(3))
    >>> 2 * m, float(2 * m), (2 * m).free_symbols
    (2*m, 6.0, set())
    """

    __slots__ = ("name", "value")
    is_real = True

    name: str
    value: sp.Expr

    def __new__(cls, name: str, value: sp.Expr) -> NamedConstant:
        constant: NamedConstant = sp.AtomicExpr.__new__(cls)
        constant.name, constant.value = name, value
        return constant

    def __getnewargs__(self) -> tuple[str, sp.Expr]:
        return self.name, self.value

    def _hashable_content(self) -> tuple[str, sp.Expr]:
        return self.name, self.value

    def __eq__(self, other: object) -> bool:
        same = isinstance(other, NamedConstant)
        return same and self._hashable_content() == other._hashable_content()  # type: ignore[attr-defined]

    def __ne__(self, other: object) -> bool:
        return not self == other

    def __hash__(self) -> int:
        return int(super().__hash__())

    def _as_mpf_val(self, prec: int) -> Any:
        return self.value._eval_evalf(prec)._as_mpf_val(prec)

    def approximation_interval(self, number_cls: type) -> None:
        """SymPy has intervals of numbers that it cannot compute."""

    def _sympystr(self, printer: object) -> str:
        return self.name

    def _latex(self, printer: object) -> str:
        return str(sp.latex(sp.Symbol(self.name)))

    def _decimal(self, printer: object) -> str:
        return repr(float(self.value))

    _numpycode = _pythoncode = _lambdacode = _mpmathcode = _decimal


def named_constants(expressions: Iterable[sp.Basic]) -> list[NamedConstant]:
    """The named constants in expressions, by name."""
    return sorted(nodes_of(expressions, NamedConstant), key=lambda constant: constant.name)


def written_in(expression: sp.Basic, constants: frozenset[sp.Symbol]) -> set[sp.Symbol]:
    """The symbols of constants whose numbers decide what is generated of an expression."""
    decisive: set[sp.Symbol] = set()
    waiting = [expression]
    while waiting:
        node = waiting.pop()
        inside = node.free_symbols & constants
        if not inside - decisive:
            continue
        if isinstance(node, sp.Add | sp.Mul | sp.Eq | sp.Derivative | sp.MatrixBase):
            waiting += node.args
        elif node.is_Symbol:
            continue
        elif not _is_smooth(node, constants):
            decisive |= inside
        else:
            waiting += node.args
    return decisive


def _is_smooth(node: sp.Basic, constants: frozenset[sp.Symbol]) -> bool:
    """Whether what is generated of a function or power is the same for all numbers in it."""
    if isinstance(node, sp.Pow) and not isinstance(node, sp.exp):
        if node.exp.is_Integer:
            return node.exp > 0 or not (node.base.is_Add and _has_thresholds(node, constants))
        if not node.free_symbols - constants and not node.atoms(AppliedUndef):
            return not node.atoms(sp.Add)  # such as sqrt(k/m): SymPy asks for the signs alone
        return node.exp.is_number and node.base.is_Mul and not node.base.atoms(sp.Add)
    if isinstance(node, _SMOOTH):
        return not isinstance(node, sp.exp) or not _has_thresholds(node, constants)
    return isinstance(node, _STEPS) and bool(node.atoms(AppliedUndef))


def _has_thresholds(node: sp.Expr, constants: frozenset[sp.Symbol]) -> bool:
    """Whether a number tells where a function has a peak or a step.

    Over the unknowns these are functions that vanish there, and are generated with the name, unless
    they are logarithms of ratios.
    """

    def variables(expression: sp.Basic) -> set[sp.Expr]:
        return {*(expression.free_symbols - constants), *expression.atoms(AppliedUndef)}

    return any(
        not surface.atoms(AppliedUndef)
        or any(ratio.free_symbols & constants for ratio in surface.atoms(sp.Abs))
        for _, surface in (*peaks([node], variables), *steps([node], variables))
    )
