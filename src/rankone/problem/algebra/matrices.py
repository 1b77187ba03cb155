"""Equations between matrices, and problems from mass, damping and stiffness matrices."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any, TypeAlias, TypeGuard

import numpy as np
import scipy.linalg
import scipy.sparse
import sympy as sp
from numpy.typing import ArrayLike

from rankone.problem.algebra.term_table import (
    FEWEST_TABULATED,
    Entry,
    TabulatedEquations,
    TermTable,
    fraction_of,
)
from rankone.problem.expressions.conditions import rate_of, unknown_of
from rankone.problem.expressions.notation import exact, expression_of
from rankone.support.arrays import COINCIDENT, Array
from rankone.support.errors import ProblemError, count, quote, shown

Matrix: TypeAlias = "Array | scipy.sparse.csr_matrix | sp.MatrixBase"
"""Numbers, dense or sparse, or expressions."""
MatrixLike: TypeAlias = "ArrayLike | scipy.sparse.spmatrix | sp.MatrixBase | Mapping[Any, Any]"
"""What users write for a matrix or a vector; a mapping has coefficients and what they multiply."""
Addends: TypeAlias = "list[tuple[sp.Expr, Matrix]]"
"""Coefficients and the arrays, sparse or SymPy matrices, that they multiply."""
MOST_SYMBOLIC_ROWS = 6
"""Rows of a mass matrix that SymPy inverts in no time, whatever is in it."""
_LARGEST_CONDITION = 1.0 / COINCIDENT  # Of a mass matrix of numbers: its inverse keeps four digits
_FORMS = "a SymPy matrix, an array, a sparse matrix of SciPy, or {coefficient: array}"


def explicit(side: object, index: int) -> sp.MatrixBase:
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


def addends_of(written: object, subject: str) -> Addends:
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


def array_of(written: object, subject: str) -> Matrix:
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


def _sparse(written: scipy.sparse.spmatrix, subject: str) -> scipy.sparse.csr_matrix:
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


def entries_of(array: Matrix) -> Iterator[tuple[tuple[int, ...], sp.Expr]]:
    """The entries that are not zero, with their places."""
    if isinstance(array, sp.MatrixBase):
        for place in itertools.product(*map(range, array.shape)):
            if array[place] != 0:
                yield place, array[place]
        return
    for place, entry in numbers_of(array):
        yield place, exact(sp.Float(entry))


def numbers_of(array: Matrix) -> Iterator[tuple[tuple[int, ...], float]]:
    """The entries of an array, or a sparse matrix, that are not zero, with their places."""
    if isinstance(array, np.ndarray):
        places = [*np.nonzero(array)]
        entries = array[tuple(places)]
    else:
        array = array.tocoo()
        places, entries = [array.row, array.col], array.data
    yield from zip(zip(*(p.tolist() for p in places), strict=True), entries.tolist(), strict=True)


def off_diagonal(array: Matrix) -> list[float] | list[bool]:
    """What is off the diagonal, as numbers or truth values."""
    if isinstance(array, sp.MatrixBase):
        return [entry != 0 for (i, j), entry in entries_of(array) if i != j]
    return [entry for (i, j), entry in numbers_of(array) if i != j]


def product_of(inverse: Array | None, array: Matrix) -> Matrix:
    """An array multiplied from the left; what rounding leaves of zeros is zero."""
    if inverse is None:
        return array
    if isinstance(array, sp.MatrixBase):
        return sp.Matrix(inverse) * array
    if not isinstance(array, np.ndarray):
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
    dense = (a if isinstance(a, np.ndarray | sp.MatrixBase) else a.toarray() for _, a in mass)
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


# -----------------------------------------------------------------------------
# Equations between matrices, and problems from mass, damping and stiffness matrices.


# -- equations ---------------------------------------------------------------------------------


def scalar_equations(equations: Iterable[Any]) -> tuple[Any, ...]:
    """The rows of equations between matrices, and other equations as they are.

    A ProblemError if a matrix has entries that are not written out.
    """
    scalars: list[Any] = []
    for index, equation in enumerate(equations, 1):
        sides = equation.args if isinstance(equation, sp.Eq) else (equation,)
        if not any(isinstance(side, sp.MatrixExpr | sp.MatrixBase) for side in sides):
            scalars.append(equation)
            continue
        matrices = [explicit(side, index) for side in sides]
        entries = [[*matrix] for matrix in matrices]
        for row in zip(*entries, strict=True):
            scalars.append(sp.Eq(*row, evaluate=False) if len(row) == 2 else row[0])
    return tuple(scalars)


# -- systems of second order -------------------------------------------------------------------


@dataclass(frozen=True)
class MatrixSystem:
    """``M q'' + C q' + K q = force``, or without M of first order.

    Matrices are sums of a coefficient times an array; M is None, or None are C and K, where they
    are left out.
    """

    unknowns: tuple[sp.Expr, ...]
    time: sp.Symbol
    terms: Mapping[int, Addends]
    """The matrices by the order of the derivative that they multiply."""
    force: Addends

    @classmethod
    def of(
        cls,
        matrices: Mapping[str, object],
        force: object,
        time: sp.Symbol,
        names: str | Sequence[str],
    ) -> MatrixSystem:
        """The system of the matrices ``M``, ``C`` and ``K``; a ProblemError if they do not fit."""
        orders = {"M": 2, "C": 1, "K": 0}
        terms = {
            orders[name]: addends_of(matrix, f"the matrix {name}")
            for name, matrix in matrices.items()
            if matrix is not None
        }
        if not terms or max(terms) == 0:
            raise ProblemError("neither M nor C is given", remedy="give M, or C for first order")
        named = [(name, a) for name, n in orders.items() for _, a in terms.get(n, ())]
        size = named[0][1].shape[0]
        for name, array in named:
            if array.shape != (size, size):
                raise ProblemError(
                    f"the matrix {name} is {' x '.join(map(str, array.shape))}",
                    term=name,
                    remedy=f"give {size} x {size} entries, as {named[0][0]} has",
                )
        if not any(True for _, array in terms[max(terms)] for _ in entries_of(array)):
            message = f"the matrix {named[0][0]} is zero: the system has no highest derivatives"
            raise ProblemError(
                message, term=named[0][0], remedy="leave it out, or give its entries"
            )
        vector = [] if force is None else addends_of(force, "the force")
        for _, array in vector:
            if array.shape not in ((size,), (size, 1)):
                raise ProblemError(
                    f"the force has the shape {tuple(array.shape)}",
                    term=force,
                    remedy=f"give {count(size, 'entry', 'entries')}",
                )
        return cls(named_unknowns(names, size, time), time, terms, vector)

    @property
    def order(self) -> int:
        """The order of the highest derivatives."""
        return max(self.terms)

    @property
    def equations(self) -> Sequence[sp.Basic]:
        """One for each row, of many written out when they are read."""
        table = self._table() if len(self.unknowns) >= FEWEST_TABULATED else None
        if table is None:
            return self._written()
        return TabulatedEquations(len(self.unknowns), self._written, table)

    def _table(self) -> TermTable | None:
        """The terms of all rates; None if matrices have expressions, or masses are none of numbers.

        Of a mass matrix that is not diagonal the rates are multiplied by its inverse.
        """
        arrays = [array for addends in (*self.terms.values(), self.force) for _, array in addends]
        mass = self.terms[self.order]
        symbolic = any(isinstance(array, sp.MatrixBase) for array in arrays)
        if symbolic or not all(c.is_Rational for c, _ in mass):
            return None
        inverse, masses = None, [Fraction(1)] * len(self.unknowns)
        if self._is_kept(mass):
            masses = masses_of(mass, len(self.unknowns))
            if not all(masses):
                return None
        else:
            inverse = inverse_of(mass)
        n, terms, functions = len(self.unknowns), list[Entry](), dict[sp.Expr, int]()
        first = (self.order - 1) * n  # of the states whose rates the equations determine
        terms += [(Fraction(1), i, 0, (n + i,)) for i in range(first)]
        functions[sp.S.One] = 0
        lower = [(order * n, -1, self.terms.get(order, ())) for order in range(self.order)]
        for offset, sign, addends in (*lower, (None, 1, self.force)):
            for coefficient, array in addends:
                function = functions.setdefault(coefficient, len(functions))
                for (i, *j), entry in numbers_of(product_of(inverse, array)):
                    states = () if offset is None else (offset + j[0],)
                    share = sign * fraction_of(entry) / masses[i]
                    terms.append((share, first + i, function, states))
        states = tuple(
            rate_of(q, self.time, order) if order else q
            for order in range(self.order)
            for q in self.unknowns
        )
        return TermTable(states, tuple(functions), tuple(terms))

    def _written(self) -> list[sp.Eq]:
        """One for each row; solved for the highest derivatives if M is dense and of numbers."""
        highest = [rate_of(q, self.time, self.order) for q in self.unknowns]
        mass = self.terms[self.order]
        lower = [(order, term) for order, term in self.terms.items() if order < self.order]
        if self._is_kept(mass):
            left = self._rows([(self.order, mass), *lower], None)
            return [
                sp.Eq(row, f, evaluate=False)
                for row, f in zip(left, self._forces(None), strict=True)
            ]
        inverse = inverse_of(mass)
        pulls, forces = self._rows(lower, inverse), self._forces(inverse)
        return [
            sp.Eq(q, f - pull, evaluate=False)
            for q, pull, f in zip(highest, pulls, forces, strict=True)
        ]

    def _is_kept(self, mass: Addends) -> bool:
        """Whether the mass matrix stays in the equations: it is diagonal, or small."""
        if len(self.unknowns) <= MOST_SYMBOLIC_ROWS:
            return True
        return all(not np.any(off_diagonal(array)) for _, array in mass)

    def _rows(self, terms: Iterable[tuple[int, Addends]], inverse: Array | None) -> list[sp.Expr]:
        """The sum of matrices times derivatives, perhaps times an inverse from the left."""
        rows: list[list[sp.Expr]] = [[] for _ in self.unknowns]
        for order, addends in terms:
            derivatives = [rate_of(q, self.time, order) if order else q for q in self.unknowns]
            for coefficient, array in addends:
                for (i, j), entry in entries_of(product_of(inverse, array)):
                    rows[i].append(coefficient * entry * derivatives[j])
        return [sp.Add(*row) for row in rows]

    def _forces(self, inverse: Array | None) -> list[sp.Expr]:
        """The right-hand side, perhaps times an inverse from the left."""
        rows: list[list[sp.Expr]] = [[] for _ in self.unknowns]
        for coefficient, array in self.force:
            for (i, *_), entry in entries_of(product_of(inverse, array)):
                rows[i].append(coefficient * entry)
        return [sp.Add(*row) for row in rows]

    def initial(self, written: object) -> dict[sp.Expr, Any]:
        """Initial values of all states; see :func:`initial_values`."""
        return initial_values(written, self.unknowns, self.time, self.order)


def initial_values(
    written: object, unknowns: Sequence[sp.Expr], time: sp.Symbol, order: int
) -> dict[sp.Expr, Any]:
    """Initial values of all states: of an array, of a pair of arrays, or of a mapping.

    What is left out is zero.
    """
    states = [rate_of(q, time, k) if k else q for k in range(order) for q in unknowns]
    start: dict[sp.Expr, Any] = dict.fromkeys(states, sp.S.Zero)
    if isinstance(written, Mapping):
        return {**start, **_by_state(written, unknowns, time)}
    columns = [written]
    if isinstance(written, tuple | list) and written and all(map(_is_column, written)):
        columns = [*written]
    if len(columns) > order:
        raise ProblemError(
            f"initial has {len(columns)} arrays for a system of order {order}",
            term=written,
            remedy="give the values of the unknowns, then those of their derivatives",
        )
    for k, column in enumerate(columns):
        entries = [*column] if _is_column(column) else None
        if entries is None or len(entries) != len(unknowns):
            content = shown(written) if entries is None else count(len(entries), "value")
            raise ProblemError(
                f"initial is {content} for {count(len(unknowns), 'unknown')}",
                term=written,
                remedy=f"give {count(len(unknowns), 'value')}, or a pair of such arrays "
                "for values and derivatives, or a mapping",
            )
        first = k * len(unknowns)
        start |= dict(zip(states[first : first + len(entries)], entries, strict=True))
    return start


def _by_state(
    written: Mapping[Any, Any], unknowns: Sequence[sp.Expr], time: sp.Symbol
) -> dict[Any, Any]:
    """Initial values by states, given by their names or as they are."""
    named = {q.func.__name__: q for q in unknowns}
    named |= {f"{name}_t": rate_of(q, time) for name, q in named.items()}
    return {named.get(key, key) if isinstance(key, str) else key: at for key, at in written.items()}


def _is_column(written: object) -> TypeGuard[Iterable[object]]:
    """Whether something is an array of one dimension, a list, or a matrix of one column."""
    if isinstance(written, sp.MatrixBase):
        return 1 in written.shape
    return isinstance(written, list | tuple) or np.ndim(written) == 1  # type: ignore[arg-type]


def named_unknowns(names: object, size: int, time: sp.Symbol) -> tuple[sp.Expr, ...]:
    """Functions of time with the names given, or ``q0``, ``q1``, ... for ``"q"``."""
    if isinstance(names, str):
        listed = [f"{names}{i}" for i in range(size)]
    else:
        listed = [*names] if isinstance(names, Sequence) else []
    if len(listed) != size or not all(isinstance(name, str) and name for name in listed):
        raise ProblemError(
            f"names are {shown(names)}",
            term=names,
            remedy=f'give "q" for q0, q1, ..., or a list of {count(size, "name")}',
        )
    return tuple(unknown_of(name, time) for name in listed)
