"""Kernels: the separated right-hand side of one group, acting on many columns at once.

A quadratic kernel first multiplies states, one batched matrix product for each paired state; then
every kernel combines rows with the coefficients of the terms. A combination of few terms is written
out, one line for each output. One of many terms becomes a product with a coefficient matrix, listed
term by term above the kernel: a statement on a few hundred numbers costs as much as a hundred
matrix entries.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from fractions import Fraction

from rankone.compiler.codegen.layout import (
    INDENT,
    Names,
    assignment,
    commented,
    docstring,
    literal,
    nested,
    statement,
    table,
    tuple_lines,
)
from rankone.compiler.codegen.module_header import signature_text
from rankone.compiler.codegen.printer import factor_text
from rankone.compiler.codegen.sums import Addend, SharedSums, share
from rankone.problem.forms import Group, QuadraticSystem

KERNELS = ("constant", "linear", "linear_adjoint", "quadratic", "quadratic_adjoint")
"""The kernels of a group, in the order of the module."""

STATEMENT_COST = 0.3
"""Microseconds of an assignment to a row of about 500 numbers, measured."""
OPERATION_COST = 0.5
"""Microseconds of an operation on such rows."""
MATRIX_COST = 1.5
"""Microseconds of a matrix product with such rows, whatever its size."""
ENTRY_COST = 0.02
"""Microseconds of each of its entries."""
MATRIX_GAIN = 2.0
"""Microseconds that a matrix must save, since written-out sums read better."""

MATRIX_HELPERS = '''\
def _matrix(shape, *entries):
    """Matrix with the given entries (row, column, value)."""
    matrix = np.zeros(shape)
    for row, column, value in entries:
        matrix[row, column] = value
    return matrix


def _combine(matrix, x):
    """Rows of matrix (m, n) times the rows of x (n, P, r): shape (m, P, r)."""
    return (matrix @ x.reshape(len(x), -1)).reshape(len(matrix), *x.shape[1:])
'''

PRODUCT_HELPERS = '''\
def _contract(x, z, q):
    """Every row of x (a, P, r) times z (P, r, s), into q (a, P, s)."""
    np.matmul(x.transpose(1, 0, 2), z, out=q.transpose(1, 0, 2))


def _expand(x, w, v):
    """Sum over the rows of x (a, P, r) times w (a, P, s), into v (P, r, s)."""
    if len(x) == 1 and v.size > 4000:  # BLAS multiplies two rows several times faster than one
        x, w = x[[0, 0]], 0.5 * w[[0, 0]]
    np.matmul(x.transpose(1, 2, 0), w.transpose(1, 0, 2), out=v)
'''


def kernel_blocks(system: QuadraticSystem) -> list[list[str]]:
    """Source blocks: helpers, the kernels of every group, then the tables that list them.

    Large systems have none.
    """
    if not system.has_kernels:
        return [["SIGNATURES, PAIRED, KERNELS = (), (), {}"]]
    time_factors = [factor_text(factor.expression) for factor in system.factors[0]]
    writers = [KernelWriter(system, group, time_factors) for group in system.groups]
    blocks = [_helpers(writers)]
    listed: dict[str, list[str]] = {kernel: [] for kernel in KERNELS}
    for writer in writers:
        functions = writer.functions()
        matrices = [line for combination in writer.combinations for line in combination.tables()]
        blocks += [matrices, *functions.values()]
        for kernel, names in listed.items():
            names.append(f"{kernel}_{writer.group.index}" if kernel in functions else "None")
    listing = ["KERNELS = {"]
    for kernel in KERNELS:
        listing += tuple_lines(f'"{kernel}": ', listed[kernel], ",", INDENT)
    listing.append("}")
    signatures = table("SIGNATURES", nested(group.signature for group in system.groups))
    paired = table("PAIRED", nested(group.paired for group in system.groups))
    return [*blocks, [*signatures, *paired, *listing]]


def _helpers(writers: Iterable[KernelWriter]) -> list[str]:
    """Functions shared by the kernels, as far as the writers use them."""
    used = []
    if any(combination.uses_matrix for writer in writers for combination in writer.combinations):
        used.append(MATRIX_HELPERS)
    if any(writer.group.quadratic for writer in writers):
        used.append(PRODUCT_HELPERS)
    return "\n\n".join(used).splitlines()


class KernelWriter:
    """Writes the kernels of one group; the time factors, as people write them, are for comments."""

    def __init__(self, system: QuadraticSystem, group: Group, time_factors: Sequence[str]) -> None:
        self.group, self.factor = group, signature_text(system, group.signature)
        self.rates, self.n_time_factors = system.rates, len(time_factors)
        rates, states = system.rates, system.names
        self.monomials = [f"{states[min(pair)]}*{states[max(pair)]}" for pair in group.monomials]
        order = {tuple(sorted(pair)): k for k, pair in enumerate(group.monomials)}
        linear = [
            Entry(term.equation, term.coefficient, term.factors[0], term.monomial[0])
            for term in group.linear
        ]
        quadratic = [
            Entry(term.equation, term.coefficient, term.factors[0], order[term.monomial])
            for term in group.quadratic
        ]
        index = group.index
        self.linear_combination = Combination(
            f"LINEAR_MATRIX_{index}", rates, states, linear, time_factors
        )
        self.quadratic_combination = Combination(
            f"QUADRATIC_MATRIX_{index}", rates, self.monomials, quadratic, time_factors
        )
        self.combinations = self.linear_combination, self.quadratic_combination

    def functions(self) -> dict[str, list[str]]:
        """Source lines of the kernels the group needs, by kernel."""
        terms = self.group.by_degree
        writers = {
            "constant": self.constant,
            "linear": self.linear,
            "linear_adjoint": self.linear_adjoint,
            "quadratic": self.quadratic,
            "quadratic_adjoint": self.quadratic_adjoint,
        }
        needed = (kernel for kernel in KERNELS if terms[kernel.removesuffix("_adjoint")])
        return {kernel: writers[kernel]() for kernel in needed}

    def constant(self) -> list[str]:
        sums: list[list[Addend]] = [[] for _ in range(len(self.rates))]
        for term in self.group.constant:
            factors = (term.factors[0],) if term.factors[0] else ()
            sums[term.equation].append((term.coefficient, factors))
        symbols = [f"phi[{i}]" for i in range(self.n_time_factors)]
        written = share(sums, symbols, Names().numbered("c"))
        lines = self.head("constant", "phi", "Constant terms", len(self.group.constant))
        allocate = "empty" if all(written.sums) else "zeros"
        lines.append(f"    y = np.{allocate}(({len(self.rates)}, phi.shape[1]))")
        for row, terms in enumerate(written.sums):
            if terms:
                lines += assignment(f"y[{row}]", terms, self.rates[row])
        return [*lines, "    return y"]

    def linear(self) -> list[str]:
        return [
            *self.head("linear", "phi, x", "Linear terms", len(self.group.linear)),
            *self.linear_combination.statements("y", "x.shape", "x", final=True),
        ]

    def linear_adjoint(self) -> list[str]:
        return [
            *self.head("linear_adjoint", "phi, w", "Adjoint of the linear terms"),
            *self.linear_combination.statements("v", "w.shape", "w", adjoint=True, final=True),
        ]

    def quadratic(self) -> list[str]:
        n = len(self.monomials)
        shape = f"({len(self.rates)}, *q.shape[1:])"
        return [
            *self.head("quadratic", "phi, x, z", "Quadratic terms", len(self.group.quadratic)),
            f"    # Intermediate terms ({n})",
            f"    q = np.empty(({n}, z.shape[1], z.shape[3]))",
            *self.blocks("_contract(x[{rows}], z[{k}], q[{products}])"),
            "    # Output",
            *self.quadratic_combination.statements("y", shape, "q", final=True),
        ]

    def quadratic_adjoint(self) -> list[str]:
        n, m = len(self.monomials), len(self.group.paired)
        shape = f"({n}, *w.shape[1:])"
        return [
            *self.head("quadratic_adjoint", "phi, x, w", "Adjoint of the quadratic terms"),
            f"    # Intermediate terms ({n})",
            *self.quadratic_combination.statements("q", shape, "w", adjoint=True),
            "    # Output",
            f"    v = np.empty(({m}, *x.shape[1:], w.shape[2]))",
            *self.blocks("_expand(x[{rows}], q[{products}], v[{k}])"),
            "    return v",
        ]

    def head(
        self, kernel: str, arguments: str, summary: str, count: int | None = None
    ) -> list[str]:
        """The first lines of a kernel."""
        summary += f" of group {self.group.index}"
        if any(self.group.signature):
            summary += f", to be multiplied by {self.factor}"
        summary += "." if count is None else f" ({count})."
        return [f"def {kernel}_{self.group.index}({arguments}):", *docstring([summary])]

    def blocks(self, statement: str) -> list[str]:
        """The statement for each paired state with the rows and products it concerns."""
        lines, first = [], 0
        for k, block in enumerate(self.group.blocks):
            last = first + len(block)
            line = statement.format(rows=_selection(block), k=k, products=f"{first}:{last}")
            lines.append(commented(f"    {line}", ", ".join(self.monomials[first:last])))
            first = last
        return lines


def _selection(rows: Sequence[int]) -> str:
    """Index that selects the rows, a slice if they are equally spaced.

    >>> _selection([1, 2]), _selection([0, 3]), _selection([4]), _selection([0, 1, 3])
    ('1:3', '0:4:3', '4:5', '[0, 1, 3]')
    """
    steps = {b - a for a, b in itertools.pairwise(rows)} or {1}
    if len(steps) > 1:
        return repr(list(rows))
    step = steps.pop()
    return f"{rows[0]}:{rows[-1] + 1}" + (f":{step}" if step > 1 else "")


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
        self.name, self.rows, self.columns = name, rows, columns
        self.entries, self.time_factors = entries, time_factors
        self.factors = sorted({entry.factor for entry in entries})
        self.uses_matrix = self._matrix_saves() > MATRIX_GAIN

    def _matrix_saves(self) -> float:
        """Microseconds by which matrix products beat written-out sums, both ways together."""
        written_out = sum(
            OPERATION_COST * sums.operations + STATEMENT_COST * sum(map(bool, sums.sums))
            for sums in (self._sums("x", adjoint=False), self._sums("x", adjoint=True))
        )
        size = len(self.rows) * len(self.columns)
        product = MATRIX_COST + ENTRY_COST * size
        scaled = sum(map(bool, self.factors))
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
