"""From the separated form to sums of products, and their text."""

from __future__ import annotations

import heapq
import re
from collections import Counter, defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction

import sympy as sp

from rankone.compiler.codegen.layout import Names, assignment, docstring, literal, table
from rankone.compiler.codegen.printer import common_subexpressions, factor_text
from rankone.problem.expressions.admissible import known_functions
from rankone.problem.forms import (
    Coordinate,
    Factor,
    Group,
    QuadraticSystem,
    SeparatedForm,
    State,
    Term,
)
from rankone.solvers.outcome import Role
from rankone.support.errors import SeparationError, check_kind
from rankone.support.files import WIDTH

_LEAST_STATES = 16  # Shorter sums are evaluated term by term

Sums = dict[sp.Dummy, dict[sp.Symbol, float]]
"""For the symbol of each sum its states, and the numbers before them."""


def long_sums(
    expressions: Sequence[sp.Expr], states: Collection[sp.Symbol]
) -> tuple[list[sp.Expr], Sums]:
    """Expressions with symbols for sums of many states, and what these symbols stand for."""
    sums: Sums = {}
    shorter: dict[sp.Expr, sp.Expr] = {}
    for expression in expressions:
        walk = sp.preorder_traversal(expression)
        for node in walk:
            if not isinstance(node, sp.Add) or len(node.args) < _LEAST_STATES:
                continue
            if node not in shorter:
                weights, others = _weights(node, states)
                if len(weights) < _LEAST_STATES:
                    continue
                symbol = sp.Dummy(f"sum{len(sums)}")
                sums[symbol], shorter[node] = weights, sp.Add(symbol, *others)
            walk.skip()
    return [expression.xreplace(shorter) for expression in expressions], sums


def _weights(
    terms: sp.Add, states: Collection[sp.Symbol]
) -> tuple[dict[sp.Symbol, float], list[sp.Expr]]:
    """The numbers before states in a sum, and its other terms."""
    weights: dict[sp.Symbol, float] = {}
    others: list[sp.Expr] = []
    for term in terms.args:
        weight, rest = term.as_coeff_Mul()
        if rest in states:
            weights[rest] = float(weight)
        else:
            others.append(term)
    return weights, others


# -----------------------------------------------------------------------------
# Factor functions: all known functions of one coordinate, evaluated together.


_SHARED_ARGUMENT = "p"  # Name of the parameter in a function that serves several parameters


def coordinate_functions(
    coordinates: Sequence[Coordinate], expressions: Sequence[Sequence[sp.Expr]]
) -> list[list[str]]:
    """``time_factors``, the functions of the parameters and ``parameter_factors``.

    The expressions are those of each coordinate in turn; the first of each is one.
    Parameters whose factors are the same but for the name share one function.
    """
    clock, *parameters = coordinates
    names = Names(["np", "special", "out"])
    identifiers = [names(parameter.name) for parameter in parameters]
    shared = sp.Symbol(_SHARED_ARGUMENT)
    renamed = [
        tuple(factor.xreplace({c.symbol: shared}) for factor in factors)
        for c, factors in zip(parameters, expressions[1:], strict=True)
    ]
    blocks = [_factor_function("time_factors", "t", clock.symbol, expressions[0], clock.name)]
    functions: dict[tuple[sp.Expr, ...], str] = {}
    for j, factors in enumerate(renamed):
        if factors in functions:
            continue
        users = [i for i, candidate in enumerate(renamed) if candidate == factors]
        title = ", ".join(parameters[i].name for i in users)
        name = f"factors_of_{identifiers[j]}"
        if len(users) == 1:
            arguments = identifiers[j], parameters[j].symbol, expressions[j + 1]
        else:
            name += f"_and_{len(users) - 1}_more"
            arguments = _SHARED_ARGUMENT, shared, factors
        functions[factors] = name
        blocks.append(_factor_function(name, *arguments, title))
    listed = [functions[factors] for factors in renamed]
    alike = len(listed) > 1 and len(functions) == 1
    repeated = [f"PARAMETER_FACTORS = ({listed[0]},) * {len(listed)}"] if alike else []
    blocks.append(
        [
            *(repeated or table("PARAMETER_FACTORS", listed)),
            "",
            "",
            "def parameter_factors(dimension, p):",
            *docstring(["Factors of one parameter at the points p (N,): shape (number, N)."]),
            "    return PARAMETER_FACTORS[dimension](p)",
        ]
    )
    return blocks


def _factor_function(
    name: str, argument: str, symbol: sp.Symbol, expressions: Sequence[sp.Expr], title: str
) -> list[str]:
    """A function that evaluates all factors of a coordinate, called ``title``."""
    names = Names(["np", "special", "out", argument])
    shared, texts = common_subexpressions(expressions, {symbol: argument}, names.numbered("c"))
    summary = f"Factors of {title}: {', '.join(map(factor_text, expressions))}."
    if len(summary) > WIDTH - 10:
        summary = f"Factors of {title} ({len(expressions)})."
    if len(summary) > WIDTH - 10:
        summary = f"Factors of several parameters ({len(expressions)})."
    lines = [f"def {name}({argument}):", *docstring([summary])]
    for target, text in shared:
        lines += assignment(target, [text])
    lines.append(f"    out = np.empty(({len(expressions)}, {argument}.size))")
    for row, text in enumerate(texts):
        lines += assignment(f"out[{row}]", ["1.0" if text == "1" else text])
    return [*lines, "    return out"]


# -----------------------------------------------------------------------------
# Sums of products with few operations: shared pairs computed once, common factors taken out.
#
# Symbols are numbered by the caller, who says how each is written. The sums become text for
# :func:`rankone.compiler.codegen.layout.assignment`, with a count of its operations.


Addend = tuple[Fraction | float, tuple[int, ...]]
"""A coefficient and the symbols multiplied."""

# A quotient that is a number only where it stands first or in parentheses
_FRACTION = re.compile(r"^\d+ / \d+")

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
        if any(len(chunk) > WIDTH - 20 for chunk in chunks):
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


# -----------------------------------------------------------------------------
# Lowering: from the separated form to the quadratic system that is printed.
#
# The right-hand side f of ``u' = f`` is read from the residual. Products of more than two states
# become products of two by auxiliary states: with ``w = x*x``, ``x**3`` is ``w*x`` and ``x**4`` is
# ``w*w``. Terms that share their parameter factors share one contraction, so terms are grouped by
# signature; the *paired* states of a group are a smallest set that touches each of its quadratic
# monomials (a vertex cover), since every paired state costs a contraction.


_MOST_SEARCHED = 300  # Vertices of a graph whose smallest cover is searched for


def quadratic_system(form: SeparatedForm) -> QuadraticSystem:
    """Lower and group a separated form.

    Known functions of one parameter in jumps join the factors: they are to be resolved as well.

    Raises
    ------
    SeparationError
        If its rates have general terms, or its derivative terms are anything but one ``u'`` for
        each state.
    OptionError
        If it is not a separated form.
    """
    remedy = "give separate(problem); what is compiled has `.separated`"
    check_kind("quadratic_system", form, SeparatedForm, remedy=remedy)
    form.require_separated_rates()
    f = right_hand_side(form)
    products, terms = lower(f, len(form.states))
    return QuadraticSystem(
        coordinates=form.coordinates,
        states=(*form.states, *_auxiliary_states(form.states, products)),
        factors=_with_jumps(form),
        rhs=f,
        products=products,
        groups=_grouped(terms),
        initial=form.initial,
        coupled=tuple(form.general),
        jumps=form.jumps,
    )


def _with_jumps(form: SeparatedForm) -> tuple[tuple[Factor, ...], ...]:
    """The factors, and after them the functions of one parameter in values after jumps."""
    in_jumps = known_functions(form.coordinates, (v for jump in form.jumps for v in jump.values))
    extended = [form.factors[0]]
    for j, (factors, functions) in enumerate(zip(form.factors[1:], in_jumps[1:], strict=True), 1):
        expressions = {factor.expression for factor in factors}
        extended.append((*factors, *(Factor(j, f) for f in functions if f not in expressions)))
    return tuple(extended)


def right_hand_side(form: SeparatedForm) -> tuple[Term, ...]:
    """Terms of f in ``u' = f``, like terms merged, in the order of the form.

    A SeparationError if the derivative terms of the form are not one ``u'`` for each state.
    """
    merged: dict[tuple[int, tuple[int, ...], tuple[int, ...]], Fraction | float] = {}
    derivatives = []
    for term in form.terms:
        if term.derivative:
            derivatives.append((term.derivative, term.equation, term.monomial))
            if term.coefficient != 1.0 or any(term.factors):
                raise SeparationError(
                    f"the derivative of {form.states[term.equation].name} has a factor",
                    equation=term.equation + 1,
                    term=term,
                    remedy="divide the equation by the factor of the derivative",
                )
        else:
            key = (term.equation, term.factors, tuple(sorted(term.monomial)))
            merged[key] = merged.get(key, Fraction(0)) - term.coefficient
    if sorted(derivatives) != [(1, c, (c,)) for c in range(len(form.states))]:
        raise SeparationError(
            "the derivative terms are not one u' for each state",
            remedy="solve the equations for the derivatives",
        )
    return tuple(
        Term(c, coefficient, factors, monomial)
        for (c, factors, monomial), coefficient in merged.items()
        if coefficient
    )


def lower(f: Sequence[Term], n_states: int) -> tuple[tuple[Pair, ...], tuple[Term, ...]]:
    """Rewrite the right-hand side of ``u' = f`` with products of at most two states.

    Auxiliary state ``n_states + k`` is the product of the k-th pair of states. The terms are those
    of f, of degree at most two, then ``s_a s_b - w`` of every product.
    """
    high = list(dict.fromkeys(term.monomial for term in f if len(term.monomial) > 2))
    products, lowered = extract_pairs(high, n_states, degree=2)
    rewritten = dict(zip(high, lowered, strict=True))
    terms = [
        replace(term, monomial=rewritten[term.monomial]) if term.monomial in rewritten else term
        for term in f
    ]
    for k, pair in enumerate(products, start=n_states):
        one = (0,) * len(f[0].factors)
        terms += [Term(k, Fraction(1), one, pair), Term(k, Fraction(-1), one, (k,))]
    return tuple(products), tuple(terms)


def _auxiliary_states(states: Sequence[State], products: Sequence[Pair]) -> tuple[State, ...]:
    """The products as states, with names that no other state has: ``w0``, ``w1``, ..."""
    prefix = "w"
    while any(s.name.startswith(prefix) and s.name[len(prefix) :].isdigit() for s in states):
        prefix += "_"
    extended = list(states)
    for k, (a, b) in enumerate(products):
        expression = extended[a].expression * extended[b].expression
        extended.append(State(f"{prefix}{k}", expression, Role.AUXILIARY))
    return tuple(extended[len(states) :])


def _grouped(terms: Iterable[Term]) -> tuple[Group, ...]:
    """Collect terms by signature; groups in ascending order of their signatures."""
    collected: dict[tuple[int, ...], tuple[list[Term], list[Term], list[Term]]] = {}
    for term in terms:
        by_degree = collected.setdefault(term.factors[1:], ([], [], []))
        by_degree[len(term.monomial)].append(term)
    groups = []
    for index, (signature, by_degree) in enumerate(sorted(collected.items())):
        constant, linear, quadratic = map(tuple, by_degree)
        edges = sorted({(a, b) for a, b in (term.monomial for term in quadratic)})
        paired = vertex_cover(edges)
        blocks: dict[int, list[int]] = {b: [] for b in paired}
        for a, b in edges:
            first, second = (a, b) if b in blocks else (b, a)
            blocks[second].append(first)
        ascending = tuple(tuple(sorted(blocks[b])) for b in paired)
        groups.append(Group(index, signature, constant, linear, quadratic, paired, ascending))
    return tuple(groups)


def vertex_cover(edges: Sequence[Pair], *, budget: int = 500) -> tuple[int, ...]:
    """Smallest set of vertices that touches every edge, in ascending order.

    Branch and bound on the vertex of largest degree: either it is in the cover, or all its
    neighbours are. The first descent is the greedy cover. After ``budget`` branches the search
    keeps the best cover so far, without the vertices that it does not need; in large graphs there
    is no search. So every vertex of the
    cover has an edge that no other one touches.
    """
    loops = {a for a, b in edges if a == b}
    neighbours: dict[int, set[int]] = {}
    for a, b in edges:
        if not loops & {a, b}:
            neighbours.setdefault(a, set()).add(b)
            neighbours.setdefault(b, set()).add(a)
    best = set(neighbours)
    branches = 0

    def search(graph: dict[int, set[int]], cover: set[int]) -> None:
        nonlocal best, branches
        branches += 1
        if not graph:
            best = min(best, cover, key=len)
            return
        largest = min(graph, key=lambda v: (-len(graph[v]), v))
        edges_left = sum(map(len, graph.values())) / 2
        if len(cover) + edges_left / len(graph[largest]) > len(best) - 1:
            return
        for chosen in ({largest}, graph[largest]):
            if chosen is graph[largest] and branches > budget:
                return
            untouched = {v: near - chosen for v, near in graph.items() if v not in chosen}
            search({v: near for v, near in untouched.items() if near}, cover | chosen)

    if len(neighbours) <= _MOST_SEARCHED:
        search(neighbours, set())
    return tuple(sorted(loops | _irredundant(best, neighbours)))


def _irredundant(cover: set[int], neighbours: Mapping[int, set[int]]) -> set[int]:
    """A vertex cover without the vertices whose neighbours all stay in it; small degrees first."""
    needed = set(cover)
    for v in sorted(cover, key=lambda v: (len(neighbours[v]), v)):
        if neighbours[v] <= needed:
            needed.remove(v)
    return needed
