"""Trajectories are not carried past what is narrow over the states."""

import itertools
import warnings

import numpy as np
import pytest
import sympy as sp

import rankone as ro
from rankone.compiler.passes.feature_pass import features_of
from rankone.problem.forms import Coordinate
from rankone.solvers.request import Domain
from rankone.solvers.verification.points import check_points, surface_points
from rankone.solvers.verification.reference import integrate_reference
from rankone.support.budget import limited
from rankone.trajectories.integrators.integrator import Tolerances
from rankone.trajectories.integrators.single import SingleIntegrator
from rankone.trajectories.stacks.explicit import StackedDOP853
from rankone.trajectories.stacks.implicit import Collocation, StackedRadau
from rankone.trajectories.stacks.newton import jacobians_for
from tests.honesty.cases import t, unknown

SHAPES = {
    "peak": ("exp(-Z**2)", np.sqrt(np.pi)),
    "rational": ("1/(1 + Z**2)", np.pi),
    "reciprocal": ("1/cosh(Z)**2", 2.0),
    "pulse": ("Piecewise((1, (Z > 0) & (Z < 1)), (0, True))", 1.0),
    "window": ("Piecewise((1, Z**2 < 1), (0, True))", 2.0),
    "hat": ("Max(0, 1 - Abs(Z))", 1.0),
    "steps": ("(tanh(9*Z) - tanh(9*Z - 9))/2", 1.0),
}
"""Narrow functions of Z = (x - 0.5)/width, and their areas."""


def compiled(rate, box=None, start="0", end=3):
    return ro.compile(ro.Problem.from_strings({"x": rate}, {"x": start}, box or {}, (0, end)))


@pytest.mark.parametrize("width", [1e-2, 1e-7])
@pytest.mark.parametrize(("shape", "area"), SHAPES.values(), ids=SHAPES)
def test_nothing_narrow_is_stepped_over(shape, area, width):
    rates = {"x": "1", "y": shape.replace("Z", f"((x - 0.5)*{1 / width:.0f})") + f"/{width}"}
    starts = {"x": "0", "y": "1"}
    system = ro.compile(ro.Problem.from_strings(rates, starts, {}, (0, 3))).system
    reference = integrate_reference(system, np.zeros((1, 0)), (0.0, 3.0), 1e-6)
    tails = width * (1 / 0.5 + 1 / 2.5) if shape == SHAPES["rational"][0] else 0.0
    assert reference(np.array([3.0]))[1, 0, 0] == pytest.approx(1.0 + area - tails, abs=1e-4)


@pytest.mark.slow
def test_what_no_event_tells_is_met_at_random_places():
    """The exponent is largest where its slope vanishes, which is no polynomial, nor periodic."""
    rate = "1/(1 + 50*k*exp(-30000*(x - 2 + 2.25/(x + 1))))"
    problem = compiled(rate, {"k": (0.5, 1.5)})
    points = check_points(np.array([[0.5, 1.5]]), 96)
    reference = integrate_reference(problem.system, points, (0.0, 3.0), 3e-6)
    delay = 50 * points[:, 0] * np.sqrt(np.pi / 20000)
    ends = reference(np.array([3.0]))[0, :, 0]
    assert np.abs(ends - (3.0 - delay)).min() < 1e-3
    solution = problem.solve(1e-3, effort="low")
    assert not solution.success or solution(t=3, k=1)[0] == pytest.approx(
        3.0 - 50 * np.sqrt(np.pi / 20000), abs=5e-3
    )


def test_periodic_functions_are_narrow_in_high_powers_and_exponentials():
    rate = "cos(x)**1000 + exp(1000*sin(x)) + 1/(2 - cos(2*x)) + cos(3*x)**2"
    problem = ro.Problem.from_strings({"x": rate}, {"x": "1"}, {}, (0, 1))
    features = features_of([Coordinate("t", t, 0, 1)], [problem.equations[0].rhs], [])
    assert {str(f) for f in features.peaks} == {"-sin(x(t))", "1000*cos(x(t))", "2*sin(2*x(t))"}


@pytest.mark.parametrize(
    ("exponent", "middles"),
    [
        ("(x - 2)**2 + x**2", {0, 1, 2}),
        ("(x - 2)**2 + t**2", {0, 2}),
        ("x**2 - 4*x + 4", {0, 2}),
        ("(x - 2)*(x - 2)*(x + 1)*(x + 1)", {-1, sp.Rational(1, 2), 2}),
        ("(x - 2)*(2 - x)*(x + 1)", {0, 2}),
        ("(x - 2)**2 + x", {sp.Rational(3, 2), 2}),
        ("x**3 - 3*x", {-1, 1}),
        ("x**4 - 2*x**2", {-1, 0, 1}),
        ("(x - 1)**2 + 9*cos(pi*x)", {1, None}),
        ("exp(2*x - 4) - 2*x", {2}),
        ("exp(x - 2) + exp(2 - x)", {2}),
    ],
)
def test_no_square_hides_another(exponent, middles):
    problem = ro.Problem.from_strings({"x": f"exp(-({exponent}))"}, {"x": "1"}, {}, (0, 1))
    peaks = features_of([Coordinate("t", t, 0, 1)], [problem.equations[0].rhs], []).peaks
    plain = [peak.subs(unknown("x"), sp.Symbol("x")) for peak in peaks]
    solved = [sp.solve(peak) if peak.is_polynomial() else [None] for peak in plain]
    assert {*itertools.chain(*solved)} == middles


@pytest.mark.parametrize(
    "rate",
    ["1/(1 + exp({}))", "exp({})/(1 + exp({}))**2", "1/(1 + exp({}) + exp(-({})))"],
)
@pytest.mark.parametrize("argument", ["1000000*x - 500000", "(x - 1/2)/1e-6", "1000000*(x - k/2)"])
def test_logistic_steps_have_middles(rate, argument):
    written = rate.replace("{}", argument)
    problem = ro.Problem.from_strings({"x": written}, {"x": "1"}, {"k": (1, 2)}, (0, 1))
    coordinates = [Coordinate("t", t, 0, 1), Coordinate("k", sp.Symbol("k"), 1, 2)]
    features = features_of(coordinates, [problem.equations[0].rhs], [])
    middles = [f.subs(sp.Symbol("k"), 1) for f in (*features.peaks, *features.steps)]
    assert {sp.nsimplify(zero) for f in middles for zero in sp.solve(f, unknown("x"))} == {
        sp.Rational(1, 2)
    }


def test_surfaces_over_states_are_middles_and_borders():
    x = unknown("x")
    rate = "exp(-(x - 2)**2) + Abs(x - 1) + Heaviside(x - 3) + tanh(x - 4) + exp(-x)"
    problem = ro.Problem.from_strings({"x": rate}, {"x": "1"}, {}, (0, 1))
    features = features_of([Coordinate("t", t, 0, 1)], [problem.equations[0].rhs], [])
    assert [str(f) for f in features.peaks] == ["x(t) - 2"]
    assert [str(f) for f in features.kinks] == ["x(t) - 1"]
    assert sorted(map(str, features.steps)) == ["x(t) - 3", "x(t) - 4"]
    assert str(x) == "x(t)"


def test_surfaces_are_those_of_several_parameters():
    problem = compiled(
        "-x + exp(-((a*b - 0.3)/0.001)**2) + Abs(a - 0.2) + Max(0, a + b - 1) + Abs(x - a)",
        {"a": (0, 1), "b": (0, 1)},
    )
    a, b = problem.problem.parameters
    coordinates = [Coordinate("t", t, 0, 1), Coordinate("a", a, 0, 1), Coordinate("b", b, 0, 1)]
    features = features_of(coordinates, problem.first_order.rhs, [])
    assert len(features.parameter_surfaces) == 3  # middle and exponent of the ridge, and the kink
    points = surface_points(problem.system, Domain.of(problem.system))
    on_ridge = np.abs(points[:, 0] * points[:, 1] - 0.3) < 1e-12
    on_kink = np.abs(points.sum(axis=1) - 1) < 1e-12
    assert on_ridge.sum() >= 8
    assert on_kink.sum() >= 8


@pytest.mark.parametrize("d", [2, pytest.param(6, marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    "shape",
    [
        "Piecewise((1, R < {w}**2), (0, True))",
        "Max(0, 1 - R/{w}**2)",
        "1/(1 + R/{w}**2)",
        "Piecewise((1, B), (0, True))",
    ],
)
def test_an_island_in_the_box_is_seen(d, shape):
    """A ball or a box of a few percent in each direction, on which all is different."""
    names = "abcdef"[:d]
    centre = [0.337, 0.612, 0.271, 0.543, 0.713, 0.431][:d]
    ball = " + ".join(f"({n} - {c})**2" for n, c in zip(names, centre, strict=True))
    sides = " & ".join(f"(Abs({n} - {c}) < 0.05)" for n, c in zip(names, centre, strict=True))
    rate = "-x + 1 + " + shape.replace("R", f"({ball})").replace("B", sides).format(w=0.05)
    solution = compiled(rate, dict.fromkeys(names, (0, 1)), end=1).solve(1e-3, effort="low")
    there = solution(t=1, **dict(zip(names, centre, strict=True)))[0]
    exact = 2 * (1 - np.exp(-1))
    assert not solution.success or there == pytest.approx(exact, rel=5e-3)


@pytest.mark.parametrize(
    "rate",
    [
        pytest.param("1/cosh((t - k)/1e-6)**2/1e-6", marks=pytest.mark.slow),
        "Piecewise((2*t/1e-4, (t**2 > k) & (t**2 < k + 1e-4)), (0, True))",
        pytest.param("exp(-((t - k)/1e-6)**4)/1e-6", marks=pytest.mark.slow),
        pytest.param(
            "(tanh((t - k)/1e-6) - tanh((t - k - 3e-6)/1e-6))/1e-6", marks=pytest.mark.slow
        ),
    ],
)
def test_pulses_that_move_are_seen_at_any_time(rate):
    solution = compiled(rate, {"k": (2, 6)}, start="1", end=10).solve(1e-3, effort=0.01)
    assert not solution.success
    assert not solution.outcome.slabs or solution.error > 0.1


@pytest.mark.slow
def test_a_parameter_carried_by_a_state_is_seen():
    rates = {"y": "0*x", "x": "-x + 1 + Piecewise((1, Abs(y - 0.612) < 1e-3), (0, True))"}
    starts = {"x": "0", "y": "k"}
    problem = ro.Problem.from_strings(rates, starts, {"k": (0, 1)}, (0, 1))
    solution = ro.solve(problem, 1e-3, effort="low")
    exact = 2 * (1 - np.exp(-1))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ro.RankoneWarning)  # NaN on a sliver that is declared
        there = solution(t=1, k=0.612)[1]
    assert not solution.success or np.isnan(there) or there == pytest.approx(exact, rel=5e-3)


@pytest.mark.slow
def test_a_tiny_source_that_an_instability_amplifies():
    """x' = c + k*x*(1 - x) from zero: the roots r1, r2 of the right-hand side give x."""
    problem = compiled("1e-15 + k*x*(1 - x)", {"k": (8, 10)}, end=6)
    solution = problem.solve(1e-4)
    assert solution.success
    k, t = 8.5, 4.0
    small = 1e-15 / k  # the root below zero, up to its square
    grown = small * np.expm1(k * t)
    assert solution(t=t, k=k)[0] == pytest.approx(grown / (1 + small + grown), abs=5e-4)


@pytest.mark.slow
def test_a_ridge_is_refused_or_right():
    rate = "-x*(1 + 1/(1 + ((a*b - 0.41)/1e-4)**2)) + 1"
    problem = compiled(rate, {"a": (0, 1), "b": (0, 1)}, end=5)
    solution = problem.solve(1e-3, effort="low")
    a = np.linspace(0.5, 1.0, 11)
    exact = (1 - np.exp(-10.0)) / 2  # on the ridge
    assert not solution.success or np.abs(solution(t=5, a=a, b=0.41 / a)[0] - exact).max() < 5e-3


def test_a_stiff_system_is_handed_over_before_the_watch_refuses_many_steps(monkeypatch):
    """The estimate of the error lets unstable steps pass, and a fifth of their length is stable."""
    steps = []
    step = StackedDOP853.step
    monkeypatch.setattr(StackedDOP853, "step", lambda self: steps.append(self.t) or step(self))
    back, release = "2270*y + 9430*y/(y/127 + 1)", "1290*z/(z + 0.0135) + 0.845*z/(742*y**2 + 1)"
    rates = {
        "x": f"-2.83*k*x + {back}",
        "y": f"2.83*k*x - ({back}) + {release}",
        "z": f"-({release})",
    }
    starts = {"x": "100", "y": "167", "z": "116"}
    system = ro.compile(ro.Problem.from_strings(rates, starts, {"k": (0.7, 1.3)}, (0, 30))).system
    reference = integrate_reference(
        system, np.linspace(0.7, 1.3, 16)[:, None], (0.0, 30.0), 3e-7, "stack"
    )
    assert reference.stiff
    assert len(steps) < 60


def test_rounded_times_of_an_ignition_miss_nothing():
    """In steps of 1e-11 at t = 2 times have five digits, and slopes not many more."""
    heat = "exp(T/(1 + T/20))"
    rates = {"T": f"c*{heat} - 1.5*T", "c": f"-0.01*c*{heat}"}
    ignition = ro.Problem.from_strings(rates, {"T": "16.2", "c": "0.82"}, {}, (2, 2.3))
    system = ro.compile(ignition).system
    single, tolerances = (
        SingleIntegrator(looks_anywhere=True),
        Tolerances(1e-10, np.full((2, 1), 1e-16)),
    )
    with limited(2e7):
        trajectories = single.run(system, np.zeros((1, 0)), (2.0, 2.3), tolerances)
    assert trajectories.end == 2.3


def test_two_finite_peaks_are_no_end_of_trajectories():
    rates = {"x": "k", "y": "1e9*exp(-(1e9*(x-1))**2) + 1e9*exp(-(1e9*(x-1-1e-7))**2)"}
    made = ro.Problem.from_strings(rates, {"x": 0, "y": 0}, {"k": (1, 2)}, (0, 3))
    reference = integrate_reference(
        ro.compile(made).system, np.array([[1.25], [1.5]]), (0.0, 3.0), 3e-7, integrator="single"
    )
    assert reference.blown is None
    np.testing.assert_allclose(
        reference(np.array([3.0]))[1, :, 0], 2 * np.sqrt(np.pi) / np.array([1.25, 1.5]), rtol=1e-4
    )


def radau_of(rates, *span_and_tolerances):
    system = compiled("-k*x", {"k": (0.5, 1.5)}, start="k").system
    blocks = jacobians_for(system, np.ones((10, 1)))
    return StackedRadau(rates, *span_and_tolerances, None, Collocation(blocks))


@pytest.mark.parametrize("method", [StackedDOP853, radau_of])
def test_states_at_several_shares_of_a_step_are_those_at_each(method):
    """Their slopes are those of the states over the share."""
    m, columns = 10, np.array([0, 2, 3])

    class Decay:
        def __call__(self, _t, y):
            return -y

        def at(self, _times, states):
            return -states

    starts = np.arange(1.0, m + 1.0)[None]
    tolerances = Tolerances(1e-6, np.full((1, 1), 1e-9))
    solver = method(Decay(), (0.0, 1.0), starts, tolerances)
    solver.step()
    interpolant = solver.interpolant(columns)
    shares = np.random.default_rng(1).random((4, columns.size))
    states, slopes = interpolant(shares, True)
    assert states.shape == slopes.shape == (1, 4, columns.size)
    for k, row in enumerate(shares):
        np.testing.assert_allclose(states[:, k], interpolant(row, True)[0], rtol=1e-13)
        np.testing.assert_allclose(slopes[:, k], interpolant(row, True)[1], rtol=1e-11)
    further, before = (interpolant(shares + shift, False)[0] for shift in (1e-5, -1e-5))
    np.testing.assert_allclose((further - before) / 2e-5, slopes, rtol=1e-6)
    exact = np.exp(-shares * (solver.t - solver.t_old)) * starts[:, None, columns]
    np.testing.assert_allclose(states, exact, rtol=1e-4)
