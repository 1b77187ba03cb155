"""Modes of fields and of elementwise functions, made of trajectories, and points to interpolate at.

Modes are those of a proper orthogonal decomposition, of all trajectories so far (Sirovich, Quart.
Appl. Math. 45 (1987), 561). Functions are interpolated in modes of their own at a few entries
(Chaturantabut & Sorensen, SIAM J. Sci. Comput. 32 (2010), 2737), which a factorisation with column
pivots chooses (Drmač & Gugercin, SIAM J. Sci. Comput. 38 (2016), A631), some more than there are
modes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from rankone.support.arrays import Array
from rankone.trajectories.fields.field_trajectories import Compressed, Compression, least_count

_TELLING = 128  # Times at once that tell how many modes are needed
_OVERSAMPLED = 1.5  # Entries at which a function is taken, for each of its modes


class Snapshots:
    """The values of one unknown, or one function, along all trajectories so far."""

    def __init__(self, tolerance: float, *, relative: bool = False) -> None:
        self._union = Compression(tolerance, relative=relative)

    def add(self, trajectory: Compressed, unit: float = 1.0) -> None:
        """Take a further trajectory, times a number."""
        for first in range(0, trajectory.numbers.shape[1], _TELLING):
            self._union.add(unit * trajectory.at(slice(first, first + _TELLING)))

    @property
    def largest(self) -> float:
        """The largest absolute value."""
        return self._union.largest

    def modes(self, left_out: float) -> Array:
        """Modes (n, r) that leave out so much of any entry at any time at most.

        They are orthonormal in the mean over the entries.
        """
        union = self._union.result()
        if not union.modes.shape[1]:  # it is zero: any mode will do
            return np.ones((len(union.modes), 1))
        rotation, values, columns = np.linalg.svd(union.numbers, full_matrices=False)
        count = len(values)
        if left_out > 0.0:
            rotated, count = (union.modes @ rotation) * values, 0
            while True:  # at the times that miss most so far
                squares = np.square(values[count:, None] * columns[count:]).sum(axis=0)
                telling = np.argsort(-squares, kind="stable")[:_TELLING]
                needed = least_count(rotated, columns[:, telling], left_out)
                if needed <= count:
                    break
                count = needed
            count = max(count, 1)
        return np.asarray(np.sqrt(len(union.modes)) * (union.modes @ rotation[:, :count]))

    def missed(self, count: int) -> float:
        """What so many modes leave out of any entry at any time at most."""
        union = self._union.result()
        rotation, values, columns = np.linalg.svd(union.numbers, full_matrices=False)
        rest = values[count:, None] * columns[count:]
        telling = np.argsort(-np.square(rest).sum(axis=0), kind="stable")[:_TELLING]
        missed = union.modes @ rotation[:, count:] @ rest[:, telling]
        return float(np.abs(missed).max(initial=0.0))


class FieldSnapshots:
    """The values of all unknowns of sizes (unknowns,) along all trajectories so far.

    Positions share the modes of their ``velocities``, so that what is reduced moves as the body
    does: a rate of the coefficients of positions is the coefficients of velocities, and forces that
    do no work in the body do none in the reduced one.
    """

    def __init__(self, velocities: Mapping[int, int], sizes: Array, tolerance: float) -> None:
        self._shared = [velocities.get(k, k) for k in range(len(sizes))]
        self._units = sizes[self._shared] / sizes
        self._groups = {k: Snapshots(tolerance * float(sizes[k])) for k in {*self._shared}}

    def add(self, states: Sequence[Compressed]) -> None:
        """Take the values of all unknowns along a further trajectory."""
        for k, unit, values in zip(self._shared, self._units.tolist(), states, strict=True):
            self._groups[k].add(values, unit)

    def modes(self, left_out: Array) -> list[Array]:
        """Modes of each unknown that leave out so much (unknowns,) of any entry at most."""
        shared, units = np.array(self._shared), self._units * left_out
        modes = {k: group.modes(units[shared == k].min()) for k, group in self._groups.items()}
        return [modes[k] for k in self._shared]

    def missed(self, unknown: int, count: int) -> float:
        """What so many modes of an unknown leave out of any of its entries at most."""
        group, unit = self._groups[self._shared[unknown]], float(self._units[unknown])
        return group.missed(count) / unit


@dataclass(frozen=True, eq=False)
class Interpolation:
    """A function of many entries by its values at a few: ``modes @ weights @ values[entries]``."""

    modes: Array
    entries: NDArray[np.intp]
    weights: Array

    @classmethod
    def of(cls, modes: Array, further: Array) -> Interpolation:
        """The interpolation in modes (n, m), at entries that tell ``further`` ones (n, k) apart."""
        wanted = min(int(np.ceil(_OVERSAMPLED * modes.shape[1])), further.shape[1], len(modes))
        together = further[:, : max(wanted, modes.shape[1])]
        _, _, pivots = scipy.linalg.qr(together.T, mode="economic", pivoting=True)
        entries = np.sort(pivots[: together.shape[1]])
        return cls(modes, entries, np.linalg.pinv(modes[entries]))
