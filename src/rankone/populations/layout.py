"""The population parameters in a row: means, effects of covariates, random effects, noise.

Subject i has the parameters x = g(z), and its coordinates are z = mu + X_i beta + eta with the
random effects eta ~ N(0, Omega).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from rankone.populations.scales import Scale
from rankone.support.arrays import Array


@dataclass(frozen=True)
class Effect:
    """The effect of a covariate: ``x`` (n,) for each subject, on the parameter at ``position``.

    A coefficient that is ``held`` is not estimated.
    """

    name: str
    position: int
    x: Array
    held: float | None = None


@dataclass(frozen=True)
class Layout:
    """What a row of population parameters psi (P,) means.

    It has the means mu of the ``names`` (E), the coefficients of the ``effects`` (C), the entries
    of the Cholesky factor L of Omega, with logarithms on its diagonal, and the logarithms of the
    ``levels`` of noise; ``zero_levels`` are zero. ``random`` are the positions (q,) of the random
    parameters, ``groups`` which of those correlate, as positions among them.
    """

    names: tuple[str, ...]
    scales: tuple[Scale, ...]
    random: tuple[int, ...]
    covariates: tuple[Effect, ...]
    groups: tuple[tuple[int, ...], ...]
    levels: tuple[str, ...]
    subjects: int
    zero_levels: tuple[str, ...] = ()

    @cached_property
    def effects(self) -> tuple[Effect, ...]:
        """The effects of covariates whose coefficients are estimated."""
        return tuple(effect for effect in self.covariates if effect.held is None)

    @cached_property
    def entries(self) -> tuple[tuple[int, int], ...]:
        """Rows and columns of the entries of L: the diagonal, then what is below it."""
        q = len(self.random)
        below = [(i, j) for group in self.groups for i in group for j in group if j < i]
        return (*((i, i) for i in range(q)), *sorted(below))

    @property
    def means(self) -> slice:
        """The means and the coefficients of covariates: what shifts subjects."""
        return slice(0, len(self.names) + len(self.effects))

    @property
    def factors(self) -> slice:
        """The entries of L."""
        begin = self.means.stop
        return slice(begin, begin + len(self.entries))

    @property
    def noise(self) -> slice:
        """The levels of noise."""
        begin = self.factors.stop
        return slice(begin, begin + len(self.levels))

    @property
    def spreads(self) -> slice:
        """All that is no mean: L and the levels of noise."""
        return slice(self.means.stop, self.size)

    @property
    def size(self) -> int:
        """Number of population parameters."""
        return len(self.names) + len(self.effects) + len(self.entries) + len(self.levels)

    @cached_property
    def designs(self) -> Array:
        """Derivatives (n, E, E + C) of the coordinates of subjects with respect to the means."""
        designs = np.zeros((self.subjects, len(self.names), self.means.stop))
        designs[:, range(len(self.names)), range(len(self.names))] = 1.0
        for c, effect in enumerate(self.effects):
            designs[:, effect.position, len(self.names) + c] = effect.x
        return designs

    @cached_property
    def offsets(self) -> Array:
        """What held coefficients add to the coordinates of each subject, (n, E)."""
        offsets = np.zeros((self.subjects, len(self.names)))
        for effect in self.covariates:
            offsets[:, effect.position] += (effect.held or 0.0) * effect.x
        return offsets

    def selected(self, which: NDArray[np.intp]) -> Layout:
        """The layout for some of the subjects."""
        effects = tuple(replace(effect, x=effect.x[which]) for effect in self.covariates)
        return replace(self, covariates=effects, subjects=which.size)

    def typical(self, psi: Array) -> Array:
        """Coordinates (K, n, E) of subjects without random effects at psi (K, P)."""
        shifts = np.einsum("nep,kp->kne", self.designs, psi[:, self.means])
        return np.asarray(shifts + self.offsets)

    def cholesky(self, psi: Array) -> Array:
        """L (K, q, q) at psi (K, P)."""
        q = len(self.random)
        factor = np.zeros((len(psi), q, q))
        for column, (i, j) in zip(psi[:, self.factors].T, self.entries, strict=True):
            factor[:, i, j] = np.exp(column) if i == j else column
        return factor

    def covariance(self, psi: Array) -> Array:
        """Omega (q, q) at psi (P,)."""
        factor = self.cholesky(psi[None])[0]
        return np.asarray(factor @ factor.T)

    def factored(self, omega: Array) -> Array:
        """The entries of psi for an Omega (q, q); what does not correlate is left out."""
        kept = np.eye(len(omega), dtype=bool)
        for group in self.groups:
            kept[np.ix_(group, group)] = True
        factor = np.linalg.cholesky(np.where(kept, omega, 0.0))
        entries = [np.log(factor[i, i]) if i == j else factor[i, j] for i, j in self.entries]
        return np.array(entries)

    def values(self, coordinates: Array) -> Array:
        """Parameters (..., E) at coordinates (..., E)."""
        columns = [scale.value(coordinates[..., e]) for e, scale in enumerate(self.scales)]
        return np.stack(columns, axis=-1)

    def slopes(self, values: Array) -> Array:
        """Derivatives (..., E) of parameters with respect to their coordinates."""
        columns = [scale.slope(values[..., e]) for e, scale in enumerate(self.scales)]
        return np.stack(columns, axis=-1)

    def coordinates(self, values: Array) -> Array:
        """Coordinates (..., E) of parameters (..., E)."""
        columns = [scale.coordinate(values[..., e]) for e, scale in enumerate(self.scales)]
        return np.stack(columns, axis=-1)


def correlated_groups(groups: Sequence[Sequence[int]], q: int) -> tuple[tuple[int, ...], ...]:
    """Groups of positions that cover all q, those that are in none alone."""
    inside = {position for group in groups for position in group}
    alone = [(i,) for i in range(q) if i not in inside]
    return tuple(sorted([*(tuple(sorted(group)) for group in groups), *alone]))
