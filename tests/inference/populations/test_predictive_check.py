"""Predictive checks agree with closed forms, and see what is wrong."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.stats

import rankone as ro
from tests.inference.populations.simulated import as_table, level, levels, one_way, population

QUANTILES = (0.05, 0.5, 0.95)


def test_simulated_quantiles_are_those_of_the_fitted_distribution():
    fit = levels()
    check = fit.predictive_check(count=2000, seed=1)
    assert check.times.tolist() == pytest.approx(np.linspace(0, 4, 4))
    assert check.counts.tolist() == [12] * 4
    spread = np.hypot(fit.x["omega_a"], fit.x["sigma_u"])
    draws = np.random.default_rng(5).standard_normal((20000, 12))
    expected = fit.x["a"] + spread * np.median(np.quantile(draws, QUANTILES, axis=1), axis=1)
    np.testing.assert_allclose(check.simulated[:, 1], expected[:, None] * np.ones(4), atol=0.15)
    np.testing.assert_allclose(
        check.observed, np.quantile(one_way(1), QUANTILES, axis=0), rtol=1e-12
    )
    assert check.inside.shape == (3, 4)
    assert f"{check.inside.sum()} of 12 quantiles" in check.message
    assert np.array_equal(check.simulated, fit.predictive_check(count=2000, seed=1).simulated)


def test_a_wrong_model_is_seen():
    """Levels that grow in time are no constants."""
    data = one_way(2, 20) + np.array([-3.0, -1.0, 1.0, 3.0])
    fit = level().fit_population(as_table(data), random={"a": "normal"})
    check = fit.predictive_check()
    assert not check.inside[1, [0, -1]].any()
    assert "nan" not in repr(check)


def test_draws_outside_of_the_box_are_counted_or_refused():
    narrow = level().restrict(a=(6, 14))
    fit = narrow.fit_population(as_table(one_way(1)), random={"a": "normal"})
    assert any("the box does not hold 3 standard deviations" in note for note in fit.checks)
    check = fit.predictive_check()
    inside = scipy.stats.norm(fit.x["a"], fit.x["omega_a"]).cdf([6, 14])
    assert check.outside == pytest.approx(1.0 - np.diff(inside)[0], abs=0.02)
    assert "drawn again" in check.message


def test_options():
    fit = levels()
    assert fit.predictive_check(bins=2).times.size == 2
    assert fit.predictive_check(bins=[1, 3]).counts.tolist() == [12, 24, 12]
    frame = fit.predictive_check().to_dataframe()
    assert list(frame.columns) == ["observed", "lower", "median", "upper"]
    with pytest.raises(ro.OptionError, match="`v` was not observed"):
        fit.predictive_check("v")
    with pytest.raises(ro.OptionError, match="count=1 is not valid"):
        fit.predictive_check(count=1)
    with pytest.raises(ro.OptionError, match="bins=0 is not valid"):
        fit.predictive_check(bins=0)


@pytest.mark.slow
def test_corrected_predictions_make_doses_comparable():
    """With one dose twice as high, the spread of corrected data is smaller."""
    fit = population(4, 16)
    plain, corrected = (fit.predictive_check(corrected=each) for each in (False, True))
    assert np.ptp(corrected.observed, axis=0).mean() < np.ptp(plain.observed, axis=0).mean()
    assert corrected.inside.mean() > 0.8
