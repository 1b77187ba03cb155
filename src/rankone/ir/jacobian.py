"""Jacobians of many states, as the entries of a pattern."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rankone.ir.features import OfStates, VectorLike
from rankone.support.arrays import Array


@dataclass(frozen=True, eq=False)
class PatternJacobian:
    """The Jacobian df/du (size, size, ...) of t, u and p, which is zero outside of a pattern.

    The pattern has ``rows`` and ``columns``, each (k,), sorted by rows; ``entries`` are (k, ...).
    Called, it is an array with all zeros.
    """

    size: int
    rows: NDArray[np.intp]
    columns: NDArray[np.intp]
    entries: OfStates

    def __call__(self, t: float | Array, u: VectorLike, p: VectorLike) -> Array:
        entries = self.entries(t, u, p)
        dense = np.zeros((self.size, self.size, *entries.shape[1:]))
        dense[self.rows, self.columns] = entries
        return dense


def pattern_of(jacobian: OfStates) -> PatternJacobian | None:
    """The pattern of a Jacobian, if it has one."""
    return jacobian if isinstance(jacobian, PatternJacobian) else None
