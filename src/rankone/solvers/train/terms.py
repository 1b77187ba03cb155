"""Kernels of many states, from the table of terms: sparse matrices times products of states.

They do what the generated kernels of a group do. The terms are of degree two at most.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import scipy.sparse

from rankone.ir.system import System
from rankone.support.arrays import Array

Monomial: TypeAlias = tuple[int, ...]
"""States that a term multiplies, in order."""


@dataclass(frozen=True)
class Entry:
    """A term of a group: coefficient, state, row of its time factor, states multiplied."""

    coefficient: float
    state: int
    factor: int
    monomial: Monomial


def entries_of(system: System) -> dict[tuple[int, tuple[int, ...]], list[Entry]]:
    """Terms by degree and by the rows of their parameter factors."""
    groups: dict[tuple[int, tuple[int, ...]], list[Entry]] = {}
    for coefficient, state, (factor, *rows), monomial in system.terms:
        entry = Entry(float(coefficient), state, factor, tuple(sorted(monomial)))
        groups.setdefault((len(monomial), tuple(rows)), []).append(entry)
    return groups


class TermKernels:
    """A group of terms of one degree: ``paired`` are the second states of products of two.

    Of P points of time and parameter, time-major, ``phi`` (factors, P) has the time factors.
    """

    def __init__(self, entries: Sequence[Entry], n_states: int) -> None:
        monomials = sorted({entry.monomial for entry in entries}, key=lambda m: m[::-1])
        if len(monomials[0]) == 1:  # linear terms multiply all states, so that none are gathered
            monomials = [(state,) for state in range(n_states)]
        place = {monomial: k for k, monomial in enumerate(monomials)}
        blocks: dict[int, list[int]] = {}
        for first, second in (monomial for monomial in monomials if len(monomial) == 2):
            blocks.setdefault(second, []).append(first)
        self.paired, self._blocks = list(blocks), list(blocks.values())
        by_factor: dict[int, list[Entry]] = {}
        for entry in entries:
            by_factor.setdefault(entry.factor, []).append(entry)
        shape = n_states, len(monomials)
        self._matrices = {
            factor: scipy.sparse.csr_matrix(
                (
                    [entry.coefficient for entry in own],
                    ([entry.state for entry in own], [place[entry.monomial] for entry in own]),
                ),
                shape,
            )
            for factor, own in by_factor.items()
        }
        self._adjoints = {factor: m.T.tocsr() for factor, m in self._matrices.items()}

    def constant(self, phi: Array) -> Array:
        """Constant terms (n, P)."""
        return _sums(self._matrices, phi, np.ones((1, phi.shape[1], 1)))[:, :, 0]

    def linear(self, phi: Array, x: Array) -> Array:
        """Linear terms at x (n, P, r)."""
        return _sums(self._matrices, phi, x)

    def linear_adjoint(self, phi: Array, w: Array) -> Array:
        """Their adjoint at w (n, P, s)."""
        return _sums(self._adjoints, phi, w)

    def quadratic(self, phi: Array, x: Array, z: Array) -> Array:
        """Products of x (n, P, r) with z (paired states, P, r, s), summed over r: (n, P, s)."""
        products = [
            np.matmul(x[first].transpose(1, 0, 2), second).transpose(1, 0, 2)
            for first, second in zip(self._blocks, z, strict=True)
        ]
        return _sums(self._matrices, phi, np.concatenate(products))

    def quadratic_adjoint(self, phi: Array, x: Array, w: Array) -> Array:
        """The adjoint at w (n, P, s): (paired states, P, r, s)."""
        q, last = _sums(self._adjoints, phi, w), 0
        v = np.empty((len(self.paired), *x.shape[1:], w.shape[2]))
        for first, out in zip(self._blocks, v, strict=True):
            begin, last = last, last + len(first)
            np.matmul(x[first].transpose(1, 2, 0), q[begin:last].transpose(1, 0, 2), out=out)
        return v


def _sums(matrices: dict[int, scipy.sparse.csr_matrix], phi: Array, x: Array) -> Array:
    """Matrices times the rows of x (m, P, r), each with its time factor; row 0 of them is one."""
    total: Array | float = 0.0
    for factor, matrix in matrices.items():
        part = np.asarray(matrix @ x.reshape(len(x), -1)).reshape(-1, *x.shape[1:])
        total = total + (part * phi[factor, :, None] if factor else part)
    return np.asarray(total)
