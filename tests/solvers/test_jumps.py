"""Jumps at known times: every engine against segments integrated one by one."""

import importlib.util
import itertools
import sys

import numpy as np
import pytest
import scipy.integrate
import sympy as sp

import rankone as ro

t, k, dose = sp.symbols("t k dose")
x, theta = (sp.Function(name)(t) for name in ("x", "theta"))
BOX = {k: (0.5, 1.5), dose: (0.2, 0.6)}
TIMES = np.array([0.0, 0.4, 0.999999, 1.0, 1.7, 2.5, 2.500001, 3.9, 4.0])


def doses():
    """Repeated doses, one that depends on the state and one that resets it."""
    return ro.Problem(
        [sp.Eq(x.diff(t), -k * x)],
        (t, 0, 4),
        BOX,
        {x: 0},
        jumps={(0, 1.0): {x: x + dose}, 2.5: {x: x**2 + dose / k}, 3.5: {x: 1}},
    )


def kicked():
    """A pendulum that is kicked twice, once by an impulse."""
    kick = dose * sp.DiracDelta(t - 1)
    return ro.Problem(
        [sp.Eq(theta.diff(t, 2), -k * sp.sin(theta) + kick)],
        (t, 0, 4),
        BOX,
        {theta: 0.5, theta.diff(t): 0},
        jumps={2.5: {theta: theta / 2, theta.diff(t): theta.diff(t) + dose * sp.cos(theta)}},
    )


def truth(rate, start, jumps, times):
    """One trajectory by segments; at the time of a jump it is what comes after."""
    found, state, edges = {}, np.array(start, dtype=float), sorted({0.0, *jumps, 4.0})
    for a, b in itertools.pairwise(edges):
        state = np.array(jumps[a](state), dtype=float) if a in jumps else state
        run = scipy.integrate.solve_ivp(
            lambda s, y: rate(y), (a, b), state, "DOP853", rtol=1e-12, atol=1e-14, dense_output=True
        )
        found |= {at: run.sol(at) for at in times if a <= at < b or at == b == 4.0}
        state = run.y[:, -1]
    return np.stack([found[at] for at in times], axis=1)


def exact(name, k, d):
    if name == "doses":
        dose = lambda u: u + d  # noqa: E731
        jumps = {0.0: dose, 1.0: dose, 2.5: lambda u: u**2 + d / k, 3.5: lambda u: [1.0]}
        return truth(lambda u: -k * u, [0.0], jumps, TIMES)
    jumps = {1.0: lambda u: [u[0], u[1] + d], 2.5: lambda u: [u[0] / 2, u[1] + d * np.cos(u[0])]}
    return truth(lambda u: [u[1], -k * np.sin(u[0])], [0.5, 0.0], jumps, TIMES)[:1]


PROBLEMS = {"doses": doses, "kicked": kicked}
POINTS = [(0.5, 0.2), (0.77, 0.31), (1.5, 0.6), (1.1, 0.55)]


def largest_error(solution, name):
    unknown = {"doses": "x", "kicked": "theta"}[name]
    errors = [solution[unknown](t=TIMES, k=k, dose=d) - exact(name, k, d)[0] for k, d in POINTS]
    return np.abs(errors).max()


@pytest.mark.parametrize(
    ("name", "method", "rtol"),
    [
        ("doses", "cross", 1e-6),
        ("doses", "train", 1e-6),
        ("doses", "greedy", 1e-4),
        ("kicked", "cross", 1e-6),
        ("kicked", "train", 1e-6),
        ("kicked", "greedy", 1e-3),
    ],
)
def test_engines(name, method, rtol):
    solution = ro.solve(PROBLEMS[name](), rtol, method=method)
    assert solution.success, solution.message
    assert largest_error(solution, name) < 5 * rtol


def imported(path, monkeypatch):
    """A generated file as a module."""
    spec = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, path.stem, module)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("name", PROBLEMS)
def test_what_is_saved_and_exported_jumps_too(name, tmp_path, monkeypatch):
    problem = PROBLEMS[name]()
    compiled = ro.compile(problem)
    solution = compiled.solve(1e-5)
    solution.save(tmp_path / "u.npz")
    assert largest_error(ro.load(tmp_path / "u.npz"), name) < 5e-5
    solution.export(tmp_path / "model.py")
    model = imported(tmp_path / "model.py", monkeypatch)
    where = {"t": TIMES, "k": np.full(TIMES.size, 0.77), "dose": np.full(TIMES.size, 0.31)}
    np.testing.assert_allclose(model.value(where), solution(where), rtol=1e-12)
    for method in ("cross", "train"):
        compiled.export(tmp_path / f"{method}.py", method=method)
        again = imported(tmp_path / f"{method}.py", monkeypatch).solve(rtol=1e-5)
        assert again.success
        assert largest_error(again, name) < 5e-5


def test_the_canonical_form_jumps_too():
    solution = ro.solve(doses(), 1e-6)
    canonical = solution.to_canonical(1e-7)["x"]
    at = {"k": 0.77, "dose": 0.31}
    np.testing.assert_allclose(canonical(TIMES, **at), solution["x"](TIMES, **at), atol=1e-5)


def test_without_parameters_and_with_another_end():
    problem = ro.Problem.from_strings(
        {"x": "-x"}, {"x": "1"}, {}, (0, 3), jumps={1: {"x": "x + 1"}, 2: {"x": "0"}}
    )
    compiled = ro.compile(problem)
    for method in ("cross", "train", "greedy"):
        solution = compiled.solve(1e-6, method=method, t_final=2.0)
        assert solution.success
        assert solution(t=1.0)[0] == pytest.approx(np.exp(-1) + 1, rel=1e-5)
        assert solution(t=2.0)[0] == pytest.approx((np.exp(-1) + 1) * np.exp(-1), rel=1e-5)
    longer = compiled.solve(1e-6, t_final=4.0)
    assert abs(longer(t=3.5)[0]) < 1e-6


def test_a_jump_to_where_nothing_is_finite_is_said():
    problem = ro.Problem.from_strings(
        {"x": "-k*x"}, {"x": "0"}, {"k": (1, 2)}, (0, 3), jumps={1: {"x": "1/x"}}
    )
    with pytest.raises(ro.RankoneError, match="t = 1"):
        ro.solve(problem, 1e-4)


def test_an_infusion_of_a_second_in_a_day():
    """One second of a day: the rate is large and on for one part in 86,400."""
    hours = ro.Problem.from_strings(
        {"C": "R*(Heaviside(t - 8) - Heaviside(t - 8 - 1/3600)) - k*C"},
        {"C": "0"},
        {"R": (3600, 7200), "k": (0.1, 0.3)},
        (0, 24),
    )
    for method in ("auto", "train"):
        solution = ro.solve(hours, 1e-5, method=method)
        assert solution.success
        for rate, k in ((3600, 0.1), (5000, 0.17), (7200, 0.3)):
            end = 8 + 1 / 3600
            peak = rate / k * (1 - np.exp(-k / 3600))
            expected = peak * np.exp(-k * (np.array([9.0, 16.0, 24.0]) - end))
            found = solution["C"](t=[9.0, 16.0, 24.0], R=rate, k=k)
            np.testing.assert_allclose(found, expected, atol=5e-5 * 2)  # of a size of two
