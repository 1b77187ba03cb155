"""What numerical work costs, in operations of a budget: about nanoseconds of one core.

The figures are fitted to one machine, see ``tests/benchmarks/work.py``. They need not be exact: a
budget that is off by a factor of two serves as well, as long as it is the same each time.
"""

from __future__ import annotations

import dis
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from types import FunctionType
from typing import Any

import numpy as np

from rankone.support.arrays import Array

__all__ = [
    "CALL",
    "Cost",
    "eigenvalues",
    "in_pieces",
    "inverse",
    "product",
    "qr",
    "svd",
]

CALL = 1e3
"""A call of NumPy for small arrays."""
_ENTRY = 3e3
"""A generated function without any term: shapes are found and its result is made."""
_TERM, _FUNCTION, _POWER = (500.0, 0.5), (900.0, 7.0), (900.0, 14.0)
"""An arithmetic operation on arrays, a call such as exp, a power: once, and for each number."""
_USER = (5e5, 2e3)
"""A call of a function of the user, which may be slow."""
_UNWATCHED = 2e8
"""Operations between two looks at a budget, where the work can be divided."""
_ARITHMETIC, _CALLS = dis.opmap["BINARY_OP"], dis.opmap["CALL"]
_POWERS = (8, 21)
"""Arguments of BINARY_OP that stand for ``**`` and ``**=``."""
_INDEXING = 26
"""The argument that stands for ``[]`` where that is an operation too."""


@dataclass(frozen=True)
class Cost:
    """Operations of a generated function: once for a call, and for each column of its arrays."""

    once: float
    each: float

    def __call__(self, columns: float) -> float:
        """Operations for so many columns."""
        return self.once + self.each * columns

    def __add__(self, other: Cost) -> Cost:
        return Cost(self.once + other.once, self.each + other.each)


@lru_cache(32)
def function_cost(function: Callable[..., Any], users: frozenset[str] = frozenset()) -> Cost:
    """What a generated function costs, by the operations in its code.

    ``users`` are the names of functions of the user. Functions of the same module count wherever
    they are named.
    """
    if not isinstance(function, FunctionType):
        return Cost(_ENTRY, 0.0)
    code = np.frombuffer(function.__code__.co_code, dtype=np.uint8)
    names, arguments = code[::2], code[1::2]
    operators = arguments[names == _ARITHMETIC]
    powers = int(np.isin(operators, _POWERS).sum())
    terms = int((operators != _INDEXING).sum()) - powers
    called = int((names == _CALLS).sum())
    counts = (terms, _TERM), (called, _FUNCTION), (powers, _POWER)
    once, each = (sum(count * unit[k] for count, unit in counts) for k in (0, 1))
    total = Cost(_ENTRY + once, each)
    for name in function.__code__.co_names:
        other = function.__globals__.get(name)
        if name in users:
            total += Cost(*_USER)
        elif isinstance(other, FunctionType) and other is not function:
            same = other.__globals__ is function.__globals__
            total += function_cost(other, users) if same else Cost(0.0, 0.0)
    return total


def in_pieces(stack: Array, each: float) -> list[Array]:
    """A stack of matrices in pieces that take about as long as a budget may go unwatched."""
    count = max(int(_UNWATCHED / each), 1)
    return [stack[first : first + count] for first in range(0, len(stack), count)]


def product(rows: float, inner: float, columns: float) -> float:
    """A product of matrices."""
    return CALL + rows * columns * (1.0 + 0.04 * inner)


def qr(rows: float, columns: float) -> float:
    """A QR decomposition."""
    size = rows * columns
    return 15e3 + size * (12.0 + 0.12 * min(rows, columns))


def svd(rows: float, columns: float) -> float:
    """A thin singular value decomposition."""
    size = rows * columns
    return 20e3 + size * (40.0 + 0.25 * min(rows, columns))


def inverse(size: int, real: bool) -> float:
    """The inverse of one matrix of a stack."""
    return (100.0 + size**2 * (20.0 + 0.3 * size)) * (1.0 if real else 2.0)


def eigenvalues(size: int) -> float:
    """The eigenvalues of one matrix of a stack."""
    return size**2 * (150.0 + 0.7 * size)
