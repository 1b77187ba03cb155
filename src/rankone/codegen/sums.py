"""Sums of products with few operations: shared pairs computed once, common factors taken out.

Symbols are numbered by the caller, who says how each is written. The sums become text for
:func:`rankone.codegen.text.assignment`, with a count of its operations.
"""

from __future__ import annotations

import heapq
import re
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction

from rankone.codegen.text import literal

Addend = tuple[Fraction | float, tuple[int, ...]]
"""A coefficient and the symbols multiplied."""

# A quotient that is a number only where it stands first or in parentheses
_FRACTION = re.compile(r"^\d+ / \d+")
_MAX_TERM_WIDTH = 80  # Characters of a factored term that is still easy to read

Symbols = tuple[int, ...]
"""A product of numbered symbols, repeated for powers."""
Pair = tuple[int, int]
"""Two symbols that are multiplied."""


def extract_pairs(
    monomials: Sequence[Symbols], n_symbols: int, *, degree: int, repeats: int = 1
) -> tuple[list[Pair], list[Symbols]]:
    """Replace pairs of symbols by new symbols, the most frequent pair first.

    Monomials of ``degree`` or less are left alone, and so are pairs that occur less often than
    ``repeats``. The symbol of pair k is ``n_symbols + k``; it may occur in later pairs, and equally
    frequent pairs are in ascending order. Returns the pairs and the rewritten monomials, ascending.
    """
    bags = [Counter(monomial) for monomial in monomials]
    where: defaultdict[Pair, dict[int, int]] = defaultdict(dict)  # pair -> {monomial: how often}

    def record(i: int, symbols: Sequence[int]) -> None:
        """Update the occurrences in monomial i of all pairs that contain one of the symbols."""
        bag = bags[i]
        active = bag.total() > degree
        for a in symbols:
            of_a = bag[a] if active else 0
            for b, of_b in bag.items():
                pair = (a, b) if a <= b else (b, a)
                often = of_a // 2 if a == b else min(of_a, of_b)
                if often:
                    where[pair][i] = often
                else:
                    where[pair].pop(i, None)

    for i, bag in enumerate(bags):
        record(i, tuple(bag))
    queue = [(-sum(counts.values()), pair) for pair, counts in where.items()]
    heapq.heapify(queue)
    pairs: list[Pair] = []
    while queue:
        often, pair = heapq.heappop(queue)
        counts = where[pair]
        if (now := sum(counts.values())) != -often:  # counts only ever fall: requeue and go on
            heapq.heappush(queue, (-now, pair))
            continue
        if now < repeats or now == 0:
            break
        symbol_of_pair = n_symbols + len(pairs)
        pairs.append(pair)
        partners: set[Pair] = set()
        for i, times in sorted(counts.items()):
            bags[i].subtract({pair[0]: times})
            bags[i].subtract({pair[1]: times})
            bags[i][symbol_of_pair] = times
            stays = bags[i].total() > degree
            record(i, (*pair, symbol_of_pair) if stays else tuple(bags[i]))
            bags[i] = +bags[i]
            partners.update((symbol, symbol_of_pair) for symbol in bags[i])
        for partner in sorted(partners):
            heapq.heappush(queue, (-sum(where[partner].values()), partner))
    return pairs, [tuple(sorted(bag.elements())) for bag in bags]


@dataclass(frozen=True, slots=True)
class SharedSums:
    """Several sums of products over common intermediate terms, and how many operations they have.

    The names and expressions of ``intermediate`` use only what precedes them. The terms of each
    sum, but for the first, start with their sign.
    """

    intermediate: tuple[tuple[str, str], ...]
    sums: tuple[tuple[str, ...], ...]
    operations: int


def share(
    sums: Sequence[Sequence[Addend]], symbols: Sequence[str], temporaries: Iterator[str]
) -> SharedSums:
    """Write sums of products with few operations.

    Pairs of symbols that occur more than once become intermediate terms; then each sum is
    factored by its most frequent symbol, ``k*x - k*y`` to ``k * (x - y)``, unless a factored
    term would be long.

    ``symbols`` has the text of each symbol, ``temporaries`` fresh names for intermediate terms.
    """
    flat = [symbols_ for terms in sums for _, symbols_ in terms]
    pairs, rewritten = extract_pairs(flat, len(symbols), degree=1, repeats=2)
    names = [*symbols]
    intermediate = []
    for a, b in pairs:
        name = next(temporaries)
        intermediate.append((name, f"{names[a]} * {names[b]}"))
        names.append(name)
    operations = len(pairs)
    remaining = iter(rewritten)
    written = []
    for terms in sums:
        shared = [(coefficient, next(remaining)) for coefficient, _ in terms]
        chunks, count = _factored(shared, names)
        if any(len(chunk) > _MAX_TERM_WIDTH for chunk in chunks):
            chunks, count = _plain(shared, names)
        written.append(tuple(chunks))
        operations += count
    return SharedSums(tuple(intermediate), tuple(written), operations)


def _factored(terms: Sequence[Addend], names: Sequence[str]) -> tuple[list[str], int]:
    """Terms of a sum with its most frequent symbol taken out, again and again, and operations."""
    chunks: list[str] = []
    count = 0
    remaining = list(terms)
    while remaining:
        often = Counter(symbol for _, symbols in remaining for symbol in set(symbols))
        common = min(often, key=lambda symbol: (-often[symbol], symbol), default=None)
        if common is None or often[common] < 2:
            added, operations = _plain(remaining, names)
            remaining = []
        else:
            inside = [(c, symbols) for c, symbols in remaining if common in symbols]
            remaining = [(c, symbols) for c, symbols in remaining if common not in symbols]
            product, operations = _product_of(common, inside, names)
            added = [product]
        if chunks:
            added[0] = f"- {added[0][1:]}" if added[0][0] == "-" else f"+ {added[0]}"
        count += operations + bool(chunks)
        chunks += added
    return chunks, count


def _product_of(common: int, terms: Sequence[Addend], names: Sequence[str]) -> tuple[str, int]:
    """A symbol times the sum of its cofactors in some terms, and operations."""
    cofactors: list[Addend] = []
    for coefficient, symbols in terms:
        cofactor = list(symbols)
        cofactor.remove(common)
        cofactors.append((coefficient, tuple(cofactor)))
    inside, count = _factored(cofactors, names)
    if len(inside) > 1:
        return f"{names[common]} * ({' '.join(inside)})", count + 1
    # a product again: k * (x * (a + b)) needs no outer parentheses
    sign = "-" if inside[0].startswith("-") else ""
    factor = _FRACTION.sub(r"(\g<0>)", inside[0].removeprefix("-"))
    return f"{sign}{names[common]} * {factor}", count + 1


def _plain(terms: Sequence[Addend], names: Sequence[str]) -> tuple[list[str], int]:
    """Terms of a sum as they are, and the number of operations."""
    chunks: list[str] = []
    operations = max(len(terms) - 1, 0)
    positive = next((i for i, term in enumerate(terms) if term[0] > 0), 0)  # y - x, not -x + y
    ordered = [*terms[positive : positive + 1], *terms[:positive], *terms[positive + 1 :]]
    for coefficient, symbols in ordered:
        size = abs(coefficient)
        factors = [names[symbol] for symbol in symbols]
        if size != 1.0 or not factors:
            factors.insert(0, literal(size))
        operations += len(factors) - 1
        minus = coefficient < 0
        sign = ("-" if minus else "") if not chunks else ("- " if minus else "+ ")
        chunks.append(sign + " * ".join(factors))
    return chunks, operations
