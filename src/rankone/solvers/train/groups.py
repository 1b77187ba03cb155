"""Term groups of a generated system on given parameter bases, and the keys that address them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rankone.discretization import Basis1D
from rankone.system import Array, System

__all__ = ["CONSTANT", "LINEAR", "QUADRATIC", "Group", "Key", "ParameterOperators", "term_groups"]

CONSTANT, LINEAR, QUADRATIC = 0, 1, 2
"""Degrees in the states."""

Key = tuple[int, tuple[int, ...]]
"""(degree, factor rows of the remaining parameters): all terms with the same key share one
contraction over those parameters, whatever they did before."""


@dataclass(frozen=True, slots=True)
class Group:
    """All terms of one degree and one signature: they share every contraction."""

    degree: int
    index: int
    signature: tuple[int, ...]

    @property
    def key(self) -> Key:
        return (self.degree, self.signature)


def term_groups(system: System) -> tuple[Group, ...]:
    """The groups of a generated system, by degree and signature."""
    tables = {CONSTANT: system.CONSTANT, LINEAR: system.LINEAR, QUADRATIC: system.QUADRATIC}
    return tuple(
        Group(degree, index, signature)
        for degree, table in tables.items()
        for index, signature in enumerate(system.SIGNATURES)
        if table[index] is not None
    )


class ParameterOperators:
    """Diagonal parameter operators: one vector per factor, dimension and degree.

    Cores hold values scaled by sqrt(weight), so that the Euclidean product is the L2 product. The
    projection of a product of ``degree`` states and a factor is then diagonal with the entries
    ``factor * weight ** ((1 - degree) / 2)``.
    """

    def __init__(self, system: System, bases: Sequence[Basis1D]) -> None:
        factors = [system.parameter_factors(j, basis.nodes) for j, basis in enumerate(bases)]
        self.bases = tuple(bases)
        self._vectors: list[list[Array]] = [
            [
                rows * basis.weights ** (0.5 * (1 - degree))
                for rows, basis in zip(factors, bases, strict=True)
            ]
            for degree in (CONSTANT, LINEAR, QUADRATIC)
        ]

    def vector(self, key: Key, dimension: int) -> Array:
        """The operator of the first remaining factor of ``key`` in ``dimension``, shape (size,)."""
        degree, rows = key
        return np.asarray(self._vectors[degree][dimension][rows[0]])
