"""Curves, bands and surfaces hold the values of the solution."""

from __future__ import annotations

import matplotlib.pyplot as plt
import numpy as np
import pytest
import scipy.stats

import rankone as ro
from examples import lotka_volterra
from rankone import plotting
from tests.share.plotting.drawn import band, legend, lines, populations, product, texts, with_units

TIMES = np.linspace(0.0, 6.0, 13)


# --- curves ------------------------------------------------------------------------------------


def test_one_curve_for_each_unknown():
    solution = populations()
    ax = plotting.plot_trajectories(solution, x0=9, y0=5, t=TIMES)
    for row, (times, values) in enumerate(lines(ax)):
        assert times.tolist() == TIMES.tolist()
        np.testing.assert_allclose(values, solution(TIMES, x0=9, y0=5)[row])
    assert texts(ax) == ["x", "y"]
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("t", "x, y")
    assert ax.get_xlim() == (0.0, 6.0)


def test_times_may_be_among_the_values():
    y, values = lotka_volterra.y, {lotka_volterra.x0: 9, "y0": 5, lotka_volterra.t: TIMES}
    ax = plotting.plot_trajectories(populations(), values, unknowns=y)
    ((times, found),) = lines(ax)
    assert times.tolist() == TIMES.tolist()
    np.testing.assert_allclose(found, populations()["y"](TIMES, x0=9, y0=5))
    with pytest.raises(ro.OptionError, match="`t` is given twice"):
        plotting.plot_trajectories(populations(), values, t=TIMES)


def test_a_family_of_few_curves_is_named():
    ax = plotting.plot_trajectories(populations(), x0=[8, 10, 12], y0=5, unknowns="x", t=TIMES)
    assert legend(ax) == ["x0 = 8", "x0 = 10", "x0 = 12"]
    for (_, values), x0 in zip(lines(ax), (8, 10, 12), strict=True):
        np.testing.assert_allclose(values, populations()["x"](TIMES, x0=x0, y0=5))
    assert len({line.get_color() for line in ax.get_lines()}) == 3


def test_a_family_of_many_curves_has_a_scale():
    ax = plotting.plot_trajectories(with_units(), x0=np.linspace(8, 12, 20), y0=5, t=TIMES)
    assert len(lines(ax)) == 40
    assert {line.get_linestyle() for line in ax.get_lines()} == {"-", "--"}
    _, scale = ax.figure.axes
    assert scale.get_ylabel() == "x0 [1e3]"
    assert scale.get_ylim() == (8, 12)
    assert legend(ax) == ["x", "y"]


def test_curves_at_samples():
    values = populations().sample(30, seed=1)
    ax = plotting.plot_trajectories(populations(), values, unknowns="x", t=TIMES)
    wanted = populations()["x"](TIMES, {name: column[:, None] for name, column in values.items()})
    np.testing.assert_allclose([found for _, found in lines(ax)], wanted)
    assert len(ax.figure.axes) == 1


def test_values_broadcast_to_a_grid():
    x0, y0 = np.array([[8.0], [12.0]]), np.array([4.0, 6.0])
    ax = plotting.plot_trajectories(populations(), x0=x0, y0=y0, unknowns="x", t=[1.0, 2.0])
    assert legend(ax)[1] == "x0 = 8, y0 = 6"
    np.testing.assert_allclose(lines(ax)[1][1], populations()["x"]([1.0, 2.0], x0=8, y0=6))


def test_a_state_that_is_no_unknown():
    problem = ro.Problem.from_strings(
        {"x": "v", "v": "-k*x"}, {"x": "1", "v": "0"}, {"k": (1, 2)}, (0, 1)
    )
    solution = ro.solve(problem, rtol=1e-3)
    ax = plotting.plot_trajectories(solution, k=[1.0, 2.0], unknowns=["v", "x"])
    assert ax.get_ylabel() == "v, x"
    assert legend(ax) == ["v", "x", "k = 1", "k = 2"]


# --- bands -------------------------------------------------------------------------------------


def test_bands_of_quantiles():
    solution, under = populations(), {"x0": scipy.stats.norm(10, 0.5)}
    ax = plotting.plot_bands(solution, "y", TIMES, quantiles=(0.1, 0.8), under=under)
    ((_, mean),) = lines(ax)
    np.testing.assert_allclose(mean, solution.mean(TIMES, under=under)[1])
    times, lower, upper = band(ax)
    assert times.tolist() == TIMES.tolist()
    wanted = solution.quantile([0.1, 0.8], TIMES, under=under)[:, 1]
    np.testing.assert_allclose([lower, upper], wanted)
    assert legend(ax) == ["mean", "10 to 80 %"]


def test_bands_of_correlated_parameters():
    over = {"under": {"x0": scipy.stats.norm(10, 0.5)}, "correlation": {("x0", "y0"): 0.8}}
    for options in ({}, {"sigmas": 1}):
        ax = plotting.plot_bands(populations(), unknowns="x", t=[1.0, 2.0], **options, **over)
        _, lower, upper = band(ax)
        if options:
            wanted = 2 * populations().std([1.0, 2.0], **over)[0]
        else:
            low, high = populations().quantile([0.025, 0.975], [1.0, 2.0], **over)[:, 0]
            wanted = high - low
        np.testing.assert_allclose(upper - lower, wanted)
        mean = populations().mean([1.0, 2.0], **over)[0]
        np.testing.assert_allclose(lines(ax)[0][1], mean)


def test_bands_of_standard_deviations():
    solution = with_units()
    ax = plotting.plot_bands(solution, t=TIMES, sigmas=1.5)
    for row in (0, 1):
        _, lower, upper = band(ax, row)
        np.testing.assert_allclose(upper - lower, 3 * solution.std(TIMES)[row], rtol=1e-9)
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("t [a]", "x, y [1e3]")
    assert texts(ax) == ["x", "y"]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"quantiles": (0.9, 0.1)}, "two ascending probabilities"),
        ({"quantiles": 0.5}, "two ascending probabilities"),
        ({"quantiles": (0.1, 0.9), "sigmas": 2}, "both given"),
        ({"sigmas": -1}, "sigmas=-1"),
        ({"under": {"z0": scipy.stats.norm()}}, "no parameter `z0`"),
        ({"unknowns": []}, "none is given"),
        ({"unknowns": ["x", "x"]}, "twice"),
        ({"correlation": {("x0", "z0"): 0.5}}, "no parameter `z0`"),
        ({"t": [[0.0, 1.0]]}, "more than one dimension"),
        ({"t": []}, "no entry"),
    ],
)
def test_bands_that_are_refused(options, message):
    with pytest.raises(ro.OptionError, match=message):
        plotting.plot_bands(populations(), **options)


# --- surfaces ----------------------------------------------------------------------------------


@pytest.mark.parametrize(("x", "y"), [("t", "x0"), ("y0", "t"), ("y0", "x0")])
def test_surfaces(x, y):
    """Heights of a surface are those of the solution, with x across."""
    fixed = {"t": 2.0, "x0": 9.0, "y0": 5.0}
    rest = {name: value for name, value in fixed.items() if name not in (x, y)}
    ax = plt.figure().add_subplot(projection="3d")
    assert plotting.plot_surface(populations(), "x", rest, x=x, y=y, points=3, ax=ax) is ax
    assert (ax.get_xlabel(), ax.get_ylabel(), ax.get_zlabel()) == (x, y, "x")
    surface = ax.collections[0]  # Matplotlib 3.9 keeps its corners in homogeneous coordinates
    faces = np.concatenate(surface._faces) if hasattr(surface, "_faces") else surface._vec[:3].T
    at = {name: np.full(len(faces), value) for name, value in rest.items()}
    wanted = populations()["x"]({**at, x: faces[:, 0], y: faces[:, 1]})
    np.testing.assert_allclose(faces[:, 2], wanted)


def test_contours():
    ax = plotting.plot_surface(product(), "u", x="a", y="b", t=1.0)
    filled, _ = ax.collections
    assert filled.levels[0] <= 0.0
    assert filled.levels[-1] >= 4.0
    assert (ax.get_title("left"), ax.figure.axes[1].get_ylabel()) == ("t = 1", "u")
    # along the line of one level
    level = filled.levels[len(filled.levels) // 2]
    path = ax.collections[1].get_paths()[len(filled.levels) // 2]
    a, b = path.vertices.T
    np.testing.assert_allclose(a + 2 * b + a * b, level, atol=1e-3)


@pytest.mark.filterwarnings("ignore:parameter `k` appears nowhere")
def test_a_constant_is_drawn():
    problem = ro.Problem.from_strings({"u": "0"}, {"u": "2"}, {"k": (1, 2)}, (0, 1))
    plotting.plot_surface(
        ro.solve(problem, rtol=1e-3), "u", x="t", y="k"
    ).figure.draw_without_rendering()


def test_surfaces_of_one_time():
    later = product().at(0.5)
    ax = plotting.plot_surface(later, x="b", y="a")
    assert ax.get_title("left") == ""
    with pytest.raises(ro.EvaluationError, match="no coordinate `t`"):
        plotting.plot_surface(later, x="t", y="a")


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"x": "t", "y": "t", "y0": 5}, ro.OptionError, "both `t`"),
        ({"x": "t", "y": "x1", "y0": 5}, ro.EvaluationError, "no coordinate `x1`"),
        ({"x": "t", "y": "x0"}, ro.EvaluationError, "no value for `y0`"),
        ({"x": "t", "y": "x0", "y0": 7}, ro.EvaluationError, "outside its range"),
        ({"x": "t", "y": "x0", "y0": [4, 5]}, ro.OptionError, "not a number"),
        ({"x": "t", "y": "x0", "y0": 5, "x0": 9}, ro.OptionError, "along an axis"),
        ({"x": "t", "y": "x0", "y0": 5, "points": 1}, ro.OptionError, "points=1"),
        ({"x": "t", "y": "x0", "y0": 5, "unknown": "z"}, ro.EvaluationError, "no unknown `z`"),
        ({"x": "t", "y": "x0", "y0": 5, "unknown": None}, ro.EvaluationError, "2 unknowns: x, y"),
        ({"x": "t", "y": "x0", "y0": 5, "unknown": ["x", "y"]}, ro.OptionError, "names several"),
    ],
)
def test_surfaces_that_are_refused(options, error, message):
    with pytest.raises(error, match=message):
        plotting.plot_surface(populations(), **{"unknown": "x", **options})


def test_fixed_values_are_named_while_they_hold():
    solution = with_units()
    ax = plotting.plot_trajectories(solution, x0=9, y0=[4, 5])
    assert ax.get_title(loc="left") == "x0 = 9 1e3"
    plotting.plot_trajectories(solution, x0=9, y0=6, ax=ax)
    assert ax.get_title(loc="left") == ""
    ax = plotting.plot_surface(solution, "x", x="t", y="y0", x0=9)
    assert ax.get_title(loc="left") == "x0 = 9 1e3"
    _, own = plt.subplots()
    own.set_title("mine")
    plotting.plot_trajectories(solution, x0=9, y0=5, ax=own)
    assert (own.get_title(), own.get_title(loc="left")) == ("mine", "")


def test_many_fixed_values_are_cut():
    box = {f"p{i}": (1, 2) for i in range(20)}
    problem = ro.Problem.from_strings({"x": " + ".join(box)}, {"x": "0"}, box, (0, 1))
    ax = plotting.plot_trajectories(ro.solve(problem, 1e-3), dict.fromkeys(box, 1.5))
    title = ax.get_title(loc="left")
    assert title.endswith("p11 = 1.5, and 8 more")
    assert max(map(len, title.splitlines())) < 80


def test_curves_jump_at_events_and_end_with_time():
    problem = ro.Problem.from_strings(
        {"x": "1", "n": "0"},
        {"x": 0, "n": 0},
        {"k": (0.9, 1.1)},
        (0, 3),
        events=[
            {"when": "x - k", "then": {"x": 0, "n": "n + 1"}, "name": "full"},
            {"when": "n - 2.5", "terminal": True, "name": "last"},
        ],
        jumps={0.5: {"x": "x + 0.1"}},
    )
    solution = ro.solve(problem, 1e-3)
    assert solution.success, solution.message
    ax = plotting.plot_trajectories(solution, k=0.95, unknowns="x")
    (times, values), (ticks, _) = lines(ax)
    drops = np.array([0.85, 1.8, 2.75])
    np.testing.assert_allclose(ticks, drops, atol=1e-3)
    assert legend(ax) == ["at full, last"]
    steepest = np.flatnonzero(np.diff(values) < -0.9)
    np.testing.assert_allclose(times[steepest], drops[: steepest.size], atol=1e-3)
    assert steepest.size >= 2
    assert (np.diff(times)[steepest] < 1e-11).all()
    risen = int(np.nanargmax(np.diff(values)))
    assert times[risen] == pytest.approx(0.5)
    assert np.diff(times)[risen] < 1e-11
    assert np.isnan(values[times > 2.76]).all()
