"""Newton's matrices of many states against dense ones, and growth rates against eigenvalues."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scipy.linalg
import scipy.sparse

import rankone as ro
from rankone.trajectories.integrators import diagnosis as spectra
from rankone.trajectories.integrators.diagnosis import (
    decays_faster,
    first_jacobian,
    growth_bounds,
    growth_rate,
    jacobian_blocks,
)
from rankone.trajectories.integrators.integrator import Tolerances, jacobians
from rankone.trajectories.stacks.newton import (
    COFACTOR_STATES,
    BandElimination,
    DenseJacobians,
    SmallJacobians,
    SparseElimination,
    SparseJacobians,
    elimination_of,
    entries_at,
    jacobians_for,
    sparse_pattern,
)
from rankone.trajectories.stacks.stack import StackedIntegrator
from rankone.trajectories.system.system import PatternJacobian, System

N, TIME = 80, 0.2


@pytest.fixture(scope="module")
def system() -> System:
    """A reaction, and diffusion on a ring."""
    rhs = {
        f"u{i}": f"D*(u{(i - 1) % N} - 2*u{i} + u{(i + 1) % N}) + u{i}*(1 - k*u{i})"
        for i in range(N)
    }
    initial = {f"u{i}": str(0.5 + 0.3 * np.cos(2 * np.pi * i / N)) for i in range(N)}
    box = {"D": (20.0, 40.0), "k": (0.5, 1.5)}
    return ro.compile(ro.Problem.from_strings(rhs, initial, box, (0, 0.5))).system


@pytest.fixture
def stack() -> tuple[np.ndarray, np.ndarray]:
    """Points (m, d) and states (n, m)."""
    rng = np.random.default_rng(1)
    return np.array([[20.0, 0.5], [30.0, 1.0], [40.0, 1.5]]), rng.random((N, 3))


@pytest.mark.parametrize("shift", [3.5, 2.0 + 1.5j])
def test_sparse_solutions_are_those_of_inverses(system, stack, shift) -> None:
    points, states = stack
    sparse = jacobians_for(system, points)(TIME, states)
    assert isinstance(sparse, SparseJacobians)
    blocks = jacobians(system, points, TIME, states)
    right = np.random.default_rng(2).random(N * 3).astype(type(shift))
    expected = np.stack(
        [
            np.linalg.solve(shift * np.eye(N) - block, vector)
            for block, vector in zip(blocks, right.reshape(N, 3).T, strict=True)
        ],
        axis=1,
    )
    pattern = sparse_pattern(system)
    entries = entries_at(system, pattern, points, TIME, states)
    both = [each.of(pattern) for each in (BandElimination, SparseElimination)]
    chosen = [SparseJacobians(each, entries) for each in both]
    for matrices in (each.newton(shift) for each in (sparse, *chosen, DenseJacobians(blocks))):
        assert matrices.solve(right).reshape(N, 3) == pytest.approx(expected, rel=1e-9)
        for places in ([2, 0], [2, 0, 1], [2, 0, 2, 2, 1]):
            some = matrices.solve_some(np.array(places), right.reshape(N, 3)[:, places])
            assert some == pytest.approx(expected[:, places], rel=1e-9)


@pytest.mark.parametrize("shift", [2.5, 1.5 + 2.0j])
@pytest.mark.parametrize("n", range(1, COFACTOR_STATES + 1))
def test_inverses_of_few_states_are_those_of_numpy(n, shift) -> None:
    generator = np.random.default_rng(n)
    blocks = generator.normal(size=(40, n, n)) * np.geomspace(1e-3, 1e6, 40)[:, None, None]
    matrices = SmallJacobians(blocks).newton(shift)
    right = generator.normal(size=(n, 40))
    expected = np.linalg.solve(shift * np.eye(n) - blocks, right.T[:, :, None])[:, :, 0].T
    assert np.allclose(matrices.solve(right.ravel()).reshape(n, 40), expected, rtol=1e-10, atol=0.0)
    some = matrices.solve_some(np.array([7, 2]), right[:, [7, 2]])
    assert np.allclose(some, expected[:, [7, 2]], rtol=1e-10, atol=0.0)


@pytest.mark.parametrize("of_blocks", [SmallJacobians, DenseJacobians])
def test_pairs_are_real_and_imaginary_parts_of_complex_solutions(of_blocks) -> None:
    generator, shifts = np.random.default_rng(5), [1.5 + 2.0j, 0.5 + 4.0j]
    jacobians, right = of_blocks(generator.normal(size=(40, 3, 3))), generator.random((4, 120))
    solution = jacobians.paired(shifts).solve(right)
    for shift, (a, b), (x, y) in zip(
        shifts, right.reshape(2, 2, -1), solution.reshape(2, 2, -1), strict=True
    ):
        assert np.allclose(x + 1j * y, jacobians.newton(shift).solve(a + 1j * b), rtol=1e-10)


def test_chains_are_bands_and_nets_are_not() -> None:
    chain = np.stack([np.arange(1, N), np.arange(N - 1)])
    shuffled = np.random.default_rng(3).permutation(N)[chain]
    band = elimination_of(PatternJacobian(N, *shuffled, np.zeros))
    assert isinstance(band, BandElimination)
    assert band.lower + band.upper <= 2
    net = np.unique(np.random.default_rng(3).integers(0, 400, (2, 700)), axis=1)
    assert isinstance(elimination_of(PatternJacobian(400, *net, np.zeros)), SparseElimination)


@pytest.mark.parametrize("stages", [3, 5, 7])
def test_more_stages_keep_the_tolerance_in_fewer_steps(stages, monkeypatch) -> None:
    monkeypatch.setattr("rankone.trajectories.stacks.stack.stages_for", lambda *_: stages)
    rates = {"y": "-k*(y - cos(t)) - sin(t)", "z": "-z*z"}
    problem = ro.Problem.from_strings(rates, {"y": 2, "z": 1}, {"k": (1, 1e5)}, (0, 3))
    points, times = np.geomspace(1, 1e5, 9)[:, None], np.linspace(0.01, 3, 40)
    steps = []
    for tolerance in (1e-4, 1e-7):
        tolerances = Tolerances(tolerance, np.full((2, 1), tolerance))
        stacked = StackedIntegrator(stiff=True)
        dense = stacked.run(ro.compile(problem).system, points, (0.0, 3.0), tolerances)
        y, z = dense(times)
        exact = np.cos(times) + np.exp(-points * times)
        assert np.abs(y - exact).max() < 3 * tolerance
        assert np.abs(z - 1 / (1 + times)).max() < 3 * tolerance
        steps.append(dense.steps)
    assert steps[1] < 1.5 * 1e3 ** (1 / (stages + 1)) * steps[0]


def test_growth_and_decay_are_those_of_eigenvalues(system, stack) -> None:
    points, states = stack
    block = first_jacobian(system, points, TIME, states)
    eigenvalues = np.linalg.eigvals(block.toarray()).real
    assert growth_rate(block) == pytest.approx(eigenvalues.max(), rel=0.05)
    fastest = -min(np.linalg.eigvals(b).real.min() for b in jacobians(system, points, TIME, states))
    assert decays_faster(system, points, TIME, states, 0.9 * fastest)
    assert not decays_faster(system, points, TIME, states, 1.1 * fastest)


def test_blocks_of_some_states_are_parts_of_the_jacobian(system, stack) -> None:
    rows = np.array([3, 4, 5, 40])
    expected = jacobians(system, stack[0], TIME, stack[1])[:, rows[:, None], rows]
    assert jacobian_blocks(system, *stack[:1], TIME, stack[1], rows) == pytest.approx(expected)
    bounds = growth_bounds(system, *stack[:1], TIME, stack[1], rows)
    fastest = np.linalg.eigvals(expected).real.max(axis=1)
    assert (fastest <= bounds + 1e-12 * np.abs(bounds)).all()
    diagonal = np.einsum("mii->mi", expected)
    radii = [np.abs(expected).sum(axis=a) - np.abs(diagonal) for a in (1, 2)]
    assert bounds == pytest.approx(np.min([(diagonal + r).max(axis=1) for r in radii], axis=0))


def test_full_jacobians_are_dense(system) -> None:
    rows, columns = np.divmod(np.arange(N * N), N)
    full = PatternJacobian(N, rows, columns, system.jacobian.entries)
    assert sparse_pattern(replace(system, jacobian=full)) is None
    assert sparse_pattern(system) is not None


@pytest.mark.slow
def test_a_stiff_field_is_solved_as_the_exponential_is() -> None:
    n = 70
    rhs = {
        f"u{i}": " + ".join(
            [f"D*u{j}" for j in (i - 1, i + 1) if 0 <= j < n]
            + [f"-2*D*u{i}", "1" if i < 9 else "0"]
        )
        for i in range(n)
    }
    initial = {f"u{i}": str(i % 5) for i in range(n)}
    problem = ro.Problem.from_strings(rhs, initial, {"D": (200.0, 400.0)}, (0, 1))
    solution = ro.solve(problem, rtol=1e-4)
    assert solution.success, solution.message
    diffusion = np.diag(np.full(n, -2.0)) + np.diag(np.ones(n - 1), 1) + np.diag(np.ones(n - 1), -1)
    source, start = np.array([1.0 if i < 9 else 0.0 for i in range(n)]), np.arange(n) % 5
    for conductivity in (217.0, 391.0):
        matrix = conductivity * diffusion
        still = np.linalg.solve(matrix, -source)
        exact = still + scipy.linalg.expm(0.7 * matrix) @ (start - still)
        assert solution(0.7, D=conductivity) == pytest.approx(exact, abs=2e-4 * 4)


def test_what_swings_does_not_grow():
    """The slowest modes of a long row of masses are close together, and Arnoldi stalls."""
    n = 150
    spring = scipy.sparse.diags([-np.ones(n - 1), np.full(n, 2.0), -np.ones(n - 1)], [-1, 0, 1])
    damped = scipy.sparse.bmat([[None, scipy.sparse.eye(n)], [-spring, -0.2 * spring]])
    assert abs(growth_rate(scipy.sparse.csr_array(damped))) < 1e-2


def test_diffusion_and_decay_along_a_chain_need_no_eigenvalue(monkeypatch):
    n = 300
    diffusion = scipy.sparse.diags([1.0, -2.0, 1.0], [-1, 0, 1], shape=(n, n), format="csr")
    chain = scipy.sparse.csr_array(scipy.sparse.diags([2.0, -1.0], [-1, 0], shape=(n, n)))
    assert growth_rate(chain, harmless=0.5) == pytest.approx(-1.0, abs=0.1)  # of some circle > 0.5
    monkeypatch.setattr(spectra, "eigs", None)
    monkeypatch.setattr(np.linalg, "eigvals", None)
    assert growth_rate(scipy.sparse.csr_array(diffusion), harmless=0.0) <= 0.0
    assert growth_rate(chain, harmless=1.0) == 1.0
