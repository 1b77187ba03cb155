"""The sweeps against dense tensors: every contraction is checked by brute force."""

import numpy as np
import pytest
import sympy as sp

import rankone as ro
from rankone.solvers.engines.train_operators import (
    ParameterOperators,
    SlabJacobian,
    SlabOperator,
    term_groups,
)
from rankone.solvers.engines.train_sweep import Sweeper
from rankone.tensors import ChebyshevBasis, LegendreBasis, RadauCollocation
from rankone.tensors.train import Train

t, p, q, r = sp.symbols("t p q r")
x, y = sp.Function("x")(t), sp.Function("y")(t)


def system(cubic=False):
    """Constant, linear and quadratic terms, several signatures, explicit time."""
    extra = q * x**2 * y if cubic else 0
    problem = ro.Problem(
        [
            sp.Eq(x.diff(t), p * x * y + sp.exp(q) * sp.sin(t) - x + extra),
            sp.Eq(y.diff(t), r * y**2 - p * r * x + q * t + 2 * x * y),
        ],
        (t, 0, 1),
        {p: (0.5, 1.5), q: (-1, 1), r: (1, 2)},
        {x: p, y: q * r},
    )
    return ro.compile(problem).system


def setting(module, kind=ChebyshevBasis, seed=0):
    """A sweeper with random cores and the dense data it stands for."""
    rng = np.random.default_rng(seed)
    bases = tuple(kind(low, high, size) for (low, high), size in zip(module.box, (3, 4, 5)))
    collocation = RadauCollocation.of(4)
    n = len(module.states)
    scale = rng.uniform(0.5, 2.0, n)
    jacobian = SlabJacobian.of(rng.standard_normal((n, n, 4)))
    operator = SlabOperator(module, collocation, 0.3, 0.2, scale, jacobian)
    ranks = (3, 4, 2)

    def cores(first):
        shapes = [(3, 3, 4), (4, 4, 2), (2, 5, 1)]
        return Train((first, *(rng.standard_normal(s) for s in shapes))).right_orthonormal()

    train = cores(rng.standard_normal((n, 4, ranks[0])))
    source = cores(rng.standard_normal((module.n_differential, ranks[0])))
    sweeper = Sweeper(
        operator,
        term_groups(module),
        ParameterOperators(module, bases),
        list(train.cores),
        source,
        100,
    )
    return sweeper, bases


def dense(cores):
    """Full tensor (first..., n1, n2, n3) of a train."""
    full = cores[0]
    for core in cores[1:]:
        full = np.tensordot(full, core, axes=1)
    return full[..., 0]


def fixed_point(module, sweeper, bases, train):
    """E U_s + S (f(U) - A U) on the full grid, by pointwise evaluation of the generated rhs."""
    operator = sweeper.operator
    n, count = operator.shape
    weight = np.ones(())
    for basis in bases:
        weight = np.multiply.outer(weight, np.sqrt(basis.weights))
    units = operator._units[:, None, None, None, None]
    states = dense(train) * units / weight
    grids = np.meshgrid(*(basis.nodes for basis in bases), indexing="ij")
    times = operator.times[:, None, None, None]
    m = module.n_differential
    lifted = np.zeros_like(states)
    jac = module.quadratic_jacobian(times, states, [g[None] for g in grids])
    lifted[:m] = module.rhs(times, states[:m], [g[None] for g in grids]) if n == m else 0.0
    if n > m:  # f is quadratic in the lifted states: f = f(0) + (J(0) + J(x)) x / 2
        zero = np.zeros_like(states)
        at_zero = module.quadratic_jacobian(times, zero, [g[None] for g in grids])
        shape = (n, n, *states.shape[1:])
        mean = 0.5 * (np.broadcast_to(jac, shape) + np.broadcast_to(at_zero, shape))
        lifted = np.einsum("ab...,b...->a...", mean, states)
        lifted[:m] += module.rhs(times, zero[:m], [g[None] for g in grids])
    f = lifted * weight / units
    jacobian, collocation = operator.jacobian.dense(), operator.collocation
    rest = f - np.einsum("kab,bkxyz->akxyz", jacobian, dense(train))
    mass = np.where(np.arange(n) < m, 1.0 / operator.length, 0.0)
    matrix = np.einsum("ab,kl->akbl", np.diag(mass), collocation.derivative)
    matrix -= np.einsum("kab,kl->akbl", jacobian, np.eye(count))
    source = np.zeros((n, *states.shape[2:]))
    source[:m] = dense(sweeper.source.cores)
    rest += np.einsum("a,k,axyz->akxyz", mass, collocation.start, source) / np.sqrt(count)
    right = rest.reshape(n * count, -1)
    return np.linalg.solve(matrix.reshape(n * count, -1), right).reshape(states.shape)


def frames(cores, b):
    """Orthonormal frames to the left of core b and to the right of core b + 1, as matrices."""
    left = np.ones((1, 1))
    for core in cores[:b]:
        flat = core.reshape(-1, core.shape[-1]) if core is cores[0] else core
        left = flat if core is cores[0] else np.tensordot(left, flat, axes=1)
        left = left.reshape(-1, left.shape[-1])
    right = np.ones((1, 1))
    for core in reversed(cores[b + 2 :]):
        right = np.tensordot(core, right, axes=1)
        right = right.reshape(core.shape[0], -1)
    return left, right


@pytest.mark.parametrize("kind", [ChebyshevBasis, LegendreBasis])
@pytest.mark.parametrize("cubic", [False, True], ids=["quadratic", "lowered cubic"])
def test_every_pair_is_the_projection_of_the_fixed_point(kind, cubic):
    module = system(cubic)
    sweeper, bases = setting(module, kind)
    for b in range(sweeper.dimensions):
        train = [core.copy() for core in sweeper.cores]
        full = fixed_point(module, sweeper, bases, train)
        left, right = frames(train, b)
        if b == 0:
            left = np.eye(1)
        projected = left.T @ full.reshape(left.shape[0], -1)
        projected = projected.reshape(-1, right.shape[1]) @ right.T
        new, present = sweeper._pair_block(b)
        np.testing.assert_allclose(new.ravel(), projected.ravel(), atol=1e-10)
        value = left.T @ dense(train).reshape(left.shape[0], -1)
        value = value.reshape(-1, right.shape[1]) @ right.T
        np.testing.assert_allclose(present.ravel(), value.ravel(), atol=1e-10)
        if b < sweeper.dimensions - 1:
            sweeper._shift_right(b, 1e-15)
            sweeper._contract_left(b + 1)


def test_first_core_alone_is_the_projection_on_the_parameter_frame():
    module = system()
    sweeper, bases = setting(module)
    full = fixed_point(module, sweeper, bases, sweeper.cores)
    _, right = frames(sweeper.cores, -1)
    projected = full.reshape(*full.shape[:2], -1) @ right.T
    block = sweeper._first_block(sweeper.cores[0], 1)
    np.testing.assert_allclose(block, projected, atol=1e-10)


def test_the_centre_moves_without_a_change_of_the_train():
    sweeper, _ = setting(system())
    before = dense(sweeper.cores)
    sweeper._shift_right(0, 1e-15)
    np.testing.assert_allclose(dense(sweeper.cores), before, atol=1e-12)
    first = sweeper.cores[0].reshape(-1, sweeper.cores[0].shape[-1])
    np.testing.assert_allclose(first.T @ first, np.eye(first.shape[1]), atol=1e-12)


def test_a_sweep_leaves_right_orthonormal_cores_and_reports_spectra():
    sweeper, bases = setting(system())
    _, spectra = sweeper.iterate(1e-10)
    for core in sweeper.cores[1:]:
        flat = core.reshape(core.shape[0], -1)
        np.testing.assert_allclose(flat @ flat.T, np.eye(core.shape[0]), atol=1e-10)
    norm = np.linalg.norm(sweeper.cores[0])
    for spectrum, basis in zip(spectra, bases):
        assert spectrum.shape == (basis.size,)
    assert np.linalg.norm(spectra[0]) == pytest.approx(norm, rel=1e-8)
