"""Fits against closed forms and SciPy, and how often their intervals hold what they should."""

import re

import numpy as np
import pytest
import scipy.optimize
import sympy as sp

import rankone as ro
from tests.inference.estimation.systems import (
    DOSE_NOISE,
    DOSE_TIMES,
    FALL,
    FALL_TIMES,
    PERSON,
    covered,
    decay,
    drug,
    drug_fit,
    fall,
    fall_fit,
    line,
    noisy,
    reaching_squares,
)

TIMES = np.linspace(0.05, 2.0, 15)


def closed(t, k, a):
    return a * np.exp(-k * t)


def with_box(covariance):
    """A covariance of decay's parameters with what its box says beforehand."""
    widths = np.ptp(list(decay().parameters.values()), axis=1)
    return np.linalg.inv(np.linalg.inv(covariance) + np.diag(12 / widths**2))


@pytest.mark.parametrize("sigma", [0.02, None, np.linspace(0.01, 0.05, 15)])
def test_against_curve_fit(sigma):
    data = noisy(closed(TIMES, 1.3, 2.0), 0.02, 4)
    fit = decay().fit(TIMES, data, sigma=sigma)
    each = None if sigma is None else np.broadcast_to(sigma, TIMES.shape)
    wanted, covariance = scipy.optimize.curve_fit(
        closed, TIMES, data, (1.0, 1.0), each, absolute_sigma=sigma is not None
    )
    np.testing.assert_allclose(list(fit.x.values()), wanted, rtol=1e-6)
    np.testing.assert_allclose(fit.covariance, with_box(covariance), rtol=1e-4)
    np.testing.assert_allclose(fit.residuals, data - closed(TIMES, *wanted), atol=1e-7)
    assert list(fit.x) == ["k", "a"]
    assert fit.identifiable == {"k": True, "a": True}
    if sigma is None:
        assert fit.sigma == pytest.approx(np.sqrt(np.sum(fit.residuals**2) / 13))
        half = scipy.stats.t.ppf(0.95, 13) * np.sqrt(covariance[0, 0])
        linear = fit.interval(0.9, method="linear")["k"]
        np.testing.assert_allclose(linear, (wanted[0] - half, wanted[0] + half), rtol=1e-5)
        assert fit.success, fit.message


def test_weights_are_sigmas_up_to_a_factor():
    sigma = np.linspace(0.01, 0.05, 15)
    data = noisy(closed(TIMES, 1.3, 2.0), sigma, 4)
    one = decay().fit(TIMES, data, weights=3.0 / sigma**2)
    wanted, covariance = scipy.optimize.curve_fit(closed, TIMES, data, (1.0, 1.0), sigma)
    np.testing.assert_allclose(list(one.x.values()), wanted, rtol=1e-6)
    np.testing.assert_allclose(one.covariance, with_box(covariance), rtol=1e-4)


def test_profiles_of_a_linear_model_are_linear():
    t = np.linspace(0, 1, 12)
    for sigma in (0.3, None):
        fit = line().fit(t, noisy(0.4 - 1.1 * t, 0.3, 2), sigma=sigma)
        half = fit._quantile(None, np.ones(2)) * np.sqrt(np.diag(np.linalg.inv(fit.information)))
        for (low, high), x, each in zip(fit.interval().values(), fit.x.values(), half, strict=True):
            np.testing.assert_allclose((low, high), (x - each, x + each), rtol=1e-4)


def test_profile_of_a_nonlinear_model():
    """The end of the interval is where the best cost is larger by the quantile."""
    data = noisy(closed(TIMES, 1.3, 2.0), 0.3, 4)
    fit = decay().fit(TIMES, data, sigma=0.3)
    for end in fit.interval(method="profile")["k"]:
        held = decay().fit(TIMES, data, sigma=0.3, fixed={"k": end})
        assert held.chi2 - fit.chi2 == pytest.approx(1.959964**2, rel=1e-3)


def test_fixed_bounds_and_start():
    k = sp.Symbol("k")
    data = closed(TIMES, 1.3, 2.0)
    fit = decay().fit(TIMES, data, sigma=0.01, fixed={k: 1.3})
    assert fit.x == {"a": pytest.approx(2.0, abs=1e-6)}
    assert fit.fixed == {"k": 1.3}
    np.testing.assert_allclose(decay()(TIMES, fit.values)[0], data, atol=1e-6)
    bounded = decay().fit(TIMES, data, sigma=0.01, bounds={k: (2, 3)}, start={"a": 1}, starts=0)
    assert bounded.x["k"] == pytest.approx(2.0, abs=1e-12)
    assert bounded.at_bounds == {"k": "lower"}
    assert not bounded.success
    assert "`k` = 2 is at the lower end of its bounds" in bounded.message
    assert "times as large as sigma" in bounded.message


@pytest.mark.slow
def test_several_outputs_with_their_own_times():
    c, p = drug()["c"], drug()["p"]
    times = {"c": DOSE_TIMES, "p": DOSE_TIMES[::4]}
    data = {"p": noisy(p(times["p"], PERSON), 0.02, 1), "c": noisy(c(times["c"], PERSON), 0.02, 2)}
    fit = drug().fit(times, data, sigma={"c": 0.02, "p": 0.02})
    assert fit.success, fit.message
    for name, interval in fit.interval(0.999).items():
        assert covered(interval, PERSON[name])
    assert {name: row.size for name, row in fit.residuals.items()} == {"p": 6, "c": 24}
    table = np.array([c(DOSE_TIMES, PERSON), p(DOSE_TIMES, PERSON)])
    both = drug().fit(DOSE_TIMES, table, observe=["c", "p"], sigma=[0.02, 0.05])
    assert both.residuals.shape == table.shape
    np.testing.assert_allclose(list(both.x.values()), list(PERSON.values()), rtol=1e-3)


def test_missing_data_and_derivative_states():
    problem = ro.Problem.from_strings(
        {"x": "v", "v": "-k*x"}, {"x": "1", "v": "0"}, {"k": (1, 5)}, (0, 2)
    )
    solution = ro.solve(problem, 1e-7)
    data = solution["v"](t=TIMES, k=2.5)
    data[3] = np.nan
    fit = solution.fit(TIMES, data, observe="v", sigma=0.01, missing="drop")
    assert fit.x["k"] == pytest.approx(2.5, abs=1e-5)
    assert np.isnan(fit.residuals[3])
    assert fit.dof == 13
    t = sp.Symbol("t")
    x = sp.Function("x")(t)
    k = sp.Symbol("k")
    second = ro.Problem([sp.Eq(x.diff(t, 2), -k * x)], (t, 0, 2), {k: (1, 5)}, {x: 1, x.diff(t): 0})
    solved = ro.solve(second, 1e-7)
    fit = solved.fit(TIMES, solved[x.diff(t)](t=TIMES, k=2.5), observe=x.diff(t), sigma=0.01)
    assert fit.x["k"] == pytest.approx(2.5, abs=1e-5)


@pytest.mark.slow
def test_coverage_of_free_fall():
    """C_D and m are never identified alone; the interval of C_D/m holds it as often as it says."""
    ratio, inside = FALL["C_D"] / FALL["m"], 0
    for seed in range(100):
        fit = fall_fit(seed)
        assert fit.identifiable == {"C_D": False, "m": False}
        assert fit.combinations == ("C_D/m",)
        assert not fit.success
        assert "do not identify `C_D` and `m` alone, only `C_D/m`" in fit.message
        inside += covered(fit.interval_of("C_D/m"), ratio)
    assert 90 <= inside <= 99


@pytest.mark.slow
def test_coverage_of_doses():
    """At all levels at once; in benchmarks/fit.py counts of those of 95 %."""
    squares, lower, upper = reaching_squares(map(drug_fit, range(24)), PERSON)
    assert all(lower < square < upper for square in squares.values()), squares


def test_a_quantity_as_text_expression_or_function():
    fit, (C_D, m) = fall_fit(0), sp.symbols("C_D m")
    for given in ("C_D/m", C_D / m, lambda p: p["C_D"] / p["m"]):
        np.testing.assert_allclose(fit.interval_of(given), fit.interval_of("C_D*m**-1"), rtol=1e-8)
    fixed = fall().fit(FALL_TIMES, fit.observations.values, sigma=0.1, fixed={m: 1})
    np.testing.assert_allclose(fixed.interval()["C_D"], fit.interval_of("C_D/m"), rtol=1e-3)
    assert fit.interval_of("C_D") == (-np.inf, np.inf)
    assert fit.std["C_D"] < np.ptp(fall().parameters["C_D"]) / np.sqrt(12)


def test_a_bad_model_and_a_coarse_solution_are_said():
    data = closed(TIMES, 1.3, 2.0) + 0.1 * TIMES
    assert "does not describe the data" in decay().fit(TIMES, data, sigma=0.001).message
    exact = drug()["c"](DOSE_TIMES, PERSON)
    fit = drug().fit(DOSE_TIMES, noisy(exact, 1e-6, 1), observe="c", sigma=1e-6)
    assert "the error of the solution" in fit.message
    assert (
        "the solution itself is not a success"
        in decay().diff("a").fit(TIMES, closed(TIMES, 1.3, 1.0), sigma=0.01, fixed={"a": 1}).message
    )


def test_it_prints():
    text = repr(fall_fit(1))
    assert "not identified" in text
    assert re.search(r"C_D/m +0\.4", text)
    assert repr(drug_fit(1)).splitlines()[0] == (
        "Fit to 24 values of c: chi2 " + f"{drug_fit(1).chi2:.4g}, 20 degrees of freedom"
    )
    assert DOSE_NOISE == 0.05
