"""From coefficients to fields: one matrix of modes for each unknown."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rankone.support.arrays import Array
from rankone.trajectories.fields.field_system import Unknown


@dataclass(frozen=True, eq=False)
class FieldModes:
    """Fields as sums of modes: each unknown is its ``modes`` (n, r) times its own coefficients.

    The coefficients of all unknowns are stacked in the order of the unknowns, (R,). Modes are
    orthonormal for each unknown in the mean over its entries: ``modes.T @ modes == n * eye(r)``, so
    that coefficients have the size of the field. A scalar unknown has the mode one. ``scales`` are
    the largest absolute values of the unknowns over all full trajectories, ``errors`` the largest
    differences of the solution from full trajectories that no mode was made of, each relative to
    its scale, and ``trajectories`` how many full ones were integrated in all.
    """

    unknowns: tuple[Unknown, ...]
    modes: tuple[Array, ...]
    scales: tuple[float, ...]
    errors: tuple[float, ...] = ()
    trajectories: int = 0

    @property
    def counts(self) -> tuple[int, ...]:
        """Numbers of coefficients of each unknown."""
        return tuple(modes.shape[1] for modes in self.modes)

    def coefficients_of(self, unknown: int) -> slice:
        """The coefficients of an unknown among those of all."""
        first = sum(self.counts[:unknown])
        return slice(first, first + self.counts[unknown])

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the coefficients: ``u_0``, ``u_1``, ..., and those of scalar unknowns."""
        names: list[str] = []
        for unknown, count in zip(self.unknowns, self.counts, strict=True):
            own = [f"{unknown.name}_{k}" for k in range(count)]
            names += own if unknown.is_field else [unknown.name]
        return tuple(names)

    def fields(self, coefficients: Array) -> Array:
        """All unknowns stacked (N, ...) of coefficients (R, ...)."""
        return np.concatenate(
            [
                np.tensordot(modes, coefficients[self.coefficients_of(k)], axes=1)
                for k, modes in enumerate(self.modes)
            ]
        )
