"""Evaluation in blocks, so that values of any number of points take bounded memory."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Sequence

import numpy as np

from rankone.support.arrays import Array
from rankone.support.errors import EvaluationError
from rankone.support.memory import in_words

Index = tuple[int | slice, ...]
"""Where a block is in the broadcast shape of the arguments."""

# Numbers for each point beside its coordinates and values: copies of both in the order of slabs
_COPIES = 3
# Bytes that an evaluation takes whatever the number of points: buffers of products
_BUFFERS = 16e6


def bytes_of(points: int, coordinates: int, states: int) -> float:
    """Bytes that an evaluation of so many points takes, its values included."""
    return 8.0 * _COPIES * (coordinates + states + 1) * points + _BUFFERS


def in_blocks(
    arrays: Sequence[Array],
    states: int,
    most: float,
    evaluate: Callable[[list[Array]], Array],
) -> Iterator[tuple[Index, Array]]:
    """Indices into the broadcast shape of arrays, and values (states, *block) there.

    No block takes more than ``most`` bytes, or it is an EvaluationError.
    """
    try:
        shape = np.broadcast_shapes(*(array.shape for array in arrays))
    except ValueError:
        yield (), evaluate(list(arrays))  # raises an error that names the shapes
        return
    each = bytes_of(1, len(arrays), states) - _BUFFERS
    points = int((most - _BUFFERS) // each)
    if points < 1:
        raise EvaluationError(
            f"max_memory={in_words(most)} is less than evaluations take, "
            f"{in_words(_BUFFERS + each)}",
            remedy="raise max_memory",
        )
    views = [np.broadcast_to(array, shape) for array in arrays]
    for index in _indices(shape, points):
        yield index, evaluate([view[index] for view in views])


def _indices(shape: tuple[int, ...], points: int) -> Iterator[Index]:
    """Indices of parts of a shape, of so many points at most each, in their order."""
    axis = 0  # the first axis of which a part fits with all that follow
    while axis < len(shape) and math.prod(shape[axis + 1 :]) > points:
        axis += 1
    if not shape:
        yield ()
        return
    step = max(points // math.prod(shape[axis + 1 :]), 1)
    for before in itertools.product(*map(range, shape[:axis])):
        for start in range(0, shape[axis], step):
            yield (*before, slice(start, min(start + step, shape[axis])))
