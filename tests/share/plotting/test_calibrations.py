"""`plot_calibration`: what is drawn is what was measured and found."""

import matplotlib.pyplot as plt
import numpy as np
import pytest

import rankone as ro
from rankone.plotting import plot_calibration

TIMES = np.array([0.2, 0.5, 1.0, 2.0])


@pytest.fixture(scope="module")
def calibration():
    """Decay measured in two experiments, one with log-normal noise."""
    problem = ro.Problem.from_strings(
        {"x": "-k*x"}, {"x": "dose"}, {"k": (1e-3, 1e3, "log"), "dose": (1, 10)}, (0, 2)
    )
    curve = np.exp(-0.8 * TIMES)
    wiggle = np.array([1.02, 0.97, 1.01, 1.0])
    experiments = [
        ro.Experiment(2 * curve * wiggle, TIMES, fixed={"dose": 2}, observe={"a": "x"}, sigma=0.05,
                      name="low"),
        ro.Experiment(5 * curve / wiggle, TIMES, fixed={"dose": 5}, observe={"b": "x"}, sigma=0.03,
                      noise="log-normal", name="high"),
    ]  # fmt: skip
    return ro.calibrate(problem, experiments, starts=3, box=False)


def test_measurements_predictions_and_their_errors_are_compared(calibration):
    low, high = calibration.comparisons
    k = calibration.x["k"]
    assert k == pytest.approx(0.8, rel=0.05)
    assert (low.observable, low.experiment, high.experiment) == ("a", "low", "high")
    np.testing.assert_allclose(low.predicted, 2 * np.exp(-k * TIMES), rtol=1e-4)
    np.testing.assert_allclose(low.bars - low.measured, np.outer([-1, 1], np.full(4, 0.05)))
    np.testing.assert_allclose(high.bars, high.measured * np.exp(np.outer([-1, 1], [0.03] * 4)))
    residuals = np.log(high.measured / (5 * np.exp(-k * TIMES))) / 0.03
    np.testing.assert_allclose(high.standardised, residuals, atol=0.01)
    # the band by hand: one parameter, d log x / d log k = -k t, in each of the experiments
    slopes = k * TIMES
    information = np.sum((slopes * low.predicted / 0.05) ** 2) + np.sum((slopes / 0.03) ** 2)
    half = 1.96 * slopes / np.sqrt(information)
    np.testing.assert_allclose(high.band[1], high.predicted * np.exp(half), rtol=1e-3)
    np.testing.assert_allclose(low.band[1], low.predicted * (1 + half), rtol=1e-3)


def test_each_observable_has_a_panel_beside_residuals_and_starts(calibration):
    axes = plot_calibration(calibration)
    assert [panel.get_title() for panel in axes] == ["a", "b", "residuals", "starts"]
    np.testing.assert_allclose(axes[0].lines[-1].get_ydata(), calibration.comparisons[0].predicted)
    drawn = np.concatenate([line.get_ydata() for line in axes[2].lines[:2]])
    expected = np.concatenate([each.standardised for each in calibration.comparisons])
    np.testing.assert_allclose(drawn, expected)
    assert (np.diff(axes[3].lines[0].get_ydata()) >= 0.0).all()
    (panel, *_), count = plot_calibration(calibration, observables=["b"]), 3
    assert panel.get_title() == "b"
    figure, own = plt.subplots(1, count)
    assert list(plot_calibration(calibration, observables="b", ax=own)) == list(own)
    plt.close(figure)


def test_what_cannot_be_drawn_is_said(calibration):
    with pytest.raises(ro.OptionError, match="needs a Calibration, not dict"):
        plot_calibration({})
    with pytest.raises(ro.OptionError, match="no observable `c`"):
        plot_calibration(calibration, observables=["c"])
    with pytest.raises(ro.OptionError, match="2 axes were given for 4"):
        plot_calibration(calibration, ax=plt.subplots(1, 2)[1])
