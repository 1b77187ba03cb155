"""Kernels: the separated right-hand side of one group, acting on many columns at once.

A quadratic kernel first multiplies states, one batched matrix product for each paired state;
then every kernel combines rows with the coefficients of the terms.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence

from rankone.codegen.combination import Combination, Entry
from rankone.codegen.header import signature_text
from rankone.codegen.names import Names
from rankone.codegen.sums import Addend, share
from rankone.codegen.text import assignment, commented, docstring
from rankone.ir.forms import Group, QuadraticSystem

__all__ = ["KERNELS", "KernelWriter", "helpers"]

KERNELS = ("constant", "linear", "linear_adjoint", "quadratic", "quadratic_adjoint")

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


def helpers(writers: Iterable[KernelWriter]) -> list[str]:
    """Functions shared by the kernels, as far as the writers use them."""
    used = []
    if any(combination.uses_matrix for writer in writers for combination in writer.combinations):
        used.append(MATRIX_HELPERS)
    if any(writer.group.quadratic for writer in writers):
        used.append(PRODUCT_HELPERS)
    return "\n\n".join(used).splitlines()


class KernelWriter:
    """Writes the kernels of one group.

    ``time_factors`` are written as people write them, for comments.
    """

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
        self.linear_part = Combination(
            f"LINEAR_MATRIX_{index}", rates, states, linear, time_factors
        )
        self.quadratic_part = Combination(
            f"QUADRATIC_MATRIX_{index}", rates, self.monomials, quadratic, time_factors
        )

    @property
    def combinations(self) -> tuple[Combination, Combination]:
        """The linear and the quadratic one."""
        return self.linear_part, self.quadratic_part

    def tables(self) -> list[str]:
        """Coefficient matrices of the kernels."""
        return [line for combination in self.combinations for line in combination.tables()]

    def functions(self) -> dict[str, list[str]]:
        """Source lines of the kernels the group needs, by kernel."""
        terms = self.group.by_degree
        needed = [kernel for kernel in KERNELS if terms[kernel.removesuffix("_adjoint")]]
        return {kernel: getattr(self, kernel)() for kernel in needed}

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
            *self.linear_part.statements("y", "x.shape", "x", final=True),
        ]

    def linear_adjoint(self) -> list[str]:
        return [
            *self.head("linear_adjoint", "phi, w", "Adjoint of the linear terms"),
            *self.linear_part.statements("v", "w.shape", "w", adjoint=True, final=True),
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
            *self.quadratic_part.statements("y", shape, "q", final=True),
        ]

    def quadratic_adjoint(self) -> list[str]:
        n = len(self.monomials)
        m = len(self.group.paired)
        shape = f"({n}, *w.shape[1:])"
        return [
            *self.head("quadratic_adjoint", "phi, x, w", "Adjoint of the quadratic terms"),
            f"    # Intermediate terms ({n})",
            *self.quadratic_part.statements("q", shape, "w", adjoint=True),
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
            line = statement.format(rows=selection(block), k=k, products=f"{first}:{last}")
            lines.append(commented(f"    {line}", ", ".join(self.monomials[first:last])))
            first = last
        return lines


def selection(rows: Sequence[int]) -> str:
    """Index that selects the rows, a slice if they are equally spaced.

    >>> selection([1, 2]), selection([0, 3]), selection([4]), selection([0, 1, 3])
    ('1:3', '0:4:3', '4:5', '[0, 1, 3]')
    """
    steps = {b - a for a, b in itertools.pairwise(rows)} or {1}
    if len(steps) > 1:
        return repr(list(rows))
    step = steps.pop()
    return f"{rows[0]}:{rows[-1] + 1}" + (f":{step}" if step > 1 else "")
