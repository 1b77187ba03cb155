"""Pointwise functions: the right-hand side and its Jacobians at given states and parameters.

They are vectorised over points and also serve as right-hand side for an integrator, so they use
few operations: factors and products that occur twice are computed once.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import sympy as sp

from rankone.codegen.lowering import LoweredSystem, state_names
from rankone.codegen.names import Names
from rankone.codegen.printer import common_subexpressions
from rankone.codegen.sums import Product, share
from rankone.codegen.text import assignment, docstring, unpacking
from rankone.ir import SeparatedForm, Term

__all__ = ["PointwiseWriter"]

Index = tuple[int, ...]


class PointwiseWriter:
    """Writes ``rhs``, ``jacobian``, ``with_products`` and ``quadratic_jacobian``.

    Parameters
    ----------
    form : SeparatedForm
        Supplies factors and names.
    f : sequence of Term
        Right-hand sides of the differential states, of any degree.
    lowered : LoweredSystem
        The quadratic system.
    """

    def __init__(self, form: SeparatedForm, f: Sequence[Term], lowered: LoweredSystem) -> None:
        self.form = form
        self.f = f
        self.lowered = lowered
        self.operations: dict[str, int] = {}

    def rhs(self) -> list[str]:
        """Source lines of ``rhs``."""
        n = len(self.form.states)
        entries: dict[Index, list[Term]] = {(c,): [] for c in range(n)}
        for term in self.f:
            entries[(term.equation,)].append(term)
        return [
            "def rhs(t, u, p):",
            *docstring([f"Right-hand side f(t, u, p) at u ({n}, ...): shape ({n}, ...)."]),
            *self.body("rhs", "u", n, f"np.empty(({n}, *shape))", entries),
        ]

    def jacobian(self) -> list[str]:
        """Source lines of ``jacobian``."""
        n = len(self.form.states)
        return [
            "def jacobian(t, u, p):",
            *docstring([f"Jacobian df/du at u ({n}, ...): shape ({n}, {n}, ...)."]),
            *self.body("jacobian", "u", n, f"np.zeros(({n}, {n}, *shape))", derivatives(self.f)),
        ]

    def with_products(self) -> list[str]:
        """Source lines of ``with_products``."""
        n, total = self.lowered.n_differential, self.lowered.n_states
        lines = [
            "def with_products(u):",
            *docstring([f"Append the products: ({n}, ...) to ({total}, ...)."]),
        ]
        if not self.lowered.products:
            return [*lines, "    return np.array(u, dtype=float)"]
        lines += [
            "    u = np.asarray(u, dtype=float)",
            f"    x = np.empty(({total}, *u.shape[1:]))",
            f"    x[:{n}] = u",
        ]
        for k, (a, b) in enumerate(self.lowered.products, start=n):
            lines.append(f"    x[{k}] = x[{a}] * x[{b}]")
        return [*lines, "    return x"]

    def quadratic_jacobian(self) -> list[str]:
        """Source lines of ``quadratic_jacobian``."""
        n = self.lowered.n_states
        entries = derivatives(self.lowered.terms)
        allocation = f"np.zeros(({n}, {n}, *shape))"
        return [
            "def quadratic_jacobian(t, x, p):",
            *docstring(
                [f"Jacobian of the quadratic system at x ({n}, ...): shape ({n}, {n}, ...)."]
            ),
            *self.body("quadratic_jacobian", "x", n, allocation, entries),
        ]

    def body(
        self,
        function: str,
        states: str,
        n_states: int,
        allocation: str,
        entries: dict[Index, list[Term]],
    ) -> list[str]:
        """Statements that compute the entries of an array, from the arguments to the return."""
        names = Names(["np", "t", "u", "x", "shape", "out"])
        coordinates = self.form.coordinates
        parameter_names = [names(coordinate.name) for coordinate in coordinates[1:]]
        names.taken -= {"u", "x"}  # states are unpacked last and may replace the argument
        state_locals = [names(name) for name in state_names(self.form, self.lowered)[:n_states]]

        terms = [term for found in entries.values() for term in found]
        used_factors = sorted({(j, i) for term in terms for j, i in enumerate(term.factors) if i})
        used_states = {state for term in terms for state in term.monomial}
        used_parameters = {j for j, _ in used_factors}
        spelled = ["t", *parameter_names]
        factor_lines, factor_names, count = self.factor_lines(used_factors, spelled, names)

        symbols = [*factor_names, *state_locals]
        position = {key: k for k, key in enumerate(used_factors)}
        sums = [
            [product(term, position, len(factor_names)) for term in found]
            for found in entries.values()
        ]
        written = share(sums, symbols, names.numbered("c"))
        self.operations[function] = written.operations + count

        lines = [shape_line(states, n_states, len(parameter_names))]
        parameters = mask(parameter_names, (j - 1 for j in used_parameters))
        lines += unpacking(parameters, "p")
        lines += unpacking(mask(state_locals, used_states), states)
        n_intermediate = len(factor_lines) + len(written.intermediate)
        if n_intermediate:
            lines.append(f"    # Intermediate terms ({n_intermediate})")
            for name, text in (*factor_lines, *written.intermediate):
                lines += assignment(name, [text])
        if not entries:
            return [*lines, "    # Output", f"    return {allocation}"]
        lines += ["    # Output", f"    out = {allocation}"]
        for index, sum_terms in zip(entries, written.sums, strict=True):
            target = f"out[{', '.join(map(str, index))}]"
            lines += assignment(target, sum_terms or ["0.0"])
        return [*lines, "    return out"]

    def factor_lines(
        self, used: Sequence[tuple[int, int]], spelled: Sequence[str], names: Names
    ) -> tuple[list[tuple[str, str]], list[str], int]:
        """Statements for the factors used, the name of each factor, and operations."""
        lines: list[tuple[str, str]] = []
        factor_names: list[str] = []
        count = 0
        for j, coordinate in enumerate(self.form.coordinates):
            rows = [i for dimension, i in used if dimension == j]
            expressions = [self.form.factors[j][i].expression for i in rows]
            written = {coordinate.symbol: spelled[j]}
            shared, texts = common_subexpressions(
                expressions, written, names.numbered(f"{spelled[j]}_c")
            )
            lines += shared
            for i, expression, text in zip(rows, expressions, texts, strict=True):
                name = text
                if not text.isidentifier():
                    name = names(f"{coordinate.name}_{i}")
                    lines.append((name, text))
                factor_names.append(name)
                count += int(sp.count_ops(expression))
        return lines, factor_names, count


def product(term: Term, position: dict[tuple[int, int], int], n_factors: int) -> Product:
    """A term as a product of the symbols of a pointwise function: factors, then states."""
    factors = (position[j, i] for j, i in enumerate(term.factors) if i)
    return term.coefficient, (*factors, *(n_factors + state for state in term.monomial))


def derivatives(terms: Iterable[Term]) -> dict[Index, list[Term]]:
    """Terms of the Jacobian's nonzero entries, by (row, column) in ascending order."""
    entries: dict[Index, dict[tuple[tuple[int, ...], tuple[int, ...]], float]] = {}
    for term in terms:
        for position, state in enumerate(term.monomial):
            rest = (*term.monomial[:position], *term.monomial[position + 1 :])
            entry = entries.setdefault((term.equation, state), {})
            key = (term.factors, rest)
            entry[key] = entry.get(key, 0.0) + term.coefficient
    return {
        index: [Term(index[0], value, factors, rest) for (factors, rest), value in entry.items()]
        for index, entry in sorted(entries.items())
    }


def shape_line(states: str, n_states: int, n_parameters: int) -> str:
    """The statement for the common shape of all points (np.broadcast takes 64 arguments)."""
    if 1 + n_states + n_parameters <= 64:
        return f"    shape = np.broadcast(t, *{states}, *p).shape"
    return f"    shape = np.broadcast_shapes(np.shape(t), np.shape({states})[1:], np.shape(p)[1:])"


def mask(names: Sequence[str], used: Iterable[int]) -> list[str]:
    """The names with ``_`` for those not used.

    >>> mask(["a", "b"], [1])
    ['_', 'b']
    """
    keep = set(used)
    return [name if k in keep else "_" for k, name in enumerate(names)]
