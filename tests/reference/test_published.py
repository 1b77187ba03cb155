"""The published systems: statements agree, trajectories exist, solutions are right."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.integrate
import sympy as sp

import rankone as ro
from tests.reference.measure import measured_errors, trajectories
from tests.reference.published import KINDS, PUBLISHED

RTOL = 1e-3
POINTS, EXACT = 64, 1e-8
"""Trajectories at which solutions are measured, and their tolerance."""
FEW, CLOSE = 16, 1e-6
"""Those at which rates are compared."""
UNSOLVED = {"chua", "wilson_cowan"}
"""Those that a low effort leaves above RTOL, and says so."""
QUICK = {entry.kind: name for name, entry in PUBLISHED.items()}.values()
"""The last of each kind: the others are slow together."""
each = pytest.mark.parametrize(
    "name", [pytest.param(n, marks=() if n in QUICK else pytest.mark.slow) for n in PUBLISHED]
)


def test_the_suite_is_large_and_varied():
    assert len(PUBLISHED) >= 42
    assert {entry.kind for entry in PUBLISHED.values()} == set(KINDS)
    assert all(1 <= len(entry.parameters) <= 6 for entry in PUBLISHED.values())


@each
def test_trajectories_reach_the_end(name):
    system = PUBLISHED[name].independent
    _, _, states = trajectories(system, FEW, CLOSE)
    largest = np.abs(states).max(axis=(1, 2)) / np.array(system.sizes)
    least = 1e-3 if system.stiff else 0.1  # peaks of fast transients fall between the times
    assert np.isfinite(states).all()
    assert np.all((largest > least) & (largest < 10.0)), largest


@each
def test_the_statement_by_hand_is_the_symbolic_one(name):
    entry = PUBLISHED[name]
    first = ro.first_order(entry.problem())
    time, *parameters = (coordinate.symbol for coordinate in first.coordinates)
    assert tuple(state.name for state in first.states) == entry.unknowns
    rhs = sp.lambdify([time, first.functions, parameters], first.rhs, "numpy", cse=True)
    initial = sp.lambdify([parameters], first.initial, "numpy")

    p, times, states = trajectories(entry.independent, FEW, CLOSE)
    for ours, theirs in zip(entry.independent.initial(p), initial(p), strict=True):
        np.testing.assert_allclose(*np.broadcast_arrays(ours, theirs), rtol=1e-13, atol=0.0)
    # off the trajectories, so that stiff terms do not cancel
    around = states * np.random.default_rng(7).uniform(0.8, 1.2, states.shape)
    rates = np.empty((2, *states.shape))
    for k, t in enumerate(times):
        u = around[:, :, k]
        for side, function in enumerate((rhs, entry.independent.rhs)):
            for row, values in enumerate(function(t, u, p)):
                rates[side, row, :, k] = values
    size = np.abs(rates[0]).max(axis=(1, 2), keepdims=True)
    assert np.all(np.abs(rates[0] - rates[1]) <= 1e-10 * size)


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted({*QUICK, *[*PUBLISHED][::4]}))
def test_a_success_is_right(name):
    """A quarter of them; tests/benchmarks/published.py does so for all, at several tolerances."""
    entry = PUBLISHED[name]
    solution = ro.solve(entry.problem(), RTOL, effort="low")
    assert solution.success or name in UNSOLVED, solution.message
    if solution.success:
        errors = measured_errors(solution, entry.independent, POINTS, EXACT)
        assert np.all(errors <= 5 * RTOL), errors


@pytest.mark.parametrize(
    ("name", "centre", "end", "first"),
    [
        ("pollu", (0.35, 26.6, 1.63e4), 60.0, 0.5646255480022769e-1),
        ("hires", (1.71, 7e-4, 280.0), 321.8122, 0.7371312573325668e-3),
    ],
)
def test_reference_values_of_the_ivp_test_set(name, centre, end, first):
    system = PUBLISHED[name].independent
    p = np.array(centre)[:, None]
    result = scipy.integrate.solve_ivp(
        lambda t, y: np.array([np.ravel(row)[0] for row in system.rhs(t, y[:, None], p)]),
        (0.0, end),
        system.initial(p),
        method="LSODA",
        rtol=1e-9,
        atol=1e-12 * np.array(system.sizes),
    )
    assert result.y[0, -1] == pytest.approx(first, rel=1e-6)
