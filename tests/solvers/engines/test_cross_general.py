"""Right-hand sides that do not separate, solved by sampling trajectories."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import scipy.integrate
import sympy as sp

import rankone as ro

RTOL = 1e-4
t, w, k1, k2 = sp.symbols("t w k1 k2")
x, v = sp.Function("x")(t), sp.Function("v")(t)
INPUT_TIMES, INPUT = np.array([0.0, 1.0, 1.5, 2.2, 4.0]), np.array([0.0, 1.0, -0.5, 0.7, 0.2])


def problem(rhs, parameters, initial, horizon):
    """The problem x' = rhs[x], ..., by text or expressions."""
    if all(isinstance(f, str) for f in rhs.values()):
        return ro.Problem.from_strings(rhs, initial, parameters, horizon)
    equations = [sp.Eq(u.diff(t), f) for u, f in rhs.items()]
    return ro.Problem(equations, (t, *horizon), parameters, initial)


def table_forcing():
    force = ro.table(INPUT_TIMES, INPUT)
    return problem({x: -k1 * x + force(t) * sp.sqrt(1 + x**2)}, {k1: (0.5, 2)}, {x: 0}, (0, 4))


CASES = {
    "pendulum": (
        lambda: problem(
            {"th": "v", "v": "-g*sin(th) - c*v"},
            {"g": (8, 11), "c": (0.1, 0.5), "a": (0.1, 2.0)},
            {"th": "a", "v": 0},
            (0, 3),
        ),
        lambda s, u, g, c, a: [u[1], -g * np.sin(u[0]) - c * u[1]],
        lambda g, c, a: [a, 0.0],
    ),
    "michaelis_menten": (
        lambda: problem(
            {"s": "-vmax*s/(km + s)"}, {"vmax": (0.5, 2), "km": (0.4, 1)}, {"s": 2}, (0, 5)
        ),
        lambda s, u, vmax, km: [-vmax * u[0] / (km + u[0])],
        lambda vmax, km: [2.0],
    ),
    "forcing_frequency": (
        lambda: problem(
            {x: v, v: -x - sp.Rational(1, 5) * v + sp.cos(w * t)},
            {w: (0.5, 1.5)},
            {x: 0, v: 0},
            (0, 10),
        ),
        lambda s, u, w: [u[1], -u[0] - 0.2 * u[1] + np.cos(w * s)],
        lambda w: [0.0, 0.0],
    ),
    "drag": (
        lambda: problem(
            {"x": "v", "v": "-9.81 - c*v*abs(v)"},
            {"c": (0.05, 0.2), "v0": (5, 10)},
            {"x": 0, "v": "v0"},
            (0, 1.5),
        ),
        lambda s, u, c, v0: [u[1], -9.81 - c * u[1] * abs(u[1])],
        lambda c, v0: [0.0, v0],
    ),
    "gompertz": (
        lambda: problem(
            {"x": "-r*x*log(x/c)"},
            {"r": (0.5, 1.5), "c": (1, 3), "x0": (0.1, 1)},
            {"x": "x0"},
            (0, 4),
        ),
        lambda s, u, r, c, x0: [-r * u[0] * np.log(u[0] / c)],
        lambda r, c, x0: [x0],
    ),
    "initial_value": (
        lambda: problem(
            {x: -k1 * x * (1 + k2 * x)}, {k1: (0.5, 2), k2: (0.2, 1)}, {x: 1 / (k1 + k2)}, (0, 2)
        ),
        lambda s, u, k1, k2: [-k1 * u[0] * (1 + k2 * u[0])],
        lambda k1, k2: [1 / (k1 + k2)],
    ),
    "table": (
        table_forcing,
        lambda s, u, k1: [-k1 * u[0] + np.interp(s, INPUT_TIMES, INPUT) * np.sqrt(1 + u[0] ** 2)],
        lambda k1: [0.0],
    ),
}


def exact(rhs, start, end, values, times):
    """An independent trajectory, begun anew at the kinks of the input."""
    state, done = np.array(start, float), {}
    edges = sorted({0.0, *INPUT_TIMES[end > INPUT_TIMES], end})
    for a, b in itertools.pairwise(edges):
        inside = [s for s in times if a <= s <= b]
        run = scipy.integrate.solve_ivp(
            lambda s, u: rhs(s, u, *values),
            (a, b),
            state,
            "LSODA",
            [*inside, b],
            rtol=1e-10,
            atol=1e-12,
        )
        done |= dict(zip(inside, run.y.T))
        state = run.y[:, -1]
    return np.transpose([done[s] for s in times])


@pytest.mark.parametrize("name", CASES)
def test_against_independent_trajectories(name):
    build, rhs, start = CASES[name]
    compiled = ro.compile(build())
    assert compiled.separated.general
    solution = compiled.solve(RTOL, method="cross")
    assert solution.success, solution.message
    rng = np.random.default_rng(7)
    box = np.array([*solution.parameters.values()])
    points = box[:, 0] + (box[:, 1] - box[:, 0]) * rng.random((20, len(box)))
    end = solution.time[1]
    times = np.sort(rng.uniform(0, end, 15))
    wanted = np.array([exact(rhs, start(*q), end, q, times) for q in points])
    found = np.array(
        [solution(t=times, **dict(zip(solution.parameters, q)))[: wanted.shape[1]] for q in points]
    )
    size = np.abs(wanted).max(axis=(0, 2))[:, None]
    assert np.max(np.abs(found - wanted) / size) <= 5 * RTOL


@pytest.mark.parametrize("method", ["train", "greedy"])
def test_other_methods_need_separated_terms(method):
    compiled = ro.compile(problem({"x": "-k*x*abs(x)"}, {"k": (1, 2)}, {"x": 1}, (0, 1)))
    with pytest.raises(
        ro.SeparationError, match=r"equation 1: .*Abs.*no lifted form.*'cross', the default, takes"
    ):
        compiled.solve(RTOL, method=method)
    assert "not polynomial" in compiled.methods[method]
    assert compiled.lifted is None
    assert compiled.methods["cross"] is None
    assert compiled.quadratic is None


def test_separable_problems_can_be_solved_by_all_methods():
    compiled = ro.compile(problem({"x": "-k*x"}, {"k": (1, 2)}, {"x": 1}, (0, 1)))
    assert set(compiled.methods.values()) == {None}


def test_another_box_and_horizon():
    compiled = ro.compile(CASES["michaelis_menten"][0]())
    solution = compiled.solve(RTOL, method="cross", parameters={"km": (0.5, 2)}, t_final=3)
    assert solution.success
    assert solution.parameters["km"] == (0.5, 2)
    with pytest.raises(ro.OptionError, match=r"initial value of `x\(t\)`.*not finite and real"):
        ro.compile(CASES["initial_value"][0]()).solve(
            RTOL, method="cross", parameters={"k1": (-1, 1), "k2": (-1, 1)}
        )
    with pytest.raises(ro.OptionError, match=r"is a table over \[0, 4\]"):
        ro.compile(table_forcing()).solve(RTOL, method="cross", t_final=5)


@pytest.mark.parametrize(
    ("rhs", "initial", "message"),
    [
        (
            {"x": "log(x - k)"},
            {"x": 1.5},
            r"equation 1: the derivative of `x\(t\)`.* k = .*x = 1.5",
        ),
        ({"x": "sin(x)/(k - m)"}, {"x": 0}, r"not finite and real at the start.* k = 1.5, m = 1.5"),
        ({"x": "sin(x)"}, {"x": "log(k - m)"}, r"the initial value of `x\(t\)`, `log\(k - m\)`"),
        ({"x": "sin(x)*log(k - 1.5)"}, {"x": 0}, r"`log\(k - 1.5\)` is not .* at k = "),
        ({"x": "sin(k*x)/(t - 0.5)"}, {"x": 0}, r"is not finite at t = 0.5, inside the horizon"),
    ],
)
def test_what_is_not_finite_is_named(rhs, initial, message):
    used = "".join(map(str, (*rhs.values(), *initial.values())))
    asked = problem(rhs, {n: (1, 2) for n in ("k", "m") if n in used}, initial, (0, 1))
    with pytest.raises(ro.ProblemError, match=message):
        ro.compile(asked)


def test_without_parameters_and_with_awkward_names():
    u, p = sp.Function("u")(t), sp.Function("p")(t)
    rhs = {u: -sp.sin(u) * p, p: -sp.exp(-t * p)}
    solution = ro.solve(problem(rhs, {}, {u: 1, p: 1}, (0, 1)), RTOL, method="cross")
    run = scipy.integrate.solve_ivp(
        lambda s, y: [-np.sin(y[0]) * y[1], -np.exp(-s * y[1])], (0, 1), [1, 1], rtol=1e-10
    )
    np.testing.assert_allclose(solution(t=1.0), run.y[:, -1], atol=5 * RTOL)


def test_a_table_may_be_called_like_anything_else():
    for name in ("k1", "rhs", "np"):
        force = ro.table([0, 1], [0, 1], name=name)
        asked = problem({x: -k1 * sp.sin(x) + force(t)}, {k1: (1, 2)}, {x: 1}, (0, 1))
        assert ro.solve(asked, RTOL, method="cross").success
