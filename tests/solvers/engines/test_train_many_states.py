"""Systems of many states: sparse factors of slabs, kernels from the table of terms."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.integrate

import rankone as ro
from rankone.compiler import stages
from rankone.problem import forms
from rankone.solvers.engines import train_operators as inverse
from rankone.solvers.engines.train_operators import (
    CONSTANT,
    LINEAR,
    DenseInverse,
    SchurInverse,
    SlabJacobian,
    SparseInverse,
    inverse_of,
    term_groups,
)
from rankone.support.arrays import Array
from rankone.tensors import RadauCollocation
from rankone.trajectories.system.system import Kernels


def test_sparse_factors_invert_the_same_matrix() -> None:
    rng = np.random.default_rng(1)
    n, nodes = 7, RadauCollocation.of(5)
    dense = rng.standard_normal((n, n, 5)) * (rng.random((n, n, 1)) < 0.4)
    dense[range(n), range(n)] -= 3.0
    mass = np.array([4.0] * 5 + [0.0] * 2)  # two auxiliary states
    jacobian = SlabJacobian.of(dense)
    assert jacobian.rows.size < n * n
    np.testing.assert_array_equal(jacobian.dense(), np.moveaxis(dense, 2, 0))
    one = DenseInverse(jacobian, mass, nodes)
    other = SparseInverse(jacobian, mass, nodes)
    x = rng.standard_normal((n * 5, 3))
    for name in ("jacobian", "solve", "adjoint"):
        np.testing.assert_allclose(getattr(other, name)(x), getattr(one, name)(x), atol=1e-12)
    rates = np.einsum("kl,ilm->ikm", nodes.derivative, other.solve(x).reshape(n, 5, 3))
    back = (mass[:, None, None] * rates).reshape(x.shape) - other.jacobian(other.solve(x))
    np.testing.assert_allclose(back, x, atol=1e-11)


@pytest.mark.parametrize("count", [1, 2, 7, 12])
def test_the_schur_form_solves_with_the_same_matrix(count: int) -> None:
    rng = np.random.default_rng(2)
    n, nodes = 9, RadauCollocation.of(count)
    same = rng.standard_normal((n, n)) * (rng.random((n, n)) < 0.4)
    same[range(n), range(n)] -= 3.0
    mass = np.array([4.0] * 7 + [0.0] * 2)  # two auxiliary states
    jacobian = SlabJacobian.of(np.repeat(same[:, :, None], count, axis=2))
    assert jacobian.change == 0.0
    one = DenseInverse(jacobian, mass, nodes)
    other = SchurInverse(jacobian, mass, nodes)
    x = rng.standard_normal((n * count, 3))
    for name in ("jacobian", "solve", "adjoint"):
        expected = getattr(one, name)(x)
        size = np.abs(expected).max()
        np.testing.assert_allclose(getattr(other, name)(x), expected, atol=1e-12 * size)


def test_a_jacobian_that_changes_much_over_a_slab_is_kept_at_all_nodes() -> None:
    n, nodes = 700, RadauCollocation.of(3)
    rows, mass = np.arange(n), np.full(n, 2.0)

    def kind(change: float) -> type:
        entries = -1.0 + change * np.linspace(-1.0, 1.0, 3) * np.ones((n, 1))
        return type(inverse_of(SlabJacobian(n, rows, rows, entries), mass, nodes))

    assert kind(0.1) is SchurInverse
    assert kind(100.0) is SparseInverse


def exchange(n: int) -> ro.Problem:
    """A chain with an inflow that depends on time, and reactions of neighbours and of like."""
    rhs = {"x0": "k*(sin(t)**2 + 1/2) - c*x0*x1 - x0"}
    for i in range(1, n):
        rhs[f"x{i}"] = f"k*x{i - 1} - x{i} - c*x{i}*x{(i + 1) % n} - t*x{i}**2/3 + c*t/9"
    initial = dict.fromkeys(rhs, 0.5)
    return ro.Problem.from_strings(rhs, initial, {"k": (1, 1.5), "c": (0.5, 1)}, (0, 1))


def test_kernels_from_terms_equal_the_generated_ones() -> None:
    system = ro.compile(exchange(9)).system
    generated = {group.key: group for group in term_groups(system)}
    without = replace(system, kernels=Kernels())
    tabulated = {group.key: group for group in term_groups(without)}
    assert generated.keys() == tabulated.keys()
    assert {degree for degree, _ in generated} == {0, 1, 2}
    rng = np.random.default_rng(2)
    phi = system.time_factors(np.linspace(0, 1, 4))
    x, w = rng.random((9, 4, 3)), rng.random((9, 4, 2))
    env = rng.random((3, 3, 2))
    env += env.swapaxes(0, 1)
    for key, group in generated.items():
        other = tabulated[key]
        if group.degree == CONSTANT:
            pairs = [(group.kernel(phi), other.kernel(phi))]
        elif group.degree == LINEAR:
            pairs = [(one.kernel(phi, x), one.adjoint(phi, w)) for one in (group, other)]
            pairs = list(zip(*pairs, strict=True))
        else:
            forward, backward = [], []
            for one in (group, other):
                paired = x[one.paired]
                forward.append(one.kernel(phi, x, np.einsum("mpr,rqs->mpqs", paired, env)))
                form = np.einsum("mpr,mpqs->rqs", paired, one.adjoint(phi, x, w))
                backward.append(form + form.swapaxes(0, 1))
            pairs = [tuple(forward), tuple(backward)]
        for expected, actual in pairs:
            np.testing.assert_allclose(actual, expected, rtol=1e-12)


def from_trajectories(problem: ro.CompiledProblem, point: list[float], time: float) -> Array:
    """States at a time by SciPy."""
    system, p = problem.system, np.array(point)[:, None]
    return scipy.integrate.solve_ivp(
        lambda t, u: system.rhs(t, u[:, None], p)[:, 0],
        (0, time),
        system.initial(p)[:, 0],
        rtol=1e-8,
        atol=1e-10,
    ).y[:, -1]


@pytest.fixture
def low_limits(monkeypatch: pytest.MonkeyPatch) -> None:
    """Four states count as many, and no slab has a dense inverse."""
    monkeypatch.setattr(forms, "MOST_KERNEL_STATES", 4)
    monkeypatch.setattr(stages, "MOST_KERNEL_STATES", 4)
    monkeypatch.setattr(inverse, "MOST_DENSE", 0)


@pytest.mark.usefixtures("low_limits")
def test_sweeps_with_sparse_factors_and_kernels_from_terms() -> None:
    problem = ro.compile(exchange(9))
    assert not problem.system.kernels.signatures
    solution = problem.solve(1e-5, method="train")
    assert solution.success
    expected = from_trajectories(problem, [1.4, 0.6], 1.0)
    np.testing.assert_allclose(solution(1.0, {"k": 1.4, "c": 0.6}), expected, rtol=2e-5)


@pytest.mark.slow
def test_a_system_of_more_than_two_hundred_states_is_solved() -> None:
    problem = ro.compile(exchange(210))
    solution = problem.solve(1e-4, method="train")
    assert solution.success
    expected = from_trajectories(problem, [1.4, 0.6], 0.9)
    np.testing.assert_allclose(solution(0.9, {"k": 1.4, "c": 0.6}), expected, rtol=2e-4)


@pytest.mark.usefixtures("low_limits")
def test_what_is_refused_above_the_limit() -> None:
    quadratic = ro.compile(exchange(5))
    assert quadratic.methods["train"] is None
    assert quadratic.methods["greedy"] is not None
    assert quadratic.automatic == ("cross",)
    with pytest.raises(ro.OptionError, match="5 states, and it takes at most 4"):
        quadratic.solve(method="greedy")
    for rate, reason in {
        "k*x0*x1*x{}": "above 4 no term may multiply three states",
        "k*x0*x1*x{}/(1 + x0)": "too many for terms that multiply three of them",  # lifted
    }.items():
        rhs = {f"x{i}": f"-{rate.format(i)}" for i in range(5)}
        cubic = ro.Problem.from_strings(rhs, dict.fromkeys(rhs, 1), {"k": (1, 2)}, (0, 1))
        with pytest.raises(ro.OptionError, match=reason):
            ro.solve(cubic, method="train")
