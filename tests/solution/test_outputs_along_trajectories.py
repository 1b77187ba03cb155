"""Quantities that are evaluated along the trajectories of a solve."""

from functools import partial

import numpy as np
import pytest
import scipy.sparse
import sympy as sp
from scipy.integrate import solve_ivp

import rankone as ro
from rankone.compiler import reformulated as observed

RATES = {"x": "x*(1.5 - y)", "y": "-y*(3 - x)"}


@pytest.fixture(scope="module")
def predators():
    box = {"a": (8, 12), "b": (4, 6)}
    return ro.compile(
        ro.Problem.from_strings(RATES, {"x": "a", "y": "b"}, box, (0, 2), definitions={"w": "a*x"})
    )


def states(t, a, b):
    def rates(_, u):
        return [u[0] * (1.5 - u[1]), -u[1] * (3 - u[0])]

    return solve_ivp(rates, (0, 2), [a, b], rtol=1e-10, atol=1e-12, t_eval=t).y


def test_outputs_are_a_solution_of_their_own(predators, tmp_path):
    """Values, gradients, statistics, further outputs, fits, files and models."""
    solution = predators.solve(rtol=1e-4, outputs={"q": "a*x*y + t"}, unknowns=["y"])
    assert solution.success
    assert solution.states == ("y", "q")
    t = np.linspace(0, 2, 9)
    x, y = states(t, 9.0, 5.0)
    np.testing.assert_allclose(solution(t, a=9.0, b=5.0), [y, 9 * x * y + t], rtol=0, atol=0.05)
    error = np.abs(solution["y"](t, a=9.0, b=5.0) - y).max()
    assert error <= 1e-4 * 15
    step = 1e-4
    up, down = (solution(1.0, a=9.0 + s, b=5.0) for s in (step, -step))
    slope = solution.gradient(1.0, a=9.0, b=5.0)[:, 0]
    np.testing.assert_allclose(slope, (up - down) / (2 * step), rtol=1e-5)
    assert solution.mean([1.0]).shape == (2, 1)
    peak = solution.output({"peak": "maximum(q)"})(a=9.0, b=5.0)
    assert abs(peak - solution["q"](np.linspace(0, 2, 500), a=9.0, b=5.0).max()) < 1e-2
    fit = solution.fit(t, solution["q"](t, a=9.0, b=5.0), observe=["q"])
    np.testing.assert_allclose([fit.x["a"], fit.x["b"]], [9.0, 5.0], rtol=1e-3)
    again = ro.load(solution.save(tmp_path / "q.npz"))
    np.testing.assert_array_equal(again(t, a=9.0, b=5.0), solution(t, a=9.0, b=5.0))
    assert solution.export(tmp_path / "model.py").exists()


def test_definitions_are_asked_for_by_name(predators):
    solution = predators.solve(rtol=1e-3, outputs="w", parameters={"b": (4, 5)}, t_final=1.0)
    assert solution.states == ("w",)
    assert solution.parameters["b"] == (4, 5)
    exact = 9.0 * states([1.0], 9.0, 4.5)[0]
    np.testing.assert_allclose(solution(1.0, a=9.0, b=4.5), exact, rtol=1e-2)


def test_a_small_difference_of_large_states_is_as_accurate_as_asked():
    rates = {"x": "-k*x", "y": "-k*y + 1e-6"}
    problem = ro.Problem.from_strings(rates, {"x": "1", "y": "1"}, {"k": (1, 2)}, (0, 2))
    solution = ro.solve(problem, rtol=1e-4, outputs={"q": "y - x"})
    t = np.linspace(0, 2, 9)
    exact = 1e-6 * (1 - np.exp(-1.3 * t)) / 1.3
    assert solution.success
    assert np.abs(solution["q"](t, k=1.3) - exact).max() <= 1e-4 * exact.max()


def test_digits_that_no_trajectory_has_are_refused():
    rates = {"x": "-k*x", "y": "-k*y + 1e-14"}
    problem = ro.Problem.from_strings(rates, {"x": "1", "y": "1"}, {"k": (1, 2)}, (0, 2))
    with pytest.raises(ro.ConvergenceError, match="`q` loses the digits"):
        ro.solve(problem, rtol=1e-4, outputs={"q": "y - x"})


@pytest.mark.slow
def test_only_what_is_asked_for_is_checked():
    """States far down a chain are tiny, and vary by orders of magnitude over the box."""
    n = 70
    t, k = sp.symbols("t k")
    flow = scipy.sparse.diags([np.ones(n), -np.ones(n - 1)], [0, -1])
    problem = ro.Problem.from_matrices(
        None,
        scipy.sparse.eye(n),
        {k: flow},
        time=(t, 0, 4),
        parameters={k: (0.7, 1.4)},
        initial=np.eye(n)[0],
        names="x",
    )
    total = sum(sp.Function(f"x{i}")(t) for i in range(n))
    solution = ro.solve(problem, rtol=1e-4, outputs={"total": total}, unknowns=["x3"])
    assert solution.success
    times = np.linspace(0, 4, 5)
    exact = [np.exp(-times) * times**3 / 6, np.ones(5)]
    np.testing.assert_allclose(solution(times, k=1.0), exact, rtol=0, atol=1e-4)


def test_rows_are_in_the_order_of_the_problem():
    rates = {"x5": "-k*x5", "x50": "-2*k*x50"}
    problem = ro.Problem.from_strings(rates, {"x5": "1", "x50": "1"}, {"k": (1, 2)}, (0, 1))
    solution = ro.solve(problem, rtol=1e-3, unknowns=["x50", "x5"])
    assert solution.states == ("x5", "x50")
    np.testing.assert_allclose(solution(1.0, k=1.0), np.exp([-1.0, -2.0]), rtol=1e-2)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"outputs": {}}, "outputs is empty"),
        ({"outputs": []}, "outputs is empty"),
        ({"outputs": {"q": "x"}, "unknowns": []}, "unknowns is empty"),
        ({"unknowns": []}, "unknowns is empty"),
        ({"outputs": {"1q": "x"}}, "the name `1q` of an output is not an identifier"),
        ({"outputs": {"q": "x", "a b": "x"}}, "the name `a b` of an output is not"),
        ({"outputs": 3}, "not a mapping"),
        ({"outputs": {"q": "z"}}, "unknown name `z`"),
        ({"outputs": {"a": "x"}}, "name of a coordinate"),
        ({"outputs": {"q": "x_t"}}, "derivative that is no state"),
        ({"outputs": {"q": "maximum(x)"}}, "over the whole of time"),
        ({"outputs": {"q": "Heaviside(t - 1)*x"}}, "the output `q` jumps, kinks or is narrow"),
        ({"outputs": {"x": "y"}, "unknowns": ["x"]}, "both an output and among unknowns"),
        ({"outputs": {"q": "x"}, "unknowns": ["z"]}, "no unknown `z`"),
        ({"outputs": {"x": "y"}}, "`x` has the name of an unknown, and is `y`"),
        ({"outputs": {"x_t": "x + 1"}, "unknowns": ["x"]}, "the derivative of an unknown, and is"),
        ({"outputs": {"x": "2*x"}}, "`x` has the name of an unknown"),
        ({"outputs": {"q": "x"}, "method": "train"}, "does not apply"),
        ({"outputs": {"q": "x"}, "markers": ["x - 3"]}, "does not apply"),
    ],
)
def test_what_is_no_output_is_refused(predators, options, message):
    with pytest.raises(ro.OptionError, match=message):
        predators.solve(rtol=1e-3, **options)


DECAY = {"x": "-a*x"}, {"x": "1"}, {"a": (0.5, 1.5)}, (0, 3)


@pytest.mark.parametrize("output", ["tanh(x)", "exp(-(x**2))", "exp(cos(3*x))", "1/(1 + 9*x**2)"])
def test_outputs_that_might_be_narrow_are_solved_for(output):
    solution = ro.solve(ro.Problem.from_strings(*DECAY), rtol=1e-4, outputs={"q": output})
    assert solution.success
    times, function = np.linspace(0, 3, 9), sp.lambdify(sp.Symbol("x"), sp.sympify(output))
    exact = function(np.exp(-1.3 * times))
    np.testing.assert_allclose(solution(times, a=1.3)[0], exact, rtol=0, atol=3e-4 * exact.max())


@pytest.mark.parametrize(
    "output",
    [
        pytest.param("sin(pi*x)**10000000", marks=pytest.mark.slow),
        pytest.param("exp(-((x - 0.4)/1e-5)**2)", marks=pytest.mark.slow),
        pytest.param("exp(1e9*(cos(x - 0.4) - 1))", marks=pytest.mark.slow),
    ],
)
def test_an_output_too_narrow_for_samples_has_no_success(output):
    problem = ro.Problem.from_strings(*DECAY)
    solution = ro.solve(problem, rtol=1e-4, outputs={"q": output}, effort=0.1)
    assert not solution.success
    assert max(solution.errors.values()) > 0.1


def test_events_and_jumps_are_refused():
    arguments = {"x": "-k*x"}, {"x": "1"}, {"k": (1, 2)}, (0, 2)
    event = {"when": "x - 0.5", "then": {"x": "1"}}
    for more in ({"events": [event]}, {"jumps": {1.0: {"x": "x + 1"}}}):
        problem = ro.Problem.from_strings(*arguments, **more)
        with pytest.raises(ro.OptionError, match="outputs along trajectories do not take"):
            ro.solve(problem, outputs={"q": "x"})


def test_an_output_that_is_not_finite_is_refused(predators):
    with pytest.raises(ro.EvaluationError, match="is not finite on a trajectory"):
        predators.solve(rtol=1e-3, outputs={"q": "log(-x)"})


def test_constants_may_be_outputs(predators):
    solution = predators.solve(rtol=1e-3, outputs={"three": 3, "x": "x"})
    assert solution.success
    assert solution["three"](1.0, a=9.0, b=5.0) == pytest.approx(3.0, rel=1e-4)


def test_outputs_are_translated_once_for_all_boxes(predators, monkeypatch):
    translated = []
    original = observed.output_formulas

    def counting(outputs, *arguments):
        translated.append(outputs)
        return original(outputs, *arguments)

    monkeypatch.setattr(observed, "output_formulas", counting)
    compiled = ro.compile(predators.problem.set({}))
    asked = {"outputs": {"q": "x*y + Heaviside(a - 10)"}, "rtol": 1e-3}
    pieces = [
        compiled.solve(parameters={"a": box}, **asked) for box in ((8, 9), (9, 9.5), (11, 12))
    ]
    assert len(translated) == 1
    assert len({piece.timings["outputs"] for piece in pieces}) == 1
    for piece, a in zip(pieces, (8.3, 9.1, 11.4), strict=True):
        x, y = states([1.0], a, 5.0)
        np.testing.assert_allclose(piece(1.0, a=a, b=5.0), x * y + (a > 10), rtol=1e-2)
    with pytest.raises(ro.OptionError, match="`q` jumps, kinks or is narrow"):
        compiled.solve(parameters={"a": (9, 11)}, **asked)
    compiled.solve(parameters={"a": (8, 9)}, unknowns=["x"], **asked)
    compiled.solve(parameters={"a": (8, 9)}, t_final=1.0, **asked)
    assert len(translated) == 3


def test_functions_of_the_user_with_one_name_are_told_apart(predators):
    x = sp.Function("x")(sp.Symbol("t"))
    values = []
    for factor in (2.0, 3.0):
        scaled = ro.function(
            "scaled", partial(np.multiply, factor), partial(np.full_like, fill_value=factor)
        )
        solution = predators.solve(1e-3, outputs={"q": scaled(x)})
        values.append(solution(1.0, a=9.0, b=5.0)[0])
    assert values[1] == pytest.approx(1.5 * values[0], rel=1e-2)
