"""Extraction of pairs: products of many symbols from products of two, the frequent ones first.

Lowering uses it on the monomials of a system, code generation on common subexpressions.
"""

from __future__ import annotations

import heapq
from collections import Counter, defaultdict
from collections.abc import Sequence

__all__ = ["Pair", "extract_pairs"]

_Symbols = tuple[int, ...]
Pair = tuple[int, int]


def extract_pairs(
    monomials: Sequence[_Symbols], n_symbols: int, *, degree: int, repeats: int = 1
) -> tuple[list[Pair], list[_Symbols]]:
    """Replace pairs of symbols by new symbols, the most frequent pair first.

    Monomials are symbols, repeated for powers; those of ``degree`` or less are left alone, and so
    are pairs that occur less often than ``repeats``. The new symbol of pair k is ``n_symbols + k``.

    Returns
    -------
    pairs : list of (int, int)
        The symbols multiplied, possibly earlier pairs; equally frequent pairs in ascending order.
    monomials : list of tuple of int
        The rewritten monomials, each ascending.
    """
    bags = [Counter(monomial) for monomial in monomials]
    where: defaultdict[Pair, dict[int, int]] = defaultdict(dict)  # pair -> {monomial: how often}

    def record(i: int, symbols: Sequence[int]) -> None:
        """Update the occurrences in monomial i of all pairs that contain one of the symbols."""
        bag = bags[i]
        active = bag.total() > degree
        for a in symbols:
            for b in bag:
                pair = (min(a, b), max(a, b))
                often = (bag[a] // 2 if a == b else min(bag[a], bag[b])) if active else 0
                if often:
                    where[pair][i] = often
                else:
                    where[pair].pop(i, None)

    for i, bag in enumerate(bags):
        record(i, tuple(bag))
    queue = [(-sum(found.values()), pair) for pair, found in where.items()]
    heapq.heapify(queue)
    pairs: list[Pair] = []
    while queue:
        often, pair = heapq.heappop(queue)
        found = where[pair]
        if (now := sum(found.values())) != -often:  # counts only ever fall: requeue and go on
            heapq.heappush(queue, (-now, pair))
            continue
        if now < repeats or now == 0:
            break
        new = n_symbols + len(pairs)
        pairs.append(pair)
        partners: set[Pair] = set()
        for i, times in sorted(found.items()):
            bags[i].subtract({pair[0]: times})
            bags[i].subtract({pair[1]: times})
            bags[i][new] = times
            record(i, tuple(bags[i]))
            bags[i] = +bags[i]
            partners.update((symbol, new) for symbol in bags[i])
        for other in sorted(partners):
            heapq.heappush(queue, (-sum(where[other].values()), other))
    return pairs, [tuple(sorted(bag.elements())) for bag in bags]
