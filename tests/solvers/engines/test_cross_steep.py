"""What is easily missed: stiff forcing, pulses, vanishing and tiny states, steep parameters."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.integrate

import rankone as ro
from rankone.solvers.engines.cross_engine import CrossMarcher
from rankone.solvers.engines.cross_samples import TrajectoryEnds
from rankone.solvers.engines.engine_options import CrossOptions
from rankone.solvers.request import Domain
from rankone.support.budget import NORMAL


def problem(rates, initial, box, end):
    return ro.Problem.from_strings(rates, initial, box, (0, end))


@pytest.mark.parametrize("method", ["cross", "train"])
@pytest.mark.parametrize("rate", ["1e4", "1e6", "1e8"])
def test_stiff_forcing_is_followed_between_the_steps(rate, method):
    forced = problem({"x": f"-{rate}*k*(x - cos(3*t))"}, {"x": 1}, {"k": (1, 2)}, 5)
    solution = ro.solve(forced, rtol=1e-4, method=method)
    assert solution.success, solution.message
    times = np.linspace(0.1, 5.0, 200)
    # x' = -L (x - cos 3t) ends in (L^2 cos 3t + 3 L sin 3t) / (L^2 + 9)
    rate = 1.5 * float(rate)
    exact = (rate**2 * np.cos(3 * times) + 3 * rate * np.sin(3 * times)) / (rate**2 + 9)
    np.testing.assert_allclose(solution["x"](t=times, k=1.5), exact, atol=5e-4)


@pytest.mark.parametrize("width", [0.3, 0.1, 0.03])
def test_a_pulse_in_a_state_is_not_stepped_over(width):
    rates = {"y": "1", "x": f"-x + exp(-((y - 5)/{width})**2)/{width}"}
    solution = ro.solve(problem(rates, {"y": 0, "x": 0}, {}, 10), rtol=1e-3)
    assert solution.success
    exact = np.sqrt(np.pi) * np.exp(-3.0 + width**2 / 4)
    assert float(solution["x"](t=8.0)) == pytest.approx(exact, rel=0.01)


@pytest.mark.parametrize("rate", ["k*sin(x)", "-k*x*c", "k*sqrt(x)"])
def test_a_solution_that_vanishes(rate):
    box = {"k": (1, 2), "c": (1, 2)}
    solution = ro.solve(problem({"x": rate}, {"x": 0}, box, 1), rtol=1e-3, method="cross")
    assert solution.success
    assert float(solution["x"](t=0.5, k=1.2, c=1.7)) == 0.0


@pytest.mark.slow
def test_a_tiny_state_is_measured_in_its_own_size():
    rates = {"x": "1e-12*cos(20*k*t)", "y": "-y"}
    tiny = problem(rates, {"x": 0, "y": 1}, {"k": (1, 2)}, 5)
    solution = ro.solve(tiny, rtol=1e-4)
    assert solution.success
    times = np.linspace(0.0, 5.0, 41)
    exact = 1e-12 * np.sin(25.0 * times) / 25.0
    np.testing.assert_allclose(solution["x"](t=times, k=1.25), exact, atol=5e-4 * 5e-14)


def test_growth_at_a_pole_of_the_sensitivity_is_solved_or_refused():
    solution = ro.solve(problem({"x": "k*x"}, {"x": 1}, {"k": (63, 65)}, 1), 1e-3, method="train")
    assert solution.success == (solution.error <= 1e-3)


@pytest.mark.parametrize(
    ("rate", "initial", "box", "where"),
    [
        ("-1/x", "k", (1.3, 3), 1.3),
        ("-k*sqrt(x)", "1", (0.1, 0.69), 0.69),
        pytest.param("k*sqrt(1 - x) + 0.01", "0", (0.5, 3), 3, marks=pytest.mark.slow),
    ],
)
def test_an_end_names_the_trajectory_that_ends(rate, initial, box, where):
    with pytest.raises(ro.BlowUpError, match="right-hand side is not finite") as caught:
        ro.solve(problem({"x": rate}, {"x": initial}, {"k": box}, 3), rtol=1e-3)
    assert caught.value.parameters["k"] == pytest.approx(where, rel=0.01)


@pytest.mark.parametrize(
    ("rate", "exact"),
    [
        ("-x + tanh(80*(k - 0.37))", lambda t, k: (1 - np.exp(-t)) * np.tanh(80 * (k - 0.37))),
        ("-x + Heaviside(k - 0.37)", lambda t, k: (1 - np.exp(-t)) * (k > 0.37)),
        ("-x + Max(k - 0.37, 0)", lambda t, k: (1 - np.exp(-t)) * np.maximum(k - 0.37, 0)),
    ],
)
@pytest.mark.parametrize("rtol", [1e-2, 1e-4])
def test_steps_and_kinks_in_a_parameter(rate, exact, rtol):
    steep = problem({"x": rate}, {"x": 0}, {"k": (0, 1)}, 2)
    solution = ro.solve(steep, rtol=rtol, method="cross")
    assert solution.success, solution.message
    k = np.random.default_rng(0).uniform(0.0, 1.0, 400)
    np.testing.assert_allclose(solution["x"](t=1.5, k=k), exact(1.5, k), atol=5 * rtol)


def test_trajectories_that_part_are_resolved_by_elements():
    parting = problem({"x": "x - x**3"}, {"x": "x0"}, {"x0": (-1.0, 0.7)}, 5)
    solution = ro.solve(parting, rtol=1e-3, method="cross")
    assert solution.success, solution.message
    start = np.concatenate([np.linspace(-1.0, 0.7, 101), np.linspace(-0.02, 0.02, 101)])
    exact = start * np.exp(5.0) / np.sqrt(1.0 + start**2 * (np.exp(10.0) - 1.0))
    np.testing.assert_allclose(solution["x"](t=5.0, x0=start), exact, atol=5e-3)


def test_a_layer_beside_the_border_of_an_element():
    steep = problem({"x": "-x + tanh(532.91*k - 329.33838)"}, {"x": 0}, {"k": (0, 1)}, 1.78)
    solution = ro.solve(steep, rtol=1e-3)
    assert solution.success
    k = np.linspace(0.61, 0.64, 2001)
    exact = (1 - np.exp(-1.78)) * np.tanh(532.91 * k - 329.33838)
    assert np.abs(solution["x"](t=1.78, k=k) - exact).max() < 1e-3


def test_a_front_at_one_end_of_another_parameter():
    threshold = problem(
        {"x": "s*x*(1 - x)*(x - 0.428)"}, {"x": "k"}, {"k": (0.05, 0.95), "s": (0.657, 2.621)}, 4.72
    )
    solution = ro.solve(threshold, rtol=1e-4)
    assert solution.success
    k = np.random.default_rng(3).uniform(0.38, 0.46, 200)
    exact = scipy.integrate.solve_ivp(
        lambda t, x: 2.6 * x * (1 - x) * (x - 0.428), (0, 4.72), k, rtol=1e-10, atol=1e-12
    ).y[:, -1]
    assert np.abs(solution["x"](t=4.72, k=k, s=2.6) - exact).max() < 1e-4


@pytest.mark.parametrize(
    ("rates", "initial", "box", "end", "said"),
    [
        (
            {"x": "y", "y": "x - x**3 - 0.3*y"},
            {"x": "a", "y": "b"},
            {"a": (-1.2, 1.2), "b": (-1, 1)},
            20,
            "end in different states",
        ),
        (
            {"x": "x - x**3 + b"},
            {"x": "a"},
            {"a": (-0.4, 0.4), "b": (-0.12, 0.12)},
            8.7,
            "x changes by",
        ),
    ],
)
@pytest.mark.slow
def test_failures_name_the_parameter_and_the_place(rates, initial, box, end, said):
    solution = ro.solve(problem(rates, initial, box, end), rtol=1e-3, effort="low")
    assert not solution.success
    assert solution.status.name == "STEEP"
    assert solution.method == "cross"
    assert said in solution.message


def test_a_feature_in_a_corner_of_many_parameters():
    corner = problem(
        {"x": "-x*(1 + 200*(a*b*c*d)**6) + 1"}, {"x": 0}, dict.fromkeys("abcd", (0, 1)), 2
    )
    solution = ro.solve(corner, rtol=1e-3)
    points = np.random.default_rng(9).random((4, 20_000))
    decay = 1 + 200 * points.prod(axis=0) ** 6
    found = solution["x"](t=2.0, **dict(zip("abcd", points, strict=True)))
    errors = np.abs(found - (1 - np.exp(-2 * decay)) / decay)
    assert solution.success
    assert np.quantile(errors, 0.999) < 1e-3


def test_a_blow_up_that_only_a_sample_meets():
    peak = problem(
        {"x": "-x + 40*exp(-((a - 0.5)**2 + (b - 0.8535534)**2)/4e-5)*x**2"},
        {"x": 1},
        {"a": (0, 1), "b": (0, 1)},
        2,
    )
    with pytest.raises(ro.BlowUpError, match="blows up") as caught:
        ro.solve(peak, rtol=1e-4)
    assert caught.value.parameters["b"] == pytest.approx(0.8535534, abs=0.01)
    assert caught.value.solution.time[1] < caught.value.time < 0.1


@pytest.mark.slow
def test_a_fast_state_that_follows_a_high_power():
    pulses = problem(
        {"u": "-1000*lam*(u - 200*c**41)", "c": "-w*s", "s": "w*c"},
        {"u": 200, "c": 1, "s": 0},
        {"lam": (1, 2), "w": (1, 2)},
        6,
    )
    solution = ro.solve(pulses, rtol=1e-3, effort=4)
    times = np.linspace(0.5, 6, 301)
    exact = 200 * np.cos(1.7 * times) ** 41  # but for the lag of a few thousandths
    lag = np.abs(np.gradient(exact, times)).max() / 1500
    assert solution.success
    assert np.abs(solution["u"](t=times, lam=1.5, w=1.7) - exact).max() < 2 * lag


@pytest.mark.parametrize("width", [0.07, 0.05])
def test_a_product_of_narrow_factors(width):
    peak = problem(
        {"x": f"-x + exp(-((a - 0.27)**2 + (b - 0.68)**2 + (c - 0.4)**2)/{width}**2)"},
        {"x": 0.1},
        dict.fromkeys("abc", (0, 1)),
        5,
    )
    solution = ro.solve(peak, rtol=1e-3)
    a, b, c = np.random.default_rng(9).normal([[0.27], [0.68], [0.4]], 0.1, (3, 2000)).clip(0, 1)
    height = np.exp(-((a - 0.27) ** 2 + (b - 0.68) ** 2 + (c - 0.4) ** 2) / width**2)
    exact = height + (0.1 - height) * np.exp(-5)
    assert solution.success == (np.abs(solution["x"](t=5.0, a=a, b=b, c=c) - exact).max() < 5e-3)


def test_a_front_is_named_though_the_budget_ends():
    rates = {"x": "v", "v": "x - x**3 - 0.3*v"}
    box = {"a": (-1.2, 1.2), "b": (-1, 1)}
    separatrix = ro.Problem.from_strings(rates, {"x": "a", "v": "b"}, box, (0, 40))
    solution = ro.solve(separatrix, rtol=1e-3, method="cross", effort=0.03)
    assert solution.status is ro.Status.STEEP
    assert "as on a jump" in solution.message


@pytest.mark.parametrize("method", ["cross", pytest.param("auto", marks=pytest.mark.slow)])
def test_a_jump_on_the_first_lines_ends_a_solve_before_it_samples_the_box(method):
    well = problem(
        {"x": "v", "v": "x - x**3 - 0.3*v"},
        {"x": "a", "v": "b"},
        {"a": (-1.2, 1.2), "b": (-1, 1)},
        20,
    )
    solution = ro.solve(well, 1e-3, method=method)
    assert solution.status is ro.Status.STEEP
    assert "as on a jump" in solution.message
    assert not solution.history
    assert sum(solution.work.values()) < 0.02 * NORMAL


@pytest.mark.slow
def test_a_front_within_a_millionth_of_the_only_interval_is_resolved():
    solution = ro.solve(problem({"x": "-k*x"}, {"x": 1}, {"k": (0, 1e7)}, 1), 1e-3, method="cross")
    assert solution.success, solution.message
    k = np.geomspace(0.1, 1e3, 50)
    np.testing.assert_allclose(solution["x"](t=0.7, k=k), np.exp(-0.7 * k), atol=5e-3)


def test_a_trajectory_that_ends_leaves_a_narrower_box_untold():
    class Ends:
        def uncounted(self, points):
            raise TrajectoryEnds(0.5, points[0])

    class Whole:
        domain = Domain((0.0, 1.0), ((0.0, 1.0), (0.0, 1.0)))

    marcher = object.__new__(CrossMarcher)
    marcher.trajectories, marcher.reference_set = Ends(), Whole()
    marcher.options, marcher.rtol = CrossOptions(), 1e-3
    assert marcher.modes_on_lines() == []
