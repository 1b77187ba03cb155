"""Lowering to quadratic, pair extraction and the choice of paired states."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import rankone as ro
from rankone.compiler.codegen.sums import (
    extract_pairs,
    quadratic_system,
    right_hand_side,
    vertex_cover,
)
from rankone.problem.forms import SeparatedForm, Term
from rankone.solvers.outcome import Role
from rankone.support.errors import SeparationError
from tests.compiler.codegen.systems import decay, driven, lotka_volterra, separated

MONOMIALS = st.lists(st.lists(st.integers(0, 3), max_size=6).map(tuple), max_size=8)


def lowered_monomials(*monomials: tuple[int, ...]) -> tuple[list[tuple[int, int]], list[object]]:
    pairs, lowered = extract_pairs(monomials, 2, degree=2)
    return pairs, [*lowered]


@pytest.mark.parametrize(
    ("monomial", "pairs", "lowered"),
    [
        ((0, 0), [], (0, 0)),
        ((0, 0, 0), [(0, 0)], (0, 2)),
        ((0, 0, 0, 0), [(0, 0)], (2, 2)),
        ((0, 0, 0, 0, 0), [(0, 0), (0, 2)], (2, 3)),
        ((0, 0, 1), [(0, 0)], (1, 2)),
    ],
)
def test_powers(
    monomial: tuple[int, ...], pairs: list[tuple[int, int]], lowered: tuple[int, ...]
) -> None:
    assert lowered_monomials(monomial) == (pairs, [lowered])


def test_the_most_frequent_pair_comes_first() -> None:
    pairs, lowered = lowered_monomials((0, 0, 0), (0, 1, 1), (1, 1, 1))
    assert pairs == [(1, 1), (0, 0)]
    assert lowered == [(0, 3), (0, 2), (1, 2)]


@given(monomials=MONOMIALS, degree=st.integers(1, 3), repeats=st.integers(1, 3))
def test_extraction_keeps_the_values(
    monomials: list[tuple[int, ...]], degree: int, repeats: int
) -> None:
    values = [2.0, 3.0, 5.0, 7.0]
    pairs, rewritten = extract_pairs(monomials, 4, degree=degree, repeats=repeats)
    for a, b in pairs:
        values.append(values[a] * values[b])
    for before, after in zip(monomials, rewritten, strict=True):
        assert math.prod(values[a] for a in before) == math.prod(values[a] for a in after)
        if repeats == 1:
            assert len(after) <= max(degree, 1) or len(before) <= degree


def test_products_get_their_rows() -> None:
    form = driven()
    system = quadratic_system(form)
    assert system.products == ((0, 0),)
    assert [state.role for state in system.states] == [*[Role.UNKNOWN] * 2, Role.AUXILIARY]
    assert system.definitions == ("w0 = x*x",)
    one = (0, 0, 0)
    own = [term for term in system.terms if term.equation == 2]
    assert own == [Term(2, -1, one, (2,)), Term(2, 1, one, (0, 0))]


@pytest.mark.parametrize("form", [decay(), lotka_volterra()])
def test_quadratic_systems_stay_as_they_are(form: SeparatedForm) -> None:
    system = quadratic_system(form)
    assert system.products == ()
    assert sorted(system.terms, key=str) == sorted(system.rhs, key=str)


def test_like_terms_merge_and_cancel() -> None:
    form = separated({"x": [(1.0, {}, ["x"]), (2.0, {}, []), (2.0, {}, ["x"]), (-2.0, {}, [])]})
    assert right_hand_side(form) == (Term(0, 3.0, (0,), (0,)),)


def test_a_factor_on_a_derivative_is_an_error() -> None:
    form = decay()
    derivative, *others = form.terms
    scaled = Term(0, 2.0, derivative.factors, derivative.monomial, 1)
    terms = (scaled, *others)
    broken = SeparatedForm(form.coordinates, form.states, form.factors, terms, form.initial)
    with pytest.raises(SeparationError, match=r"equation 1: .*remedy: divide"):
        right_hand_side(broken)


def test_a_missing_derivative_is_an_error() -> None:
    form = decay()
    broken = SeparatedForm(
        form.coordinates, form.states, form.factors, form.terms[1:], form.initial
    )
    with pytest.raises(SeparationError, match="one u' for each state"):
        right_hand_side(broken)


EDGES = st.sets(st.tuples(st.integers(0, 6), st.integers(0, 6)).map(sorted).map(tuple), max_size=12)


@given(edges=EDGES)
def test_vertex_cover_is_smallest(edges: set[tuple[int, int]]) -> None:
    cover = vertex_cover(sorted(edges))
    assert all({a, b} & {*cover} for a, b in edges)
    smaller = itertools.combinations(range(7), max(len(cover) - 1, 0))
    assert not cover or not any(all({a, b} & {*c} for a, b in edges) for c in smaller)


def test_vertex_cover_of_a_large_graph_is_found_within_its_budget() -> None:
    rng = np.random.default_rng(0)
    edges = sorted({tuple(sorted(map(int, pair))) for pair in rng.integers(0, 80, (500, 2))})
    cover = vertex_cover([(a, b) for a, b in edges])
    assert all({a, b} & {*cover} for a, b in edges)
    assert len(cover) < 75


@given(seed=st.integers(0, 10**6), budget=st.integers(1, 60))
def test_every_vertex_of_a_cover_is_needed(seed: int, budget: int) -> None:
    """Also where the budget ends the search, and whatever the order of the edges."""
    rng = np.random.default_rng(seed)
    drawn = rng.integers(0, 60, (rng.integers(1, 120), 2)).tolist()
    edges = sorted({(min(pair), max(pair)) for pair in drawn})
    cover = vertex_cover(edges, budget=budget)
    assert all({a, b} & {*cover} for a, b in edges)
    assert all(any({a, b} & {*cover} == {v} for a, b in edges) for v in cover)
    assert vertex_cover(edges[::-1], budget=budget) == cover


def test_many_products_of_many_states_compile() -> None:
    """The search ends with its budget here, with a vertex that the cover does not need."""
    rng = np.random.default_rng(49)
    pairs = rng.integers(0, 60, (70, 2)).tolist()
    rates = {f"x{i}": f"-k*x{i}" for i in range(60)}
    for number, (a, b) in enumerate(pairs):
        rates[f"x{number % 60}"] += f" + x{a}*x{b}"
    starts = {name: f"{1 + i / 60}" for i, name in enumerate(rates)}
    compiled = ro.compile(ro.Problem.from_strings(rates, starts, {"k": (1, 2)}, (0, 0.1)))
    system, u = compiled.system, np.linspace(-1.0, 1.0, 60)
    exact = -1.5 * u
    for number, (a, b) in enumerate(pairs):
        exact[number % 60] += u[a] * u[b]
    rates_there = system.rhs(0.0, u[:, None], np.array([[1.5]]))[:, 0]
    np.testing.assert_allclose(rates_there, exact, atol=1e-13)
    assert compiled.solve(1e-4).success
