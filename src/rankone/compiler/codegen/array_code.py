"""Systems of many states as array code: sparse matrices times products of states.

A line and a name for each state serve a reader, and small arrays, up to some tens of states. Beyond
that the table of terms is the text, and what is computed from it are a few sparse products,
whatever the number of states: linear terms are a matrix times the states, others a matrix times
gathered products. The Jacobian has the entries of its pattern alone.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from fractions import Fraction

from rankone.compiler.codegen.layout import Formula, docstring, literal, nested, table
from rankone.compiler.codegen.rates import SeparatedWriter

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
