"""Measurements, fitted curves and residuals."""

from __future__ import annotations

from types import SimpleNamespace

import matplotlib.pyplot as plt
import numpy as np
import pytest

import rankone as ro
from examples import lotka_volterra
from rankone import plotting
from tests.plotting.drawn import legend, lines, populations


def fit_of(**changes):
    x, times = {"x0": 9.0, "y0": 5.0}, np.array([0.5, 1.0, 2.0])
    given = {
        "solution": populations(),
        "times": times,
        "data": populations()(times, x) + 0.1,
        "observe": ("x", "y"),
        "sigma": [0.1, 0.2],
        "x": x,
    }
    return SimpleNamespace(**{**given, **changes})


def test_fits():
    fit = fit_of()
    upper, lower = plotting.plot_fit(fit)
    assert upper.get_ylabel() == "x, y"
    (_, ends_x), (_, curve_x) = lines(upper)[0], lines(upper)[1]
    np.testing.assert_allclose(ends_x, fit.data[0])
    times = lines(upper)[1][0]
    assert (times[0], times[-1]) == (0.0, 2.0)
    np.testing.assert_allclose(curve_x, populations()["x"](times, fit.x))
    np.testing.assert_allclose(lines(lower)[0][1], 1.0)
    np.testing.assert_allclose(lines(lower)[1][1], 0.5)
    bars = [c.get_segments() for c in upper.collections]
    np.testing.assert_allclose(bars[1][0][:, 1], fit.data[1, 0] + np.array([-0.2, 0.2]))


def test_fits_of_one_output():
    data = np.array([0.5, np.nan, 0.9])
    fit = fit_of(observe="y", data=data, sigma=None)
    upper, lower = plotting.plot_fit(fit)
    assert legend(upper) == ["fitted", "measured"]
    assert lower.get_ylabel() == "residual"
    rest = data - populations()["y"](fit.times, fit.x)
    np.testing.assert_allclose(lines(lower)[0][1], rest)


def test_fits_given_by_name():
    """Outputs may have times of their own."""
    times = {"x": np.array([0.5]), "y": np.array([1.0, 3.0])}
    data = {lotka_volterra.x: [1.0], "y": [0.5, 0.25]}
    upper, _ = plotting.plot_fit(fit_of(times=times, data=data, sigma={"x": 0.1, "y": [0.1, 0.2]}))
    measured_x, curve_x, measured_y, curve_y = (found for found, _ in lines(upper))
    assert (measured_x.tolist(), measured_y.tolist()) == ([0.5], [1.0, 3.0])
    assert (curve_x[-1], curve_y[-1]) == (0.5, 3.0)


def test_fits_into_axes():
    _, axes = plt.subplots(2)
    assert plotting.plot_fit(fit_of(), ax=axes) == tuple(axes)
    assert plotting.plot_fit(fit_of(), ax=axes[0]) == (axes[0],)
    with pytest.raises(ro.OptionError, match="3 axes"):
        plotting.plot_fit(fit_of(), ax=[axes[0]] * 3)


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"data": np.ones((2, 4))}, ro.OptionError, "do not fit 3 times"),
        ({"sigma": np.ones(5)}, ro.OptionError, "do not fit 3 times"),
        ({"observe": ("x", "z")}, ro.EvaluationError, "no unknown `z`"),
        ({"x": {"x0": 9.0}}, ro.EvaluationError, "no value for `y0`"),
        ({"times": [0.5, 1.0, 9.0]}, ro.EvaluationError, "outside of its horizon"),
    ],
)
def test_fits_that_are_refused(changes, error, message):
    with pytest.raises(error, match=message):
        plotting.plot_fit(fit_of(**changes))


def test_what_is_no_fit():
    with pytest.raises(ro.OptionError, match="is not a fit: it has no"):
        plotting.plot_fit(populations())
