"""Arithmetic of SymPy expressions that stand for many numbers with arrays.

NumPy would take such an expression for one number, and make an array of expressions of it.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.sparse
import sympy as sp


class ArrayOperators:
    """``array * u``, ``array + u`` and ``matrix @ u`` for an expression u of many entries.

    The other base is a class of SymPy expressions.
    """

    __slots__ = ()
    __array_ufunc__ = None  # NumPy leaves operators to the methods below

    def _beside(self, array: object) -> sp.Expr:
        """An array that is combined entry by entry, as an expression."""
        raise NotImplementedError

    def _under(self, matrix: object) -> sp.Expr:
        """A matrix times this."""
        raise NotImplementedError

    def __rmatmul__(self, other: object) -> Any:
        return self._under(other) if _is_array(other) else NotImplemented

    def __mul__(self, other: object) -> Any:
        return super().__mul__(self._operand(other))  # type: ignore[misc]

    def __rmul__(self, other: object) -> Any:
        return super().__rmul__(self._operand(other))  # type: ignore[misc]

    def __add__(self, other: object) -> Any:
        return super().__add__(self._operand(other))  # type: ignore[misc]

    def __radd__(self, other: object) -> Any:
        return super().__radd__(self._operand(other))  # type: ignore[misc]

    def __sub__(self, other: object) -> Any:
        return super().__sub__(self._operand(other))  # type: ignore[misc]

    def __rsub__(self, other: object) -> Any:
        return super().__rsub__(self._operand(other))  # type: ignore[misc]

    def __truediv__(self, other: object) -> Any:
        return super().__truediv__(self._operand(other))  # type: ignore[misc]

    def __rtruediv__(self, other: object) -> Any:
        return super().__rtruediv__(self._operand(other))  # type: ignore[misc]

    def _operand(self, other: object) -> object:
        return self._beside(other) if _is_array(other) else other


def _is_array(other: object) -> bool:
    """Whether it is an array with dimensions, or a sparse matrix."""
    if isinstance(other, np.ndarray):
        return other.ndim > 0
    return isinstance(other, scipy.sparse.sparray | scipy.sparse.spmatrix)
