"""What numerical work costs, in operations of a budget, and sparse factors that are counted.

The figures are fitted to one machine, see ``tests/benchmarks/work.py``. They need not be exact: a
budget that is off by a factor of two serves as well, as long as it is the same each time.
"""

from __future__ import annotations

import dis
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from types import FunctionType

import numpy as np
import scipy.sparse
from numpy.typing import NDArray
from scipy.sparse.linalg import splu

from rankone.support.arrays import Array
from rankone.support.budget import charge, reserve

COPY = 3.0
"""Operations of copying a number of a matrix at chosen places."""
CALL = 1e3
"""A call of NumPy for small arrays."""
# Operations of a piece of work between two looks at the budget: a fifth of a second
_PIECE_OPERATIONS = 2e8
_ARITHMETIC_CODE = dis.opmap["BINARY_OP"]
_CALL_CODE = dis.opmap["CALL"]
_CONSTANT_CODE = dis.opmap["LOAD_CONST"]
_SMALL_CODE = dis.opmap.get("LOAD_SMALL_INT", -1)  # From Python 3.14 on
_POWER_ARGUMENTS = (8, 21)  # Arguments of BINARY_OP that stand for ``**`` and ``**=``
_INDEX_ARGUMENT = 26  # The argument of BINARY_OP that stands for ``[]``, from Python 3.14 on


@dataclass(frozen=True)
class Cost:
    """Operations of a generated function: once for a call, and for each column of its arrays."""

    once: float
    each: float

    def __call__(self, columns: float) -> float:
        """Operations for this many columns."""
        return self.once + self.each * columns

    def __add__(self, cost: Cost) -> Cost:
        return Cost(self.once + cost.once, self.each + cost.each)

    def __rmul__(self, count: int) -> Cost:
        return Cost(count * self.once, count * self.each)


# A generated function without any term: it looks at shapes and makes the array it returns
_ENTRY = Cost(3 * CALL, 0.0)
_TERM = Cost(0.5 * CALL, 0.5)  # An arithmetic operation on arrays
_FUNCTION = Cost(CALL, 7)  # A call of a NumPy function such as exp
_SLOW_FUNCTION = Cost(CALL, 1000)  # A call of one of those of SciPy that take about as long
_SLOW_FUNCTIONS = frozenset(
    ["airy", "expn", "iv", "jv", "kv", "lambertw", "polygamma", "yv", "gammainc", "gammaincc"]
)
_POWER = Cost(CALL, 14)  # A power
_STORED = 0.8  # A number of a sparse matrix, for each column, and what is gathered for it
_USER_FUNCTION = Cost(500 * CALL, 2000)  # A call of a function of the user, which may be slow
_TABLE_PREFIX = "f_"  # Begins the names of tables in generated functions
_SCALAR_ENTRY = 200  # A function of floats: it unpacks them, and makes the list it returns
_SCALAR_TERM = 25  # An arithmetic operation on floats
_SCALAR_CALL = 60  # A call of a function of floats


@lru_cache(32)
def function_cost(function: Callable[..., object], users: frozenset[str] = frozenset()) -> Cost:
    """What a generated function costs, by the operations in its code.

    ``users`` are the names of functions of the user, each call of which counts, as each of a slow
    function does. Functions of the same module count once wherever they are named. What is not
    generated may have a ``cost`` of its own. Array code says in ``stored`` how many numbers its
    matrices have.
    """
    if not isinstance(function, FunctionType):
        cost: Cost = getattr(function, "cost", _ENTRY)
        return cost
    terms, powers, calls = _operations(function)
    stored = Cost(0.0, _STORED * getattr(function, "stored", 0))
    total = stored + _ENTRY + terms * _TERM + calls * _FUNCTION + powers * _POWER
    total += _uses(function, _SLOW_FUNCTIONS) * _SLOW_FUNCTION
    total += _uses(function, users) * _USER_FUNCTION
    for name in function.__code__.co_names:
        callee = function.__globals__.get(name)
        if (
            name not in users
            and isinstance(callee, FunctionType)
            and callee is not function
            and callee.__globals__ is function.__globals__
        ):
            total += function_cost(callee, users)
    return total


def _uses(function: FunctionType, names: frozenset[str]) -> int:
    """How often the code of a function has any of some names."""
    if names.isdisjoint(function.__code__.co_names):
        return 0  # reading all instructions takes longer than counting operations
    instructions = dis.get_instructions(function)
    return sum(each.opcode in dis.hasname and each.argval in names for each in instructions)


def scalar_cost(function: Callable[..., object]) -> float:
    """What a function of floats costs, by the operations in its code."""
    if not isinstance(function, FunctionType):
        return _SCALAR_ENTRY
    terms, powers, calls = _operations(function)
    total: float = _SCALAR_ENTRY + _SCALAR_TERM * (terms + powers) + _SCALAR_CALL * calls
    for table in _tables_of(function):
        on_arrays = "np" in table.__code__.co_names  # which take as long for one number
        total += function_cost(table).once if on_arrays else scalar_cost(table)
    return total


def _tables_of(function: FunctionType) -> list[FunctionType]:
    """The tables that a generated function applies, each once."""
    names = (name for name in function.__code__.co_names if name.startswith(_TABLE_PREFIX))
    named = (function.__globals__.get(name) for name in names)
    return [each for each in named if isinstance(each, FunctionType)]


@lru_cache(32)
def _operations(function: FunctionType) -> tuple[int, int, int]:
    """How many arithmetic operations, powers but squares, and calls the code of a function has."""
    code = np.frombuffer(function.__code__.co_code, dtype=np.uint8)
    operations, arguments = code[::2], code[1::2]
    operators = arguments[operations == _ARITHMETIC_CODE]
    powers = int(np.isin(operators, _POWER_ARGUMENTS).sum())
    powers -= _squares(function, operations, arguments) if powers else 0
    terms = int((operators != _INDEX_ARGUMENT).sum()) - powers
    return terms, powers, int((operations == _CALL_CODE).sum())


def _squares(
    function: FunctionType, operations: NDArray[np.uint8], arguments: NDArray[np.uint8]
) -> int:
    """How many powers in the code of a function are squares, which NumPy makes by a product."""
    is_power = (operations == _ARITHMETIC_CODE) & np.isin(arguments, _POWER_ARGUMENTS)
    squares, constants = 0, function.__code__.co_consts
    for place in (np.flatnonzero(is_power) - 1).tolist():
        argument = int(arguments[place])
        if operations[place - 1] == dis.EXTENDED_ARG:
            argument += 256 * int(arguments[place - 1])
        if operations[place] == _CONSTANT_CODE:
            squares += int(constants[argument] == 2)
        else:
            squares += int(operations[place] == _SMALL_CODE and argument == 2)
    return squares


def in_pieces(stack: Array, each: float) -> list[Array]:
    """A stack of matrices in pieces, so that the budget is checked often enough."""
    count = max(int(_PIECE_OPERATIONS / each), 1)
    return [stack[first : first + count] for first in range(0, len(stack), count)]


READ = Cost(50 * CALL, 15)
"""Evaluating a step of an integrator, or an interpolant: once, and for each number."""
# SuperLU: for each entry of the factors
SPARSE_FACTORS = Cost(80 * CALL, 45)
SPARSE_SOLUTION = Cost(22 * CALL, 2)


def product(rows: float, inner: float, columns: float) -> float:
    """A product of matrices."""
    return CALL + rows * columns * (1.0 + 0.04 * inner)


def qr(rows: float, columns: float) -> float:
    """A QR decomposition."""
    size = rows * columns
    return 15 * CALL + size * (12 + 0.12 * min(rows, columns))


def svd(rows: float, columns: float) -> float:
    """A thin singular value decomposition."""
    size = rows * columns
    return 20 * CALL + size * (40 + 0.25 * min(rows, columns))


def inverse(size: int, real: bool) -> float:
    """The inverse of one matrix of a stack."""
    return (100 + size**2 * (20 + 0.3 * size)) * (1 if real else 2)


def pseudo_inverse(rows: float, columns: float) -> float:
    """The pseudo-inverse of one matrix of a stack."""
    return 400 * min(rows, columns) + 90 * rows * columns


def eigenvalues(size: int) -> float:
    """The eigenvalues of one matrix of a stack."""
    return size**2 * (150 + 0.7 * size)


# -----------------------------------------------------------------------------
# Factors of one sparse matrix, counted as work and memory.
#
# SuperLU factors it (Demmel et al., SIAM J. Matrix Anal. Appl. 20 (1999), 720).


class SparseFactors:
    """Factors of a square matrix: a RuntimeError if it is singular."""

    def __init__(self, matrix: scipy.sparse.csc_matrix) -> None:
        self._factors = splu(matrix, permc_spec="MMD_AT_PLUS_A")
        self.filled = int(self._factors.nnz)
        self._weight = 2.0 if np.iscomplexobj(matrix) else 1.0
        reserve(8 * (self._weight + 1.0) * self.filled)
        multiplications = 0.1 * self.filled**2 / matrix.shape[0]  # measured
        charge(self._weight * (SPARSE_FACTORS(self.filled) + multiplications))

    def solve(self, x: Array) -> Array:
        """Solutions for right-hand sides (n, m)."""
        charge(SPARSE_SOLUTION(self._weight * self.filled * x.shape[1]))
        return np.asarray(self._factors.solve(x))

    def adjoint(self, x: Array) -> Array:
        """Solutions with the transpose."""
        charge(SPARSE_SOLUTION(self._weight * self.filled * x.shape[1]))
        return np.asarray(self._factors.solve(x, "T"))
