"""Fits of tables with rows of doses: sums of the curve of one dose, against closed forms."""

from __future__ import annotations

import numpy as np
import pytest

import rankone as ro
from tests.inference.populations.test_doses import DOSES, SAMPLES, WRONG, bolus, columns, exact

ONE = [(0.0, 5.0), (3.1, 3.0), (6.0, 4.0)]
AMOUNT = {"doses": {"dose": "amt"}}


def table(doses=ONE, k=0.3, **more):
    """Doses, then data of one subject, without noise."""
    data = exact(SAMPLES, k, doses)
    times, amounts = np.array(doses).T
    rows = {"t": [*times, *SAMPLES], "amt": [*amounts, *np.full(data.size, np.nan)]}
    return {**rows, "u": [*np.full(times.size, np.nan), *data], **more}


def test_one_subject_needs_no_column_of_subjects():
    fit = bolus().fit(table(), sigma=0.01, **AMOUNT)
    assert fit.success, fit.message
    assert fit.parameters == ("k",)
    assert abs(fit.x["k"] - 0.3) < 1e-5
    assert np.abs(fit.residuals["u"]).max() < 1e-4
    times = np.linspace(0.0, 10.0, 7)
    np.testing.assert_allclose(fit.curve("u", times)[0], exact(times, 0.3, ONE), rtol=1e-5)
    assert fit.values == fit.x  # without an amount: each dose has its own


def test_a_datum_before_a_dose_at_the_same_time_and_none_before_the_first():
    """The order of rows tells which is first; nothing is there before any dose."""
    late = [(2.0, 5.0), (6.0, 4.0)]
    data = exact(SAMPLES, 0.3, late)
    data[SAMPLES == 6.0] -= 4.0
    rows = {"t": [2.0, *SAMPLES[:4], 6.0, *SAMPLES[4:]], "amt": [5.0, *[0] * 4, 4.0, 0, 0]}
    rows["u"] = [np.nan, *data[:4], np.nan, *data[4:]]
    fit = bolus().fit(rows, sigma=0.01, **AMOUNT)
    assert abs(fit.x["k"] - 0.3) < 1e-5
    assert fit.residuals["u"][0] == 0.0


def test_conditions_and_subjects_have_doses_of_their_own():
    """Experiments of one rate; the same doses by subject, condition, or as experiments."""
    tables = [table(doses, 0.3) for doses in DOSES[:3]]
    stacked = {key: np.concatenate([each[key] for each in tables]) for key in tables[0]}
    labels = np.repeat(["a", "b", "c"], [len(each["t"]) for each in tables])
    for column in ("subject", "condition"):
        fit = bolus().fit({**stacked, column: labels}, sigma=0.01, **AMOUNT)
        assert len(fit.trials) == 3
        assert abs(fit.x["k"] - 0.3) < 1e-5
    pairs = [(bolus(), ro.Experiment(each, sigma=0.01, **AMOUNT)) for each in tables]
    assert ro.fit(pairs).x == pytest.approx(fit.x, rel=1e-9)


def test_posterior_and_design_take_the_doses_of_a_fit():
    """Information is k-derivatives of the sum of curves, where samples are most telling."""
    fit = bolus().fit(table(), sigma=0.1, **AMOUNT)
    posterior = bolus().posterior(table(), sigma=0.1, **AMOUNT)
    assert posterior.mean["k"] == pytest.approx(0.3, abs=0.01)
    assert posterior.std["k"] == pytest.approx(fit.std["k"], rel=0.1)
    times = np.linspace(0.5, 9.5, 37)
    design = bolus().design(1, times, after=fit)
    step = 1e-4
    slopes = exact(times, 0.3 + step, ONE) - exact(times, 0.3 - step, ONE)
    assert design.times[0] == times[np.argmax(np.abs(slopes))]
    two = bolus().fit(columns(), sigma=0.1, **AMOUNT)
    with pytest.raises(ro.OptionError, match="have doses of their own"):
        bolus().design(1, times, after=two)


@pytest.mark.parametrize(
    ("rows", "options", "message"), WRONG[:-2], ids=[message for *_, message in WRONG[:-2]]
)
def test_what_populations_refuse_is_refused(rows, options, message):
    options = {key: entry for key, entry in options.items() if key != "random"}
    with pytest.raises(ro.OptionError, match=message):
        bolus().fit(rows, **{**AMOUNT, "sigma": 0.01, **options})


def test_what_else_is_refused():
    with pytest.raises(ro.OptionError, match="the experiments fix `dose` themselves"):
        bolus().fit(table(), fixed={"dose": 1.0}, **AMOUNT)
    with pytest.raises(ro.OptionError, match="`u` depends on `dose` itself"):
        bolus().fit(table(), observe={"u": "u/dose"}, **AMOUNT)
    with pytest.raises(ro.OptionError, match="the data are none"):
        bolus().fit(SAMPLES, exact(SAMPLES, 0.3, ONE), **AMOUNT)
    for column in ("amt", "AMT"):
        rows = {key.replace("amt", column): each for key, each in table().items()}
        with pytest.raises(ro.OptionError, match=r"has doses.*`doses` does not say") as refused:
            bolus().fit(rows, sigma=0.01)
        assert refused.value.term == column
        assert f'doses={{"dose": "{column}"}}' in refused.value.remedy
        named = {**rows, "u": rows["u"]}
        assert bolus().fit(named, sigma=0.01, doses={"dose": column}).success
    with pytest.raises(ro.OptionError, match=r"`amt` .* has doses") as refused:
        bolus().fit_population(columns(), random=["k"])
    assert 'doses={"dose": "amt"}' in refused.value.remedy
    without = {**table(), "amt": np.full(len(table()["t"]), np.nan)}
    with pytest.raises(ro.OptionError, match="the table has data and no dose"):
        bolus().fit(without, **AMOUNT)
    assert "dose" in bolus().fit({**without, "u": table()["u"]}, sigma=0.01).parameters


def test_statistics_under_a_fit_with_doses_are_those_of_an_amount_that_is_fixed():
    fit = bolus().fit(table(), sigma=0.01, **AMOUNT)
    with pytest.raises(ro.OptionError, match="own values of `dose`") as refused:
        bolus().mean(1.0, under=fit)
    assert "solution.fix(dose=...)" in refused.value.remedy
    mean = bolus().fix(dose=2.0).mean(1.0, under=fit)
    assert mean[0] == pytest.approx(2.0 * np.exp(-0.3), rel=1e-4)
