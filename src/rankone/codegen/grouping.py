"""Grouping: terms that share their parameter factors share one contraction.

A group holds the terms of one signature. Its quadratic monomials ``x_a x_b`` are evaluated as
``x_a`` times a precomputed contraction of ``x_b``; the states ``b`` are the group's paired states,
a smallest set that touches every monomial (a vertex cover), since each costs a contraction.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from rankone.ir import Term

__all__ = ["Group", "group_terms", "vertex_cover"]

Pair = tuple[int, int]


@dataclass(frozen=True, slots=True)
class Group:
    """Terms of degree at most two with the same parameter factors.

    Attributes
    ----------
    index : int
        Position of the group.
    signature : tuple of int
        For each parameter the factor's row; 0 is one.
    constant, linear, quadratic : tuple of Term
        The terms by degree.
    paired : tuple of int
        Second states of the quadratic monomials.
    blocks : tuple of tuple of int
        For each paired state b the first states a of the monomials ``x_a x_b``, ascending.
    """

    index: int
    signature: tuple[int, ...]
    constant: tuple[Term, ...]
    linear: tuple[Term, ...]
    quadratic: tuple[Term, ...]
    paired: tuple[int, ...]
    blocks: tuple[tuple[int, ...], ...]

    @property
    def monomials(self) -> tuple[Pair, ...]:
        """Quadratic monomials (a, b), b paired, in the order they are evaluated."""
        return tuple(
            (a, b) for b, block in zip(self.paired, self.blocks, strict=True) for a in block
        )


def group_terms(terms: Iterable[Term]) -> tuple[Group, ...]:
    """Collect terms by signature; groups in ascending order of their signatures."""
    collected: dict[tuple[int, ...], tuple[list[Term], list[Term], list[Term]]] = {}
    for term in terms:
        by_degree = collected.setdefault(term.factors[1:], ([], [], []))
        by_degree[len(term.monomial)].append(term)
    groups = []
    for index, (signature, (constant, linear, quadratic)) in enumerate(sorted(collected.items())):
        edges = sorted({(a, b) for a, b in (term.monomial for term in quadratic)})
        paired = vertex_cover(edges)
        blocks: dict[int, list[int]] = {b: [] for b in paired}
        for a, b in edges:
            first, second = (a, b) if b in blocks else (b, a)
            blocks[second].append(first)
        groups.append(
            Group(
                index,
                signature,
                tuple(constant),
                tuple(linear),
                tuple(quadratic),
                paired,
                tuple(tuple(sorted(blocks[b])) for b in paired),
            )
        )
    return tuple(groups)


def vertex_cover(edges: Sequence[Pair], *, budget: int = 500) -> tuple[int, ...]:
    """Smallest set of vertices that touches every edge, in ascending order.

    Branch and bound on the vertex of largest degree: either it is in the cover, or all its
    neighbours are. The first descent takes it every time (the greedy cover); after ``budget``
    branches the best cover found so far is returned, so that large graphs stay cheap.
    """
    loops = {a for a, b in edges if a == b}
    neighbours: dict[int, set[int]] = {}
    for a, b in edges:
        if not loops & {a, b}:
            neighbours.setdefault(a, set()).add(b)
            neighbours.setdefault(b, set()).add(a)
    best = set(neighbours)
    branches = 0

    def search(graph: dict[int, set[int]], cover: set[int]) -> None:
        nonlocal best, branches
        branches += 1
        if not graph:
            best = min(best, cover, key=len)
            return
        largest = min(graph, key=lambda v: (-len(graph[v]), v))
        edges_left = sum(map(len, graph.values())) / 2
        if len(cover) + edges_left / len(graph[largest]) > len(best) - 1:
            return
        for taken in ({largest}, graph[largest]):
            if taken is graph[largest] and branches > budget:
                return
            rest = {v: near - taken for v, near in graph.items() if v not in taken}
            search({v: near for v, near in rest.items() if near}, cover | taken)

    search(neighbours, set())
    return tuple(sorted(loops | best))
