"""Matrices and vectors as users give them: sums of coefficients times arrays."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping
from fractions import Fraction
from typing import Any, TypeAlias

import numpy as np
import scipy.linalg
import scipy.sparse
import sympy as sp

from rankone.expressions.notation import exact, expression_of
from rankone.frontend.term_table import fraction_of
from rankone.support.arrays import Array
from rankone.support.errors import ProblemError
from rankone.support.wording import quote, shown

Addends: TypeAlias = "list[tuple[sp.Expr, Any]]"
"""Coefficients and the arrays, sparse or SymPy matrices, that they multiply."""
MOST_SYMBOLIC_ROWS = 6
"""Rows of a mass matrix that SymPy inverts in no time, whatever is in it."""
_LARGEST_CONDITION = 1e12  # Of a mass matrix of numbers: its inverse keeps four digits
_FORMS = "a SymPy matrix, an array, a sparse matrix of SciPy, or {coefficient: array}"


def explicit(side: Any, index: int) -> sp.MatrixBase:
    """One side of an equation as a matrix of expressions."""
    try:
        matrix = side.as_explicit() if isinstance(side, sp.MatrixExpr) else side
        unknown = isinstance(matrix, sp.MatrixBase) and matrix.atoms(sp.MatrixSymbol)
    except (TypeError, ValueError, AttributeError):
        matrix, unknown = None, True
    if unknown or not isinstance(matrix, sp.MatrixBase):
        raise ProblemError(
            f"the matrix {quote(side)} has entries that are not written out",
            equation=index,
            term=side,
            remedy="write it out, sympy.Matrix([...]), of functions of time and parameters",
        )
    return matrix


def addends_of(written: Any, subject: str) -> Addends:
    """A matrix or vector as a sum of coefficients times arrays."""
    if not isinstance(written, Mapping):
        return [(sp.S.One, array_of(written, subject))]
    addends: Addends = []
    for key, array in written.items():
        coefficient = expression_of(key)
        if coefficient is None:
            raise ProblemError(
                f"the coefficient {shown(key)} of {subject} is no number or expression",
                term=key,
                remedy="use symbols of parameters and numbers as keys: {1: K0, k: K1}",
            )
        addends.append((exact(coefficient), array_of(array, subject)))
    if not addends:
        raise ProblemError(f"{subject} has no terms", term=written, remedy=f"give {_FORMS}")
    return addends


def array_of(written: Any, subject: str) -> Any:
    """An array of floats, or a SymPy matrix if there are expressions."""
    if isinstance(written, sp.MatrixExpr):
        written = explicit(written, 0)
    if isinstance(written, sp.MatrixBase):
        return written
    if scipy.sparse.issparse(written):
        return _sparse(written, subject)
    array = np.asarray(written)
    if array.dtype == object or array.dtype.kind in "US":
        try:
            return sp.Matrix(array.tolist())
        except (TypeError, ValueError, sp.SympifyError):
            array = np.empty(())
    if array.dtype.kind not in "iuf" or array.ndim not in (1, 2):
        raise ProblemError(f"{subject} is {shown(written)}", term=written, remedy=f"give {_FORMS}")
    _check_finite(array, subject)
    return array.astype(float)


def _sparse(written: Any, subject: str) -> Any:
    """A sparse matrix of floats, by rows, without zeros."""
    if written.dtype.kind not in "iuf" or len(written.shape) != 2:
        raise ProblemError(f"{subject} is {shown(written)}", term=written, remedy=f"give {_FORMS}")
    array = scipy.sparse.csr_matrix(written, dtype=float)
    array.sum_duplicates()
    array.eliminate_zeros()
    _check_finite(array.data, subject)
    return array


def _check_finite(entries: Array, subject: str) -> None:
    if not np.isfinite(entries).all():
        message = f"{subject} has entries that are not finite"
        raise ProblemError(message, term=subject, remedy="check the array")


def entries_of(array: Any) -> Iterator[tuple[tuple[int, ...], sp.Expr]]:
    """The entries that are not zero, with their places."""
    if isinstance(array, sp.MatrixBase):
        for place in itertools.product(*map(range, array.shape)):
            if array[place] != 0:
                yield place, array[place]
        return
    for place, entry in numbers_of(array):
        yield place, exact(sp.Float(entry))


def numbers_of(array: Any) -> Iterator[tuple[tuple[int, ...], float]]:
    """The entries of an array, or a sparse matrix, that are not zero, with their places."""
    if scipy.sparse.issparse(array):
        array = array.tocoo()
        places, entries = [array.row, array.col], array.data
    else:
        places = [*np.nonzero(array)]
        entries = array[tuple(places)]
    yield from zip(zip(*(p.tolist() for p in places), strict=True), entries.tolist(), strict=True)


def off_diagonal(array: Any) -> Any:
    """What is off the diagonal, as numbers or truth values."""
    if isinstance(array, sp.MatrixBase):
        return [entry != 0 for (i, j), entry in entries_of(array) if i != j]
    return [entry for (i, j), entry in numbers_of(array) if i != j]


def product_of(inverse: Array | None, array: Any) -> Any:
    """An array multiplied from the left; what rounding leaves of zeros is zero."""
    if inverse is None:
        return array
    if isinstance(array, sp.MatrixBase):
        return sp.Matrix(inverse) * array
    if scipy.sparse.issparse(array):
        array = array.toarray()
    product = inverse @ array
    size = np.abs(inverse) @ np.abs(array)
    return np.where(np.abs(product) > np.finfo(float).eps * size, product, 0.0)


def masses_of(mass: Addends, n: int) -> list[Fraction]:
    """The masses of a diagonal matrix of numbers."""
    masses = [Fraction(0)] * n
    for coefficient, array in mass:
        for (i, _), entry in numbers_of(array):
            masses[i] += Fraction(int(coefficient.p), int(coefficient.q)) * fraction_of(entry)
    return masses


def inverse_of(mass: Addends) -> Array:
    """The inverse of a mass matrix of numbers."""
    if any((isinstance(a, sp.MatrixBase) and a.free_symbols) or c.free_symbols for c, a in mass):
        raise ProblemError(
            f"the mass matrix has {mass[0][1].shape[0]} rows, is not diagonal, and depends on "
            "parameters or time",
            term=mass[0][1],
            remedy=f"with more than {MOST_SYMBOLIC_ROWS} rows let it be diagonal, or of numbers "
            "alone: change to coordinates in which it is",
        )
    dense = (a.toarray() if scipy.sparse.issparse(a) else a for _, a in mass)
    pairs = zip((float(c) for c, _ in mass), dense, strict=True)
    total = sum(c * np.array(a, dtype=float) for c, a in pairs)
    if np.linalg.cond(total) > _LARGEST_CONDITION:
        raise ProblemError(
            "the mass matrix is singular, or nearly so: its condition number is "
            f"{np.linalg.cond(total):.2g}",
            term=mass[0][1],
            remedy="leave out degrees of freedom that have no mass",
        )
    return np.asarray(scipy.linalg.inv(total))
