"""What users write for constant matrices and vectors, as checked numbers."""

from __future__ import annotations

import hashlib
from typing import Any, TypeAlias

import numpy as np
import scipy.sparse
from numpy.typing import ArrayLike, NDArray

from rankone.support.arrays import Array
from rankone.support.errors import ProblemError, shown

SparseLike: TypeAlias = "ArrayLike | scipy.sparse.spmatrix | scipy.sparse.sparray"
"""What users write for a constant matrix or vector."""
_MATRIX_REMEDY = "give an array of one or two dimensions, or a sparse matrix of SciPy"


def checked_array(array: object, subject: str) -> Array | scipy.sparse.csr_array:
    """A copy of a vector, or of a matrix as a sparse one; a ProblemError if it is neither."""
    is_sparse = isinstance(array, scipy.sparse.sparray | scipy.sparse.spmatrix)
    numbers: Any = array if is_sparse else _dense(array)
    if numbers.dtype.kind == "c":
        message = f"{subject} has complex entries"
        raise ProblemError(message, term=subject, remedy="write real and imaginary parts apart")
    if numbers.dtype.kind not in "biuf" or numbers.ndim not in (1, 2) or 0 in numbers.shape:
        raise ProblemError(f"{subject} is {shown(array)}", term=array, remedy=_MATRIX_REMEDY)
    if numbers.ndim == 1:
        vector = numbers.toarray() if is_sparse else numbers
        return _finite(vector.astype(float), subject)
    rows = scipy.sparse.csr_array(numbers, dtype=float, copy=True)
    _finite(rows.data, subject)
    rows.sum_duplicates()
    rows.eliminate_zeros()
    return rows


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
