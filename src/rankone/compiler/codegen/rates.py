"""Right-hand sides and their Jacobians: a line for each state, or sparse matrices for many."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from fractions import Fraction
from typing import Literal

import sympy as sp
from sympy.core.function import AppliedUndef

from rankone.compiler.codegen.layout import Formula, commented, docstring, literal, nested, table
from rankone.compiler.codegen.pointwise import (
    Entry,
    Index,
    PointwiseWriter,
    Printer,
    Scope,
    Shared,
    Statements,
)
from rankone.compiler.codegen.printer import numpy_text
from rankone.compiler.codegen.sums import Addend, share
from rankone.compiler.passes.first_order import FirstOrderSystem
from rankone.compiler.passes.well_posed import NamedExpression
from rankone.problem.expressions.conditions import Differentiator
from rankone.problem.expressions.stable import stable
from rankone.problem.forms import QuadraticSystem, Term
from rankone.support.arrays import MANY_STATES
from rankone.support.errors import ProblemError, SeparationError


class SeparatedWriter(PointwiseWriter):
    """Writes the rates of a system that separates, as sums of its terms."""

    def __init__(self, system: QuadraticSystem, printer: Printer | None = None) -> None:
        super().__init__(system.coordinates, system.differential, printer)
        self.system = system

    def functions(self) -> list[list[str]]:
        """Source lines of ``rhs``, the Jacobians and ``with_products``."""
        n, total = len(self.system.differential), len(self.system.states)
        blocks = [
            self.rhs(n),
            self.jacobian("jacobian", "t, u, p", self.system.rhs, n),
            self.with_products(),
        ]
        if self.system.products:
            lowered = self.system.terms
            blocks.append(self.jacobian("quadratic_jacobian", "t, x, p", lowered, total))
        return blocks

    def rhs(self, n: int) -> list[str]:
        """Source lines of ``rhs``."""
        rates: dict[Index, list[Term]] = {(c,): [] for c in range(n)}
        for term in self.system.rhs:
            rates[(term.equation,)].append(term)
        summary = f"Right-hand side f(t, u, p) at u ({n}, ...): shape ({n}, ...)."
        return self.sums("rhs", "t, u, p", summary, (n,), rates, "empty")

    def jacobian(self, name: str, arguments: str, terms: Iterable[Term], n: int) -> list[str]:
        """Source lines of the Jacobian of some terms."""
        lowered = name == "quadratic_jacobian"
        title = "Jacobian of the quadratic system at x" if lowered else "Jacobian df/du at u"
        summary = f"{title} ({n}, ...): shape ({n}, {n}, ...)."
        return self.sums(name, arguments, summary, (n, n), _derivatives(terms), "zeros")

    def with_products(self) -> list[str]:
        """Source lines of ``with_products``."""
        n, total = len(self.system.differential), len(self.system.states)
        if not self.system.products:
            return unchanged_states(n)
        lines = [
            "def with_products(u):",
            *docstring([f"Append the products: ({n}, ...) to ({total}, ...)."]),
            "    u = np.asarray(u, dtype=float)",
            f"    x = np.empty(({total}, *u.shape[1:]))",
            f"    x[:{n}] = u",
        ]
        pairs = zip(self.system.products, self.system.definitions, strict=True)
        for k, ((a, b), meaning) in enumerate(pairs, start=n):
            lines.append(commented(f"    x[{k}] = x[{a}] * x[{b}]", meaning))
        return [*lines, "    return x"]

    def initial(self) -> list[str]:
        """Source lines of ``unseparated_initial``; none if all initial values separate."""
        if not self.system.coupled:
            return []
        n = len(self.states)
        sums: dict[Index, sp.Expr] = {}
        for term in self.system.coupled:
            row = (term.equation,)
            sums[row] = sums.get(row, sp.S.Zero) + self.real(term.expression)
        summary = f"What of the initial values couples parameters, at p (d, ...): ({n}, ...)."
        name = "unseparated_initial"
        return self.array(name, "p", summary, (n,), sums, self.state_name, "zeros")

    def sums(
        self,
        name: str,
        arguments: str,
        summary: str,
        shape: Index,
        entries: Mapping[Index, Sequence[Term]],
        start: Literal["empty", "zeros"],
    ) -> list[str]:
        """Source lines of a function with sums of separated terms as entries of its value.

        They are of the system's own states, or of all of them with the products.
        """
        names = self.system.names[: shape[0]]
        scope = Scope(self.printer, [p.name for p in self.parameters], names)
        terms = [term for listed in entries.values() for term in listed]
        rows = sorted({(j, i) for term in terms for j, i in enumerate(term.factors) if i})
        lines, factor_names, count = self._factors(rows, scope)
        column = {row: k for k, row in enumerate(rows)}
        sums: list[list[Addend]] = [
            [_product(term, column) for term in listed] for listed in entries.values()
        ]
        written = share(sums, [*factor_names, *scope.states], scope.fresh.numbered("c"))
        self.operations[name] = written.operations + count
        scope.used_parameters |= {j - 1 for j, _ in rows}
        scope.used_states |= {state for term in terms for state in term.monomial}
        statements = Statements(
            [*lines, *written.intermediate],
            [
                Entry(index, chunks or ["0.0"], self._meaning(*index))
                for index, chunks in zip(entries, written.sums, strict=True)
            ],
        )
        return self.written(scope, name, arguments, summary, shape, start, [statements])

    def _meaning(self, row: int, *column: int) -> str:
        """What an entry is: ``x'``, or ``d(x')/dy`` for one of a Jacobian."""
        rate = self.system.rates[row]
        return f"d({rate})/d{self.system.names[column[0]]}" if column else rate

    def _factors(
        self, rows: Sequence[tuple[int, int]], scope: Scope
    ) -> tuple[Shared, list[str], int]:
        """Statements for factors, the name of each factor, and operations."""
        lines: Shared = []
        names: list[str] = []
        count = 0
        local_names = ["t", *scope.parameters]
        pairs = zip(self.system.coordinates, local_names, strict=True)
        for j, (coordinate, local) in enumerate(pairs):
            indices = [i for dimension, i in rows if dimension == j]
            expressions = [self.system.factors[j][i].expression for i in indices]
            shared, texts = self.printer.expressions(
                expressions, {coordinate.symbol: local}, scope.fresh.numbered(f"{local}_c")
            )
            lines += shared
            for i, expression, text in zip(indices, expressions, texts, strict=True):
                name = text
                if not text.isidentifier():
                    name = scope.fresh(f"{coordinate.name}_{i}")
                    lines.append((name, text))
                names.append(name)
                count += int(sp.count_ops(expression))
        return lines, names, count


class GeneralWriter(PointwiseWriter):
    """Writes the rates of a system that does not separate, as they are.

    A ProblemError if a function cannot be written with NumPy or SciPy.
    """

    def __init__(self, system: FirstOrderSystem, printer: Printer | None = None) -> None:
        super().__init__(system.coordinates, system.states, printer)
        self.system = system
        self.rates = [self._checked(f, name, origin) for name, origin, f in self.named_rates()]
        self.starts = [
            self._checked(start, f"the initial value of {self.state_name(i)}", None)
            for i, start in enumerate(system.initial)
        ]

    def named_rates(self) -> list[NamedExpression]:
        """The rates with what they are and the numbers of the user's equations."""
        pairs = zip(self.system.origins, self.system.rhs, strict=True)
        return [(f"{self.state_name(i)}'", origin, f) for i, (origin, f) in enumerate(pairs)]

    def _checked(self, expression: sp.Expr, name: str, origin: int | None) -> sp.Expr:
        """The expression in real symbols; an error that says where, if it cannot be written."""
        for applied in sorted(expression.atoms(AppliedUndef), key=sp.default_sort_key):
            if applied not in self._real:
                raise ProblemError(f"{applied} in {name} is unknown", equation=origin, term=applied)
        real = stable(self.real(expression))
        try:
            numpy_text(real, {})
        except SeparationError as error:
            raise ProblemError(
                f"{name}: {error.message} or SciPy",
                equation=origin,
                term=error.term,
                remedy="rewrite it with functions they have, or give it with its derivative: "
                "rankone.function(name, value, derivative)",
            ) from None
        return real

    def functions(self, prefix: str = "") -> list[list[str]]:
        """Source lines of ``rhs`` and ``jacobian``, with a prefix, and ``with_products``."""
        n = len(self.states)
        rates: dict[Index, sp.Expr] = {(i,): f for i, f in enumerate(self.rates)}
        of_rates = f"Right-hand side f(t, u, p) at u ({n}, ...): shape ({n}, ...)."
        of_jacobian = f"Jacobian df/du at u ({n}, ...): shape ({n}, {n}, ...)."
        slopes = self._slopes()
        right_hand_side = f"{prefix}rhs", "t, u, p", of_rates, (n,), rates, self._meaning
        if n >= MANY_STATES and not prefix:
            entries = self._jacobian_entries(slopes)
            return [self.array(*right_hand_side), *entries, unchanged_states(n)]
        return [
            self.array(*right_hand_side),
            self.array(
                f"{prefix}jacobian", "t, u, p", of_jacobian, (n, n), slopes, self._meaning, "zeros"
            ),
            unchanged_states(n),
        ]

    def _jacobian_entries(self, slopes: Mapping[Index, sp.Expr]) -> list[list[str]]:
        """Source lines of the places of the Jacobian that are not zero, and of what is there."""
        n, places = len(self.states), list(slopes)
        entries: dict[Index, sp.Expr] = {(k,): slope for k, slope in enumerate(slopes.values())}
        summary = f"Entries of the Jacobian df/du at u ({n}, ...): shape (places, ...)."

        def meaning(k: int) -> str:
            return self._meaning(*places[k])

        written = "jacobian_entries", "t, u, p", summary, (len(places),), entries, meaning
        return [table("JACOBIAN_PLACES", nested(places)), self.array(*written)]

    def _slopes(self) -> dict[Index, sp.Expr]:
        """The entries of the Jacobian that are not zero."""
        slopes: dict[Index, sp.Expr] = {}
        rows = {symbol: j for j, symbol in enumerate(self.states)}
        derivatives = [Differentiator(symbol) for symbol in self.states]
        for i, (rate, origin) in enumerate(zip(self.rates, self.system.origins, strict=True)):
            for j in sorted(rows[symbol] for symbol in rate.free_symbols & rows.keys()):
                try:
                    slope = derivatives[j](rate)
                except ProblemError as error:
                    raise ProblemError(
                        error.message, equation=origin, term=error.term, remedy=error.remedy
                    ) from None
                if slope != 0:
                    slopes[(i, j)] = slope
        return slopes

    def initial(self, name: str = "unseparated_initial") -> list[str]:
        """Source lines of a function of all initial values."""
        starts: dict[Index, sp.Expr] = {(i,): start for i, start in enumerate(self.starts)}
        n = len(self.states)
        summary = f"Initial values at p (d, ...): shape ({n}, ...)."
        return self.array(name, "p", summary, (n,), starts, self.state_name)

    def _meaning(self, row: int, *column: int) -> str:
        """What an entry of the rates, or of their Jacobian, means."""
        rate = f"{self.state_name(row)}'"
        return f"d({rate})/d{self.state_name(column[0])}" if column else rate


def unchanged_states(n: int) -> list[str]:
    """Source lines of ``with_products`` where there are none."""
    return [
        "def with_products(u):",
        *docstring([f"All states, ({n}, ...): there are no products to append."]),
        "    return np.array(u, dtype=float)",
    ]


def _product(term: Term, column: Mapping[tuple[int, int], int]) -> Addend:
    """A term as a product of the symbols of a function: factors, then states."""
    factors = (column[j, i] for j, i in enumerate(term.factors) if i)
    return term.coefficient, (*factors, *(len(column) + state for state in term.monomial))


def _derivatives(terms: Iterable[Term]) -> dict[Index, list[Term]]:
    """Terms of the Jacobian's nonzero entries, by (row, column) in ascending order."""
    sums: dict[Index, dict[tuple[tuple[int, ...], tuple[int, ...]], Fraction | float]] = {}
    for term in terms:
        for position, state in enumerate(term.monomial):
            cofactor = (*term.monomial[:position], *term.monomial[position + 1 :])
            like_terms = sums.setdefault((term.equation, state), {})
            key = (term.factors, cofactor)
            like_terms[key] = like_terms.get(key, Fraction(0)) + term.coefficient
    return {
        index: [Term(index[0], size, factors, m) for (factors, m), size in like_terms.items()]
        for index, like_terms in sorted(sums.items())
    }


# -----------------------------------------------------------------------------
# Systems of many states as array code: sparse matrices times products of states.
#
# A line and a name for each state serve a reader, and small arrays, up to some tens of states.
# Beyond that the table of terms is the text, and what is computed from it are a few sparse
# products, whatever the number of states: linear terms are a matrix times the states, others a
# matrix times gathered products. The Jacobian has the entries of its pattern alone.


SUMS = '''\
def _matrices(terms, rows, columns):
    """Sums of terms (coefficient, row, factors, states), by factors and degree.

    Of each: the factors, the states multiplied (degree, products), and the matrix (rows, products).
    """
    groups = {}
    for coefficient, row, factors, states in terms:
        products, entries = groups.setdefault((factors, len(states)), ({}, []))
        entries.append((coefficient, row, products.setdefault(states, len(products))))
    sums = []
    for (factors, degree), (products, entries) in groups.items():
        coefficients, to, of = zip(*entries)
        states = np.array(list(products), dtype=int).T
        matrix = sparse.csr_array((coefficients, (to, of)), shape=(rows, len(products)))
        if degree == 1:  # of all states, so that none are gathered
            entries = coefficients, (to, states[0, list(of)])
            matrix = sparse.csr_array(entries, shape=(rows, columns))
        sums.append((factors, states, matrix))
    return sums


def _columns(t, u, p):
    """The shape of t (...), u (n, ...) and p (d, ...) together, and these as columns."""
    p = np.asarray(p, dtype=float)
    shape = np.broadcast_shapes(np.shape(t), np.shape(u)[1:], p.shape[1:])
    u = np.broadcast_to(u, (N_DIFFERENTIAL, *shape)).reshape(N_DIFFERENTIAL, -1)
    t, *p = (np.broadcast_to(x, shape).ravel() for x in (t, *p))
    return shape, t, u, p


def _sums(sums, rows, functions, x):
    """The sums of states x (n, m) and of functions, an array (.., m) for each factor: (rows, m)."""
    out = np.zeros((rows, x.shape[1]))
    for factors, states, matrix in sums:
        part = matrix @ (x if len(states) == 1 else np.prod(x[states], axis=0))
        for function, row in zip(functions, factors):
            if row:
                part *= function[row]
        out += part
    return out
'''
_POLYNOMIALS = '''\
def _rates(sums, rows, t, u, p):
    """The sums at t (...), u (n, ...) and p (d, ...): shape (rows, ...)."""
    shape, t, u, p = _columns(t, u, p)
    functions = [time_factors(t), *(parameter_factors(j, x) for j, x in enumerate(p))]
    return _sums(sums, rows, functions, u).reshape(rows, *shape)


def _derivatives(terms):
    """Terms of the entries of df/du that are not zero, and their rows and columns."""
    entries = []
    for coefficient, row, factors, states in terms:
        for k, column in enumerate(states):
            others = (*states[:k], *states[k + 1 :])
            entries.append((coefficient, (row, column), factors, others))
    places = {place: k for k, place in enumerate(sorted({place for _, place, _, _ in entries}))}
    terms = [(c, places[place], factors, others) for c, place, factors, others in entries]
    return terms, tuple(places)


def _in_steps(products):
    """Products (a, b) of two states by steps: rows, and the states that were there before."""
    steps, levels = {}, {}
    for row, (a, b) in enumerate(products, N_DIFFERENTIAL):
        levels[row] = level = 1 + max(levels.get(a, 0), levels.get(b, 0))
        steps.setdefault(level, []).append((row, a, b))
    return [np.array(steps[level]).T for level in sorted(steps)]


RATES = _matrices(TERMS, N_DIFFERENTIAL, N_DIFFERENTIAL)
SLOPE_TERMS, JACOBIAN_PLACES = _derivatives(TERMS)
SLOPES = _matrices(SLOPE_TERMS, len(JACOBIAN_PLACES), N_DIFFERENTIAL)
PRODUCT_STEPS = _in_steps(PRODUCTS)
'''


_READER = '''\
def _table(text):
    """Rows of a coefficient, a state and lists of numbers; a list of none is a dash."""
    rows = []
    for line in text.split("\\n"):
        coefficient, state, *lists = line.split()
        above, *below = coefficient.split("/")
        value = int(above) / int(*below) if below else float(above)
        lists = (() if x == "-" else tuple(map(int, x.split(","))) for x in lists)
        rows.append((value, int(state), *lists))
    return tuple(rows)
'''
Row = tuple[Fraction | float | Formula, int, *tuple[tuple[int, ...], ...]]
"""Coefficient, state, and lists of numbers."""


def long_tables(tables: Mapping[str, tuple[str, Sequence[Row]]]) -> list[str]:
    """Tables of terms, each with a comment, as texts: Python takes long to compile long tuples.

    Rows with formulas are tuples.
    """
    lines = ["", "", *_READER.splitlines(), "", ""]
    for name, (comment, rows) in tables.items():
        lines.append(comment)
        written: dict[object, str] = {}
        if not rows or any(isinstance(coefficient, Formula) for coefficient, *_ in rows):
            lines += table(name, nested(rows))
            continue
        for coefficient, *_ in rows:
            if coefficient not in written:
                written[coefficient] = literal(coefficient).replace(" / ", "/")
        texts = (_line(written[c], state, lists) for c, state, *lists in rows)
        lines += [f'{name} = _table("""\\', *texts]
        lines[-1] += '""")'
    return lines


def helper_blocks(*texts: str) -> list[list[str]]:
    """Source lines of helpers, one block a function."""
    return [block.splitlines() for text in texts for block in text.split("\n\n\n")]


def stored_numbers(rates: float, slopes: float) -> list[str]:
    """Source lines that say how much the matrices of the rates and their slopes store."""
    return [
        "",
        "",
        "# Numbers that a column of their arrays takes",
        f"rhs.stored, jacobian_entries.stored = {rates}, {slopes}",
    ]


def _line(coefficient: str, state: int, lists: Iterable[tuple[int, ...]]) -> str:
    return " ".join([coefficient, str(state), *(",".join(map(str, x)) or "-" for x in lists)])


class ArrayWriter(SeparatedWriter):
    """Writes the rates of a system of many states that separates, from its table of terms."""

    def with_products(self) -> list[str]:
        """Source lines of ``with_products``."""
        n, total = len(self.system.differential), len(self.system.states)
        if not self.system.products:
            return super().with_products()
        return [
            "def with_products(u):",
            *docstring([f"Append the products: ({n}, ...) to ({total}, ...)."]),
            "    u = np.asarray(u, dtype=float)",
            f"    x = np.empty(({total}, *u.shape[1:]))",
            f"    x[:{n}] = u",
            "    for rows, first, second in PRODUCT_STEPS:",
            "        x[rows] = x[first] * x[second]",
            "    return x",
        ]

    def functions(self) -> list[list[str]]:
        """Source lines of the matrices, ``rhs``, ``jacobian_entries`` and ``with_products``."""
        n, terms = len(self.system.differential), self.system.rhs
        self.operations["rhs"] = sum(1 + len(term.monomial) for term in terms)
        slopes = sum(len(term.monomial) ** 2 for term in terms)
        self.operations["jacobian_entries"] = slopes
        of_entries = f"Entries of the Jacobian df/du at u ({n}, ...): shape (places, ...)."
        return [
            *helper_blocks(SUMS, _POLYNOMIALS),
            [
                "def rhs(t, u, p):",
                *docstring([f"Right-hand side f(t, u, p) at u ({n}, ...): shape ({n}, ...)."]),
                "    return _rates(RATES, N_DIFFERENTIAL, t, u, p)",
            ],
            [
                "def jacobian_entries(t, u, p):",
                *docstring([of_entries]),
                "    return _rates(SLOPES, len(JACOBIAN_PLACES), t, u, p)",
                *stored_numbers(self.operations["rhs"], slopes),
            ],
            self.with_products(),
        ]
