"""Corner plots, profiles, designs and densities show what their results hold."""

from __future__ import annotations

import functools

import matplotlib.pyplot as plt
import numpy as np
import pytest
import scipy.stats

import rankone as ro
from rankone import plotting
from tests.inference.estimation.systems import decay
from tests.share.plotting.drawn import legend, lines, product

TIMES = np.linspace(0.1, 2, 12)
DATA = 2.0 * np.exp(-1.3 * TIMES) + 0.05 * np.random.default_rng(0).standard_normal(12)


@functools.cache
def fitted():
    return decay().fit(TIMES, DATA, sigma=0.05)


@functools.cache
def posterior():
    return ro.posterior(fitted())


def test_a_corner_plot():
    axes = plotting.plot_posterior(posterior())
    assert axes.shape == (2, 2)
    assert [panel.get_visible() for panel in axes.ravel()] == [True, False, True, True]
    for j, name in enumerate(("k", "a")):
        x, density = lines(axes[j, j])[0]
        np.testing.assert_allclose(density, posterior().density(name, x))
    assert (axes[1, 0].get_xlabel(), axes[1, 0].get_ylabel()) == ("k", "a")
    given = plt.figure().subplots(2, 2)
    assert plotting.plot_posterior(posterior(), ax=given)[1, 1] is given[1, 1]


def test_contours_hold_their_share():
    """95 and 50 % of the points lie inside of the contours."""
    panel = plotting.plot_posterior(posterior())[1, 0]
    points = posterior().sample(4000, seed=3)
    pairs = np.stack([points["k"], points["a"]], axis=1)
    (contours,) = panel.collections
    outer, inner = contours.get_paths()
    covered = [inner.contains_points(pairs), outer.contains_points(pairs)]
    assert covered[0].mean() == pytest.approx(0.5, abs=0.06)
    assert (covered[0] | covered[1]).mean() == pytest.approx(0.95, abs=0.03)


def test_profiles_reach_the_limit_at_the_ends_of_intervals():
    fit = fitted()
    axes = plotting.plot_profiles(fit)
    ends = fit.interval(method="profile")
    for panel, name in zip(axes, ("k", "a"), strict=True):
        (x, rise), (_, limit), (line, square), *_ = lines(panel)
        assert limit[0] == pytest.approx(scipy.stats.norm.ppf(0.975) ** 2)
        marks = sorted(float(at[0]) for at, _ in lines(panel)[4:])
        np.testing.assert_allclose(marks, ends[name], rtol=1e-6)
        wanted = ((line - fit.x[name]) / fit.std[name]) ** 2
        np.testing.assert_allclose(square, wanted)
        assert np.interp(ends[name][1], x, rise) == pytest.approx(limit[0], rel=0.1)
    (one,) = plotting.plot_profiles(fit, ["k"])
    assert one.get_xlabel() == "k"


def test_a_design():
    plan = decay().design(2, after=fitted())
    upper, lower = plotting.plot_design(plan)
    times, curve = lines(upper)[0]
    np.testing.assert_allclose(curve, decay()["u"](times, fitted().values))
    np.testing.assert_allclose(lines(lower)[0][1], plan.gain)
    np.testing.assert_allclose(
        upper.collections[0].get_offsets()[:, 0], np.unique(plan.times), atol=1e-12
    )


def test_densities():
    ax = plotting.plot_density(product(), "u", [0.5, 1.0])
    assert legend(ax) == ["t = 0.5", "t = 1"]
    x, density = lines(ax)[1]
    np.testing.assert_allclose(density, product().density(1.0, values=x).density, rtol=1e-12)
    with pytest.raises(ro.OptionError, match="this plot needs a time"):
        plotting.plot_density(product())


def test_a_solution_plots_itself():
    ax = product().plot()
    assert legend(ax)[0] == "mean"
    curve = lines(product().plot(a=0.5, b=1.0))[0][1]
    assert curve[-1] == pytest.approx(3.0)
    assert product().plot({"a": 0.5, "b": 1.0}, ax=ax) is ax


def test_what_is_something_else():
    with pytest.raises(ro.OptionError, match="needs a Posterior, not Fit"):
        plotting.plot_posterior(fitted())
    with pytest.raises(ro.OptionError, match="needs a Fit, not Posterior"):
        plotting.plot_profiles(posterior())
    with pytest.raises(ro.OptionError, match="needs a Design, not Fit"):
        plotting.plot_design(fitted())
    with pytest.raises(ro.OptionError, match="not a free parameter"):
        plotting.plot_profiles(fitted(), ["b"])
    with pytest.raises(ro.OptionError, match="3 axes were given for 4"):
        plotting.plot_posterior(posterior(), ax=[plt.figure().subplots()] * 3)
