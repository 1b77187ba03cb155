"""Pointwise functions: the right-hand side and its Jacobians at given states and parameters.

They are vectorised over points and also serve as right-hand side for an integrator, so they use
few operations: factors and products that occur twice are computed once.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from fractions import Fraction

import sympy as sp

from rankone.codegen.names import Names
from rankone.codegen.printer import common_subexpressions
from rankone.codegen.sums import Addend, share
from rankone.codegen.text import assignment, commented, docstring, unpacking
from rankone.ir.forms import QuadraticSystem, Term

__all__ = ["Index", "PointwiseWriter", "mask", "shape_line"]

Index = tuple[int, ...]


class PointwiseWriter:
    """Writes ``rhs``, ``jacobian``, ``with_products`` and ``quadratic_jacobian``."""

    def __init__(self, system: QuadraticSystem) -> None:
        self.system = system
        self.n_differential, self.n_states = len(system.differential), len(system.states)
        self.operations: dict[str, int] = {}

    def functions(self) -> list[list[str]]:
        """Source lines of the four functions."""
        return [self.rhs(), self.jacobian(), self.with_products(), self.quadratic_jacobian()]

    def rhs(self) -> list[str]:
        """Source lines of ``rhs``."""
        n = self.n_differential
        entries: dict[Index, list[Term]] = {(c,): [] for c in range(n)}
        for term in self.system.rhs:
            entries[(term.equation,)].append(term)
        return [
            "def rhs(t, u, p):",
            *docstring([f"Right-hand side f(t, u, p) at u ({n}, ...): shape ({n}, ...)."]),
            *self.body("rhs", "u", n, f"np.empty(({n}, *shape))", entries),
        ]

    def jacobian(self) -> list[str]:
        """Source lines of ``jacobian``."""
        n, entries = self.n_differential, derivatives(self.system.rhs)
        return [
            "def jacobian(t, u, p):",
            *docstring([f"Jacobian df/du at u ({n}, ...): shape ({n}, {n}, ...)."]),
            *self.body("jacobian", "u", n, f"np.zeros(({n}, {n}, *shape))", entries),
        ]

    def with_products(self) -> list[str]:
        """Source lines of ``with_products``."""
        n, total = self.n_differential, self.n_states
        lines = ["def with_products(u):"]
        if not self.system.products:
            lines += docstring([f"All states, ({n}, ...): there are no products to append."])
            return [*lines, "    return np.array(u, dtype=float)"]
        lines += [
            *docstring([f"Append the products: ({n}, ...) to ({total}, ...)."]),
            "    u = np.asarray(u, dtype=float)",
            f"    x = np.empty(({total}, *u.shape[1:]))",
            f"    x[:{n}] = u",
        ]
        pairs = zip(self.system.products, self.system.definitions, strict=True)
        for k, ((a, b), meaning) in enumerate(pairs, start=n):
            lines.append(commented(f"    x[{k}] = x[{a}] * x[{b}]", meaning))
        return [*lines, "    return x"]

    def quadratic_jacobian(self) -> list[str]:
        """Source lines of ``quadratic_jacobian``; without products it is ``jacobian``."""
        if not self.system.products:
            return ["quadratic_jacobian = jacobian"]
        n, entries = self.n_states, derivatives(self.system.terms)
        summary = f"Jacobian of the quadratic system at x ({n}, ...): shape ({n}, {n}, ...)."
        return [
            "def quadratic_jacobian(t, x, p):",
            *docstring([summary]),
            *self.body("quadratic_jacobian", "x", n, f"np.zeros(({n}, {n}, *shape))", entries),
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
        names = Names(["np", "special", "t", "u", "x", "shape", "out"])
        coordinates = self.system.coordinates
        parameter_names = [names(coordinate.name) for coordinate in coordinates[1:]]
        names.taken -= {"u", "x"}  # states are unpacked last and may replace the argument
        state_locals = [names(name) for name in self.system.names[:n_states]]

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
            lines += assignment(target, sum_terms or ["0.0"], self.meaning(index))
        return [*lines, "    return out"]

    def meaning(self, index: Index) -> str:
        """What an entry of the output is: ``x'``, or ``d(x')/dy`` for one of a Jacobian."""
        row, *column = index
        rate = self.system.rates[row]
        if not column:
            return rate
        return f"d({rate})/d{self.system.names[column[0]]}"

    def factor_lines(
        self, used: Sequence[tuple[int, int]], spelled: Sequence[str], names: Names
    ) -> tuple[list[tuple[str, str]], list[str], int]:
        """Statements for the factors used, the name of each factor, and operations."""
        lines: list[tuple[str, str]] = []
        factor_names: list[str] = []
        count = 0
        for j, coordinate in enumerate(self.system.coordinates):
            rows = [i for dimension, i in used if dimension == j]
            expressions = [self.system.factors[j][i].expression for i in rows]
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


def product(term: Term, position: dict[tuple[int, int], int], n_factors: int) -> Addend:
    """A term as a product of the symbols of a pointwise function: factors, then states."""
    factors = (position[j, i] for j, i in enumerate(term.factors) if i)
    return term.coefficient, (*factors, *(n_factors + state for state in term.monomial))


def derivatives(terms: Iterable[Term]) -> dict[Index, list[Term]]:
    """Terms of the Jacobian's nonzero entries, by (row, column) in ascending order."""
    entries: dict[Index, dict[tuple[tuple[int, ...], tuple[int, ...]], Fraction | float]] = {}
    for term in terms:
        for position, state in enumerate(term.monomial):
            rest = (*term.monomial[:position], *term.monomial[position + 1 :])
            entry = entries.setdefault((term.equation, state), {})
            key = (term.factors, rest)
            entry[key] = entry.get(key, Fraction(0)) + term.coefficient
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
