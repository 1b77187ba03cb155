"""One unknown, or some of its entries, as functions of time and the parameters.

Everything is linear in the coefficients of the unknown: a view has a row of modes for each entry.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, NoReturn

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rankone.solution.fields.field_statistics import (
    EntryStatistics,
    FieldSobol,
    covariances,
    variances,
)
from rankone.solution.solution import Solution
from rankone.solution.statistics.over_box import Quantiles, Times
from rankone.support.arrays import Array
from rankone.support.errors import EvaluationError, shown
from rankone.tensors.evaluator import Rows
from rankone.tensors.joint_distribution import Correlations, Under


def missing_member(name: str, owner: str, view: str) -> AttributeError:
    """What to do where a member of a plain solution is asked of fields."""
    if name.startswith("_") or not hasattr(Solution, name):
        return AttributeError(f"{owner} have no `{name}`")
    return AttributeError(
        f'{owner} have no `{name}`, which outputs have: solution.output({{"a": {view}[3]}}).{name}'
    )


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
        flat = self._flat @ own.reshape(len(own), math.prod(own.shape[1:]))
        return np.asarray(flat.reshape((*self.shape, *own.shape[1:])))

    @property
    def _rows(self) -> Rows:
        """The coefficients among the states of their solution."""
        every = self.coefficients._unknowns
        if isinstance(every, slice):
            return slice(every.start + self.own.start, every.start + self.own.stop)
        return every[self.own]

    # --- statistics ----------------------------------------------------------------------------

    def mean(
        self, t: Times = None, *, under: Under = None, correlation: Correlations = None
    ) -> Array:
        """Means over the box, (*shape, *shape of t); see :meth:`rankone.Solution.mean`."""
        means = self.coefficients.mean(t, under=under, correlation=correlation)
        return self.of(means[self.own])

    def var(
        self, t: Times = None, *, under: Under = None, correlation: Correlations = None
    ) -> Array:
        """Variances over the box, (*shape, *shape of t)."""
        covariance = self.coefficients.cov(t, under=under, correlation=correlation)
        diagonal = variances(self._flat, covariance[self.own, self.own])
        return diagonal.reshape((*self.shape, *covariance.shape[2:]))

    def std(
        self, t: Times = None, *, under: Under = None, correlation: Correlations = None
    ) -> Array:
        """Standard deviations over the box, (*shape, *shape of t)."""
        return np.asarray(np.sqrt(self.var(t, under=under, correlation=correlation)))

    def cov(
        self, t: Times = None, *, under: Under = None, correlation: Correlations = None
    ) -> Array:
        """Covariances of chosen entries at the same time, (*shape, *shape, *shape of t).

        Raises
        ------
        EvaluationError
            If these are more than 10^8 numbers: choose entries, ``solution[u][[3, 17]].cov(t)``.
        """
        covariance = self.coefficients.cov(t, under=under, correlation=correlation)
        pairs = covariances(self._flat, covariance[self.own, self.own])
        return pairs.reshape((*self.shape, *self.shape, *covariance.shape[2:]))

    def sobol(
        self, t: Times = None, *, under: Under = None, correlation: Correlations = None
    ) -> FieldSobol:
        """Variance-based sensitivities of each entry at times: first-order and total Sobol indices.

        Nothing is sampled. The indices are NaN where an entry varies by less than the measured
        error of the field. Correlations are refused, and so are solutions with events.
        """
        statistics = self._statistics
        times, variance, indices = statistics.sobol(t, under, correlation)
        variance, *shaped = (a.reshape((*self.shape, *a.shape[1:])) for a in (variance, *indices))
        first, total, *widths = shaped
        names = self.coefficients.metadata.parameters
        return FieldSobol(self.name, names, self.positions, times, first, total, variance, *widths)

    def quantile(
        self,
        q: ArrayLike,
        t: Times = None,
        *,
        under: Under = None,
        correlation: Correlations = None,
        count: int = 2**13,
    ) -> Quantiles:
        """Quantiles over the box, (*shape of q, *shape, *shape of t).

        They are computed at ``count`` evenly spread points; see :meth:`rankone.Solution.quantile`.
        """
        flat = self._statistics.quantiles(q, t, under, correlation, count)
        before = np.ndim(q)
        shape = (*flat.shape[:before], *self.shape, *flat.shape[before + 1 :])
        half_width = flat.half_width
        return Quantiles(
            np.asarray(flat).reshape(shape),
            None if half_width is None else half_width.reshape(shape),
        )

    @property
    def _flat(self) -> Array:
        """The weights with one axis for all entries, (entries, modes)."""
        return self.weights.reshape(self.size, -1)

    @property
    def _statistics(self) -> EntryStatistics:
        """What takes more than means and covariances."""
        return EntryStatistics(self.coefficients, self.own, self._flat, self.error * self.scale)

    if not TYPE_CHECKING:

        def __getattr__(self, name: str) -> NoReturn:
            raise missing_member(name, "entries of fields", "solution[u]")

    def __repr__(self) -> str:
        entries = f"{self.size} entries of " if self.shape else ""
        coordinates = ", ".join(self.coefficients._coordinates.asked)
        return (
            f"{entries}{self.name}({coordinates}) of a FieldSolution, measured error "
            f"{self.error:.2g} of the largest value of the field, {self.scale:.3g}"
        )
