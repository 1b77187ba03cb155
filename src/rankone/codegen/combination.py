"""Combinations: how a kernel's outputs are weighted sums of rows of arrays.

A combination with few terms is written out, one line for each output. One with many terms
becomes a product with a coefficient matrix, listed term by term above the kernel: a statement
on a few hundred numbers costs as much as a hundred matrix entries.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction

from rankone.codegen.names import Names
from rankone.codegen.sums import Addend, SharedSums, share
from rankone.codegen.text import assignment, commented, literal, statement

__all__ = ["Combination", "Entry"]

STATEMENT_COST, OPERATION_COST = 0.3, 0.5
MATRIX_COST, ENTRY_COST, FACTOR_COST = 1.5, 0.02, 1.0
"""Measured microseconds on rows of about 500 numbers: an assignment, an operation; a matrix
product in all, each of its entries, its multiplication by a time factor."""
WORTHWHILE = 2.0
"""Microseconds a matrix must save, since written-out sums read better."""


@dataclass(frozen=True, slots=True)
class Entry:
    """``target[row] += coefficient * phi[factor] * source[column]``."""

    row: int
    coefficient: Fraction | float
    factor: int
    column: int


class Combination:
    """A linear map between rows of arrays, with coefficients that may depend on time.

    ``name`` is that of the coefficient matrix, if there is one. For comments: what the targets
    (rows) and sources (columns) are, and the time factors as people write them.
    """

    def __init__(
        self,
        name: str,
        rows: Sequence[str],
        columns: Sequence[str],
        entries: Sequence[Entry],
        time_factors: Sequence[str],
    ) -> None:
        self.name = name
        self.rows = rows
        self.columns = columns
        self.entries = entries
        self.time_factors = time_factors
        self.factors = sorted({entry.factor for entry in entries})
        self.uses_matrix = self._matrix_saves() > WORTHWHILE

    def _matrix_saves(self) -> float:
        """Microseconds by which matrix products beat written-out sums, both ways together."""
        written_out = sum(
            OPERATION_COST * sums.operations + STATEMENT_COST * sum(map(bool, sums.sums))
            for sums in (self._sums("x", adjoint=False), self._sums("x", adjoint=True))
        )
        size = len(self.rows) * len(self.columns)
        product = MATRIX_COST + ENTRY_COST * size
        scaled = sum(FACTOR_COST for factor in self.factors if factor)
        return written_out - 2 * (product * len(self.factors) + scaled)

    def tables(self) -> list[str]:
        """Definitions of the coefficient matrices; none if the sums are written out."""
        lines: list[str] = []
        if self.uses_matrix:
            for factor in self.factors:
                lines.append(f"{self._matrix(factor)} = _matrix(")
                lines.append(f"    ({len(self.rows)}, {len(self.columns)}),")
                for entry in self.entries:
                    if entry.factor == factor:
                        line = f"    ({entry.row}, {entry.column}, {literal(entry.coefficient)}),"
                        meaning = f"{self.rows[entry.row]}: {self.columns[entry.column]}"
                        lines.append(commented(line, meaning))
                lines.append(")")
        return lines

    def statements(
        self, target: str, shape: str, source: str, *, adjoint: bool = False, final: bool = False
    ) -> list[str]:
        """Lines that bind ``target``, of the given shape, to the combination of the source.

        The ``final`` combination of a function is returned.
        """
        lines = [
            commented(f"    phi_{factor} = phi[{factor}, :, None]", self.time_factors[factor])
            for factor in self.factors
            if factor
        ]
        if self.uses_matrix:
            start = "return" if final else f"{target} ="
            return [*lines, *statement(start, self._matrix_products(source, adjoint=adjoint))]
        sums = self._sums(source, adjoint=adjoint)
        for name, text in sums.intermediate:
            lines += assignment(name, [text])
        lines.append(f"    {target} = np.{'empty' if all(sums.sums) else 'zeros'}({shape})")
        for row, terms in enumerate(sums.sums):
            if terms:
                meaning = self.columns[row] if adjoint else self.rows[row]
                lines += assignment(f"{target}[{row}]", terms, meaning)
        return [*lines, f"    return {target}"] if final else lines

    def _matrix_products(self, source: str, *, adjoint: bool) -> list[str]:
        """The products with the coefficient matrices, one for each time factor."""
        products: list[str] = []
        for factor in self.factors:
            sign = "+ " if products else ""
            scale = f"phi_{factor} * " if factor else ""
            transpose = ".T" if adjoint else ""
            products.append(f"{sign}{scale}_combine({self._matrix(factor)}{transpose}, {source})")
        return products

    def _matrix(self, factor: int) -> str:
        """Name of the coefficient matrix of a time factor."""
        return f"{self.name}_PHI_{factor}" if factor else self.name

    def _sums(self, source: str, *, adjoint: bool) -> SharedSums:
        """The written-out sums; symbols are the time factors, then the rows of the source."""
        n_targets, n_sources = len(self.rows), len(self.columns)
        if adjoint:
            n_targets, n_sources = n_sources, n_targets
        scales = {factor: k for k, factor in enumerate(factor for factor in self.factors if factor)}
        symbols = [f"phi_{factor}" for factor in scales]
        symbols += [f"{source}[{k}]" for k in range(n_sources)]
        sums: list[list[Addend]] = [[] for _ in range(n_targets)]
        for entry in self.entries:
            to, of = (entry.column, entry.row) if adjoint else (entry.row, entry.column)
            scale = (scales[entry.factor],) if entry.factor else ()
            sums[to].append((entry.coefficient, (*scale, len(scales) + of)))
        return share(sums, symbols, Names().numbered("c"))
