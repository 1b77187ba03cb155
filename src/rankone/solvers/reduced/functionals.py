"""Numbers that are linear in all coefficients of fields, and what errors of the fields do to them.

A functional of fields u is ``row @ u``, so that of coefficients ``(row @ V) @ a``. Fields that are
wrong by d at most change it by ``abs(row) @ d`` at most.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import scipy.sparse as ss

from rankone.solvers.reduced.field_modes import FieldModes
from rankone.support.arrays import NEGLIGIBLE, Array

Matrix: TypeAlias = "ss.csr_array"


@dataclass(frozen=True, eq=False)
class Functional:
    """``weights @ a`` of all coefficients a (R,).

    It is at most ``size`` where each field is at its largest value, and at most ``error`` of that
    wrong; NaN where the errors of the fields were not measured.
    """

    weights: Array
    size: float
    error: float


class Functionals:
    """Functionals by number, each once; a row of all entries of all unknowns makes one."""

    def __init__(self, modes: FieldModes) -> None:
        self.modes = modes
        self.listed: list[Functional] = []
        self._numbers: dict[bytes, int] = {}
        sizes = [unknown.size for unknown in modes.unknowns]
        errors = modes.errors or (np.nan,) * len(sizes)
        self._scales = np.repeat(modes.scales, sizes)
        self._wrong = np.repeat(np.multiply(modes.scales, errors), sizes)

    def linear(self, row: Matrix) -> int:
        """The number of the functional of a row (1, N)."""
        size, wrong = (float((abs(row) @ bounds)[0]) for bounds in (self._scales, self._wrong))
        return self._number(Functional(self._of_coefficients(row)[0], size, _share(wrong, size)))

    def squares(self, row: Array, matrix: Matrix) -> list[int]:
        """Numbers of functionals whose squares add up to ``row @ (matrix @ u)**2``.

        ``row`` (m,) is not negative. There are at most as many as coefficients, whatever m is. By
        the inequality of Cauchy and Schwarz each has the error that bounds that of the sum.
        """
        used = np.flatnonzero(row)
        root = np.sqrt(row[used])
        entries = matrix[used]
        scaled = root[:, None] * self._of_coefficients(entries)
        _, values, vectors = np.linalg.svd(scaled, full_matrices=False)
        size, wrong = (
            float(np.linalg.norm(root * (abs(entries) @ bounds)))
            for bounds in (self._scales, self._wrong)
        )
        kept = values > NEGLIGIBLE * values.max(initial=0.0)
        squared = (values[:, None] * vectors)[kept]
        return [self._number(Functional(each, size, _share(wrong, size))) for each in squared]

    def size_of(self, matrix: Matrix) -> float:
        """Largest value of an entry of ``matrix @ u``, where all fields are at their largest."""
        return float((abs(matrix) @ self._scales).max(initial=0.0))

    def _of_coefficients(self, matrix: Matrix) -> Array:
        """``matrix @ V`` (m, R) for a matrix (m, N)."""
        columns = ss.csc_array(matrix)
        blocks = [
            columns[:, unknown.rows] @ own
            for unknown, own in zip(self.modes.unknowns, self.modes.modes, strict=True)
        ]
        return np.hstack(blocks)

    def _number(self, functional: Functional) -> int:
        key = functional.weights.tobytes()
        if key not in self._numbers:
            self._numbers[key] = len(self.listed)
            self.listed.append(functional)
        return self._numbers[key]


def combined(functionals: Sequence[Functional], numbers: Sequence[float]) -> Functional:
    """A sum of functionals times numbers."""
    pairs = [*zip(functionals, numbers, strict=True)]
    weights = sum((number * each.weights for each, number in pairs), np.zeros(1))
    size = sum(abs(number) * each.size for each, number in pairs)
    wrong = sum(abs(number) * each.size * each.error for each, number in pairs)
    return Functional(np.asarray(weights), size, _share(wrong, size))


def _share(wrong: float, size: float) -> float:
    return wrong / size if size else 0.0
