"""The slides' matrices, and D and G against the integrals they stand for."""

from __future__ import annotations

import numpy as np
import pytest

import rankone as ro
from rankone.solvers.engines.engine_options import GreedyOptions
from rankone.solvers.engines.greedy_enrichment import Enrichment
from rankone.solvers.engines.greedy_operators import (
    RankOneSum,
    ShapeSpace,
    SourceTerm,
    assemble,
    evaluation_order,
    named_matrices,
    source_terms,
)
from rankone.tensors import LagrangeElements
from tests.problems import REFERENCE


@pytest.fixture(scope="module")
def decay() -> ro.CompiledProblem:
    return ro.compile(REFERENCE["decay"]())


def decay_space(compiled: ro.CompiledProblem, elements: int = 2) -> ShapeSpace:
    time = LagrangeElements(0.0, 2.0, elements, 1)
    return ShapeSpace(compiled.system, time, [LagrangeElements(0.5, 5.0, elements, 1)])


def test_the_matrices_of_the_slides_by_name(decay: ro.CompiledProblem) -> None:
    """Linear elements of length h: P, M and N = int k phi phi^T dk, worked out by hand."""
    matrices = named_matrices(decay.system, decay_space(decay))
    assert list(matrices) == ["P", "M_t", "M_k", "N"]
    p = 0.5 * np.array([[-1, 1, 0], [-1, 0, 1], [0, -1, 1]])
    mass = np.array([[2, 1, 0], [1, 4, 1], [0, 1, 2]]) / 6
    assert matrices["P"] == pytest.approx(p, abs=1e-14)
    assert matrices["M_t"] == pytest.approx(mass)
    assert matrices["M_k"] == pytest.approx(2.25 * mass)
    h, a, b, c = 2.25, 0.5, 2.75, 5.0
    n = np.zeros((3, 3))
    for i, (left, right) in enumerate([(a, b), (b, c)]):
        local = [[3 * left + right, left + right], [left + right, left + 3 * right]]
        n[i : i + 2, i : i + 2] += h / 12 * np.array(local)
    assert matrices["N"] == pytest.approx(n)


def test_the_operator_of_decay_is_that_of_the_slides(decay: ro.CompiledProblem) -> None:
    space = decay_space(decay)
    named = named_matrices(decay.system, space)
    equation = assemble(space, source_terms(decay.system), GreedyOptions.slides())
    total = sum(
        np.kron(equation.matrices[0][i], equation.matrices[1][k])
        for i, k in zip(*equation.index, strict=True)
    )
    inner = slice(1, None)  # the unknown vanishes at the start
    expected = np.kron(named["P"][inner, inner], named["M_k"])
    expected += np.kron(named["M_t"][inner, inner], named["N"])
    assert total == pytest.approx(expected)


@pytest.mark.parametrize("formulation", ["derivative", "volterra"])
@pytest.mark.parametrize("projection", ["galerkin", "minimal-residual"])
@pytest.mark.parametrize("update", ["all", "time", "amplitudes"])
def test_enrichment_finds_the_solution_of_the_full_system(
    decay: ro.CompiledProblem, formulation: str, projection: str, update: str
) -> None:
    space = decay_space(decay, elements=5)
    options = GreedyOptions.slides(
        formulation=formulation, projection=projection, update=update, max_modes=60
    )
    terms = source_terms(decay.system)
    equation = assemble(space, terms, options)
    one = space.constant_in_time(RankOneSum((np.ones((1, 1)), np.ones((6, 1)))))
    source = RankOneSum.joined([space.product(term, [one]) for term in terms], space.counts)
    loads = equation.loads(source)
    result = Enrichment(equation, loads, options).run(1e-9)
    total = sum(
        np.kron(equation.matrices[0][i], equation.matrices[1][k])
        for i, k in zip(*equation.index, strict=True)
    )
    right = (loads.factors[0] @ loads.factors[1].T).ravel()
    exact = np.linalg.solve(np.asarray(total), right).reshape(5, 6)
    found = result.modes.factors[0] @ result.modes.factors[1].T
    assert np.abs(found - exact).max() < 1e-6


def test_terms_that_share_their_parameter_factors_share_one_operator() -> None:
    compiled = ro.compile(REFERENCE["lotka_volterra"]())
    space = ShapeSpace(
        compiled.system,
        LagrangeElements(0.0, 1.0, 1, 4),
        [LagrangeElements(8.0, 12.0, 1, 3), LagrangeElements(4.0, 6.0, 1, 3)],
    )
    own = [t for t in source_terms(compiled.system) if t.own and t.equation == 0]
    assert len(own) == 1
    assert assemble(space, own, GreedyOptions()).terms == 1


def test_states_are_solved_in_the_order_of_their_dependence() -> None:
    def term(equation: int, *monomial: int) -> SourceTerm:
        return SourceTerm(1.0, equation, (0,), monomial)

    chain = [term(0, 1), term(1, 2), term(2, 2), term(3)]
    assert evaluation_order(chain, 4) == ((2,), (3,), (1,), (0,))
    coupled = [term(0, 1, 2), term(1, 0), term(2, 2)]
    assert evaluation_order(coupled, 3) == ((2,), (0, 1))
