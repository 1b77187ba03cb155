"""Sums of products: shared factors computed once, common factors taken out of sums.

Works on symbols numbered by the caller, who says how each is written. The result is text ready
for :func:`rankone.codegen.text.assignment` and a count of its operations.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction

from rankone.codegen.pairs import extract_pairs
from rankone.codegen.text import literal

__all__ = ["Addend", "SharedSums", "share"]

Addend = tuple[Fraction | float, tuple[int, ...]]
"""A coefficient and the symbols multiplied."""

_FRACTION = re.compile(r"^\d+ / \d+")
"""A number that is only one when it stands first or in parentheses."""


_LONGEST = 80
"""Characters of a factored term."""


@dataclass(frozen=True, slots=True)
class SharedSums:
    """Several sums of products over common intermediate terms.

    Attributes
    ----------
    intermediate : tuple of (str, str)
        Names and expressions, each using only what precedes it.
    sums : tuple of tuple of str
        For each sum its terms, all but the first starting with their sign.
    operations : int
        Number of additions and multiplications.
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
        if any(len(chunk) > _LONGEST for chunk in chunks):
            chunks, count = _plain(shared, names)
        written.append(tuple(chunks))
        operations += count
    return SharedSums(tuple(intermediate), tuple(written), operations)


def _factored(terms: Sequence[Addend], names: Sequence[str]) -> tuple[list[str], int]:
    """Terms of a sum with its most frequent symbol taken out, again and again, and operations."""
    chunks: list[str] = []
    count = 0
    rest = list(terms)
    while rest:
        often = Counter(symbol for _, symbols in rest for symbol in set(symbols))
        common = min(often, key=lambda symbol: (-often[symbol], symbol), default=None)
        if common is None or often[common] < 2:
            more, operations = _plain(rest, names)
            rest = []
        else:
            inside = [(c, symbols) for c, symbols in rest if common in symbols]
            rest = [(c, symbols) for c, symbols in rest if common not in symbols]
            first, operations = _taken_out(common, inside, names)
            more = [first]
        if chunks:
            more[0] = f"- {more[0][1:]}" if more[0][0] == "-" else f"+ {more[0]}"
        count += operations + bool(chunks)
        chunks += more
    return chunks, count


def _taken_out(common: int, terms: Sequence[Addend], names: Sequence[str]) -> tuple[str, int]:
    """A symbol times the sum of what it stands beside in some terms, and operations."""
    others: list[Addend] = []
    for coefficient, symbols in terms:
        rest = list(symbols)
        rest.remove(common)
        others.append((coefficient, tuple(rest)))
    inside, count = _factored(others, names)
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
    rest = [*terms[:positive], *terms[positive + 1 :]]
    for coefficient, symbols in [*terms[positive : positive + 1], *rest]:
        size = abs(coefficient)
        factors = [names[symbol] for symbol in symbols]
        if size != 1.0 or not factors:
            factors.insert(0, literal(size))
        operations += len(factors) - 1
        minus = coefficient < 0
        sign = ("-" if minus else "") if not chunks else ("- " if minus else "+ ")
        chunks.append(sign + " * ".join(factors))
    return chunks, operations
