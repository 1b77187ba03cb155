"""Noise models and expressions of unknowns, against likelihoods that SciPy minimises directly."""

import numpy as np
import pytest
import scipy.optimize
import scipy.stats

from rankone.support.errors import OptionError
from tests.inference.estimation.experiments import HOURS, bateman, oral
from tests.inference.estimation.systems import decay, line

TIMES = np.linspace(0.05, 2.0, 25)
TRUE = {"k": 1.3, "a": 2.0}


def closed(k, a):
    return a * np.exp(-k * TIMES)


def draws(seed=1, size=TIMES.size):
    return np.random.default_rng(seed).standard_normal(size)


NORMAL = scipy.stats.norm.logpdf
CASES = {
    "constant": (lambda y, p, s: NORMAL(y, p, s[0]), lambda e, u: u + 0.05 * e),
    "proportional": (lambda y, p, s: NORMAL(y, p, s[0] * p), lambda e, u: u * (1 + 0.05 * e)),
    "combined": (
        lambda y, p, s: NORMAL(y, p, np.hypot(s[0], s[1] * p)),
        lambda e, u: u + np.hypot(0.03, 0.05 * u) * e,
    ),
    "log-normal": (
        lambda y, p, s: scipy.stats.lognorm.logpdf(y, s[0], scale=p),
        lambda e, u: u * np.exp(0.05 * e),
    ),
    "student": (
        lambda y, p, s: scipy.stats.t.logpdf((y - p) / s[0], 4) - np.log(s[0]),
        lambda e, u: u + 0.05 * e,
    ),
}


def direct(density, data, levels):
    """The largest log-likelihood and where it is, by a simplex search."""

    def cost(z):
        return -np.sum(density(data, closed(*z[:2]), np.exp(z[2:])))

    start = [1.2, 1.9, *[np.log(0.05)] * levels]
    options = {"xatol": 1e-9, "fatol": 1e-11, "maxiter": 4000, "maxfev": 4000}
    end = scipy.optimize.minimize(cost, start, method="Nelder-Mead", options=options)
    return -end.fun, end.x


@pytest.mark.parametrize("kind", CASES)
def test_the_largest_likelihood(kind):
    density, measured = CASES[kind]
    data = measured(draws(), closed(**TRUE))
    fit = decay().fit(TIMES, data, noise=kind)
    levels = 2 if kind == "combined" else 1
    highest, z = direct(density, data, levels)
    assert fit.log_likelihood == pytest.approx(highest, abs=1e-6)
    np.testing.assert_allclose([fit.x["k"], fit.x["a"]], z[:2], rtol=1e-4)
    assert fit.aic == pytest.approx(2 * (2 + levels) - 2 * highest, abs=1e-5)
    assert fit.bic == pytest.approx(np.log(25) * (2 + levels) - 2 * highest, abs=1e-5)
    assert fit.success, fit.message


STUDENT_SCALE = 1.0 / scipy.stats.t.std(4)


def test_the_level_of_students_noise_is_a_standard_deviation():
    """A given one is that of SciPy's distribution, and an estimated one its standard deviation."""
    data = closed(**TRUE) + 0.05 * draws()
    data[7] += 1.0
    with_sigma = decay().fit(TIMES, data, noise="student", sigma=0.08)

    def cost(z):
        scale = 0.08 * STUDENT_SCALE
        return -np.sum(scipy.stats.t.logpdf(data, 4, closed(*z), scale))

    options = {"xatol": 1e-9, "fatol": 1e-12}
    end = scipy.optimize.minimize(cost, [1.2, 1.9], method="Nelder-Mead", options=options)
    np.testing.assert_allclose(list(with_sigma.x.values()), end.x, rtol=1e-5)
    assert with_sigma.log_likelihood == pytest.approx(-end.fun, abs=1e-6)
    # one value 12 standard deviations off is no surprise
    assert with_sigma.success, with_sigma.message
    assert not decay().fit(TIMES, data, sigma=0.08).success
    free = decay().fit(TIMES, data, noise="student")
    _, z = direct(CASES["student"][0], data, 1)
    corrected = np.exp(z[2]) / STUDENT_SCALE / np.sqrt(free._freedom[2])
    assert free.x["sigma_u"] == pytest.approx(corrected, rel=1e-3)
    assert free.deviations[0][0] == pytest.approx(free.x["sigma_u"])


def test_levels_are_corrected_for_the_parameters():
    """One level of constant noise is the estimate that a fit without sigma has, and its interval
    that of a variance."""
    data = closed(**TRUE) + 0.05 * draws()
    fit, plain = decay().fit(TIMES, data, noise="constant"), decay().fit(TIMES, data)
    assert fit.x["sigma_u"] == pytest.approx(plain.sigma, rel=1e-6)
    for name in TRUE:
        np.testing.assert_allclose(fit.interval()[name], plain.interval()[name], rtol=1e-6)
        linear = fit.interval(method="linear")[name]
        np.testing.assert_allclose(linear, plain.interval(method="linear")[name], rtol=1e-3)
    wanted = plain.sigma * np.sqrt(23 / scipy.stats.chi2.ppf([0.975, 0.025], 23))
    np.testing.assert_allclose(fit.interval()["sigma_u"], wanted, rtol=1e-4)
    assert fit.dof == plain.dof == 23


def test_two_means_with_noise_of_their_own():
    """The interval of their difference is that of Welch's test."""
    generator = np.random.default_rng(2)
    one, other = generator.normal(1.0, 0.1, 12), generator.normal(1.5, 0.5, 7)
    times = {"x": np.linspace(0, 1, 12), "y": np.linspace(0, 1, 7)}
    fit = line().fit(
        times,
        {"x": one, "y": other},
        observe={"x": "a + 0*u", "y": "a + shift + 0*u"},
        fixed={"b": 0},
    )
    welch = scipy.stats.ttest_ind(other, one, equal_var=False).confidence_interval(0.95)
    np.testing.assert_allclose(fit.interval()["shift"], welch, rtol=1e-4)
    plain = scipy.stats.t.interval(0.95, 11, one.mean(), scipy.stats.sem(one))
    np.testing.assert_allclose(fit.interval()["a"], plain, rtol=1e-4)


def test_a_given_level_and_an_expression_of_the_model():
    data = closed(**TRUE) * (1.0 + 0.05 * draws())
    given = decay().fit(TIMES, data, noise="proportional", sigma=0.05)
    assert list(given.x) == ["k", "a"]
    written = decay().fit(TIMES, data, sigma="0.05*u")
    np.testing.assert_allclose(list(given.x.values()), list(written.x.values()), rtol=1e-9)
    free = decay().fit(TIMES, data, noise="proportional")
    level = decay().fit(TIMES, data, sigma="b*u")
    assert level.x["b"] == pytest.approx(free.x["relative_u"], rel=1e-6)


def test_a_part_of_the_noise_that_the_data_do_not_show():
    data = closed(**TRUE) + 0.05 * draws(4)
    fit = decay().fit(TIMES, data, sigma="s0 + s1*u")
    assert fit.fixed == {"s1": 0.0}
    assert "`s1` is zero: the data show no such part of the noise" in repr(fit)


def test_scale_and_offset_without_bounds():
    """The linear parameters are those of a direct fit, and so are the intervals of all."""
    data = 3500.0 * closed(**TRUE) - 70.0 + 50.0 * draws()
    observe = {"signal": "scale*u + offset"}
    fit = decay().fit(TIMES, data, observe=observe, fixed={"a": 2.0})

    def signal(_, k, offset, scale):
        return scale * closed(k, 2.0) + offset

    wanted, covariance = scipy.optimize.curve_fit(signal, TIMES, data, (1.0, 0.0, 1000.0))
    np.testing.assert_allclose(list(fit.x.values()), wanted, rtol=1e-6)
    np.testing.assert_allclose(fit.covariance, covariance, rtol=1e-3)
    assert list(fit.x) == ["k", "offset", "scale"]
    values, half = fit.curve("signal", TIMES)
    np.testing.assert_allclose(data - values, fit.residuals, atol=1e-9)
    slopes = np.array(
        [-TIMES * wanted[2] * closed(wanted[0], 2.0), 1 + 0 * TIMES, closed(wanted[0], 2.0)]
    )
    band = np.sqrt(np.einsum("it,ij,jt->t", slopes, covariance, slopes))
    np.testing.assert_allclose(half, scipy.stats.t.ppf(0.975, 22) * band, rtol=1e-3)


def test_a_scale_that_makes_up_for_a_parameter():
    data = 3.0 * closed(**TRUE) + 0.05 * draws()
    fit = decay().fit(TIMES, data, observe="scale*u", sigma=0.05)
    assert not fit.identifiable["a"]
    assert "a*scale" in fit.combinations
    assert fit.value_of("a*scale") == pytest.approx(6.0, abs=0.1)


def test_the_logarithm_of_an_unknown():
    import sympy as sp

    t = sp.Symbol("t")
    u = sp.Function("u")(t)
    data = np.log(closed(**TRUE)) + 0.05 * draws()
    fits = [decay().fit(TIMES, data, observe=one, sigma=0.05) for one in ("log(u)", sp.log(u))]
    line = np.polyfit(TIMES, data, 1)
    for fit in fits:
        assert fit.x["k"] == pytest.approx(-line[0], rel=1e-6)
        assert fit.x["a"] == pytest.approx(np.exp(line[1]), rel=1e-6)


def test_nonlinear_parameters_of_an_observable_have_bounds():
    data = closed(**TRUE) ** 1.7 + 0.01 * draws()
    bounds = {"power": (0.5, 3)}
    fit = decay().fit(TIMES, data, observe="u**power", sigma=0.01, fixed={"a": 2}, bounds=bounds)
    assert fit.interval()["power"][0] < 1.7 < fit.interval()["power"][1]


def test_priors_and_bounds_over_decades():
    """A prior is one more datum: the estimate of a normal model in closed form."""
    data = closed(**TRUE) + 0.05 * draws()
    prior = {"k": scipy.stats.norm(1.0, 0.02)}
    fit = decay().fit(TIMES, data, sigma=0.05, prior=prior)

    def residuals(z):
        return [*((closed(*z) - data) / 0.05), (z[0] - 1.0) / 0.02]

    wanted = scipy.optimize.least_squares(residuals, [1.2, 1.9], xtol=1e-14).x
    np.testing.assert_allclose(list(fit.x.values()), wanted, rtol=1e-6)
    decades = decay().fit(TIMES, data, sigma=0.05, bounds={"k": (0.2, 4, "log")})
    plain = decay().fit(TIMES, data, sigma=0.05)
    np.testing.assert_allclose(list(decades.x.values()), list(plain.x.values()), rtol=1e-6)
    np.testing.assert_allclose(decades.information, plain.information, rtol=1e-5)
    low, high = decades.interval(method="linear")["k"]
    assert low * high == pytest.approx(decades.x["k"] ** 2, rel=1e-9)


def test_degrees_of_freedom_with_priors():
    """A prior that says as much as the data takes half a direction, one that says all a whole."""
    times, data = np.linspace(0, 1, 9), 0.1 * draws()[:9]
    design = np.stack([np.ones(9), times], axis=1) / 0.1
    for width in (1e-3, 0.05, 1.0):
        prior = {"a": scipy.stats.norm(0.0, width)}
        fit = line().fit(times, data, sigma=0.1, prior=prior)
        whole = design.T @ design + np.diag([width**-2, 0.0])
        assert fit.dof == pytest.approx(9 - np.trace(np.linalg.solve(whole, design.T @ design)))


def test_noise_that_is_told_of_some_observables():
    data = {"x": closed(**TRUE) + 0.05 * draws(), "y": 2.0 * closed(**TRUE) + 0.2 * draws(2)}
    observe = {"x": "u", "y": "2*u"}
    with_sigma = decay().fit(TIMES, data, observe=observe, sigma={"x": 0.05})
    assert list(with_sigma.x) == ["k", "a", "sigma_y"]
    kinds = decay().fit(TIMES, data, observe=observe, noise={"y": "student"})
    assert list(kinds.x) == ["k", "a", "sigma_x", "sigma_y"]
    both = decay().fit(TIMES, data, observe=observe, noise={"y": "student"}, sigma={"x": 0.05})
    assert list(both.x) == ["k", "a", "sigma_y"]
    assert [noise.distribution for noise in both.observations.noises] == ["normal", "student"]
    for wrong in ({"sigma": {"z": 1}}, {"noise": {"z": "constant"}}, {"weights": {"x": 1}}):
        with pytest.raises(OptionError, match="observed are `x` and `y`"):
            decay().fit(TIMES, data, observe=observe, **wrong)


def test_conditions_that_were_forgotten():
    """What differs between two doses is not fixed, and the message says where to do it."""
    table = {
        "t": [*HOURS, *HOURS],
        "C": [*bateman(HOURS, 100), *bateman(HOURS, 150)],
        "condition": ["low"] * 16 + ["high"] * 16,
    }
    fit = oral().fit(table, noise="proportional", fixed={"dose": 100})
    told = "the curve of `C` is too high for `low` and too low for `high`; remedy: fix what differs"
    assert any(check.startswith(told) for check in fit.checks)
    fixed = {"low": {"dose": 100}, "high": {"dose": 150}}
    table["C"] = np.array(table["C"]) * (1.0 + 0.1 * draws(3, 32))
    assert not oral().fit(table, noise="proportional", fixed=fixed).checks


def test_residuals_are_looked_at():
    outlier = 0.05 * draws(2)
    outlier[7] = 1.0
    of = decay().fit(TIMES, closed(**TRUE) + outlier, noise="constant")
    assert "standard deviations off; remedy: look at it" in of.checks[0]
    assert of.success
    wave = 0.05 * np.sign(np.sin(3.0 * TIMES))
    assert "keep their sign for long" in decay().fit(TIMES, closed(**TRUE) + wave).checks[0]
    times = np.linspace(0.05, 2.0, 80)
    noise = 0.1 * np.random.default_rng(5).standard_normal(80)
    grown = decay().fit(times, 2.0 * np.exp(-1.3 * times) * (1.0 + noise), noise="constant")
    assert any('try noise="proportional"' in check for check in grown.checks)


def test_an_outlier_is_compared_with_the_others_where_noise_is_estimated():
    """It enlarges the estimate itself: its size is that of a fit to the others (closed form)."""
    t = np.linspace(0.1, 1.0, 10)
    noise = np.array([0.9, -1.2, 0.3, -0.4, 1.1, 0.2, -0.8, 0.5, -1.0, 0.4])
    rows = np.stack([np.ones(10), t], axis=1)
    others = np.arange(10) != 6
    for far in (12.0, 4.0):
        data = 1.0 + 2.0 * t + 0.1 * noise
        data[6] += 0.1 * far
        estimate, squares, *_ = np.linalg.lstsq(rows[others], data[others])
        at = rows[6] @ np.linalg.inv(rows[others].T @ rows[others]) @ rows[6]
        size = (data[6] - rows[6] @ estimate) / np.sqrt(squares[0] / 7.0 * (1.0 + at))
        checks = line().fit(t, data).checks
        told = f"at 0.7 is, by the spread of the others, {size:.2g} standard deviations off"
        said = [check for check in checks if "standard deviations off" in check]
        assert [told in check for check in said] == [True] * (far == 12.0)


def test_log_normal_noise_of_data_below_zero():
    with pytest.raises(OptionError, match=r"-1 of `u` is not positive, as log-normal noise wants"):
        decay().fit([0.1, 0.2, 0.3, 0.4], [1, -1, 1, 1], noise="log-normal")


@pytest.mark.parametrize("options", [{"noise": "proportional"}, {"sigma": "s0 + s1*C"}])
def test_a_value_that_is_certain(options):
    """Nothing is in the blood before the dose is absorbed: relative noise is zero there."""
    hours = np.array([0.0, 1, 2, 4, 8, 12])
    data = bateman(hours)
    with pytest.raises(OptionError, match="`C` at t = 0 is zero for all parameters"):
        oral().fit(hours, data, observe="C", fixed={"dose": 100}, **options)
    assert oral().fit(hours, data, observe="C", fixed={"dose": 100}, sigma="s0").x["ke"] > 0.2


def test_priors_bound_the_search():
    prior = {"k": scipy.stats.uniform(1.0, 0.2)}
    fit = decay().fit(TIMES, closed(**TRUE) + 0.05 * draws(), sigma=0.05, prior=prior)
    assert fit.at_bounds == {"k": "upper"}
    assert fit.x["k"] == pytest.approx(1.2)


def test_noise_that_is_too_small_to_be_seen():
    fit = decay().fit(TIMES, closed(**TRUE), noise="constant")
    assert not fit.success
    assert "the level of noise `sigma_u` tends to zero" in fit.message
