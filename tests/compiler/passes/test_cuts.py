"""Where known functions of one coordinate switch, against points known by hand."""

import math

import numpy as np
import pytest
import sympy as sp

import rankone as ro
from rankone.compiler.passes.feature_pass import cuts_of, features_of
from rankone.problem.forms import Coordinate

t, k = sp.symbols("t k")
x = sp.Function("x")(t)
TIME = Coordinate("t", t, 0.0, 10.0)


def found(expression, coordinate=TIME):
    (result,) = cuts_of([coordinate], [expression])
    return result


@pytest.mark.parametrize(
    ("expression", "points"),
    [
        (sp.Heaviside(t - 6) * sp.Heaviside(sp.Float("6.001") - t), [6.0, 6.001]),
        (sp.Piecewise((1, (t > 2) & (t < 2 + sp.Rational(1, 3600))), (0, True)), [2, 2 + 1 / 3600]),
        (sp.Abs(t**2 - 2), [-math.sqrt(2), math.sqrt(2)]),
        (sp.Max(1, t, 4 - t), [1.0, 2.0, 3.0]),
        (sp.sign(sp.exp(-t / 3) - sp.Rational(1, 2)), [3 * math.log(2)]),
        (sp.Heaviside((t - 2) * (sp.Float("2.0001") - t)), [2.0, 2.0001]),
        (sp.sqrt(t - 3), [3.0]),
        (sp.Abs(sp.Abs(t - 5) - 1), [4.0, 5.0, 6.0]),
        (sp.Heaviside(sp.log(t) - 1) * x, [math.e]),
        (sp.Piecewise((x, sp.And(t < 1, x > 0)), (0, True)), [1.0]),
        (sp.Heaviside(t * sp.sin(t) - 1), None),
        (sp.sin(t) * sp.exp(-t), []),
        (sp.Abs(t - k), []),
    ],
)
def test_points(expression, points):
    result = found(expression)
    assert not result.periodic
    if points is None:  # found by changes of sign
        assert len(result.points) == 4
        assert all(abs(a * math.sin(a) - 1) < 1e-12 for a in result.points)
    else:
        assert sorted(result.points) == pytest.approx(points, rel=1e-15)


@pytest.mark.parametrize(
    ("expression", "periodic"),
    [
        (sp.floor(2 * t + 1), [(0.5, 0.5)]),
        (sp.Mod(t, sp.Rational(1, 3)), [(0.0, 1 / 3)]),
        (sp.Abs(sp.cos(3 * t)), [(-math.pi / 6, math.pi * 2 / 3), (math.pi / 6, math.pi * 2 / 3)]),
        (sp.sign(sp.tan(t) - 1), [(math.pi / 4, math.pi)]),
        (
            sp.acos(sp.cos(t)),
            [(-math.pi, 2 * math.pi), (0.0, 2 * math.pi), (math.pi, 2 * math.pi)],
        ),
    ],
)
def test_periodic(expression, periodic):
    result = found(expression)
    known = {(a % p % p, p) for a, p in result.periodic}
    wanted = {(a % p % p, p) for a, p in periodic}
    close = [any(abs(a - b) + abs(p - q) < 1e-12 for b, q in wanted) for a, p in known]
    assert all(close)
    assert len(known) <= len(periodic)
    assert not result.points


def pulse(width, notation, start=60):
    end = start + sp.Float(width)
    match notation:
        case "Heaviside":
            return sp.Heaviside(t - start) * sp.Heaviside(end - t)
        case "Piecewise":
            return sp.Piecewise((1, (t > start) & (t < end)), (0, True))
        case _:
            return (sp.sign(t - start) - sp.sign(t - end)) / 2


@pytest.mark.parametrize("notation", ["Heaviside", "Piecewise", "sign"])
@pytest.mark.parametrize("width", [1e-2, 1e-7])
@pytest.mark.parametrize("method", ["train", "cross"])
def test_a_pulse_is_not_stepped_over(width, notation, method):
    rate = -x + k * pulse(width, notation) / sp.Float(width)
    problem = ro.Problem([sp.Eq(x.diff(t), rate)], (t, 0, 100), {k: (1, 2)}, {x: 0})
    solution = ro.solve(problem, rtol=1e-4, method=method)
    assert solution.success
    exact = 1.5 / width * (math.exp(width) - 1) * math.exp(-1)
    assert solution(t=61, k=1.5)[0] == pytest.approx(exact, rel=1e-3)


def test_a_moved_horizon_has_its_switches():
    rate = -x + k * (sp.floor(t) + sp.Heaviside(t - 7))
    problem = ro.Problem([sp.Eq(x.diff(t), rate)], (t, 0, 3), {k: (1, 2)}, {x: 1})
    moved = ro.compile(problem).solve(rtol=1e-6, t_final=9)
    direct = ro.Problem([sp.Eq(x.diff(t), rate)], (t, 0, 9), {k: (1, 2)}, {x: 1})
    there = ro.compile(direct).solve(rtol=1e-6)
    assert moved.success
    assert moved(t=8.5, k=1.5) == pytest.approx(there(t=8.5, k=1.5), rel=1e-12)


def test_what_switches_too_often_is_refused():
    rate = -x + k * sp.floor(1e6 * t)
    problem = ro.Problem([sp.Eq(x.diff(t), rate)], (t, 0, 9), {k: (1, 2)}, {x: 1})
    with pytest.raises(ro.RankoneError, match="switches 9000000 times"):
        ro.solve(problem)


@pytest.mark.parametrize("pulse", ["1/cosh((t - a)/0.01)", "sech((t - a)/0.01)**2"])
def test_moving_pulses_of_hyperbolic_cosines_divide_time(pulse):
    """As exponentials of squares do: a chain behind one needs few trajectories."""
    rhs = {"x": f"{pulse} - k*x", "y": "k*(x - y)"}
    box = {"a": (1, 2), "k": (1, 3)}
    problem = ro.Problem.from_strings(rhs, {"x": 0, "y": 0}, box, (0, 3))
    compiled = ro.compile(problem)
    assert compiled.system.features.moving_cuts([1.5, 2.0]) == pytest.approx([1.5])
    solution = compiled.solve(1e-4)
    assert solution.success, solution.message
    assert solution.rank < 60
    gentle = {name: text.replace("0.01", "0.5") for name, text in rhs.items()}
    wide = ro.compile(ro.Problem.from_strings(gentle, {"x": 0, "y": 0}, box, (0, 3)))
    assert not wide.system.features.n_moving_cuts


MOVING_PEAK = "-x + 1e5*exp(-((t - 60*k)/1e-5)**2)"
MOVING_STEPS = {
    "pulse": "-x + 1000*Heaviside(t - 60*k)*Heaviside(60*k + 0.001 - t)",
    "dose": "-0.1*x + 18000*Piecewise((1, (t > 10*k) & (t < 10*k + 1/3600)), (0, True))",
}


def test_a_peak_that_moves_with_a_parameter_is_not_stepped_over():
    """What no interpolation resolves is refused, not missed."""
    problem = ro.Problem.from_strings({"x": MOVING_PEAK}, {"x": "1"}, {"k": (0.5, 1)}, (0, 100))
    compiled = ro.compile(problem)
    assert len(compiled.system.features.moving_cuts([0.7])) == 1
    solution = compiled.solve(1e-3, effort=0.01)
    assert not solution.success
    assert solution.error > 0.1 or not solution.outcome.slabs
    reference = "the reference trajectories" in solution.message
    assert reference or "at times that depend on parameters" in solution.message


@pytest.mark.parametrize(
    "rate",
    [pytest.param(MOVING_STEPS["pulse"], marks=pytest.mark.slow), MOVING_STEPS["dose"]],
    ids=MOVING_STEPS,
)
def test_switches_that_move_with_a_parameter_end_stretches(rate):
    problem = ro.Problem.from_strings({"x": rate}, {"x": "1"}, {"k": (0.5, 1)}, (0, 100))
    solution = ro.solve(problem, 1e-3)
    assert solution.success, solution.message
    assert solution.timeline.stretches == 3
    times = np.linspace(0, 100, 51)
    exact = problem.trajectory(times, k=0.83)["x"]
    np.testing.assert_allclose(solution["x"](times, k=0.83), exact, atol=1e-3 * np.abs(exact).max())


@pytest.mark.slow
def test_switches_that_change_their_order_are_solved():
    rate = "-x + Piecewise((0, t < a), (t - a, True)) + Heaviside(t - b)*(t - b)"
    box = {"a": (1, 2), "b": (1, 2)}
    problem = ro.Problem.from_strings({"x": rate}, {"x": "1"}, box, (0, 4))
    solution = ro.solve(problem, 1e-2)
    assert solution.success, solution.message
    times = np.linspace(0, 4, 41)
    for a, b in ((1.2, 1.8), (1.7, 1.3), (1.9, 1.1)):
        exact = problem.trajectory(times, a=a, b=b)["x"]
        error = np.abs(solution["x"](times, a=a, b=b) - exact).max()
        assert error <= 2e-2 * np.abs(exact).max()


def test_moving_switches_are_those_of_time_and_parameters():
    coordinates = [TIME, Coordinate("k", k, 0.5, 1.0)]
    rate = sp.Heaviside(2 * t - k) * sp.Heaviside(t - x) + sp.Abs(t - 3) + sp.exp(-k * t)
    assert features_of(coordinates, [rate], []).moving_steps == (k / 2,)


def test_periodic_switches_move_with_a_parameter():
    coordinates = [TIME, Coordinate("k", k, 0.5, 1.0)]
    (end,) = (c.upper for c in coordinates[:1])
    of_sine = features_of(coordinates, [sp.Heaviside(sp.sin(k * t))], []).moving_steps
    assert set(of_sine) == {j * sp.pi / k for j in range(int(end / 3.14) + 1)}
    wholes = features_of(coordinates, [sp.floor(k * t)], []).moving_steps
    assert set(wholes) == {j / k for j in range(int(end) + 1)}


@pytest.mark.parametrize(
    ("shape", "area"),
    [
        ("1e7*exp(-((t - 0.31234)/1e-7)**2)", math.sqrt(math.pi)),
        pytest.param(
            "1e6*(tanh((t - 0.31234)*1e9) - tanh((t - 0.312341)*1e9))", 2.0, marks=pytest.mark.slow
        ),
        pytest.param("1e7/(1 + ((t - 0.31234)*1e7)**2)", math.pi, marks=pytest.mark.slow),
    ],
)
@pytest.mark.parametrize("method", ["train", "cross"])
def test_a_narrow_smooth_pulse_is_not_stepped_over(shape, area, method):
    problem = ro.Problem.from_strings({"x": f"k*{shape}"}, {"x": "1"}, {"k": (0.5, 1.5)}, (0, 1))
    solution = ro.solve(problem, 1e-4, method=method)
    if solution.success:
        assert solution(t=1, k=1)[0] == pytest.approx(1 + area, rel=1e-3)
    else:
        assert solution.error > 1e-4
