"""Evaluation in blocks, so that values of any number of points take bounded memory."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Sequence

import numpy as np

from rankone.support.arrays import Array
from rankone.support.errors import EvaluationError
from rankone.support.options import checked_memory, in_words, physical_memory

Index = tuple[int | slice, ...]
"""Where a block is in the broadcast shape of the arguments."""

# Numbers for each point beside its coordinates and values: copies of both in the order of slabs
_COPIES = 3
# Bytes that an evaluation takes whatever the number of points: buffers of products
_BUFFERS = 16e6
_WORKSPACE = 64e6  # Bytes beside all values for the blocks of a call that has no limit
_STREAM = "evaluate block after block: solution.blocks(...)"


def bytes_of(points: int, coordinates: int, numbers: int) -> float:
    """Bytes that an evaluation of this many points takes, with ``numbers`` values of each."""
    return 8.0 * _COPIES * (coordinates + numbers + 1) * points + _BUFFERS


def in_blocks(
    arrays: Sequence[Array],
    numbers: int,
    most: float,
    evaluate: Callable[[Sequence[Array]], Array],
) -> Iterator[tuple[Index, Array]]:
    """Indices into the broadcast shape of arrays, and values (..., *block) there.

    A point has ``numbers`` values. Axes along which the first array, times, varies alone are cut
    last: parameters have to be evaluated for each block. No block takes more than ``most`` bytes,
    or it is an EvaluationError.
    """
    try:
        shape = np.broadcast_shapes(*(array.shape for array in arrays))
    except ValueError:
        yield (), evaluate(arrays)  # raises an error that names the shapes
        return
    each = bytes_of(1, len(arrays), numbers) - _BUFFERS
    points = int((most - _BUFFERS) // each)
    if points < 1:
        raise EvaluationError(
            f"max_memory={in_words(most)} is less than evaluations take, "
            f"{in_words(_BUFFERS + each)}",
            remedy="raise max_memory",
        )
    padded = [array.reshape((1,) * (len(shape) - array.ndim) + array.shape) for array in arrays]
    of_times = [all(array.shape[k] == 1 for array in padded[1:]) for k in range(len(shape))]
    for index in _indices(shape, points, sorted(range(len(shape)), key=of_times.__getitem__)):
        yield index, evaluate([_block(array, index) for array in padded])


def whole(
    arrays: Sequence[Array],
    shape: tuple[int, ...],
    leading: tuple[int, ...],
    max_memory: str | float | None,
    evaluate: Callable[[Sequence[Array]], Array],
) -> Array:
    """Values (*leading, *shape) at arrays that broadcast to a shape, in blocks if they are many.

    An EvaluationError if they do not fit into ``max_memory``, or into the memory of the machine.
    """
    numbers = math.prod(leading)
    needed = 8.0 * numbers * math.prod(shape)
    if max_memory is None and needed <= _WORKSPACE:
        return evaluate(arrays)
    least = bytes_of(1, len(arrays), numbers)
    left = min(foreseen(needed, least, max_memory) - needed, max(_WORKSPACE, least))
    values = np.empty((*leading, *shape))
    every = (slice(None),) * len(leading)
    for index, block in in_blocks(arrays, numbers, left, evaluate):
        values[(*every, *index)] = block
    return values


def foreseen(values: float, beside: float, max_memory: str | float | None) -> float:
    """The limit on bytes; an EvaluationError if the values, and those ``beside``, exceed it."""
    there = physical_memory()
    if values > there:
        raise EvaluationError(
            f"all values take {in_words(values)}, and this machine has {in_words(there)}",
            remedy=_STREAM,
        )
    if max_memory is None:
        return math.inf
    most = checked_memory("max_memory", max_memory)
    if values + beside > most:
        raise EvaluationError(
            f"all values take {in_words(values)}, their evaluation {in_words(beside)} more, "
            f"and max_memory is {in_words(most)}",
            remedy=_STREAM,
        )
    return most


def no_memory(error: MemoryError) -> EvaluationError:
    """The error for values that the machine has no memory for after all."""
    return EvaluationError(f"there is no memory for all values: {error}", remedy=_STREAM)


def _block(array: Array, index: Index) -> Array:
    """What a padded array has at an index of the broadcast shape: axes of length one stay."""
    along = zip(index, array.shape, strict=True)
    own = (k if size != 1 else slice(None) if isinstance(k, slice) else 0 for k, size in along)
    return array[tuple(own)]


def _indices(shape: tuple[int, ...], points: int, order: Sequence[int]) -> Iterator[Index]:
    """Indices of parts of a shape, of at most ``points`` each; axes are cut in the given order."""
    sizes = [shape[axis] for axis in order]
    if not shape or 0 in shape:
        yield from () if shape else ((),)
        return
    cut = 0  # the first axis that fits in part, with all after it whole
    while cut < len(sizes) and math.prod(sizes[cut + 1 :]) > points:
        cut += 1
    step = max(points // math.prod(sizes[cut + 1 :]), 1)
    back = np.argsort(order).tolist()
    after = [slice(0, size) for size in sizes[cut + 1 :]]
    for before in itertools.product(*map(range, sizes[:cut])):
        for start in range(0, sizes[cut], step):
            index = (*before, slice(start, min(start + step, sizes[cut])), *after)
            yield tuple(index[k] for k in back)
