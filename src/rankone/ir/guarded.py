"""Functions of the user, and names of tables, as workers know them.

SymPy is not needed for that: importing it takes a second.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from rankone.support.arrays import Array
from rankone.support.errors import ProblemError
from rankone.support.wording import quote

PREFIX, POINTS, VALUES = "f_", "POINTS_", "VALUES_"
"""First letters of names in generated source: of a function, so that no local name hides it, and of
the data of a table."""
AT_THE_ENDS = 1e-9
"""Distance outside a table, over its length, that is taken for rounding."""


class GuardedFunction:
    """A user's callable; errors in it name it."""

    def __init__(self, name: str, value: Callable[..., object]) -> None:
        self.name, self.value = name, value

    def __call__(self, *arguments: ArrayLike) -> Array:
        arrays = np.broadcast_arrays(*(np.asarray(a, dtype=float) for a in arguments))
        try:
            # copies, as a function may change its arguments
            returned = np.asanyarray(self.value(*(array.copy() for array in arrays)))
            real = not (np.iscomplexobj(returned) or np.ma.is_masked(returned))
            heights = np.asarray(returned, dtype=float) if real else np.full(1, np.nan)
        except Exception as error:
            raise ProblemError(
                f"function {quote(self.name)} raised {type(error).__name__}: {error}",
                term=self.name,
                remedy="it must take arrays and return real numbers",
            ) from error
        if not real:
            raise ProblemError(
                f"function {quote(self.name)} returned complex or masked numbers",
                term=self.name,
                remedy="return real numbers; NaN where there are none",
            )
        if heights.shape != arrays[0].shape:
            raise ProblemError(
                f"function {quote(self.name)} returned shape {heights.shape} for arguments of "
                f"shape {arrays[0].shape}",
                term=self.name,
                remedy="return one number for each point",
            )
        return heights
