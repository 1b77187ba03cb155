"""The right-hand side term by term, as the generated module lists it.

The generated kernels group terms of all states, whereas the classic method solves one equation
after the other and lags the terms of the others: it needs the terms one by one.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from rankone.system import System

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

    The strongly connected components of the graph of dependence, those that others need first
    (Tarjan, SIAM J. Comput. 1 (1972) 146). A block of one state whose terms do not lag it takes
    a single solve.
    """
    needs: list[list[int]] = [[] for _ in range(states)]
    for term in terms:
        needs[term.equation] += [s for s in term.monomial if s not in needs[term.equation]]
    number: dict[int, int] = {}
    low: dict[int, int] = {}
    stack: list[int] = []
    blocks: list[tuple[int, ...]] = []

    def visit(state: int) -> None:
        number[state] = low[state] = len(number)
        stack.append(state)
        for other in needs[state]:
            if other not in number:
                visit(other)
                low[state] = min(low[state], low[other])
            elif other in stack:
                low[state] = min(low[state], number[other])
        if low[state] == number[state]:
            begin = stack.index(state)
            blocks.append(tuple(sorted(stack[begin:])))
            del stack[begin:]

    for state in range(states):
        if state not in number:
            visit(state)
    return tuple(blocks)
