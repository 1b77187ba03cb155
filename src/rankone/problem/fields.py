"""Vectors of unknowns as SymPy expressions: fields, and constant matrices that act on them.

A field stands for all of its entries at once. Sums, products and functions are taken entry by
entry, and numbers, parameters and time are the same for all entries. Only :func:`apply` takes one
entry to another.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from typing import Any, TypeAlias

import numpy as np
import scipy.sparse
import sympy as sp
from numpy.typing import ArrayLike, NDArray

from rankone.problem.expressions.notation import expression_of
from rankone.support.arrays import Array
from rankone.support.errors import ProblemError, is_line, quote, shown

SparseLike: TypeAlias = "ArrayLike | scipy.sparse.spmatrix | scipy.sparse.sparray"
"""What users write for a constant matrix or vector."""
_SUPERSCRIPTS = {1: "", 2: "²", 3: "³", 4: "⁴"}
_MATRIX_REMEDY = "give an array of one or two dimensions, or a sparse matrix of SciPy"


def field(name: str, size: int) -> Field:
    """A vector of unknowns: a function of time with ``size`` entries.

    It is written like a single unknown. ``u*v``, ``u**2`` and ``sympy.exp(-E/u)`` are taken entry
    by entry; parameters, time, numbers and ordinary unknowns ``x(t)`` are the same for all entries.
    :func:`apply` multiplies it by a matrix.

    Parameters
    ----------
    name : str
        A name for messages, results and labels.
    size : int
        The number of entries, n.

    Returns
    -------
    Field
        A SymPy symbol with the attribute ``size``. ``u.diff(t)`` is its derivative in time. SymPy
        takes derivatives of products such as ``(k*u).diff(t)`` as zero, so write derivatives of the
        field itself.

    Raises
    ------
    ProblemError
        If the name is not text in one line, or the size is not a positive integer.

    Examples
    --------
    >>> t, D = sp.symbols("t D")
    >>> u = field("u", 3)
    >>> L = np.array([[-1.0, 1.0, 0.0], [1.0, -2.0, 1.0], [0.0, 1.0, -1.0]])
    >>> sp.Eq(u.diff(t), D * apply(L, u) - u**3)
    Eq(du/dt, -u**3 + D*apply(<3 x 3>, u))
    """
    return Field(name, size)


def apply(matrix: SparseLike | Operator | Vector, expression: object) -> sp.Expr:
    """A constant matrix times an elementwise expression of fields.

    Parameters
    ----------
    matrix : array or sparse matrix
        (m, n) numbers, or (n,) numbers that multiply the entries one by one. The numbers are
        copied; two equal matrices are one. A matrix of one row gives a number, which may be used
        beside fields as a scalar is; one of a single column makes a vector of a scalar.
    expression : Expr or number
        With n entries, or a scalar, which stands for n equal entries.

    Returns
    -------
    Expr
        With m entries, or n where the matrix has one dimension.

    Raises
    ------
    ProblemError
        If sizes do not fit, or the matrix has entries that are not finite real numbers.

    Examples
    --------
    >>> t, q = sp.symbols("t q")
    >>> u = field("u", 3)
    >>> apply(np.ones((1, 3)) / 3, u**2)  # the mean, a scalar
    apply(<1 x 3>, u**2)
    >>> apply(np.array([1.0, 0.0, 0.0]), q * sp.cos(t))  # a source in the first cell
    q*<3>*cos(t)
    """
    written = expression_of(expression)
    if written is None:
        raise ProblemError(
            f"a matrix is applied to {shown(expression)}, which is not an expression",
            term=expression,
            remedy="give an expression of fields and scalars as the second argument",
        )
    factor = matrix if isinstance(matrix, Operator | Vector) else constant_of(matrix)
    if isinstance(factor, Vector):
        size = size_of(written)
        if size not in (1, factor.size):
            raise ProblemError(
                f"a vector of {factor.size} entries is applied to {quote(written)}, which has "
                f"{size}",
                term=written,
                remedy=f"give a vector of {size} entries",
            )
        return factor * written
    return Apply(factor, written)


def constant_of(
    array: object, subject: str = "the matrix of `apply`", label: str | None = None
) -> Operator | Vector:
    """A matrix or vector of numbers as a symbol; a ProblemError if it is none."""
    is_sparse = isinstance(array, scipy.sparse.sparray | scipy.sparse.spmatrix)
    numbers: Any = array if is_sparse else _dense(array)
    if numbers.dtype.kind == "c":
        message = f"{subject} has complex entries"
        raise ProblemError(message, term=subject, remedy="write real and imaginary parts apart")
    if numbers.dtype.kind not in "biuf" or numbers.ndim not in (1, 2) or 0 in numbers.shape:
        raise ProblemError(f"{subject} is {shown(array)}", term=array, remedy=_MATRIX_REMEDY)
    if numbers.ndim == 1:
        vector = numbers.toarray() if is_sparse else numbers
        return Vector(_finite(vector.astype(float), subject), label)
    rows = scipy.sparse.csr_array(numbers, dtype=float, copy=True)
    _finite(rows.data, subject)
    rows.sum_duplicates()
    rows.eliminate_zeros()
    return Operator(rows, label)


def _dense(array: object) -> NDArray[np.generic]:
    """An array of whatever type."""
    try:
        return np.asarray(array)
    except ValueError:  # rows of several lengths
        return np.empty((), dtype=object)


def _finite(entries: Array, subject: str) -> Array:
    if not np.isfinite(entries).all():
        message = f"{subject} has entries that are not finite"
        raise ProblemError(message, term=subject, remedy="check the array")
    return entries


def array_digest(array: Array | scipy.sparse.csr_array) -> str:
    """What two equal arrays, or sparse matrices, have in common."""
    if isinstance(array, np.ndarray):
        return _digest(array)
    array.sum_duplicates()
    shape = np.array(array.shape, dtype=np.int64)
    return _digest(shape, array.data, *(a.astype(np.int64) for a in (array.indices, array.indptr)))


def _digest(*arrays: NDArray[Any]) -> str:
    total = hashlib.blake2b(digest_size=16)
    for array in arrays:
        total.update(np.ascontiguousarray(array).data)
    return total.hexdigest()


class Field(sp.Symbol):  # type: ignore[misc]
    """A vector of unknowns; see :func:`field`."""

    __slots__ = ("size",)
    size: int

    def __new__(cls, name: str, size: int) -> Field:
        if not is_line(name) or not str(name).strip():
            raise ProblemError(
                f"the name of a field is {shown(name)}, not text in one line",
                term=name,
                remedy='give a name, for example rankone.field("u", 100)',
            )
        whole = isinstance(size, int | np.integer) and not isinstance(size, bool)
        if not whole or size < 1:
            raise ProblemError(
                f"the field {quote(name)} has {shown(size)} entries",
                term=size,
                remedy="give the number of entries, a positive integer",
            )
        symbol: Field = sp.Symbol.__xnew__(cls, str(name), real=True)
        symbol.size = int(size)
        return symbol

    def __reduce__(self) -> tuple[object, ...]:
        return Field, (self.name, self.size)

    def _hashable_content(self) -> tuple[object, ...]:
        return (*super()._hashable_content(), self.size)

    def diff(self, *symbols: sp.Expr | int, **assumptions: bool) -> sp.Expr:
        """The derivative in time; by the field itself it is one."""
        if len(symbols) == 1 and isinstance(symbols[0], tuple | sp.Tuple):
            symbols = tuple(symbols[0])
        time = symbols[0] if symbols else None
        if not isinstance(time, sp.Symbol) or isinstance(time, Field | Vector):
            return super().diff(*symbols, **assumptions)
        orders = [1 if s == time else s for s in symbols[1:]]
        if not all(isinstance(order, int | sp.Integer) for order in orders):
            return super().diff(*symbols, **assumptions)
        order = int(orders[0]) if len(orders) == 1 and symbols[1] != time else 1 + len(orders)
        return FieldDerivative(self, time, sp.Integer(order)) if order else self


class FieldDerivative(sp.Expr):  # type: ignore[misc]
    """A derivative of a field in time."""

    is_commutative = True
    is_real = is_extended_real = True

    def __new__(cls, field: Field, time: sp.Symbol, order: sp.Integer) -> FieldDerivative:
        derivative: FieldDerivative = sp.Expr.__new__(cls, field, time, order)
        return derivative

    @property
    def expr(self) -> Field:
        """The field."""
        field: Field = self.args[0]
        return field

    @property
    def variables(self) -> tuple[sp.Symbol, ...]:
        """Time, as often as the order says."""
        return (self.args[1],) * self.derivative_count

    @property
    def derivative_count(self) -> int:
        """The order."""
        return int(self.args[2])

    @property
    def free_symbols(self) -> set[sp.Basic]:
        return {self.expr}

    @property
    def size(self) -> int:
        """The number of entries."""
        return self.expr.size

    def diff(self, *symbols: sp.Expr | int, **assumptions: bool) -> sp.Expr:
        """The derivative of the next order in time."""
        higher = self.expr.diff(*symbols, **assumptions)
        if not isinstance(higher, FieldDerivative) or higher.args[1] != self.args[1]:
            return super().diff(*symbols, **assumptions)
        order = sp.Integer(self.derivative_count + higher.derivative_count)
        return FieldDerivative(self.expr, self.args[1], order)

    def _sympystr(self, printer: object) -> str:
        power = _SUPERSCRIPTS.get(self.derivative_count, f"^{self.derivative_count}")
        return f"d{power}{self.expr.name}/d{self.args[1]}{power}"

    def _latex(self, printer: object) -> str:
        count = self.derivative_count
        power = f"^{{{count}}}" if count > 1 else ""
        below = f"d {sp.latex(self.args[1])}{power}"
        return rf"\frac{{d{power} {sp.latex(self.expr)}}}{{{below}}}"


class Vector(sp.Symbol):  # type: ignore[misc]
    """Constant numbers, one for each entry of a field."""

    __slots__ = ("array", "digest")
    array: Array
    digest: str

    def __new__(cls, array: Array, label: str | None = None) -> Vector:
        symbol: Vector = sp.Symbol.__xnew__(cls, label or f"<{array.size}>", real=True)
        symbol.array = np.array(array, dtype=float)
        symbol.array.setflags(write=False)
        symbol.digest = _digest(symbol.array)
        return symbol

    def __reduce__(self) -> tuple[object, ...]:
        return Vector, (np.array(self.array), self.name)

    def _hashable_content(self) -> tuple[object, ...]:
        return self.size, self.digest

    def sort_key(self, order: object = None) -> tuple[object, ...]:
        """Content decides, not the label."""
        return (
            self.class_key(),
            (1, (f"<{self.size}> {self.digest}",)),
            sp.S.One.sort_key(),
            sp.S.One,
        )

    @property
    def size(self) -> int:
        """The number of entries."""
        return int(self.array.size)


class Operator(sp.Symbol):  # type: ignore[misc]
    """A constant sparse matrix; :func:`apply` multiplies expressions by it."""

    __slots__ = ("digest", "matrix")
    matrix: scipy.sparse.csr_array
    digest: str

    def __new__(cls, matrix: scipy.sparse.csr_array, label: str | None = None) -> Operator:
        rows, columns = matrix.shape
        symbol: Operator = sp.Symbol.__xnew__(cls, label or f"<{rows} x {columns}>", real=True)
        symbol.matrix = matrix
        symbol.digest = array_digest(matrix)
        for array in (matrix.data, matrix.indices, matrix.indptr):
            array.setflags(write=False)
        return symbol

    def __reduce__(self) -> tuple[object, ...]:
        return Operator, (self.matrix.copy(), self.name)

    def _hashable_content(self) -> tuple[object, ...]:
        return self.shape, self.digest

    def sort_key(self, order: object = None) -> tuple[object, ...]:
        """Content decides, not the label."""
        key = f"<{self.shape[0]} x {self.shape[1]}> {self.digest}"
        return self.class_key(), (1, (key,)), sp.S.One.sort_key(), sp.S.One

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        rows, columns = self.matrix.shape
        return int(rows), int(columns)


class Apply(sp.Expr):  # type: ignore[misc]
    """A matrix times an expression; see :func:`apply`."""

    is_commutative = True
    is_real = is_extended_real = True

    def __new__(cls, operator: Operator, expression: sp.Expr) -> sp.Expr:
        size, columns = size_of(expression), operator.shape[1]
        if size not in (1, columns):
            raise ProblemError(
                f"a matrix of {columns} columns, {quote(operator)}, is applied to "
                f"{quote(expression)}, which has {size} entries",
                term=expression,
                remedy=f"give a matrix of {size} columns",
            )
        if expression == 0:
            return sp.S.Zero
        return sp.Expr.__new__(cls, operator, expression)

    @property
    def operator(self) -> Operator:
        """The matrix."""
        operator: Operator = self.args[0]
        return operator

    @property
    def operand(self) -> sp.Expr:
        """What it is applied to."""
        return self.args[1]

    @property
    def free_symbols(self) -> set[sp.Basic]:
        symbols: set[sp.Basic] = self.operand.free_symbols
        return symbols

    def _eval_derivative(self, symbol: sp.Expr) -> sp.Expr | None:
        if isinstance(symbol, Field) or self.operand.atoms(Field, Vector) & {symbol}:
            return None  # a matrix, which is not elementwise
        return apply(self.operator, self.operand.diff(symbol))

    def _sympystr(self, printer: sp.printing.printer.Printer) -> str:
        return f"apply({self.operator.name}, {printer._print(self.operand)})"

    def _latex(self, printer: sp.printing.printer.Printer) -> str:
        name = sp.latex(sp.Symbol(self.operator.name)) if "<" not in self.operator.name else "L"
        return rf"{name} \left({printer._print(self.operand)}\right)"


def size_of(expression: sp.Basic) -> int:
    """The number of entries of an expression, one for scalars; a ProblemError if sizes differ."""
    if isinstance(expression, Field | Vector | FieldDerivative):
        return expression.size
    if isinstance(expression, Apply):
        return expression.operator.shape[0]
    if isinstance(expression, Operator):
        raise ProblemError(
            f"the matrix {quote(expression)} is multiplied entry by entry",
            term=expression,
            remedy=f"write apply({expression.name}, ...)",
        )
    sizes = {size_of(argument): argument for argument in expression.args}
    sizes.pop(1, None)
    if len(sizes) > 1:
        (first, one), (second, other), *_ = sorted(sizes.items())
        raise ProblemError(
            f"{quote(one)} has {first} entries, and {quote(other)} beside it has {second}",
            term=expression,
            remedy="elementwise terms need equal sizes; bring one to the other by `apply`",
        )
    return next(iter(sizes), 1)


def has_fields(expressions: Sequence[object]) -> bool:
    """Whether one of these expressions has a field."""
    return any(isinstance(e, sp.Basic) and e.atoms(Field) for e in expressions)
