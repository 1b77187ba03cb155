"""Coarse trajectories against SciPy."""

import numpy as np
import sympy as sp

import rankone as ro
from rankone.trajectories.integrators.diagnosis import coarse_states

t, k = sp.symbols("t k")
x, y = sp.Function("x")(t), sp.Function("y")(t)


def system(rates, initial, **more):
    equations = [sp.Eq(u.diff(t), rate) for u, rate in zip((x, y), rates)]
    problem = ro.Problem(equations, (t, 0, 5), {k: (0.5, 1.5)}, dict(zip((x, y), initial)), **more)
    return ro.compile(problem).system, problem


def test_smooth_stiff_and_reset_states_are_followed():
    rates = -1e5 * (x - k * sp.cos(t)), x - y
    stiff, problem = system(rates, (0, 1), jumps={2: {y: y + 3}})
    times, states = coarse_states(stiff, np.array([[0.6], [1.4]]), 500)
    for i, value in enumerate((0.6, 1.4)):
        exact = problem.trajectory(times, k=value, rtol=1e-9).values
        after = np.abs(times - 2) > 0.02  # where y jumps
        np.testing.assert_allclose(states[1, i, after], exact[1, after], atol=5e-3)
        np.testing.assert_allclose(states[0, i, 1:], exact[0, 1:], atol=1e-2)


def test_they_end_where_a_state_slides():
    relay, _ = system((k - 2 * sp.Heaviside(x - 1), -y), (0, 1))
    _, states = coarse_states(relay, np.array([[1.0]]), 400)
    np.testing.assert_allclose(states[0, 0, 100:], 1.0, atol=0.05)


def test_behind_a_blow_up_there_are_no_states():
    grows, _ = system((k * x**2, -y), (1, 1))
    with np.errstate(all="ignore"):
        _, states = coarse_states(grows, np.array([[1.5]]), 200)
    assert np.isfinite(states[:, 0, 0]).all()
    assert not np.isinf(states).any()
