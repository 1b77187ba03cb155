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
        pytest.param("kicked", "greedy", 1e-3, marks=pytest.mark.slow),
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


@pytest.mark.parametrize(
    ("name", "method"),
    [
        pytest.param(
            name, method, marks=[pytest.mark.slow] * ((name, method) != ("doses", "cross"))
        )
        for name in PROBLEMS
        for method in ("cross", "train")
    ],
)
def test_what_is_saved_and_exported_jumps_too(name, method, tmp_path, monkeypatch):
    problem = PROBLEMS[name]()
    compiled = ro.compile(problem)
    solution = compiled.solve(1e-5)
    solution.save(tmp_path / "u.npz")
    assert largest_error(ro.load(tmp_path / "u.npz"), name) < 5e-5
    solution.export(tmp_path / "model.py")
    model = imported(tmp_path / "model.py", monkeypatch)
    where = {"t": TIMES, "k": np.full(TIMES.size, 0.77), "dose": np.full(TIMES.size, 0.31)}
    np.testing.assert_allclose(model.value(where), solution(where), rtol=1e-12)
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


def decaying(jumps, box=None, time=(0, 4), **initial):
    """x' = -k x from one, or other initial values, with jumps as text."""
    start = {"x": "1", **initial}
    return ro.Problem.from_strings(
        {"x": "-k*x"}, start, {"k": (0.5, 1.5), **(box or {})}, time, jumps=jumps
    )


@pytest.mark.parametrize(
    "method",
    [
        "auto",
        pytest.param("train", marks=pytest.mark.slow),
        pytest.param("greedy", marks=pytest.mark.slow),
    ],
)
@pytest.mark.parametrize(
    ("value", "where", "change"),
    [
        ("x + Piecewise((1, (k > 0.7312) & (k < 0.7322)), (0, True))", 0.7317, 1.0),
        ("x + exp(-((k - 0.7312)/0.0001)**2)", 0.7312, 1.0),
        ("x + Piecewise((1, (x > 0.2) & (x < 0.201)), (0, True))", -np.log(0.2005) / 2, 1.0),
        ("x + exp(-((x - 0.1653)/0.0003)**2)", -np.log(0.1653) / 2, 1.0),
    ],
)
def test_what_is_narrow_in_a_jump_is_solved_or_refused(method, value, where, change):
    rtol = 1e-4 if method == "auto" else 1e-3
    solution = ro.solve(decaying({2: {"x": value}}), rtol, method=method, effort="low")
    if solution.success:
        after = np.exp(-2 * where) + change
        assert solution(t=2.0, k=where)[0] == pytest.approx(after, abs=5 * rtol)


@pytest.mark.slow
def test_a_ridge_over_two_parameters_in_a_jump():
    jump = {2: {"x": "x + exp(-((a*k - 1.1)/0.001)**2)"}}
    solution = ro.solve(decaying(jump, {"a": (0.5, 1.5)}), 1e-4, effort="low")
    value = solution(t=2.0, k=1.0, a=1.1)[0]
    assert not solution.success or value == pytest.approx(np.exp(-2) + 1, abs=5e-4)


@pytest.mark.parametrize("value", ["x + exp(-((k - 1)/0.05)**2)", "1/(0.3 + x)", "tanh(5*x)"])
def test_train_resolves_what_a_jump_makes(value):
    solution = ro.solve(decaying({1: {"x": value}}), 1e-4, method="train")
    assert solution.success, solution.message
    k = np.linspace(0.5, 1.5, 41)
    wanted = sp.lambdify(sp.symbols("x k"), value)(np.exp(-k), k)
    np.testing.assert_allclose(solution["x"](t=1.0, k=k), wanted, atol=5e-4 * wanted.max())


def test_jumps_that_are_at_the_end_but_for_rounding():
    with pytest.warns(ro.RankoneWarning, match="the jump at t = 0.3: not before the end"):
        problem = decaying({(0.1, 0.3): {"x": "x + 1"}}, time=(0, 0.1 * 3))
    for method in ("cross", "train", "greedy"):
        solution = ro.solve(problem, 1e-5, method=method)
        wanted = (np.exp(-0.1) + 1) * np.exp(-0.2)
        assert solution(t=0.1 * 3, k=1.0)[0] == pytest.approx(wanted, rel=1e-4)


def test_a_state_that_is_there_for_a_short_time_has_its_own_size():
    problem = ro.Problem.from_strings(
        {"x": "-k*x", "y": "-y"},
        {"x": "0", "y": "1"},
        {"k": (0.5, 1.5)},
        (0, 2),
        jumps={1.001: {"x": "1e-6*k"}, 1.004: {"x": "0"}},
    )
    for method in ("cross", "train"):
        solution = ro.solve(problem, 1e-5, method=method)
        assert solution.success
        value = solution["x"](t=1.002, k=0.7)
        assert value == pytest.approx(0.7e-6 * np.exp(-0.7e-3), rel=1e-4)


@pytest.mark.parametrize("beside", [1e-9, 2e-6])
@pytest.mark.parametrize("method", ["cross", "train", "greedy"])
def test_jumps_beside_each_other_the_start_and_cuts(method, beside):
    problem = ro.Problem.from_strings(
        {"x": f"-k*x + Heaviside(t - {1 + beside})"},
        {"x": "1"},
        {"k": (0.5, 1.5)},
        (0, 4),
        jumps={beside: {"x": "x + 1"}, 1: {"x": "x + 1"}, 1 + 3 * beside: {"x": "x + 1"}}
        if beside > 1e-8
        else {beside: {"x": "x + 1"}, 1: {"x": "x + 2"}},
    )
    solution = ro.solve(problem, 1e-4, method=method)
    assert solution.success, solution.message
    wanted = (2 * np.exp(-1) + 2) * np.exp(-3) + (1 - np.exp(-3))
    assert solution(t=4.0, k=1.0)[0] == pytest.approx(wanted, abs=1e-3)


def test_jumps_that_change_nothing_are_none():
    problem = decaying({(1, 3): {"x": "Piecewise((x, t < 2), (x + 1, True))"}, 2: {"x": "x"}})
    assert [jump.time for jump in ro.first_order(problem).jumps] == [3.0]


def test_an_impulse_times_time_and_an_unknown():
    y = sp.Function("y")(t)
    rates = [
        sp.Eq(x.diff(t), -k * x + t * y * sp.DiracDelta(t - 2)),
        sp.Eq(y.diff(t), -y),
    ]
    solution = ro.solve(ro.Problem(rates, (t, 0, 4), {k: (0.5, 1.5)}, {x: 0, y: 1}), 1e-6)
    assert solution[x](t=2.0, k=1.0) == pytest.approx(2 * np.exp(-2), abs=1e-5)


def test_a_jump_out_of_where_rates_are_finite():
    problem = ro.Problem.from_strings(
        {"x": "-k*sqrt(x) - x"},
        {"x": "2"},
        {"k": (0.1, 0.2)},
        (0, 1),
        jumps={0.5: {"x": "x - 1.5"}},
    )
    with pytest.raises(ro.BlowUpError, match=r"not finite: near t = 0\.5"):
        ro.solve(problem, 1e-4)
