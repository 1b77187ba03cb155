"""Fits of populations: closed forms, an independent likelihood, and what is refused."""

from __future__ import annotations

import functools

import numpy as np
import pytest
import scipy.optimize
import scipy.stats

import rankone as ro
from tests.inference.populations.simulated import (
    HOURS,
    MEANS,
    SPREADS,
    TRUE,
    as_table,
    concentration,
    levels,
    one_way,
    oral,
    population,
    table_of,
)


@functools.cache
def fit():
    return population(3)


def test_one_way_analysis_of_variance():
    """A linear model is exact: estimates and intervals have closed forms."""
    data = one_way(1)
    n, m = data.shape
    population = levels()
    assert population.success, population.message
    within = np.sum((data - data.mean(axis=1, keepdims=True)) ** 2) / (n * (m - 1))
    between = data.mean(axis=1).var()
    assert population.x["a"] == pytest.approx(data.mean(), rel=1e-5)
    assert population.x["sigma_u"] == pytest.approx(np.sqrt(within), rel=1e-3)
    assert population.x["omega_a"] == pytest.approx(np.sqrt(between - within / m), rel=1e-3)
    low, high = population.interval()["a"]
    half = scipy.stats.t.ppf(0.975, n - 1) * data.mean(axis=1).std(ddof=1) / np.sqrt(n)
    assert (low, high) == pytest.approx((data.mean() - half, data.mean() + half), rel=0.01)
    share = population.omega[0, 0] / (population.omega[0, 0] + within / m)
    drawn = data.mean() + share * (data.mean(axis=1) - data.mean())
    np.testing.assert_allclose(population.individuals["a"], drawn, rtol=1e-4)


def test_means_of_which_only_the_sum_is_seen_have_no_interval():
    """Their variances are those of the box, and never the small ones of a pseudo-inverse."""
    problem = ro.Problem.from_strings(
        {"u": "0*u"}, {"u": "a + b"}, {"a": (-20, 40), "b": (0, 10)}, (0, 4)
    )
    population = ro.solve(problem, 1e-8).fit_population(
        as_table(one_way(1)), random={"a": "normal"}
    )
    assert population.identifiable["a"] is population.identifiable["b"] is False
    assert population.identifiable["omega_a"]
    assert population.interval()["b"] == (-np.inf, np.inf)
    assert min(population.std["a"], population.std["b"]) > 0.5 * 10 / np.sqrt(12)
    assert repr(population).count("not identified") == 2
    assert not population.success


def test_a_subject_under_several_conditions_has_one_random_effect():
    """Half of the rows with another dose, which shifts the level by as much."""
    problem = ro.Problem.from_strings(
        {"u": "0*u"}, {"u": "a + d"}, {"a": (-20, 40), "d": (0, 10)}, (0, 4)
    )
    table = as_table(one_way(1))
    table["d"] = np.where(np.arange(table["u"].size) % 2, 3.0, 0.0)
    table["u"] = table["u"] + table["d"]
    dosed = ro.solve(problem, 1e-8).fit_population(table, random={"a": "normal"})
    for name, x in levels().x.items():
        assert dosed.x[name] == pytest.approx(x, rel=1e-5)
    np.testing.assert_allclose(dosed.individuals["a"], levels().individuals["a"], rtol=1e-5)
    assert dosed.curve(0, [1, 2]).shape == (2, 2)


def test_a_level_that_does_not_vary():
    """Subjects that are all the same have no variance, and the fit says so."""
    data = np.random.default_rng(8).normal(10.0, 1.0, (10, 5))
    data += 10.0 - data.mean(axis=1, keepdims=True)
    options = {"random": {"a": "normal", "b": "normal"}}
    problem = ro.Problem.from_strings(
        {"u": "b"}, {"u": "a"}, {"a": (-20, 40), "b": (-5, 5)}, (0, 4)
    )
    same = ro.solve(problem, 1e-8).fit_population(as_table(data), **options)
    assert same.idle
    assert set(same.idle) < {"omega_a", "omega_b"}
    assert same.x[same.idle[0]] == 0.0
    assert np.isnan(same.interval()[same.idle[0]]).all()
    assert "the data show no such variation" in same.checks[0]


def laplace(table, x):
    """-2 log L of the population by SciPy: Laplace's method with the Fisher information."""
    means = np.array([x[name] for name in MEANS])
    spreads = np.array([x[f"omega_{name}"] for name in MEANS])
    dose, data = (np.reshape(table[name], (-1, HOURS.size)) for name in ("dose", "C"))

    def parts(eta, i):
        predicted = concentration(HOURS, dose[i], *(means * np.exp(eta)))
        return predicted, np.hypot(x["sigma_C"], x["relative_C"] * predicted)

    def cost(eta, i):
        predicted, sigma = parts(eta, i)
        standardised = (data[i] - predicted) / sigma
        return np.sum(standardised**2 + 2.0 * np.log(sigma)) + np.sum((eta / spreads) ** 2)

    whole = data.size * np.log(2.0 * np.pi)
    for i in range(len(data)):
        eta = scipy.optimize.minimize(cost, np.zeros(3), (i,), "BFGS", options={"gtol": 1e-6}).x
        h = 1e-5
        ends = [(parts(eta + h * e, i), parts(eta - h * e, i)) for e in np.eye(3)]
        slopes = np.array([[(a - b) / (2 * h) for a, b in zip(*pair)] for pair in ends])
        sigma = parts(eta, i)[1]
        rows = np.concatenate([slopes[:, 0] / sigma, np.sqrt(2.0) * slopes[:, 1] / sigma], axis=1)
        matrix = np.eye(3) + spreads[:, None] * (rows @ rows.T) * spreads
        whole += cost(eta, i) + np.linalg.slogdet(matrix)[1]
    return whole


@pytest.mark.slow
def test_likelihood_of_an_independent_evaluation():
    table, few = table_of(0, 8), population(0, 8)
    at_fit = laplace(table, few.x)
    assert -2.0 * few.log_likelihood == pytest.approx(at_fit, abs=0.01)
    for name in ("CL", "omega_ka", "relative_C"):
        for factor in (0.9, 1.1):
            moved = {**few.x, name: factor * few.x[name]}
            assert laplace(table, moved) > at_fit


def test_a_fit_recovers_the_population():
    assert fit().success, fit().message
    for name, true in TRUE.items():
        assert abs(fit().x[name] - true) < 4.0 * fit().std[name]
    own = {name: np.log(fit().individuals[name] / fit().x[name]) for name in MEANS}
    for name, effects in fit().effects.items():
        np.testing.assert_allclose(own[name], effects, atol=1e-12)
    assert set(fit().shrinkage) == {*MEANS, "residuals"}
    assert all(share < 0.3 for share in fit().shrinkage.values())


def test_it_prints_as_a_table():
    lines = repr(fit()).splitlines()
    assert lines[0].startswith("Population of 30 subjects: 300 values of C, log-likelihood")
    assert [line.split()[0] for line in lines[2:10]] == list(fit().interval())
    assert "success: the fit converged" in lines[-1]
    frame = fit().to_dataframe()
    assert list(frame.columns) == ["estimate", "std", "lower", "upper", "identified"]
    assert frame.loc["V", "estimate"] == fit().x["V"]


def test_a_subject_at_the_end_of_the_box_is_named():
    narrow = oral().restrict(ka=(1.2, 12))
    outside = narrow.fit_population(table_of(3, 10), random=["ka", "CL", "V"], noise="combined")
    assert not outside.success
    at_end = np.flatnonzero(outside.individuals["ka"] <= 1.2 * (1 + 1e-8))
    assert at_end.size
    assert f"of subject{'s' if at_end.size > 1 else ''} {at_end[0] + 1}" in outside.message
    assert "wider box, such as ka in (" in outside.message


def weighed(seed, exponent=0.75):
    """Clearance grows with a power of the weight."""
    generator = np.random.default_rng(seed)
    weight = generator.uniform(40, 110, 16)
    own = {
        name: MEANS[name] * np.exp(SPREADS[name] * generator.standard_normal((16, 1)))
        for name in MEANS
    }
    own["CL"] = own["CL"] * (weight[:, None] / 70) ** exponent
    exact = concentration(HOURS, 200.0, **own)
    return {
        "ID": np.repeat([f"p{i}" for i in range(16)], HOURS.size),
        "time": np.tile(HOURS, 16),
        "weight": np.repeat(weight, HOURS.size),
        "C": (exact * (1 + 0.1 * generator.standard_normal(exact.shape))).ravel(),
    }


@pytest.mark.slow
def test_covariates():
    options = {
        "random": {"ka": "lognormal", "CL": "lognormal", "V": "lognormal"},
        "noise": "proportional",
        "fixed": {"dose": 200},
        "subject": "ID",
    }
    table = weighed(2)
    free = oral().fit_population(table, covariates={"CL": "log(weight/70)"}, **options)
    assert free.success, free.message
    low, high = free.interval()["CL~log(weight/70)"]
    assert low < 0.75 < high
    assert 0.2 < high - low < 1.5
    held = oral().fit_population(table, covariates={"CL": {"log(weight/70)": 0.75}}, **options)
    assert "CL~log(weight/70)" not in held.x
    without = oral().fit_population(table, **options)
    assert without.log_likelihood < held.log_likelihood <= free.log_likelihood + 1e-3
    assert without.x["omega_CL"] > held.x["omega_CL"]
    assert free.subjects[:2] == ("p0", "p1")


WRONG = [
    ({"random": {}}, "random is empty"),
    ({"random": {"v": "log-normal"}}, "did you mean `V`"),
    ({"random": {"V": "lognorml"}}, "did you mean `log-normal`"),
    ({"random": {"V": "logit-normal"}}, "reaches to"),
    ({"random": ["dose"]}, "is fixed by the table"),
    ({"subject": "id"}, "no column `id` of subjects"),
    ({"covariates": {"CL": "log(wt)"}}, "no column `wt`"),
    ({"covariates": {"CL": "dose - dose"}}, "for all 30 subjects"),
    ({"covariates": {"CL": "t"}}, "changes within the subject `1`"),
    ({"covariates": {"CL": 3}}, "not an expression"),
    ({"correlated": [("V", "X")]}, "`X`"),
    ({"correlated": ["V"]}, "not a group"),
    ({"start": {"V": 100}}, "outside"),
    ({"start": {"V": "x"}}, "not a real number"),
    ({"level": 2}, "level"),
    ({"observe": {"C": "scale*C"}}, "`scale`"),
]


@pytest.mark.parametrize(("options", "message"), WRONG, ids=[text for _, text in WRONG])
def test_what_is_refused(options, message):
    with pytest.raises(ro.RankoneError, match=message.replace("(", r"\(")):
        population(3, **options)


def test_one_subject_is_refused():
    with pytest.raises(ro.OptionError, match="1 subject"):
        population(3, count=1)
    with pytest.raises(ro.OptionError, match="not a table"):
        oral().fit_population(3, random=["V"])


def test_a_row_without_subject_is_refused():
    table = {"subject": ["a", None, "b"], "t": [1.0, 2.0, 1.0], "C": [1.0, 0.8, 1.1]}
    with pytest.raises(ro.OptionError, match="row 2 of the table: `subject` is empty"):
        oral().fit_population(table, random=["V"], fixed={"dose": 100.0})


def test_data_without_a_deviation_are_refused():
    """Proportional noise has none where nothing is predicted."""
    table = table_of(3, 4)
    at_dose = {**table, "t": np.where(table["t"] == HOURS[0], 0.0, table["t"])}
    with pytest.raises(ro.OptionError, match="standard deviation of a datum is zero"):
        oral().fit_population(at_dose, random=["V"], noise="proportional")


@functools.cache
def lagged():
    """A dose by mouth after a lag that all subjects share."""
    events = [{"when": "t - lag", "direction": "rising", "then": {"A": "A + 100"}, "name": "dose"}]
    problem = ro.Problem.from_strings(
        {"A": "-ka*A", "C": "ka*A/V - CL/V*C"},
        {"A": "0", "C": "0"},
        {"ka": (0.3, 6), "CL": (0.5, 6), "V": (5, 40), "lag": (0.05, 1.2)},
        (0, 24),
        events=events,
    )
    return ro.solve(problem, 1e-5)


@functools.cache
def lagged_data():
    """Of 12 subjects with a lag of 0.4 and noise of 10 %."""
    generator = np.random.default_rng(2)
    ka, CL, V = (
        mean * np.exp(0.25 * generator.standard_normal(12))[:, None] for mean in (1.5, 2.0, 15.0)
    )
    times = np.array([0.75, 1.0, 1.5, 2.0, 4.0, 6.0, 9.0, 12.0, 18.0, 24.0])
    exact = concentration(times - 0.4, 100.0, ka, CL, V)
    return {
        "subject": np.repeat(np.arange(12), times.size),
        "t": np.tile(times, 12),
        "C": (exact * (1.0 + 0.1 * generator.standard_normal(exact.shape))).ravel(),
    }


@pytest.mark.slow
def test_a_start_where_predictions_vanish_is_refused():
    options = {"random": ["ka", "CL", "V"], "noise": "proportional", "start": {"lag": 1.1}}
    with pytest.raises(ro.OptionError, match="far from all curves with the start"):
        lagged().fit_population(lagged_data(), **options)


@pytest.mark.slow
def test_no_search_ends_where_predictions_vanish(capfd):
    """Before the lag there is no prediction, and no noise in proportion to it."""
    options = {"random": ["ka", "CL", "V"], "noise": "proportional"}
    fit = lagged().fit_population(lagged_data(), **options)
    assert fit.success, fit.message
    assert fit.x["lag"] == pytest.approx(0.4, abs=4 * fit.std["lag"])
    assert fit.x["relative_C"] == pytest.approx(0.1, rel=0.3)
    assert capfd.readouterr() == ("", "")
