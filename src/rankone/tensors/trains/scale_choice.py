"""Which coordinate of a parameter needs the fewest nodes, read off columns on lines.

On a line that its nodes resolve, columns at the nodes of another coordinate are interpolated, which
costs nothing. Where they do not, the lines are drawn again at those nodes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from rankone.support.arrays import Array
from rankone.support.budget import charge
from rankone.support.costs import CALL, product
from rankone.tensors.bases import IDENTITY, Basis1D, Logarithm, Reciprocal, Scale

# Ratio of the ends of an interval up to which all coordinates are much the same: a parameter that
# may be half as large or half as large again is left as it is, whatever its ends are rounded to
_LEAST_RATIO = 3.001
# Nodes predicted, over those of the lines, above which a single parameter is drawn again: with
# several parameters fewer nodes save more than lines cost
_REDRAWN_ALONE_RATIO = 2.0
# Nodes in another coordinate over nodes in the first, below which it is taken
_CLEAR_RATIO = 0.8
# Nodes of interpolated columns over those of the lines: highest modes are then those of the columns
_FINE_RATIO = 2
# Error of interpolated columns at the nodes of the other coordinate, over the tolerance of tails,
# up to which a coordinate has seen what the other one sees
_UNSEEN_RATIO = 30.0


@dataclass(frozen=True)
class LineColumns:
    """Columns (rank, lines, size) on lines of one parameter at the nodes of a basis."""

    basis: Basis1D
    columns: Array

    @cached_property
    def spectrum(self) -> Array:
        """Largest size of each mode of the columns on some line, (size,)."""
        scaled = self.columns * np.sqrt(self.basis.weights)
        return np.asarray(np.linalg.norm(scaled @ self.basis.to_modal.T, axis=0).max(axis=0))

    def at(self, basis: Basis1D) -> LineColumns:
        """The columns interpolated to the nodes of another basis."""
        modal = basis_values(self.basis, basis.nodes)
        charge(5.0 * CALL + product(self.columns.size // self.basis.size, *modal.shape))
        return LineColumns(basis, (self.columns * np.sqrt(self.basis.weights)) @ modal.T)

    def error(self, other: LineColumns) -> float:
        """Largest error of the columns interpolated to the nodes of others.

        Later columns may have more coefficients, which earlier ones lack because they are zero.
        """
        errors = np.array(other.columns)
        errors[: len(self.columns)] -= self.at(other.basis).columns[: len(errors)]
        return float(np.linalg.norm(errors, axis=0).max())


def basis_values(basis: Basis1D, points: Array) -> Array:
    """From scaled values on a basis to values at points (N,): shape (N, size)."""
    return basis.modal_values(points) @ basis.to_modal


Needed = Callable[[Array], int]
"""The number of nodes that a spectrum predicts."""
Redraw = Callable[[Sequence[tuple[int, Array]]], list[Array]]
"""Columns (rank, lines, N) at places (N,) of parameters, in pairs (parameter, places)."""


def best_coordinates(
    lines: Sequence[LineColumns], free: Sequence[bool], redraw: Redraw, needed: Needed, tol: float
) -> list[LineColumns]:
    """For each parameter the columns in the coordinate that needs the fewest nodes.

    Parameters that are not ``free`` keep theirs. ``tol`` is the size of tails that ``needed``
    leaves out.
    """
    best, again = list(lines), list[tuple[int, Basis1D]]()
    patience = _REDRAWN_ALONE_RATIO if len(lines) == 1 else 1.0
    counts = [needed(line.spectrum) for line in lines]
    for j, line in enumerate(lines):
        others = candidates(line.basis) if free[j] else ()
        if counts[j] <= line.basis.degree:
            fine = replace(line.basis, degree=_FINE_RATIO * line.basis.degree)
            best[j] = min(
                (line, *(line.at(replace(fine, scale=scale)) for scale in others)),
                key=lambda each: needed(each.spectrum) / (1.0 if each is line else _CLEAR_RATIO),
            )
        elif counts[j] > patience * line.basis.degree:
            again += [(j, replace(line.basis, scale=scale)) for scale in others]
    drawn = redraw([(j, basis.nodes) for j, basis in again]) if again else []
    for (j, basis), columns in zip(again, drawn, strict=True):
        other, first = LineColumns(basis, columns), lines[j]
        seen = max(first.error(other), _UNSEEN_RATIO * tol)
        fewer = needed(other.spectrum) <= _CLEAR_RATIO * needed(best[j].spectrum)
        if fewer and other.error(first) <= seen:
            best[j] = other
    return best


def candidates(basis: Basis1D) -> tuple[Scale, ...]:
    """The other coordinates of an interval that may need fewer nodes."""
    smallest, largest = sorted((abs(basis.lower), abs(basis.upper)))
    if basis.lower <= 0.0 <= basis.upper or largest < _LEAST_RATIO * smallest:
        return ()
    scales = (IDENTITY, Logarithm(), Reciprocal())
    return tuple(
        scale for scale in scales if scale != basis.scale and scale.allows(basis.lower, basis.upper)
    )
