"""Term groups of a generated system on given parameter bases, and the keys that address them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from rankone.discretization import Basis1D
from rankone.ir.system import System
from rankone.support.arrays import Array

__all__ = ["CONSTANT", "LINEAR", "QUADRATIC", "GroupKernels", "ParameterOperators", "term_groups"]

CONSTANT, LINEAR, QUADRATIC = 0, 1, 2
"""Degrees in the states."""

Key = tuple[int, tuple[int, ...]]
"""(degree, factor rows of the remaining parameters): all terms with the same key share one
contraction over those parameters, whatever they did before."""


@dataclass(frozen=True, slots=True)
class GroupKernels:
    """All terms of one degree and one signature: they share every contraction.

    Attributes
    ----------
    degree : int
        In the states.
    signature : tuple of int
        Row of the factors of each parameter.
    kernel, adjoint : callable
        The generated terms and their adjoint; a constant is its own.
    paired : list of int
        Second states of quadratic terms.
    """

    degree: int
    signature: tuple[int, ...]
    kernel: Any
    adjoint: Any
    paired: list[int]

    @property
    def key(self) -> Key:
        return (self.degree, self.signature)


def term_groups(system: System) -> tuple[GroupKernels, ...]:
    """The groups of a generated system, by degree and signature."""
    kernels = (system.CONSTANT, system.LINEAR, system.QUADRATIC)
    adjoints = (system.CONSTANT, system.LINEAR_ADJOINT, system.QUADRATIC_ADJOINT)
    return tuple(
        GroupKernels(
            degree, signature, kernels[degree][g], adjoints[degree][g], list(system.PAIRED[g])
        )
        for degree in (CONSTANT, LINEAR, QUADRATIC)
        for g, signature in enumerate(system.SIGNATURES)
        if kernels[degree][g] is not None
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
