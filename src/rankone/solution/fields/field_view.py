"""One unknown, or some of its entries, as functions of time and the parameters.

Everything is linear in the coefficients of the unknown: a view has a row of modes for each entry.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rankone.solution.solution import Solution
from rankone.support.arrays import Array
from rankone.support.errors import EvaluationError, shown
from rankone.tensors.trains.evaluator import Rows


@dataclass(frozen=True, repr=False, eq=False)
class FieldView:
    """One unknown of a solution of fields, or some of its entries.

    Call it with times and values of the parameters, as a solution. An index selects entries as in
    NumPy: ``solution[u][3]`` is one entry, ``solution[u][[3, 17]]``, ``solution[u][10:20]`` and
    ``solution[u][mask]`` are several, in the shape that an array of entries would have. A call
    costs as much as the coefficients and the chosen entries do, whatever the size of the field.

    Attributes
    ----------
    coefficients : Solution
        The solution of the coefficients of all unknowns.
    name : str
        Name of the unknown.
    positions : ndarray of int
        Which entries the view has, in its shape; without dimensions for a scalar unknown.
    weights : ndarray (*shape, modes)
        The modes at these entries.
    scale : float
        Largest absolute value of the unknown over all trajectories; errors are relative to it.
    error : float
        Largest measured error of the unknown over all its entries; NaN if it was not measured.
    """

    coefficients: Solution
    name: str
    positions: NDArray[np.intp]
    weights: Array
    own: slice
    scale: float
    error: float

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the entries: what stands before the broadcast shape in values."""
        return self.positions.shape

    @property
    def size(self) -> int:
        """Number of entries."""
        return self.positions.size

    # --- entries -------------------------------------------------------------------------------

    def __getitem__(self, index: Any) -> FieldView:
        """Some of the entries, by an index, a slice, a list or a mask."""
        try:
            positions = self.positions[index]
        except (IndexError, TypeError, ValueError) as error:
            raise EvaluationError(
                f"{shown(index)} does not select entries of `{self.name}`, which has the shape "
                f"{self.shape} here: {error}",
                term=index,
                remedy="give an index, a slice, a list of indices or a mask of entries",
            ) from None
        return replace(self, positions=np.asarray(positions), weights=self.weights[index])

    def entries(self, indices: ArrayLike) -> FieldView:
        """Entries by their indices: ``entries([3, 17])`` is the same as ``[[3, 17]]``."""
        return self[np.asarray(indices)]

    def reshape(self, *shape: int) -> FieldView:
        """The same entries in another shape, such as that of a grid: values begin with it."""
        try:
            positions = self.positions.reshape(*shape)
        except (TypeError, ValueError):
            raise EvaluationError(
                f"the {self.size} entries of `{self.name}` do not have the shape {shown(shape)}",
                term=shape,
                remedy="give the numbers of points along each axis of the grid",
            ) from None
        weights = self.weights.reshape(*positions.shape, self.weights.shape[-1])
        return replace(self, positions=positions, weights=weights)

    def __len__(self) -> int:
        return len(self.positions)

    # --- evaluation ----------------------------------------------------------------------------

    def __call__(self, *at: object, max_memory: str | float | None = None, **named: object) -> Any:
        """Evaluate the entries.

        Arguments and errors are those of a call of a solution.

        Returns
        -------
        ndarray (*shape, *broadcast shape of the values)
            The entries first; without them for a single entry and for a scalar unknown.
        """
        coordinates = self.coefficients._coordinates
        gathered = coordinates.gather(at, named)
        point = coordinates.numbers(gathered) if max_memory is None else None
        if point is not None:
            return self.weights @ self.coefficients._evaluator.one(point, self._rows)
        if self.size <= self.weights.shape[-1]:
            own = self.coefficients._evaluate(gathered, self._rows, max_memory)
            return self.of(own)[()]

        def evaluate(arrays: Sequence[Array]) -> Array:
            return self.of(self.coefficients._evaluate_block(arrays, self._rows))

        self.coefficients._evaluator  # noqa: B018 - raises if nothing was solved
        return self.coefficients._within(max_memory, gathered, self.shape, evaluate)

    def grid(self, *at: object, max_memory: str | float | None = None, **named: object) -> Array:
        """Evaluate for every combination of values, one axis per coordinate after the entries."""
        gathered = self.coefficients._coordinates.gather(at, named)
        return self.of(self.coefficients._evaluate_grid(gathered, self._rows, max_memory))

    def gradient(
        self, *at: object, max_memory: str | float | None = None, **named: object
    ) -> Array:
        """Derivatives of the entries with respect to all parameters.

        Returns
        -------
        ndarray (*shape, parameters, *broadcast shape of the values)
        """
        return self.of(self.coefficients.gradient(*at, max_memory=max_memory, **named)[self.own])

    def of(self, own: Array) -> Array:
        """The entries (*shape, ...) of numbers (r, ...) that are linear in the coefficients."""
        flat = self.weights.reshape(self.size, -1) @ own.reshape(len(own), math.prod(own.shape[1:]))
        return np.asarray(flat.reshape(*self.shape, *own.shape[1:]))

    @property
    def _rows(self) -> Rows:
        """The coefficients among the states of their solution."""
        every = self.coefficients._unknowns
        if isinstance(every, slice):
            return slice(every.start + self.own.start, every.start + self.own.stop)
        return every[self.own]

    # --- statistics ----------------------------------------------------------------------------

    def mean(self, *at: Any, **options: Any) -> Array:
        """Means over the box, (*shape, *shape of t); arguments as for :meth:`Solution.mean`."""
        return self.of(self.coefficients.mean(*at, **options)[self.own])

    def __repr__(self) -> str:
        entries = f"{self.size} entries of " if self.shape else ""
        coordinates = ", ".join(self.coefficients._coordinates.asked)
        return (
            f"{entries}{self.name}({coordinates}) of a FieldSolution, measured error "
            f"{self.error:.2g} of the largest value of the field, {self.scale:.3g}"
        )
