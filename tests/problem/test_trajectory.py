"""One ordinary trajectory: against exact solutions, and in the shapes of a solution."""

import math
import pickle

import numpy as np
import pytest
import sympy as sp

import rankone as ro
from tests.problems import EXAMPLES, GENERAL

t, k, dose = sp.symbols("t k dose")
x, y = (sp.Function(name)(t) for name in "xy")
BOX = {k: (0.5, 2), dose: (1, 2)}


def problem(rate=-k * x, box=BOX, initial=1, time=(t, 0, 10), **options):
    return ro.Problem([sp.Eq(x.diff(t), rate)], time, box, {x: initial}, **options)


def decay():
    return problem(box={k: (0.5, 2)})


def test_shapes_are_those_of_a_solution():
    times = np.array([[0.0, 3.0, 0.5], [10.0, 0.5, 7.0]])
    trajectory = decay().trajectory(times, {k: 1.5})
    assert trajectory.values.shape == (1, 2, 3)
    assert np.asarray(trajectory).shape == (1, 2, 3)
    np.testing.assert_allclose(trajectory[x], np.exp(-1.5 * times), rtol=2e-6, atol=1e-8)
    np.testing.assert_array_equal(trajectory["x"], next(iter(trajectory)))
    assert decay().trajectory(t=2.0, k=1.5).values.shape == (1,)
    assert decay().trajectory(t=[], k=1.5).values.shape == (1, 0)
    np.testing.assert_array_equal(trajectory.t, times)
    assert repr(trajectory) == "Trajectory of `x` at 6 times"


@pytest.mark.parametrize("rtol", [1e-4, 1e-6, 1e-8, 1e-10, 1e-12])
def test_the_tolerance_counts(rtol):
    """A circle: the error grows with the number of periods, not beyond a hundred tolerances."""
    equations = [sp.Eq(x.diff(t), k * y), sp.Eq(y.diff(t), -k * x)]
    made = ro.Problem(equations, (t, 0, 20), {k: (0.5, 2)}, {x: 0, y: 1})
    times = np.linspace(0.0, 20.0, 41)
    error = made.trajectory(times, k=1.0, rtol=rtol) - np.array([np.sin(times), np.cos(times)])
    assert np.abs(error).max() < 100 * rtol


def test_jumps_count_from_their_time_on():
    made = problem(initial=0, jumps={(0, 4): {x: x + dose}, 6: {x: x * dose}})
    before, at, after = made.trajectory([4 - 1e-9, 4.0, 6.0], k=0.5, dose=1.5)[x]
    np.testing.assert_allclose(before, 1.5 * np.exp(-2), rtol=1e-6)
    np.testing.assert_allclose(at, before + 1.5, rtol=1e-6)
    np.testing.assert_allclose(after, 1.5 * at * np.exp(-1), rtol=1e-6)
    assert made.trajectory(0.0, k=0.5, dose=1.5)[x] == 1.5


def test_an_impulse_kicks_a_coupled_system():
    """x' + k y' = delta(t - 1), x' - y' = -y: both jump by 1/(1 + k)."""
    kick = sp.DiracDelta(t - 1)
    equations = [sp.Eq(x.diff(t) + k * y.diff(t), kick), sp.Eq(x.diff(t) - y.diff(t), -y)]
    made = ro.Problem(equations, (t, 0, 3), {k: (1, 2)}, {x: 1, y: 0})
    trajectory = made.trajectory([0.5, 1.0, 3.0], k=1.5)
    jumped = np.array([0.0, 0.4, 0.4 * np.exp(0.4 * 2)])
    np.testing.assert_allclose(trajectory[y], jumped, rtol=1e-6)
    conserved = np.array([1.0, 2.0, 2.0])
    np.testing.assert_allclose(trajectory[x] + 1.5 * trajectory[y], conserved, rtol=1e-6)


def test_derivatives_are_states():
    """m x'' + x = J delta(t - 1) from rest."""
    equation = sp.Eq(k * x.diff(t, 2) + x, dose * sp.DiracDelta(t - 1))
    made = ro.Problem([equation], (t, 0, 5), BOX, {x: 0, x.diff(t): 0})
    trajectory = made.trajectory([0.5, 1.0, 4.0], k=1.44, dose=1.2)
    assert trajectory.values.shape == (1, 3)
    np.testing.assert_allclose(trajectory[x], [0, 0, np.sin(2.5)], rtol=1e-6, atol=1e-12)
    velocities = [0, 1 / 1.2, np.cos(2.5) / 1.2]
    np.testing.assert_allclose(trajectory[x.diff(t)], velocities, rtol=1e-6)
    assert list(trajectory.states) == ["x", "x_t"]


def test_a_mass_that_depends_on_states():
    """(1 + x) x' = 1: x + x^2/2 = t."""
    made = ro.Problem([sp.Eq((1 + x) * x.diff(t), k)], (t, 0, 4), {k: (0.5, 2)}, {x: 0})
    value = made.trajectory(4.0, k=1.0)[x]
    np.testing.assert_allclose(value, 2.0, rtol=1e-7)


def test_no_step_misses_a_short_infusion():
    second = sp.Rational(1, 3600)
    rate = sp.Piecewise((dose / second, (t > 8) & (t < 8 + second)), (0, True))
    value = problem(rate - k * x, initial=0).trajectory(10.0, k=0.5, dose=1.5)[x]
    length = float(second)
    exact = 1.5 / length / 0.5 * (1 - np.exp(-0.5 * length)) * np.exp(-0.5 * (2 - length))
    np.testing.assert_allclose(value, exact, rtol=1e-6)


@pytest.mark.parametrize(
    ("rate", "integral"),
    [
        (1000 * sp.exp(-((1000 * (t - 7 * k)) ** 2)), np.sqrt(np.pi)),
        (500 / sp.cosh(1000 * (t - 7 * k)) ** 2, 1.0),
        (1000 * (sp.Heaviside(t - 7 * k) - sp.Heaviside(t - 7 * k - sp.Rational(1, 1000))), 1.0),
        (sp.floor(t * k), 45.0),
        (sp.Max(0, sp.sin(sp.pi * t)), 10 / np.pi),
        (ro.table([0, 3, 3.001, 10], [0, 0, 1000, 0], "previous")(t), 6999.0),
    ],
)
def test_no_step_misses_what_is_narrow_in_time(rate, integral):
    value = problem(k * rate, {k: (0.5, 2)}, initial=0).trajectory(10.0, k=1.0)[x]
    np.testing.assert_allclose(value, integral, rtol=1e-6)


@pytest.mark.parametrize("scale", [4, 10.5, 40])
def test_no_step_straddles_a_jump_of_the_rates(scale):
    """x' = -floor(scale x) falls in straight lines, each until scale*x is a whole number."""
    trajectory = problem(rate=-sp.floor(scale * x), box={}, time=(t, 0, 0.2)).trajectory(0.2)
    remaining, level = 0.2, 1.0
    for slope in range(int(np.ceil(scale)) - 1, 0, -1):
        span = min(remaining, (level - slope / scale) / slope)
        remaining, level = remaining - span, level - slope * span
    np.testing.assert_allclose(trajectory[x], [level], rtol=1e-8)


def test_functions_of_the_user_and_of_data():
    """A function of the user may have the name of one that SymPy knows."""
    squared = ro.function("sin", lambda z: z**2, lambda z: 2 * z)
    ramp = ro.table([0, 10], [0, 20])
    value = problem(squared(t) + sp.sin(t) + ramp(t), initial=0, box={}).trajectory(3.0)[x]
    np.testing.assert_allclose(value, 9 + 1 - np.cos(3) + 9, rtol=1e-7)


def test_states_that_start_at_zero():
    """Rates that are rounding alone at the start do not stop it."""
    equations = [
        sp.Eq(x.diff(t), sp.sin(k) * sp.cos(y) - sp.cos(k) * sp.sin(y)),
        sp.Eq(y.diff(t), 1),
    ]
    made = ro.Problem(equations, (t, 0, 3), {k: (0.1, 2)}, {x: 0, y: k})
    np.testing.assert_allclose(made.trajectory(3.0, k=0.3)[x], np.cos(3) - 1, rtol=1e-6)


@pytest.mark.parametrize("name", sorted({**EXAMPLES, **GENERAL}))
def test_solutions_agree_with_it(name):
    example = {**EXAMPLES, **GENERAL}[name]
    made = example.problem
    solution = ro.solve(made, rtol=1e-5)
    assert solution.success
    point = {symbol: 0.4 * a + 0.6 * b for symbol, (a, b) in made.parameters.items()}
    times = np.linspace(*made.time[1:], 50)
    values = np.asarray(made.trajectory(times, point))
    size = np.abs(values).max(axis=1, keepdims=True)
    assert np.abs((solution(times, point) - values) / size).max() < 2e-5


def test_a_problem_is_pickled_after_a_trajectory():
    made = decay()
    value = made.trajectory(1.0, k=1.0)[x]
    assert pickle.loads(pickle.dumps(made)).trajectory(1.0, k=1.0)["x"] == value


def test_a_blow_up_says_where():
    made = problem(k * x**2, {k: (0.5, 2)})
    with pytest.raises(ro.BlowUpError, match=r"beyond t = 1\b.*, k = 1: it grows") as raised:
        made.trajectory(2.0, k=1.0)
    assert raised.value.time == pytest.approx(1.0, abs=1e-3)
    assert raised.value.parameters == {"k": 1.0}


@pytest.mark.parametrize(
    ("at", "error", "message"),
    [
        ({"t": 11, "k": 1}, ro.EvaluationError, "`t` = 11 is outside its horizon"),
        ({"t": 1, "k": 3}, ro.EvaluationError, "`k` = 3 is outside its range"),
        ({"t": 1, "k": [1, 2]}, ro.EvaluationError, "`k` has 2 values; a trajectory has one"),
        ({"t": 1}, ro.EvaluationError, "no value for `k`"),
        ({"k": 1}, ro.EvaluationError, "no value for `t`"),
        ({"t": 1, "K": 1}, ro.EvaluationError, "unknown name `K`.*did you mean `k`"),
        ({"t": 1, "k": 1, "rtol": 2}, ro.OptionError, "rtol=2 is not valid"),
    ],
)
def test_bad_arguments(at, error, message):
    with pytest.raises(error, match=message):
        decay().trajectory(**at)


def test_an_unknown_that_is_not_there():
    with pytest.raises(ro.EvaluationError, match="no unknown `y`; the trajectory has `x`"):
        decay().trajectory(1.0, k=1.0)[y]


def test_integers_beyond_those_of_numpy():
    """Exact numbers of many digits, as formulas of a file with decimal numbers have them."""
    root = sp.sqrt(sp.Integer(10) ** 30 + 7 + 10**30 * k) / 10**15  # sqrt(1 + k), all but exactly
    made = problem(-root * x, {k: (0.5, 1)}, root, (t, 0, 1))
    exact = np.sqrt(1.7) * np.exp(-np.sqrt(1.7))
    assert made.trajectory(1.0, k=0.7)["x"] == pytest.approx(exact, rel=1e-6)
    assert ro.solve(made, rtol=1e-6)(t=1.0, k=0.7) == pytest.approx(exact, rel=1e-5)


@pytest.mark.slow
def test_a_trajectory_that_slides_is_left_to_solve():
    box = {"mu": (0.45, 0.6)}
    rates = {"x": "v", "v": "1.6*cos(t/2) - x - mu*sign(v)"}
    problem = ro.Problem.from_strings(rates, {"x": "0", "v": "0.5"}, box, (0, 15))
    with pytest.raises(ro.ConvergenceError, match=r"jump to and fro .* ro\.solve follows"):
        problem.trajectory([14.0], mu=0.52)


@pytest.mark.parametrize(
    ("rate", "exact"),
    [
        ("-x + exp(-700)", lambda t: math.exp(-700.0) * -np.expm1(-t)),
        ("-1000*x + exp(-700)", lambda t: 1e-3 * math.exp(-700.0) + 0.0 * t),
        ("60*x + exp(-700)", lambda t: math.exp(-350.0) * np.exp(60.0 * t - 350.0) / 60.0),
        ("x + exp(-730)", lambda t: math.exp(-365.0) * (math.exp(-365.0) * np.expm1(t))),
    ],
)
def test_rates_near_the_smallest_numbers_do_not_blow_up(rate, exact):
    problem = ro.Problem.from_strings({"x": rate}, {"x": 0}, {}, (0, 10))
    times = np.array([5.0, 10.0])
    values = problem.trajectory(times, rtol=1e-9).values[0]
    np.testing.assert_allclose(values, exact(times), rtol=1e-5)


def test_a_pole_after_the_smallest_numbers_is_one():
    problem = ro.Problem.from_strings(
        {"x": "x**2 + exp(-700)", "y": "y**2"}, {"x": 0, "y": 1}, {}, (0, 2)
    )
    with pytest.raises(ro.BlowUpError, match="beyond t = 1:"):
        problem.trajectory([1.5])
