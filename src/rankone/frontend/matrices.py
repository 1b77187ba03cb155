"""Equations between matrices, and problems from mass, damping and stiffness matrices."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
import scipy.linalg
import sympy as sp

from rankone.expressions.notation import exact
from rankone.expressions.unknowns import rate_of, unknown_of
from rankone.support.arrays import Array
from rankone.support.errors import ProblemError
from rankone.support.wording import count, quote, shown

Addends: TypeAlias = "list[tuple[sp.Expr, Any]]"
"""Coefficients and the arrays, or SymPy matrices, that they multiply."""
# Rows of a mass matrix that SymPy inverts in no time, whatever is in it
_MOST_SYMBOLIC_ROWS = 6
_LARGEST_CONDITION = 1e12  # Of a mass matrix of numbers: its inverse keeps four digits
_FORMS = "a SymPy matrix, an array, a sparse matrix of SciPy, or {coefficient: array}"


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
        matrices = [_explicit(side, index) for side in sides]
        entries = [[*matrix] for matrix in matrices]
        for row in zip(*entries, strict=True):
            scalars.append(sp.Eq(*row, evaluate=False) if len(row) == 2 else row[0])
    return tuple(scalars)


def _explicit(side: Any, index: int) -> sp.MatrixBase:
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
        cls, matrices: Mapping[str, Any], force: Any, time: sp.Symbol, names: str | Sequence[str]
    ) -> MatrixSystem:
        """The system of the matrices ``M``, ``C`` and ``K``; a ProblemError if they do not fit."""
        orders = {"M": 2, "C": 1, "K": 0}
        terms = {
            orders[name]: _addends(matrix, f"the matrix {name}")
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
        if not any(True for _, array in terms[max(terms)] for _ in _entries(array)):
            message = f"the matrix {named[0][0]} is zero: the system has no highest derivatives"
            raise ProblemError(
                message, term=named[0][0], remedy="leave it out, or give its entries"
            )
        vector = [] if force is None else _addends(force, "the force")
        for _, array in vector:
            if array.shape not in ((size,), (size, 1)):
                raise ProblemError(
                    f"the force has the shape {tuple(array.shape)}",
                    term=force,
                    remedy=f"give {count(size, 'entry', 'entries')}",
                )
        return cls(_unknowns(names, size, time), time, terms, vector)

    @property
    def order(self) -> int:
        """The order of the highest derivatives."""
        return max(self.terms)

    @property
    def equations(self) -> list[sp.Eq]:
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
        inverse = _inverse(mass)
        pulls, forces = self._rows(lower, inverse), self._forces(inverse)
        return [
            sp.Eq(q, f - pull, evaluate=False)
            for q, pull, f in zip(highest, pulls, forces, strict=True)
        ]

    def _is_kept(self, mass: Addends) -> bool:
        """Whether the mass matrix stays in the equations: it is diagonal, or small."""
        if len(self.unknowns) <= _MOST_SYMBOLIC_ROWS:
            return True
        return all(not np.any(_numbers_off_diagonal(array)) for _, array in mass)

    def _rows(self, terms: Iterable[tuple[int, Addends]], inverse: Array | None) -> list[sp.Expr]:
        """The sum of matrices times derivatives, perhaps times an inverse from the left."""
        rows: list[list[sp.Expr]] = [[] for _ in self.unknowns]
        for order, addends in terms:
            derivatives = [rate_of(q, self.time, order) if order else q for q in self.unknowns]
            for coefficient, array in addends:
                for (i, j), entry in _entries(_times(inverse, array)):
                    rows[i].append(coefficient * entry * derivatives[j])
        return [sp.Add(*row) for row in rows]

    def _forces(self, inverse: Array | None) -> list[sp.Expr]:
        """The right-hand side, perhaps times an inverse from the left."""
        rows: list[list[sp.Expr]] = [[] for _ in self.unknowns]
        for coefficient, array in self.force:
            for (i, *_), entry in _entries(_times(inverse, array)):
                rows[i].append(coefficient * entry)
        return [sp.Add(*row) for row in rows]

    def initial(self, written: Any) -> dict[sp.Expr, Any]:
        """Initial values of all states: of an array, of a pair of arrays, or of a mapping.

        What is left out is zero.
        """
        states = [
            rate_of(q, self.time, order) if order else q
            for order in range(self.order)
            for q in self.unknowns
        ]
        start: dict[sp.Expr, Any] = dict.fromkeys(states, sp.S.Zero)
        if isinstance(written, Mapping):
            return {**start, **self._by_state(written)}
        columns = [written]
        if isinstance(written, tuple | list) and written and all(map(_is_column, written)):
            columns = [*written]
        if len(columns) > self.order:
            raise ProblemError(
                f"initial has {len(columns)} arrays for a system of order {self.order}",
                term=written,
                remedy="give the values of the unknowns, then those of their derivatives",
            )
        for order, column in enumerate(columns):
            entries = [*column] if _is_column(column) else None
            if entries is None or len(entries) != len(self.unknowns):
                raise ProblemError(
                    f"initial is {shown(written)}",
                    term=written,
                    remedy=f"give {count(len(self.unknowns), 'value')}, or a pair of such arrays "
                    "for values and derivatives, or a mapping",
                )
            first = order * len(self.unknowns)
            start |= dict(zip(states[first : first + len(entries)], entries, strict=True))
        return start

    def _by_state(self, written: Mapping[Any, Any]) -> dict[Any, Any]:
        """Initial values by states, given by their names or as they are."""
        named = {q.func.__name__: q for q in self.unknowns}
        named |= {f"{name}_t": rate_of(q, self.time) for name, q in named.items()}
        return {
            named.get(key, key) if isinstance(key, str) else key: at for key, at in written.items()
        }


def _is_column(written: object) -> bool:
    """Whether something is an array of one dimension, a list, or a matrix of one column."""
    if isinstance(written, sp.MatrixBase):
        return 1 in written.shape
    return isinstance(written, list | tuple) or np.ndim(written) == 1  # type: ignore[arg-type]


def _unknowns(names: object, size: int, time: sp.Symbol) -> tuple[sp.Expr, ...]:
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


def _addends(written: Any, subject: str) -> Addends:
    """A matrix or vector as a sum of coefficients times arrays."""
    if not isinstance(written, Mapping):
        return [(sp.S.One, _array(written, subject))]
    addends: Addends = []
    for key, array in written.items():
        try:
            coefficient = exact(sp.sympify(key, strict=True))
        except (sp.SympifyError, TypeError):
            coefficient = None
        if not isinstance(coefficient, sp.Expr):
            raise ProblemError(
                f"the coefficient {shown(key)} of {subject} is no number or expression",
                term=key,
                remedy="use symbols of parameters and numbers as keys: {1: K0, k: K1}",
            )
        addends.append((coefficient, _array(array, subject)))
    if not addends:
        raise ProblemError(f"{subject} has no terms", term=written, remedy=f"give {_FORMS}")
    return addends


def _array(written: Any, subject: str) -> Any:
    """An array of floats, or a SymPy matrix if there are expressions."""
    if isinstance(written, sp.MatrixExpr):
        written = _explicit(written, 0)
    if isinstance(written, sp.MatrixBase):
        return written
    array = np.asarray(written.toarray() if hasattr(written, "toarray") else written)
    if array.dtype == object or array.dtype.kind in "US":
        try:
            return sp.Matrix(array.tolist())
        except (TypeError, ValueError, sp.SympifyError):
            array = np.empty(())
    if array.dtype.kind not in "iuf" or array.ndim not in (1, 2):
        raise ProblemError(f"{subject} is {shown(written)}", term=written, remedy=f"give {_FORMS}")
    if not np.isfinite(array).all():
        message = f"{subject} has entries that are not finite"
        raise ProblemError(message, term=written, remedy="check the array")
    return array.astype(float)


def _entries(array: Any) -> Iterator[tuple[tuple[int, ...], sp.Expr]]:
    """The entries that are not zero, with their places."""
    if isinstance(array, sp.MatrixBase):
        for place in itertools.product(*map(range, array.shape)):
            if array[place] != 0:
                yield place, array[place]
        return
    for place in zip(*np.nonzero(array), strict=True):
        yield tuple(map(int, place)), exact(sp.Float(float(array[place])))


def _numbers_off_diagonal(array: Any) -> Any:
    """What is off the diagonal, as numbers or truth values."""
    if isinstance(array, sp.MatrixBase):
        return [entry != 0 for (i, j), entry in _entries(array) if i != j]
    return array - np.diag(np.diag(array))


def _times(inverse: Array | None, array: Any) -> Any:
    """An array multiplied from the left; what rounding leaves of zeros is zero."""
    if inverse is None:
        return array
    if isinstance(array, sp.MatrixBase):
        return sp.Matrix(inverse) * array
    product = inverse @ array
    size = np.abs(inverse) @ np.abs(array)
    return np.where(np.abs(product) > np.finfo(float).eps * size, product, 0.0)


def _inverse(mass: Addends) -> Array:
    """The inverse of a mass matrix of numbers."""
    if any((isinstance(a, sp.MatrixBase) and a.free_symbols) or c.free_symbols for c, a in mass):
        raise ProblemError(
            f"the mass matrix has {mass[0][1].shape[0]} rows, is not diagonal, and depends on "
            "parameters or time",
            term=mass[0][1],
            remedy=f"with more than {_MOST_SYMBOLIC_ROWS} rows let it be diagonal, or of numbers "
            "alone: change to coordinates in which it is",
        )
    total = sum(float(c) * np.array(a, dtype=float) for c, a in mass)
    if np.linalg.cond(total) > _LARGEST_CONDITION:
        raise ProblemError(
            "the mass matrix is singular, or nearly so: its condition number is "
            f"{np.linalg.cond(total):.2g}",
            term=mass[0][1],
            remedy="leave out degrees of freedom that have no mass",
        )
    return np.asarray(scipy.linalg.inv(total))
