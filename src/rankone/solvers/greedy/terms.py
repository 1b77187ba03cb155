"""The right-hand side term by term, as the generated module lists it.

The generated kernels group terms of all states, whereas the classic method solves one equation
after the other and lags the terms of the others: it needs the terms one by one.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rankone.ir.system import System

__all__ = ["SourceTerm", "evaluation_order", "source_terms"]


class SourceTerm(NamedTuple):
    """One term of f in ``u' = f``: a row of ``TERMS``.

    Attributes
    ----------
    equation : int
        The state whose derivative it is part of.
    rows : tuple of int
        Row of ``time_factors``, then of ``parameter_factors`` for each parameter; 0 is one.
    monomial : tuple of int
        States multiplied, of any degree.
    """

    coefficient: float
    equation: int
    rows: tuple[int, ...]
    monomial: tuple[int, ...]

    @property
    def own(self) -> bool:
        """Whether the term is linear in the unknown of its equation: part of its operator."""
        return self.monomial == (self.equation,)


def source_terms(system: System) -> tuple[SourceTerm, ...]:
    """The terms of f in ``u' = f``."""
    return tuple(SourceTerm(*row) for row in system.TERMS)


def evaluation_order(terms: Sequence[SourceTerm], states: int) -> tuple[tuple[int, ...], ...]:
    """Blocks of states to be solved one after the other; only within a block terms are lagged.

    The strongly connected components of the graph of dependence. A state that needs another reaches
    all that the other reaches, and more: the blocks come in the order of how many states they
    reach. A block of one state whose terms do not lag it takes a single solve.
    """
    reached = np.eye(states, dtype=bool)
    for term in terms:
        reached[term.equation, list(term.monomial)] = True
    for middle in range(states):  # Warshall, J. ACM 9 (1962) 11
        reached |= np.outer(reached[:, middle], reached[middle])
    blocks = dict.fromkeys(tuple(np.flatnonzero(row).tolist()) for row in reached & reached.T)
    return tuple(sorted(blocks, key=lambda block: np.count_nonzero(reached[block[0]])))
