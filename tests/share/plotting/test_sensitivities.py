"""Sobol indices and main effects that are drawn are those of the solution."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scipy.stats

import rankone as ro
from rankone import plotting
from tests.share.plotting.drawn import band, legend, lines, populations, product, texts, with_units

TIMES = np.linspace(0.0, 6.0, 13)


def test_total_indices():
    sobol = populations().sobol(TIMES)
    ax = plotting.plot_sobol(populations(), "y", TIMES)
    np.testing.assert_allclose([values for _, values in lines(ax)], sobol.total[1])
    assert ax.get_ylabel() == "total Sobol indices of y"
    assert texts(ax) == ["x0", "y0"]


def test_both_indices():
    sobol = populations().sobol(TIMES)
    ax = plotting.plot_sobol(populations(), t=TIMES, kind="both")
    wanted = np.concatenate([sobol.total[0], sobol.first[0]])
    np.testing.assert_allclose([values for _, values in lines(ax)], wanted)
    assert legend(ax) == ["total", "first-order", "± half-width of 95 %"]
    for row, kind in enumerate(("total", "first")):
        half_width = getattr(sobol, f"{kind}_half_width")[0, 0]
        known = np.isfinite(half_width)
        _, lower, upper = band(ax, 2 * row)
        np.testing.assert_allclose((upper - lower)[known], 2.0 * half_width[known], atol=1e-12)


def test_first_order_indices_are_stacked():
    times = np.array([0.5, 1.0])
    ax = plotting.plot_sobol(product(), t=times, kind="first")
    # variances of a + 2 b + a b: (1.5 a, 2.5 b, product of the deviations)
    parts = np.array([1.5**2 / 12, 2.5**2 / 12, 1 / 144])
    wanted = np.cumsum(parts / parts.sum())
    for number, share in enumerate(wanted):
        _, _, upper = band(ax, number)
        np.testing.assert_allclose(upper, share, rtol=1e-6)
    assert legend(ax) == ["interactions", "b", "a"]


def test_bars_at_one_time():
    sobol = product().sobol([1.0])
    for solution, t in ((product(), 1.0), (product(), [1.0]), (product().at(1.0), None)):
        ax = plotting.plot_sobol(solution, t=t, kind="both")
        assert [tick.get_text() for tick in ax.get_yticklabels()] == ["a", "b"]
        widths = [bar.get_width() for bar in ax.patches]
        np.testing.assert_allclose(widths, [*sobol.total[0, :, 0], *sobol.first[0, :, 0]])
        when = "" if t is None else " at t = 1"
        assert ax.get_xlabel() == f"Sobol indices of u{when}"
        assert texts(ax) == [f"{share:.2f}" for share in sobol.total[0, :, 0]]
        assert not ax.collections  # its half-widths are below a line


def test_bars_have_whiskers_where_half_widths_are_seen():
    sobol = populations().sobol(2.5)
    ax = plotting.plot_sobol(populations(), "y", 2.5, kind="first")
    (whiskers,) = ax.collections
    lengths = sorted(float(np.ptp(path[:, 0])) for path in whiskers.get_segments())
    np.testing.assert_allclose(lengths, sorted(2.0 * sobol.first_half_width[1].ravel()))


def test_indices_below_the_error_are_left_out():
    """At the start nothing varies but rounding."""
    ax = plotting.plot_sobol(product(), t=[0.0, 1.0])
    for _, values in lines(ax):
        assert np.isnan(values).tolist() == [True, False]
    with pytest.raises(ro.EvaluationError, match="does not vary by more than its error"):
        plotting.plot_sobol(product(), t=0.0)


def test_no_indices_of_correlated_parameters():
    solution = populations()
    metadata = replace(solution.metadata, correlations=(("x0", "y0", 0.6),))
    correlated = ro.Solution(solution.outcome, metadata)
    with pytest.raises(ro.OptionError, match="not defined for correlated parameters"):
        plotting.plot_sobol(correlated, t=TIMES)
    ax = plotting.plot_sobol(correlated, t=TIMES, correlation={})
    wanted = correlated.sobol(TIMES, correlation={}).total[0]
    np.testing.assert_allclose([values for _, values in lines(ax)], wanted)


def test_main_effects():
    """Of t (a + 2 b + a b): the mean over the other parameter."""
    ax = plotting.plot_main_effects(product(), "u", t=0.5)
    shares = np.linspace(0, 1, 101)
    (x, by_a), (_, by_b), (_, mean) = lines(ax)
    np.testing.assert_allclose(x, shares)
    np.testing.assert_allclose(by_a, 0.5 * (1.5 * shares + 1.0), rtol=1e-8)
    np.testing.assert_allclose(by_b, 0.5 * (2.5 * shares + 0.5), rtol=1e-8)
    np.testing.assert_allclose(mean, 0.5 * 1.75, rtol=1e-8)
    assert legend(ax) == ["a: 0 to 1", "b: 0 to 1"]
    assert ax.get_ylabel() == "mean of u at t = 0.5"
    later = plotting.plot_main_effects(product().at(0.5))
    np.testing.assert_allclose(lines(later)[0][1], by_a, rtol=1e-8)
    assert later.get_ylabel() == "mean of u"


@pytest.mark.slow
def test_main_effects_are_those_of_the_solution():
    under = {"y0": scipy.stats.norm(5, 0.3), "x0": scipy.stats.norm(10, 0.5)}
    for over in ({"under": under}, {"under": under, "correlation": {("x0", "y0"): 0.6}}):
        ax = plotting.plot_main_effects(populations(), "y", 4.0, **over)
        found = populations().main_effects(4.0, **over)
        drawn = [values for _, values in lines(ax)]
        np.testing.assert_allclose(drawn[:2], [found.means[name][1] for name in ("x0", "y0")])
        np.testing.assert_allclose(drawn[2], populations().mean(4.0, **over)[1])


def test_main_effects_with_units():
    ax = plotting.plot_main_effects(with_units(), "y", t=1.0)
    assert legend(ax) == ["x0: 8 to 12 1e3", "y0: 4 to 6"]
    assert ax.get_ylabel() == "mean of y [1e3] at t = 1 a"


@pytest.mark.parametrize(
    ("draw", "error", "message"),
    [
        (lambda s: plotting.plot_sobol(s, kind="totl"), ro.OptionError, "did you mean `total`"),
        (lambda s: plotting.plot_sobol(s, "z"), ro.EvaluationError, "no unknown `z`"),
        (lambda s: plotting.plot_sobol(s, ["x", "y"]), ro.OptionError, "names several"),
        (lambda s: plotting.plot_sobol(s, t=7.0), ro.EvaluationError, "outside its horizon"),
        (lambda s: plotting.plot_main_effects(s), ro.OptionError, "needs a time"),
        (lambda s: plotting.plot_main_effects(s, t=[1, 2]), ro.OptionError, "several times"),
        (lambda s: plotting.plot_main_effects(s, t="now"), ro.EvaluationError, "not a real number"),
        (lambda s: plotting.plot_sobol(s.at(1.0), t=1.0), ro.EvaluationError, "leave t out"),
        (lambda s: plotting.plot_bands(s.at(1.0)), ro.EvaluationError, "depend on time"),
        (
            lambda s: plotting.plot_trajectories(s.at(1.0), x0=9, y0=5),
            ro.EvaluationError,
            "depend on time",
        ),
        (lambda s: plotting.plot_trajectories(s, x0=9), ro.EvaluationError, "no value for `y0`"),
        (lambda s: plotting.plot_trajectories(s, x0=9, y0=[]), ro.OptionError, "no curve"),
        (lambda s: plotting.plot_trajectories(s, x0=99, y0=5), ro.EvaluationError, "outside"),
        (
            lambda s: plotting.plot_trajectories(s, x0=[8, 9], y0=[4, 5, 6]),
            ro.EvaluationError,
            "do not broadcast",
        ),
    ],
)
def test_what_is_refused(draw, error, message):
    with pytest.raises(error, match=message):
        draw(populations())


def test_statistics_need_unknowns_and_parameters():
    problem = ro.Problem.from_strings({"x": "-x"}, {"x": "1"}, {}, (0, 1))
    solution = ro.solve(problem, rtol=1e-3)
    for draw in (plotting.plot_sobol, plotting.plot_main_effects):
        with pytest.raises(ro.EvaluationError, match="has no parameters"):
            draw(solution)
    assert len(lines(plotting.plot_trajectories(solution))) == 1
    plotting.plot_bands(solution)
