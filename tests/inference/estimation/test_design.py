"""Designs against an exhaustive search, and against what fits of simulated data show."""

import itertools

import numpy as np
import pytest
import scipy.stats

import rankone as ro
from rankone.support.errors import EvaluationError, OptionError
from tests.inference.estimation.experiments import HOURS, TRUE, bateman, draws, oral
from tests.inference.estimation.systems import decay, fall

AT = {name: TRUE[name] for name in ("ka", "ke", "V")}
CANDIDATES = np.linspace(0.25, 24, 40)


def derivatives(times, sigma=0.1, dose=100.0):
    """Of the concentration in closed form, over sigma, by differences of eighth order or so."""
    columns = []
    for name in AT:
        steps = 1e-3 * AT[name] * np.array([-2.0, -1.0, 1.0, 2.0])
        values = []
        for step in steps:
            at = {**AT, name: AT[name] + step}
            rate = at["ka"] - at["ke"]
            curve = np.exp(-at["ke"] * times) - np.exp(-at["ka"] * times)
            values.append(dose * at["ka"] / (at["V"] * rate) * curve)
        slope = (values[0] - 8 * values[1] + 8 * values[2] - values[3]) / (12 * steps[2])
        columns.append(slope / sigma)
    return np.stack(columns, axis=1)


SLOW = pytest.mark.slow


@pytest.mark.parametrize(
    "criterion", ["D", pytest.param("A", marks=SLOW), pytest.param("E", marks=SLOW)]
)
def test_three_times_are_those_of_an_exhaustive_search(criterion):
    design = oral().design(
        3, CANDIDATES, at=AT, observe="C", sigma=0.1, fixed={"dose": 100}, criterion=criterion
    )
    rows = derivatives(CANDIDATES)
    triples = np.array(list(itertools.combinations_with_replacement(range(40), 3)))
    information = np.einsum("kip,kiq->kpq", rows[triples], rows[triples])
    relative = information * np.outer(list(AT.values()), list(AT.values()))

    def measure(matrices):
        eigenvalues = np.linalg.eigvalsh(matrices)
        usable = eigenvalues[:, 0] > 1e-9 * eigenvalues[:, -1]
        eigenvalues = eigenvalues[usable]
        values = np.zeros(len(matrices))
        values[usable] = {
            "D": np.prod(eigenvalues, axis=1),
            "A": 1.0 / np.sum(1.0 / eigenvalues, axis=1),
            "E": eigenvalues[:, 0],
        }[criterion]
        return values

    best = measure(relative).max()
    scale = np.outer(list(AT.values()), list(AT.values()))
    assert measure(design.information[None] * scale)[0] == pytest.approx(best, rel=1e-4)
    if criterion == "D":
        np.testing.assert_allclose(design.times, CANDIDATES[triples[np.argmax(measure(relative))]])
        covariance = np.linalg.inv(information[np.argmax(measure(relative))])
        np.testing.assert_allclose(design.covariance, covariance, rtol=1e-3)


@SLOW
def test_expected_intervals_are_those_of_fits():
    design = oral().design(8, at=AT, observe="C", sigma=0.1, fixed={"dose": 100})
    estimates = []
    for seed in range(60):
        data = bateman(design.times) + 0.1 * draws(seed, design.times.shape)
        fit = oral().fit(design.times, data, observe="C", sigma=0.1, fixed={"dose": 100}, starts=1)
        estimates.append(list(fit.x.values()))
    spread = np.std(estimates, axis=0, ddof=1)
    np.testing.assert_allclose(list(design.std.values()), spread, rtol=0.3)


def test_after_a_fit_its_information_counts():
    data = bateman(HOURS[:10]) + 0.1 * draws(3, (10,))
    fit = oral().fit(HOURS[:10], data, observe="C", sigma=0.1, fixed={"dose": 100})
    design = oral().design(2, after=fit)
    for name in AT:
        assert design.std[name] < fit.std[name]
    box = np.diag([12 / np.ptp(oral().parameters[name]) ** 2 for name in AT])
    marginal = np.linalg.inv(fit.information + box)
    np.testing.assert_allclose(marginal, fit.covariance, rtol=1e-6)
    assert design.efficiency([0.25, 20]) < 1.0
    assert design.efficiency(design.times) == pytest.approx(1.0)


def two_doses(**options):
    """A fit of a low and a high dose, by blood and, after the high dose, by the gut as well."""
    low = bateman(HOURS, 50.0) + 0.1 * draws(3)
    high = bateman(HOURS, 200.0) + 0.1 * draws(4)
    gut = 200.0 * np.exp(-TRUE["ka"] * HOURS) + 3.0 * draws(5)
    pairs = [
        (oral(), ro.Experiment(low, HOURS, observe="C", fixed={"dose": 50}, **options)),
        (
            oral(),
            ro.Experiment(
                {"C": high, "A": gut}, HOURS, fixed={"dose": 200}, **options, name="high"
            ),
        ),
    ]
    return ro.fit(pairs)


def test_after_several_experiments():
    """The conditions of the next one have to be told where they differ; what is measured may be."""
    fit = two_doses()
    with pytest.raises(OptionError, match="`dose` differs between the experiments of the fit: 50"):
        oral().design(2, after=fit)
    with pytest.raises(OptionError, match="fixed: the fit estimates `ke`"):
        oral().design(2, after=fit, fixed={"dose": 100, "ke": 0.3})
    with pytest.raises(OptionError, match="the fit has not measured `B`"):
        oral().design(2, after=fit, fixed={"dose": 100}, observe="B")
    plans = {d: oral().design(2, after=fit, fixed={"dose": d}, observe="C") for d in (25, 250)}
    for dose, plan in plans.items():
        at = {name: fit.x[name] for name in AT}
        level, names = fit.x["sigma_C"], list(fit.parameters)
        rows = derivatives(plan.times, level, dose)
        own = [names.index(name) for name in at]
        more = (plan.information - fit.information)[np.ix_(own, own)]
        np.testing.assert_allclose(more, rows.T @ rows, rtol=0.2, atol=0.1 * np.abs(more).max())
    assert plans[250].std["ke"] < plans[25].std["ke"] < fit.std["ke"]
    both = oral().design(2, after=fit, fixed={"dose": 250})
    assert both.std["ka"] < plans[250].std["ka"]


def test_expected_intervals_are_students_where_noise_is_estimated():
    at, options = {**AT, "sigma_C": 0.1}, {"observe": "C", "fixed": {"dose": 100}}
    with_sigma = oral().design(6, HOURS, at=AT, sigma=0.1, **options)
    free = oral().design(6, HOURS, at=at, noise="constant", **options)
    for plan, q in ((with_sigma, scipy.stats.norm.ppf(0.95)), (free, scipy.stats.t.ppf(0.95, 3))):
        low, high = plan.interval(0.9)["ke"]
        assert high - low == pytest.approx(2 * q * plan.std["ke"], rel=1e-9)
    fit = oral().fit(HOURS, bateman(HOURS) + 0.1 * draws(3), **options)
    after = oral().design(4, HOURS, after=fit)
    low, high = after.interval()["ke"]
    q = scipy.stats.t.ppf(0.975, HOURS.size - 3 + 4)
    assert high - low == pytest.approx(2 * q * after.std["ke"], rel=1e-9)
    unknown = oral().design(6, HOURS, at=AT, **options)
    assert "sigma" in repr(unknown)
    with pytest.raises(OptionError, match="the design knows no sigma"):
        unknown.interval()
    with pytest.raises(OptionError, match="the noise of `C` and `A` is not given"):
        oral().design(6, HOURS, at=AT, observe=["C", "A"], fixed={"dose": 100})


def test_on_average_over_a_posterior():
    generator = np.random.default_rng(0)
    at = {name: x * (1 + 0.2 * generator.standard_normal(20)) for name, x in AT.items()}
    design = oral().design(4, CANDIDATES, at=at, observe="C", fixed={"dose": 100}, interest="ke")
    assert design.success
    assert "sigma" in repr(design)


def test_what_cannot_be_identified():
    design = fall().design(4, at={"C_D": 0.5, "m": 1.0}, sigma=0.1)
    assert not design.success
    assert "cannot identify all parameters" in design.message
    assert np.isinf(design.std["m"])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"at": None}, "at has no value of `k` and `a`"),
        ({"at": {"k": 1}}, "at has no value of `a`"),
        ({"at": {"k": 1, "a": 1, "b": 1}}, "at: there is no parameter `b`"),
        ({"times": 1}, "1 time cannot identify 2 parameters"),
        ({"times": 0}, "times=0"),
        ({"times": [1, 2]}, "times="),
        ({"criterion": "F"}, "criterion='F' is unknown"),
        ({"interest": "b"}, "interest: `b` is not estimated"),
        ({"observe": "v"}, "there is no unknown `v`"),
        ({"fixed": {"k": 1, "a": 1}}, "all parameters are fixed"),
        ({"after": 3}, "is not a Fit"),
        ({"level": 1.0}, "level=1"),
    ],
)
def test_bad_options(options, message):
    with pytest.raises(OptionError, match=message):
        decay().design(**{"times": 2, "at": {"k": 1, "a": 1}, **options})


def test_outside():
    with pytest.raises(EvaluationError, match="outside its horizon"):
        decay().design(2, [0, 5], at={"k": 1, "a": 1})
    with pytest.raises(EvaluationError, match="outside its range"):
        decay().design(2, at={"k": 10, "a": 1})


def test_a_time_at_which_relative_noise_vanishes_tells_nothing():
    drug = ro.Problem.from_strings(
        {"gut": "-ka*gut", "level": "ka*gut/10 - ke*level"},
        {"gut": 100, "level": 0},
        {"ka": (0.8, 1.6), "ke": (0.2, 0.4)},
        (0, 24),
    )
    solution = ro.solve(drug, 1e-5)
    at = {"ka": 1.2, "ke": 0.3}
    design = solution.design(
        2, [0.0, 0.5, 2.0, 12.0], at=at, observe="level", sigma=0.1, noise="proportional"
    )
    assert 0.0 not in design.times
