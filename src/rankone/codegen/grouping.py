"""Grouping: terms that share their parameter factors share one contraction.

A group holds the terms of one signature. Its paired states are a smallest set that touches every
quadratic monomial (a vertex cover), since each costs a contraction.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

from rankone.codegen.pairs import Pair
from rankone.ir.forms import Group, Term

__all__ = ["group_terms", "vertex_cover"]


def group_terms(terms: Iterable[Term]) -> tuple[Group, ...]:
    """Collect terms by signature; groups in ascending order of their signatures."""
    collected: dict[tuple[int, ...], tuple[list[Term], list[Term], list[Term]]] = {}
    for term in terms:
        by_degree = collected.setdefault(term.factors[1:], ([], [], []))
        by_degree[len(term.monomial)].append(term)
    groups = []
    for index, (signature, by_degree) in enumerate(sorted(collected.items())):
        constant, linear, quadratic = map(tuple, by_degree)
        edges = sorted({(a, b) for a, b in (term.monomial for term in quadratic)})
        paired = vertex_cover(edges)
        blocks: dict[int, list[int]] = {b: [] for b in paired}
        for a, b in edges:
            first, second = (a, b) if b in blocks else (b, a)
            blocks[second].append(first)
        ascending = tuple(tuple(sorted(blocks[b])) for b in paired)
        groups.append(Group(index, signature, constant, linear, quadratic, paired, ascending))
    return tuple(groups)


def vertex_cover(edges: Sequence[Pair], *, budget: int = 500) -> tuple[int, ...]:
    """Smallest set of vertices that touches every edge, in ascending order.

    Branch and bound on the vertex of largest degree: either it is in the cover, or all its
    neighbours are. The first descent takes it every time (the greedy cover). Large graphs stay
    cheap: after ``budget`` branches the search ends with the best cover so far, less the vertices
    it does not need. So every vertex of the cover has an edge that no other one touches.
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
    return tuple(sorted(loops | _irredundant(best, neighbours)))


def _irredundant(cover: set[int], neighbours: Mapping[int, set[int]]) -> set[int]:
    """A vertex cover without the vertices whose neighbours all stay in it; small degrees first."""
    needed = set(cover)
    for v in sorted(cover, key=lambda v: (len(neighbours[v]), v)):
        if neighbours[v] <= needed:
            needed.remove(v)
    return needed
