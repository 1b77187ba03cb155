"""Lowering: from the separated form to the quadratic system that is printed.

The right-hand side f of ``u' = f`` is read from the residual. Products of more than two states
become products of two by auxiliary states: with ``w = x*x``, ``x**3`` is ``w*x`` and ``x**4`` is
``w*w``. Terms that share their parameter factors share one contraction, so terms are grouped by
signature; the *paired* states of a group are a smallest set that touches each of its quadratic
monomials (a vertex cover), since every paired state costs a contraction.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from fractions import Fraction

from rankone.compiler.codegen.sums import Pair, extract_pairs
from rankone.problem.expressions.admissible import known_functions
from rankone.problem.forms import Factor, Group, QuadraticSystem, SeparatedForm, State, Term
from rankone.solvers.outcome import Role
from rankone.support.errors import SeparationError, check_kind

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
