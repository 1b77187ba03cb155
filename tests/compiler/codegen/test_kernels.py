"""Generated kernels against brute force, and against their adjoints."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rankone.compiler.codegen.layout import load_module
from rankone.compiler.codegen.module import generate_source
from rankone.compiler.codegen.sums import quadratic_system
from rankone.problem.forms import SeparatedForm, Term
from rankone.support.arrays import Array
from rankone.trajectories.system.system import System
from tests.compiler.codegen.interpreter import Interpreter
from tests.compiler.codegen.strategies import forms
from tests.compiler.codegen.systems import kirchhoff

P, R, S = 3, 4, 2


def load(form: SeparatedForm) -> System:
    return load_module(generate_source(form), "generated")


def check_kernels_sum_to_f(form: SeparatedForm, seed: int) -> None:
    """The contract's formula at single points: no knowledge of lowering or grouping."""
    system, oracle = load(form), Interpreter(form)
    rng = np.random.default_rng(seed)
    n, d = system.n_differential, len(system.parameters)
    t, u, p = rng.uniform(0.1, 1, P), rng.uniform(-1.5, 1.5, (n, P)), rng.uniform(0.5, 2, (d, P))
    phi, x = system.time_factors(t), system.with_products(u)[:, :, None]
    total = np.zeros((len(system.states), P))
    for g, signature in enumerate(system.kernels.signatures):
        scale = np.ones(P)
        for j, row in enumerate(signature):
            scale = scale * system.parameter_factors(j, p[j])[row]
        if constant := system.kernels.constant[g]:
            total += scale * constant(phi)
        if linear := system.kernels.linear[g]:
            total += scale * linear(phi, x)[:, :, 0]
        if quadratic := system.kernels.quadratic[g]:
            z = x[list(system.kernels.paired[g])][:, :, :, None]
            total += scale * quadratic(phi, x, z)[:, :, 0]
    expected = np.zeros_like(total)  # the rows of the products vanish: s_a s_b - w = 0
    expected[:n] = oracle.rhs(t, u, p)
    np.testing.assert_allclose(total, expected, 1e-10, 1e-11)


@pytest.mark.slow
@given(form=forms(), seed=st.integers(0, 2**32 - 1))
@settings(max_examples=40)
def test_kernels_sum_to_the_right_hand_side(form: SeparatedForm, seed: int) -> None:
    check_kernels_sum_to_f(form, seed)


@given(form=forms(max_states=6, max_terms=20), seed=st.integers(0, 2**32 - 1))
@settings(max_examples=10)
def test_kernels_of_many_terms_sum_to_the_right_hand_side(form: SeparatedForm, seed: int) -> None:
    """Enough terms for coefficient matrices instead of written-out sums."""
    check_kernels_sum_to_f(form, seed)


def brute_force(term: Term, phi: Array, x: Array, z: Array, paired: tuple[int, ...]) -> Array:
    """One quadratic term, as the table of the contract has it."""
    a, b = term.monomial if term.monomial[1] in paired else term.monomial[::-1]
    contracted: Array = np.einsum("pr,prs->ps", x[a], z[paired.index(b)])
    scale: Array = float(term.coefficient) * phi[term.factors[0]]
    return scale[:, None] * contracted


@given(form=forms(), seed=st.integers(0, 2**32 - 1))
@settings(max_examples=25)
def test_quadratic_kernels_contract_paired_states(form: SeparatedForm, seed: int) -> None:
    """z of the form x_b e, with e shared by all: either state of a monomial may be the paired."""
    system = load(form)
    groups = quadratic_system(form).groups
    rng = np.random.default_rng(seed)
    phi = system.time_factors(rng.uniform(0, 1, P))
    x = rng.normal(size=(len(system.states), P, R))
    e = rng.normal(size=(P, R, S))
    for group in groups:
        if quadratic := system.kernels.quadratic[group.index]:
            paired = system.kernels.paired[group.index]
            z = x[list(paired)][..., None] * e
            expected = np.zeros((len(x), P, S))
            for term in group.quadratic:
                expected[term.equation] += brute_force(term, phi, x, z, paired)
            np.testing.assert_allclose(quadratic(phi, x, z), expected, 1e-10, 1e-11)


@pytest.mark.slow
@given(form=forms(max_states=5, max_terms=8), seed=st.integers(0, 2**32 - 1))
@settings(max_examples=25)
def test_adjoints(form: SeparatedForm, seed: int) -> None:
    """<w, linear(x)> = <linear_adjoint(w), x>, <w, quadratic(x, z)> = <v, z>."""
    system = load(form)
    check_adjoints(system, seed, R, S)


def test_adjoints_of_large_arrays() -> None:
    """Sizes at which kernels use other routines."""
    check_adjoints(load(kirchhoff()), 0, 30, 20)


def check_adjoints(system: System, seed: int, r: int, s: int) -> None:
    rng = np.random.default_rng(seed)
    n = len(system.states)
    phi = system.time_factors(rng.uniform(0, 1, 12))
    x, w = rng.normal(size=(n, 12, r)), rng.normal(size=(n, 12, s))
    for g, paired in enumerate(system.kernels.paired):
        linear, adjoint = system.kernels.linear[g], system.kernels.linear_adjoint[g]
        assert (linear is None) == (adjoint is None)
        if linear and adjoint:
            y = rng.normal(size=x.shape)
            left, right = np.vdot(y, linear(phi, x)), np.vdot(adjoint(phi, y), x)
            np.testing.assert_allclose(left, right, 1e-9, 1e-9)
        quadratic, adjoint = system.kernels.quadratic[g], system.kernels.quadratic_adjoint[g]
        assert (quadratic is None) == (adjoint is None) == (not paired)
        if quadratic and adjoint:
            z = rng.normal(size=(len(paired), 12, r, s))
            left, right = np.vdot(w, quadratic(phi, x, z)), np.vdot(adjoint(phi, x, w), z)
            np.testing.assert_allclose(left, right, 1e-9, 1e-9)


def test_kirchhoff_pairs_four_of_six_states() -> None:
    assert load(kirchhoff()).kernels.paired == ((0, 1, 3, 4),)
    assert "QUADRATIC_MATRIX_0" in generate_source(kirchhoff())
