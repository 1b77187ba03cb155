"""Rates of many states with laws of a few forms, as array code, constraints, and starts at rest.

Each form is one function of arrays: states, and numbers from a table, are gathered in its slots.
What forms give are symbols like states, and so are sums inside of them; the rates are sums of
products of all of these. Step by step, what a step needs is there before it. The Jacobian follows
by the chain rule, of the slopes of each form in its slots; its pattern is found when the module is
loaded.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby

import sympy as sp

from rankone.compiler.codegen.layout import assignment, docstring, literal, quoted, table, unpacking
from rankone.compiler.codegen.pointwise import Index, PointwiseWriter, Scope
from rankone.compiler.codegen.printer import common_subexpressions
from rankone.compiler.codegen.rates import (
    SUMS,
    GeneralWriter,
    Row,
    helper_blocks,
    long_tables,
    stored_numbers,
    unchanged_states,
)
from rankone.compiler.passes.first_order import FirstOrderSystem, RestForm
from rankone.problem.algebra.term_table import RateForm, TermTable, Value
from rankone.problem.expressions.conditions import Differentiator
from rankone.problem.expressions.notation import plain_text
from rankone.problem.expressions.stable import stable
from rankone.problem.forms import ConstraintForms
from rankone.support.errors import clip

_HELPERS = '''\
def _steps(terms):
    """The matrices of sums inside of forms by the first symbol of a step, and of the rates."""
    sums = {}
    for first, last, form in STEPS:
        if form is None:
            own = [(c, row - first, *of) for c, row, *of in terms if first <= row < last]
            sums[first] = _matrices(own, last - first, N_SYMBOLS)
    rates = [term for term in terms if term[1] < N_DIFFERENTIAL]
    return sums, _matrices(rates, N_DIFFERENTIAL, N_SYMBOLS)


def _chained(terms):
    """The steps to the Jacobian: what follows the symbols, its terms, and the places.

    A step has its first and last row, and a form whose slopes they are, or the terms of sums.
    """
    before, steps, size = [{} for _ in range(N_SYMBOLS)], [], N_SYMBOLS
    by_target = {}
    for coefficient, target, *of in terms:
        by_target.setdefault(target, []).append((coefficient, *of))

    def entries(partials):
        """By target and state the products of partials (coefficient, target, factors, of, by)."""
        listed = {}
        for coefficient, target, factors, of, by in partials:
            for state, slope in before[by].items() if by >= N_DIFFERENTIAL else [(by, None)]:
                product = of if slope is None else (*of, slope)
                listed.setdefault((target, state), []).append((coefficient, factors, product))
        return listed

    def slopes_of(targets):
        for target in targets:
            for coefficient, factors, states in by_target.get(target, ()):
                for k, by in enumerate(states):
                    yield coefficient, target, factors, (*states[:k], *states[k + 1 :]), by

    for first, last, form in STEPS:
        if form is None:
            partials = slopes_of(range(first, last))
        else:
            slots = form[2]
            own = size + np.arange(slots.size).reshape(slots.shape)
            steps.append((size, size + slots.size, form, None))
            size += slots.size
            places = zip(np.tile(range(first, last), len(slots)), own.flat, slots.flat)
            partials = [(1.0, row, (0,), (int(slope),), int(by)) for row, slope, by in places]
        further, rows = [], 0
        for (target, state), products in entries(partials).items():
            (coefficient, factors, product), *others = products
            if coefficient == 1.0 and factors == (0,) and len(product) == 1 and not others:
                before[target][state] = product[0]
                continue
            before[target][state] = size + rows
            further += [(c, rows, *of) for c, *of in products]
            rows += 1
        if further:
            steps.append((size, size + rows, None, further))
            size += rows
    listed = entries(slopes_of(range(N_DIFFERENTIAL)))
    places = {place: k for k, place in enumerate(sorted(listed))}
    last = [(c, places[place], *of) for place, products in listed.items() for c, *of in products]
    for k, (first, end, form, further) in enumerate(steps):
        if further is not None:
            steps[k] = first, end, None, _matrices(further, end - first, size)
    return size, steps, _matrices(last, len(places), size), tuple(places)


def _evaluated(size, t, u, p):
    """Functions (.., m), and an array (size, m) with the states and all symbols after them."""
    functions, x = coefficient_functions(t, p), np.empty((size, t.size))
    x[:N_DIFFERENTIAL] = u
    for first, last, form in STEPS:
        if form is None:
            x[first:last] = _sums(INNER_SUMS[first], last - first, [functions], x[:N_SYMBOLS])
        else:
            function, _, slots, numbers = form
            x[first:last] = function(t, p, x[slots], numbers)
    return [functions], x
'''
_SLOTS = '''\
def _slots(count, text):
    """Rows of symbols, the first ``count`` of each, and numbers, as arrays of (.., rows)."""
    columns = np.array([line.split() for line in text.split("\\n")], dtype=float).T
    return columns[:count].astype(int), columns[count:, :, None]
'''
_RHS = """\
    shape, t, u, p = _columns(t, u, p)
    functions, x = _evaluated(N_SYMBOLS, t, u, p)
    return _sums(RATES, N_DIFFERENTIAL, functions, x).reshape(N_DIFFERENTIAL, *shape)
"""
_ENTRIES = """\
    shape, t, u, p = _columns(t, u, p)
    functions, x = _evaluated(N_SLOPES, t, u, p)
    for first, last, form, sums in SLOPE_STEPS:
        if form is None:
            x[first:last] = _sums(sums, last - first, functions, x)
        else:
            _, slopes, slots, numbers = form
            x[first:last] = slopes(t, p, x[slots], numbers).reshape(last - first, x.shape[1])
    return _sums(SLOPES, len(JACOBIAN_PLACES), functions, x).reshape(-1, *shape)
"""
_LONGEST_FORM = 60  # Characters of a form in the summary of its function
# What an operation, a call and a power but a square cost, in numbers of a sparse matrix
_OPERATION, _CALL, _POWER = 0.6, 9.0, 18.0


@dataclass(frozen=True)
class _Step:
    """Symbols ``first`` to ``last`` that are evaluated together: values of a form, or sums."""

    first: int
    last: int
    form: int | None


class FormWriter(PointwiseWriter):
    """Writes the rates of many states from a table with forms."""

    def __init__(self, system: FirstOrderSystem, terms: TermTable) -> None:
        super().__init__(system.coordinates, system.states)
        self.system, self.table, self.n = system, terms, len(system.states)
        self.levels = _levels(terms, self.n)
        self.steps, self.place = self._ordered()

    def _ordered(self) -> tuple[list[_Step], dict[int, int]]:
        """The steps, and the place of each symbol in their order."""
        forms = {value.symbol: value.form for value in self.table.values}

        def key(symbol: int) -> tuple[int, int, int]:
            return self.levels[symbol], forms.get(symbol, -1), symbol

        further = sorted((s for s in self.levels if s >= self.n), key=key)
        place = {i: i for i in range(self.n)} | {s: self.n + k for k, s in enumerate(further)}
        steps = []
        for (_, form), symbols in groupby(further, key=lambda s: key(s)[:2]):
            first, *others = (place[s] for s in symbols)
            steps.append(_Step(first, first + 1 + len(others), None if form < 0 else form))
        return steps, place

    def tables(self) -> list[str]:
        """Source lines of the terms, and of what stands in the slots of each step."""
        terms: list[Row] = [
            (c, self.place[target], (function,), tuple(sorted(self.place[s] for s in symbols)))
            for c, target, function, symbols in self.table.terms
        ]
        comment = "# coefficient, state or sum, function of time and parameters, what is multiplied"
        lines = [f"N_SYMBOLS = {len(self.place)}  # states, sums inside of forms, values of forms"]
        lines += [*long_tables({"TERMS": (comment, terms)}), "", "", *_SLOTS.splitlines(), "", ""]
        by_symbol = {self.place[value.symbol]: value for value in self.table.values}
        for k, step in enumerate(self.steps):
            if step.form is not None:
                rows = [self._slots(by_symbol[s]) for s in range(step.first, step.last)]
                count = len(self.table.forms[step.form].symbols)
                lines += [
                    f"# symbols and numbers in the slots of form {step.form}",
                    f'SLOTS_{k} = _slots({count}, """\\',
                    *rows,
                ]
                lines[-1] += '""")'
        return lines

    def _slots(self, value: Value) -> str:
        symbols = (str(self.place[s]) for s in value.symbols)
        return " ".join([*symbols, *(literal(float(x)) for x in value.numbers)])

    def functions(self) -> list[list[str]]:
        """Source lines of the forms, ``rhs``, ``jacobian_entries`` and ``with_products``."""
        count = len(self.table.functions)
        summary = f"Functions of time and parameters in front of products: shape ({count}, ...)."
        name = "coefficient_functions"
        functions = self.vector(name, "t, p", summary, self.table.functions)
        forms = [block for k in range(len(self.table.forms)) for block in self._form(k)]
        steps = [
            [str(s.first), str(s.last), "None" if s.form is None else _names(s.form, k)]
            for k, s in enumerate(self.steps)
        ]
        rates, slopes = self._stored()
        of_rates = f"Right-hand side f(t, u, p) at u ({self.n}, ...): shape ({self.n}, ...)."
        of_entries = f"Entries of the Jacobian df/du at u ({self.n}, ...): shape (places, ...)."
        return [
            functions,
            *forms,
            *helper_blocks(SUMS, _HELPERS),
            [
                *table("STEPS", steps),
                "INNER_SUMS, RATES = _steps(TERMS)",
                "N_SLOPES, SLOPE_STEPS, SLOPES, JACOBIAN_PLACES = _chained(TERMS)",
            ],
            ["def rhs(t, u, p):", *docstring([of_rates]), *_RHS.splitlines()],
            [
                "def jacobian_entries(t, u, p):",
                *docstring([of_entries]),
                *_ENTRIES.splitlines(),
                *stored_numbers(rates, slopes),
            ],
            unchanged_states(self.n),
        ]

    def initial(self) -> list[str]:
        """Source lines of a function of all initial values."""
        summary = f"Initial values at p (d, ...): shape ({self.n}, ...)."
        names = [state.name for state in self.states]
        return self.vector("unseparated_initial", "p", summary, self.system.initial, names)

    def _stored(self) -> tuple[int, int]:
        """What the rates and the Jacobian cost for a column, in numbers of a sparse matrix."""
        degrees = [len(symbols) for *_, symbols in self.table.terms]
        rates, slopes = sum(map((1).__add__, degrees)), sum(d * d for d in degrees)
        uses = [0] * len(self.table.forms)
        for value in self.table.values:
            uses[value.form] += 1
        for k, used in enumerate(uses):
            rates += used * self.operations[f"form_{k}"]
            slopes += used * self.operations[f"slopes_of_form_{k}"]
        total = rates + slopes
        for k in range(len(uses)):
            del self.operations[f"form_{k}"], self.operations[f"slopes_of_form_{k}"]
        self.operations |= {"rhs": rates, "jacobian_entries": total}
        return rates, total

    def _form(self, k: int) -> list[list[str]]:
        """Source lines of a form, and of its slopes."""
        form = self.table.forms[k]
        expression = stable(self.real(form.expression))
        slopes = [Differentiator(slot)(expression) for slot in form.symbols]
        self.printed += [expression, *slopes]
        uses = sum(value.form == k for value in self.table.values)
        text = clip(plain_text(form.expression), _LONGEST_FORM)
        summary = f"Values of {text} ({uses}); slots have x (.., rows, m) and c (.., rows, 1)."
        lines, (returned,) = self._computed(summary, f"form_{k}", form, [expression])
        lines.append(f"    return {returned}")
        summary = f"Slopes of form {k} in each symbol: (.., rows, m)."
        of_slopes, texts = self._computed(summary, f"slopes_of_form_{k}", form, slopes)
        of_slopes.append("    out = np.empty(x.shape)")
        for row, text in enumerate(texts):
            of_slopes += assignment(f"out[{row}]", [text])
        return [lines, [*of_slopes, "    return out"]]

    def _computed(
        self, summary: str, name: str, form: RateForm, expressions: Sequence[sp.Expr]
    ) -> tuple[list[str], list[str]]:
        """The first lines of a function of the slots of a form, and texts that they precede."""
        scope = Scope(self.printer, [p.name for p in self.parameters], [])
        numbers = [scope.fresh(c.name) for c in form.numbers]
        states = [scope.fresh(x.name) for x in form.symbols]
        names: dict[sp.Symbol, str] = {self.time: "t"}
        names |= dict(zip(self.parameters, scope.parameters, strict=True))
        names |= dict(zip(form.numbers, numbers, strict=True))
        names |= dict(zip(form.symbols, states, strict=True))
        shared, texts = common_subexpressions(expressions, names, scope.fresh.numbered("a"))
        used = set().union(*(e.free_symbols for e in expressions))
        lines = [f"def {name}(t, p, x, c):", *docstring([summary])]
        # parameters come last: one of them may be called c
        for symbols, source in ((form.numbers, "c"), (form.symbols, "x"), (self.parameters, "p")):
            lines += unpacking([names[s] if s in used else "_" for s in symbols], source)
        for target, text in shared:
            lines += assignment(target, [text])
        self.operations[name] = round(sum(map(_cost, (*(text for _, text in shared), *texts))))
        return lines, texts


def _names(form: int, step: int) -> str:
    """What a step of a form is evaluated with."""
    return f"(form_{form}, slopes_of_form_{form}, *SLOTS_{step})"


def _levels(terms: TermTable, n: int) -> dict[int, int]:
    """How many steps come before each symbol; states have none before them."""
    values = {value.symbol: value.symbols for value in terms.values}
    needed: dict[int, set[int]] = {symbol: {*symbols} for symbol, symbols in values.items()}
    for _, target, _, symbols in terms.terms:
        if target >= n:
            needed.setdefault(target, set()).update(symbols)
    levels = dict.fromkeys(range(n), 0)
    for symbol in sorted(needed):  # each needs smaller ones alone
        levels[symbol] = 1 + max((levels[s] for s in needed[symbol]), default=0)
    return levels


def _cost(text: str) -> float:
    """What a line costs, in numbers of a sparse matrix."""
    operations = sum(text.count(f" {sign} ") for sign in "+-*/")
    calls = text.count("np.") + text.count("special.")
    squares = len(re.findall(r"\*\* ?2(?![\w.])", text))
    powers = text.count("**") - squares
    return _OPERATION * (operations + squares) + _CALL * calls + _POWER * powers


# -----------------------------------------------------------------------------
# Constraints and starts at rest in the generated module.


def constraint_blocks(writer: PointwiseWriter, constraints: ConstraintForms) -> list[list[str]]:
    """Their names, the states that they determine, and two functions; nothing without any."""
    if not constraints.names:
        return []
    k, n = len(constraints.names), len(writer.states)
    expressions = [stable(writer.real(expression)) for expression in constraints.expressions]
    slopes: dict[Index, sp.Expr] = {
        (i, j): slope
        for j, derivative in enumerate(map(Differentiator, writer.states))
        for i, expression in enumerate(expressions)
        if (slope := derivative(expression)) != 0
    }
    names = [state.name for state in writer.states]
    of_slopes = f"Derivatives of constraints by the states u ({n}, ...): ({k}, {n}, ...)."
    guessed = f"GUESSED = {constraints.guessed}  # states that the constraints determine"
    return [
        [
            *table("CONSTRAINTS", [quoted(name) for name in constraints.names]),
            *([guessed] if constraints.guessed else []),
        ],
        writer.vector(
            "constraints",
            "t, u, p",
            f"What vanishes on all trajectories, at u ({n}, ...): ({k}, ...).",
            expressions,
            constraints.names,
        ),
        writer.array(
            "constraint_slopes",
            "t, u, p",
            of_slopes,
            (k, n),
            dict(sorted(slopes.items())),
            lambda i, j: f"{constraints.names[i]}, by {names[j]}",
            "zeros",
        ),
    ]


# -----------------------------------------------------------------------------
# The start at a steady state in the generated module: rates under its conditions.


def rest_blocks(rest: RestForm | None) -> tuple[list[Sequence[str]], Sequence[sp.Expr]]:
    """The functions of the system before the start, and what they print; none without one."""
    if rest is None:
        return [], []
    system = rest.system
    writer, n = GeneralWriter(system), len(system.states)
    names = [state.name for state in system.states]
    after = f"States right after the start from those at rest u ({n}, ...): ({n}, ...)."
    rates, jacobian, _ = writer.functions("rest_")
    blocks: list[Sequence[str]] = [
        [
            f"# {rest.text}",
            "# first look at trajectories that come to rest, and the longest time they may take",
            f"SETTLE = {literal(rest.settle)}",
        ],
        rates,
        jacobian,
        writer.initial("rest_initial"),
        writer.vector("after_rest", "t, u, p", after, rest.after or (), names),
    ]
    return blocks, writer.printed
