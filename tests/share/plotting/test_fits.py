"""Measurements, fitted curves, their bands and residuals are those of a fit."""

from __future__ import annotations

import functools

import matplotlib.pyplot as plt
import numpy as np
import pytest
import scipy.stats

import rankone as ro
from examples import lotka_volterra
from rankone import plotting
from tests.share.plotting.drawn import band, legend, lines, populations, product

TIMES = np.array([0.5, 1.0, 1.5, 2.0, 3.0])
TRUE = {"x0": 9.0, "y0": 5.0}
NOISE = np.random.default_rng(4).normal(size=(2, TIMES.size))
SIGMA = np.array([0.1, 0.2])


@functools.cache
def both():
    """Two outputs, each with its own sigma."""
    data = populations()(TIMES, TRUE) + SIGMA[:, None] * NOISE
    return populations().fit(TIMES, data, sigma=SIGMA), data


def of_line(sigma=None, weights=None, **fixed):
    """u = t (a + 2 b + a b) at three times, with b = 0.5: a straight line of slope 1 + 1.5 a."""
    times, data = np.array([0.2, 0.5, 1.0]), np.array([0.4, 0.8, 1.8])
    fit = product().fit(times, data, sigma=sigma, weights=weights, fixed={"b": 0.5, **fixed})
    return fit, times, data


def bars(ax, number=0):
    """Half the lengths of error bars."""
    found = [one.get_segments() for one in ax.collections if hasattr(one, "get_segments")]
    return np.array([0.5 * np.ptp(bar[:, 1]) for bar in found[number]] if found else [])


def test_two_outputs():
    fit, data = both()
    upper, lower = plotting.plot_fit(fit)
    assert (upper.get_ylabel(), lower.get_ylabel()) == ("x, y", "residual\n[std]")
    assert legend(upper) == ["measured", "fitted", "95 % band of the curve"]
    (_, data_x), (times, curve_x), (_, data_y), (_, curve_y) = lines(upper)
    np.testing.assert_array_equal([data_x, data_y], data)
    assert (times[0], times[-1]) == (0.0, 3.0)
    np.testing.assert_allclose([curve_x, curve_y], populations()(times, fit.values))
    for row, sigma in enumerate(SIGMA):
        np.testing.assert_allclose(bars(upper, row), sigma)
        rest = (data[row] - populations()(TIMES, fit.values)[row]) / sigma
        np.testing.assert_allclose(lines(lower)[row][1], rest)


def test_residuals_are_data_less_curve():
    data = populations()["x"](TIMES, TRUE)
    data[2] += 1.0
    fit = populations().fit(TIMES, data, observe="x", sigma=0.1, fixed={"y0": 5})
    _, lower = plotting.plot_fit(fit)
    assert np.argmax(lines(lower)[0][1]) == 2


def test_outputs_with_their_own_times():
    times = {"x": [0.5, 1.0], "y": [1.0, 3.0]}
    x, y = (populations()[name](times[name], TRUE) for name in "xy")
    data = {lotka_volterra.x: x + 0.1, "y": y - 0.1}
    fit = populations().fit(times, data, sigma={"x": 0.1, "y": [0.1, 0.2]})
    upper, lower = plotting.plot_fit(fit)
    measured_x, curve_x, measured_y, curve_y = (found for found, _ in lines(upper))
    assert (measured_x.tolist(), measured_y.tolist()) == ([0.5, 1.0], [1.0, 3.0])
    assert (curve_x[-1], curve_y[-1]) == (1.0, 3.0)
    np.testing.assert_allclose(bars(upper, 1), [0.1, 0.2])
    assert [line[0].tolist() for line in lines(lower)[:2]] == [[0.5, 1.0], [1.0, 3.0]]


def test_missing_values_are_not_drawn():
    data = populations()["y"](TIMES, TRUE)
    data[1] = np.nan
    fit = populations().fit(TIMES, data, observe="y", sigma=0.1, missing="drop")
    upper, lower = plotting.plot_fit(fit)
    for ax in (upper, lower):
        assert lines(ax)[0][0].tolist() == [0.5, 1.5, 2.0, 3.0]


def test_sigma_that_is_estimated():
    """By hand for a line through zero, with weights: one over the variance up to a factor."""
    weights = np.array([4.0, 1.0, 1.0])
    fit, times, data = of_line(weights=weights)
    slope = np.sum(weights * times * data) / np.sum(weights * times**2)
    rest = data - slope * times
    variance = np.sum(weights * rest**2) / 2
    upper, lower = plotting.plot_fit(fit)
    assert lower.get_ylabel() == "residual\n[estimated std]"
    sigma = np.sqrt(variance / weights)
    np.testing.assert_allclose(bars(upper), sigma, rtol=1e-6)
    np.testing.assert_allclose(lines(lower)[0][1], rest / sigma, rtol=1e-5)
    at, low, high = band(upper)
    half = scipy.stats.t.ppf(0.975, 2) * np.sqrt(variance / np.sum(weights * times**2)) * at
    np.testing.assert_allclose([low, high], [slope * at - half, slope * at + half], atol=1e-6)


def test_bands_of_given_sigma():
    """The delta method by hand: sigma t over the norm of the times."""
    fit, times, _ = of_line(sigma=0.3)
    upper, _ = plotting.plot_fit(fit)
    at, low, high = band(upper)
    half = scipy.stats.norm.ppf(0.975) * 0.3 * at / np.linalg.norm(times)
    np.testing.assert_allclose(0.5 * (high - low), half, atol=1e-6)


def test_bands_are_those_of_the_information():
    fit, _ = both()
    upper, _ = plotting.plot_fit(fit)
    at, low, high = band(upper, 0)
    slopes = populations().gradient(at, fit.values)[0]
    spread = np.sqrt(np.einsum("it,ij,jt->t", slopes, np.linalg.inv(fit.information), slopes))
    np.testing.assert_allclose(0.5 * (high - low), scipy.stats.norm.ppf(0.975) * spread, rtol=1e-6)


def test_bands_of_parameters_that_are_not_identified():
    """Neither a nor b is known from u = t (a + 2 b + a b), but the slope of the line is."""
    times, data = np.array([0.2, 0.5, 1.0]), np.array([0.4, 0.8, 1.8])
    fit = product().fit(times, data, sigma=0.3)
    assert not any(fit.identifiable.values())
    upper, _ = plotting.plot_fit(fit)
    at, low, high = band(upper)
    half = scipy.stats.norm.ppf(0.975) * 0.3 * at / np.linalg.norm(times)
    np.testing.assert_allclose(0.5 * (high - low), half, atol=1e-6)


def test_data_that_are_met_exactly(monkeypatch):
    """There is no noise to measure residuals in."""
    fit = populations().fit(TIMES, populations()(TIMES, TRUE))
    monkeypatch.setattr(ro.Fit, "deviations", [np.zeros(2 * TIMES.size)])
    upper, lower = plotting.plot_fit(fit)
    assert lower.get_ylabel() == "residual"
    np.testing.assert_allclose(lines(lower)[0][1], 0.0, atol=1e-6)
    assert bars(upper).size == 0


def test_fits_into_axes():
    fit, _ = both()
    _, axes = plt.subplots(2)
    assert plotting.plot_fit(fit, ax=axes) == tuple(axes)
    assert plotting.plot_fit(fit, ax=axes[0]) == (axes[0],)
    with pytest.raises(ro.OptionError, match="3 axes"):
        plotting.plot_fit(fit, ax=[axes[0]] * 3)


def test_what_is_no_fit():
    with pytest.raises(ro.OptionError, match="needs a Fit, not Solution"):
        plotting.plot_fit(populations())
    later = product().at(0.5)
    fit = later.fit(None, [0.7], sigma=0.1, fixed={"b": 0.5})
    with pytest.raises(ro.EvaluationError, match="do not depend on time"):
        plotting.plot_fit(fit)
