"""Systems of many states as array code, against rates written by hand."""

from __future__ import annotations

import numpy as np
import pytest

import rankone as ro
from rankone.support.arrays import MANY_STATES, Array
from rankone.trajectories.system.system import System, pattern_of

N = MANY_STATES
BOX = {"k": (0.5, 2.0), "c": (0.1, 0.3)}


def rates(t: float, u: Array, k: Array, c: Array) -> Array:
    steps = np.arange(len(u)).reshape(-1, *[1] * (u.ndim - 1))
    ahead, second = np.roll(u, -1, axis=0), np.roll(u, -2, axis=0)
    return k**2 * ahead - 3 * u * second + c * np.cos(t) * u**3 + steps + 0.5 * k


@pytest.fixture(scope="module")
def system() -> System:
    """A ring with constant, linear, quadratic and cubic terms, driven in time."""
    rhs = {
        f"x{i}": f"k**2*x{(i + 1) % N} - 3*x{i}*x{(i + 2) % N} + c*cos(t)*x{i}**3 + {i} + 0.5*k"
        for i in range(N)
    }
    initial = {f"x{i}": f"{i + 1}/100 + k" for i in range(N)}
    return ro.compile(ro.Problem.from_strings(rhs, initial, BOX, (0, 2))).system


@pytest.mark.parametrize("shape", [(), (5,), (2, 3)])
def test_rates_are_those_written(system: System, shape: tuple[int, ...]) -> None:
    rng = np.random.default_rng(4)
    u, p, t = rng.random((N, *shape)), 0.5 + rng.random((2, *shape)), rng.random(shape)
    assert system.rhs(t, u, p) == pytest.approx(rates(t, u, *p), rel=1e-13)
    assert system.rhs(0.3, u, p) == pytest.approx(rates(0.3, u, *p), rel=1e-13)


def test_rates_broadcast_states_and_parameters(system: System) -> None:
    rng = np.random.default_rng(5)
    u, p = rng.random((N, 1, 4)), 0.5 + rng.random((2, 3, 1))
    assert system.rhs(0.3, u, p) == pytest.approx(rates(0.3, u, *p), rel=1e-13)


def test_jacobian_has_the_pattern_and_the_slopes(system: System) -> None:
    rng = np.random.default_rng(6)
    u, (k, c) = rng.random(N), (0.7, 0.2)
    expected = np.zeros((N, N))
    for i in range(N):
        expected[i, (i + 1) % N] = k**2
        expected[i, i] = -3 * u[(i + 2) % N] + 3 * c * np.cos(0.4) * u[i] ** 2
        expected[i, (i + 2) % N] = -3 * u[i]
    pattern = pattern_of(system.jacobian)
    assert pattern is not None
    assert {*zip(pattern.rows, pattern.columns, strict=True)} == {*zip(*expected.nonzero())}
    assert system.jacobian(0.4, u, [k, c]) == pytest.approx(expected, rel=1e-13, abs=1e-15)


def test_rates_that_do_not_separate_have_a_pattern_too() -> None:
    rhs = {f"x{i}": f"-k*x{i}/(1 + x{(i + 1) % N})" for i in range(N)}
    system = ro.compile(ro.Problem.from_strings(rhs, dict.fromkeys(rhs, "c"), BOX, (0, 1))).system
    u, k = np.random.default_rng(7).random(N), 0.7
    ahead = 1 + np.roll(u, -1)
    expected = np.diag(-k / ahead)
    expected[np.arange(N), (np.arange(N) + 1) % N] = k * u / ahead**2
    assert system.jacobian(0.0, u, [k, 0.2]) == pytest.approx(expected, rel=1e-13)
    assert pattern_of(system.jacobian) is not None


def test_products_of_products_follow_those_they_are_made_of() -> None:
    """Fifth powers take two products each; no line of the module is about a single one."""
    rates = {f"x{i}": f"-k*x{i}**5 + c*x{(i + 1) % N}*x{i}" for i in range(N)}
    problem = ro.Problem.from_strings(rates, dict.fromkeys(rates, "1"), BOX, (0, 1))
    compiled = ro.compile(problem)
    system = compiled.system
    assert len(system.products) == 2 * N
    assert max(max(pair) for pair in system.products) >= N
    u = np.random.default_rng(5).uniform(0.5, 1.5, (N, 2, 3))
    x = system.with_products(u)
    assert np.array_equal(x[:N], u)
    for row, (a, b) in enumerate(system.products, N):
        assert np.array_equal(x[row], x[a] * x[b])
    writing = compiled.source.split("def with_products")[1].split("\ndef ")[0]
    assert len(writing.splitlines()) < 15


def decays(n: int) -> ro.CompiledProblem:
    rhs = {f"x{i}": f"-k*x{i}" for i in range(n)}
    return ro.compile(ro.Problem.from_strings(rhs, dict.fromkeys(rhs, 1), {"k": (1, 2)}, (0, 1)))


def test_small_systems_keep_a_line_for_each_state() -> None:
    source = decays(N - 1).source
    assert f"out[{N - 2}] = " in source
    assert "sparse" not in source
