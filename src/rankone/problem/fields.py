"""Vectors of unknowns as SymPy expressions: fields, and constant matrices that act on them.

A field stands for all of its entries at once. Sums, products and functions are taken entry by
entry, and numbers, parameters and time are the same for all entries. Only :func:`apply` takes one
entry to another.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NoReturn

import numpy as np
import scipy.sparse
import sympy as sp

from rankone.problem.array_operators import ArrayOperators
from rankone.problem.constant_arrays import SparseLike, array_digest, checked_array
from rankone.problem.expressions.notation import expression_of
from rankone.support.arrays import Array
from rankone.support.errors import ProblemError, count, is_line, quote, shown

_SUPERSCRIPTS = {1: "", 2: "²", 3: "³", 4: "⁴"}


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
    numbers = checked_array(array, subject)
    return Vector(numbers, label) if isinstance(numbers, np.ndarray) else Operator(numbers, label)


class _Entries(ArrayOperators):
    """What has many entries: arrays act on it."""

    __slots__ = ()
    __iter__ = None  # an index alone would make it a sequence

    def _beside(self, array: object) -> sp.Expr:
        constant = constant_of(array, "the array")
        if isinstance(constant, Vector) and size_of(self) in (1, constant.size):
            return constant
        shape = constant.shape if isinstance(constant, Operator) else (constant.size,)
        raise ProblemError(
            f"an array of {' x '.join(map(str, shape))} is combined entry by entry with "
            f"{quote(self)}, which has {count(size_of(self), 'entry', 'entries')}",
            term=self,
            remedy=f"write rankone.apply(matrix, {self}) for the product with a matrix, and give "
            "an array with one number for each entry otherwise",
        )

    def _under(self, matrix: object) -> sp.Expr:
        constant = constant_of(matrix, "the matrix")
        if isinstance(constant, Vector):  # as in NumPy
            constant = constant_of(constant.array[None])
        return apply(constant, self)

    def __getitem__(self, index: object) -> NoReturn:
        raise ProblemError(
            f"`{self}[{shown(index)}]`: expressions of fields are not divided into entries",
            term=self,
            remedy=f"write rankone.apply(row, {self}) with a matrix of one row that has a one at "
            "this entry; of a solution, solution[u][3] is the entry",
        )


class Field(_Entries, sp.Symbol):  # type: ignore[misc]
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

    def __call__(self, *arguments: object) -> Field:
        """The field itself for ``u(t)``; a ProblemError for all else."""
        if len(arguments) == 1 and isinstance(arguments[0], sp.Symbol):
            return self
        raise ProblemError(
            f"`{self}({', '.join(map(shown, arguments))})` is no expression",
            term=self,
            remedy=f"write {self}: a field is a function of time already; initial values are "
            f"initial={{{self}: ...}}, values of a solution solution[{self}](t=0.5, ...)",
        )

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


class FieldDerivative(_Entries, sp.Expr):  # type: ignore[misc]
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


class Vector(_Entries, sp.Symbol):  # type: ignore[misc]
    """Constant numbers, one for each entry of a field."""

    __slots__ = ("array", "digest")
    array: Array
    digest: str

    def __new__(cls, array: Array, label: str | None = None) -> Vector:
        symbol: Vector = sp.Symbol.__xnew__(cls, label or f"<{array.size}>", real=True)
        symbol.array = np.array(array, dtype=float)
        symbol.array.setflags(write=False)
        symbol.digest = array_digest(symbol.array)
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


class Apply(_Entries, sp.Expr):  # type: ignore[misc]
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
