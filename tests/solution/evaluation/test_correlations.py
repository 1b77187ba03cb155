"""Correlated parameters against closed forms and brute force."""

import functools

import numpy as np
import pytest
import scipy.stats
import sympy as sp

import rankone as ro
from rankone.solution.statistics import moments
from rankone.support.errors import OptionError
from tests.problems import EXAMPLES

SIGMA = 0.1
NORMAL = scipy.stats.norm(1, SIGMA)
BOX = dict.fromkeys("abmd", (0.3, 1.7))


@functools.cache
def rated(*rates, names="amb"):
    """Unknowns u0, u1, ... at t = 1 equal to their rates; by the parameters in this order."""
    right = {f"u{i}": rate for i, rate in enumerate(rates)}
    box = {name: BOX[name] for name in names}
    return ro.solve(ro.Problem.from_strings(right, dict.fromkeys(right, "0"), box, (0, 1)), 1e-9)


def normal(solution):
    return dict.fromkeys(solution.parameters, NORMAL)


@pytest.mark.parametrize("rho", [-0.95, -0.3, 0.6, 0.9])
@pytest.mark.parametrize("names", ["ab", "amb", "mab", "abm", "bma"])
def test_product_of_normal_parameters(names, rho):
    """Moments of products of two correlated and one independent normal parameter."""
    solution = rated("a*b", "m" if "m" in names else "b", names=names)
    given = {"under": normal(solution), "correlation": {("a", "b"): rho}}
    s = SIGMA**2
    product = s * s * (1 + rho**2) + 2 * s * (1 + rho)
    found = solution.cov(1.0, **given)
    assert solution.mean(1.0, **given)[0] == pytest.approx(1 + rho * s, rel=1e-9)
    assert found[0, 0] == pytest.approx(product, rel=1e-7)
    assert found[1, 1] == pytest.approx(s, rel=1e-7)
    other = 0.0 if "m" in names else s * (1 + rho)
    assert found[0, 1] == pytest.approx(other, rel=1e-7, abs=1e-10)
    np.testing.assert_allclose(solution.std(1.0, **given) ** 2, np.diag(found), rtol=1e-9)


def test_independent_parameters_between_correlated_ones():
    solution = rated("a*b*m")
    given = {"under": normal(solution), "correlation": {("a", "b"): 0.6}}
    s = SIGMA**2
    square = (1 + 0.6 * s) ** 2 + s * s * (1 + 0.36) + 2 * s * 1.6
    exact = square * (1 + s) - (1 + 0.6 * s) ** 2
    assert solution.var(1.0, **given)[0] == pytest.approx(exact, rel=1e-7)


def test_log_normal_products():
    solution = rated("exp(2*a - b)", names="ab")
    given = {"under": normal(solution), "correlation": {("b", "a"): -0.5}}
    variance = SIGMA**2 * (4 + 1 + 2 * 2 * 0.5)
    assert solution.mean(1.0, **given)[0] == pytest.approx(np.exp(1 + variance / 2), rel=1e-8)
    spread = np.exp(2 + variance) * np.expm1(variance)
    assert solution.var(1.0, **given)[0] == pytest.approx(spread, rel=1e-6)


@pytest.mark.parametrize("rho", [-0.8, 0.5, 0.95])
def test_uniform_parameters(rho):
    """The rank correlation of a Gaussian copula is 6/pi asin(rho/2)."""
    solution = rated("a", "b", names="ab")
    found = solution.cov(1.0, correlation={("a", "b"): rho})
    exact = 1.4**2 / 12 * 6 / np.pi * np.arcsin(rho / 2)
    assert found[0, 1] == pytest.approx(exact, rel=1e-7)
    np.testing.assert_allclose(np.diag(found), 1.4**2 / 12, rtol=1e-7)


def test_three_correlated_parameters():
    solution, a, b, m = rated("a + 2*b - m", "a*b*m"), *sp.symbols("a b m")
    given = {"under": normal(solution), "correlation": {(a, b): 0.5, (b, m): -0.4, (a, m): 0.2}}
    matrix = np.array([[1, 0.5, 0.2], [0.5, 1, -0.4], [0.2, -0.4, 1]])
    weights = np.array([1, 2, -1])
    exact = SIGMA**2 * weights @ matrix @ weights
    assert solution.var(1.0, **given)[0] == pytest.approx(exact, rel=1e-7)
    mean = 1 + SIGMA**2 * (0.5 - 0.4 + 0.2)  # E[abm] = 1 + sum of covariances
    assert solution.mean(1.0, **given)[1] == pytest.approx(mean, rel=1e-8)


def test_four_correlated_parameters():
    solution = rated("a + b + m + d", names="abmd")
    pairs = {("a", "b"): 0.5, ("m", "d"): 0.3}
    given = {"under": normal(solution), "correlation": pairs}
    assert solution.mean(1.0, **given)[0] == pytest.approx(4.0, abs=1e-3 * SIGMA)
    assert solution.var(1.0, **given)[0] == pytest.approx(SIGMA**2 * 5.6, rel=2e-3)


def test_a_kink_is_met_to_what_is_said():
    """E[|a - 1| b] is s sqrt(2/pi), whatever the correlation."""
    problem = ro.Problem.from_strings(
        {"u": "Abs(a - 1)*b"}, {"u": "0"}, {"a": (0.3, 1.7), "b": (0.3, 1.7)}, (0, 1)
    )
    solution = ro.solve(problem, 1e-8)
    given = {"under": normal(solution), "correlation": {("a", "b"): 0.7}}
    with pytest.warns(ro.RankoneWarning, match="has settled to .* only"):
        found = solution.mean(1.0, **given)[0]
    assert found == pytest.approx(SIGMA * np.sqrt(2 / np.pi), rel=1e-3)


def test_against_brute_force():
    solution = ro.solve(EXAMPLES["lotka_volterra"].problem, 1e-5)
    under = {"x0": scipy.stats.norm(10, 0.3), "y0": scipy.stats.norm(5, 0.15)}
    nodes, weights = np.polynomial.hermite_e.hermegauss(40)
    z, other = (part.ravel() for part in np.meshgrid(nodes, nodes))
    w = np.outer(weights, weights).ravel() / weights.sum() ** 2
    near = w > 1e-14
    z, other, w = z[near], other[near], w[near]
    x0, y0 = np.clip(10 + 0.3 * z, 8, 12), np.clip(5 + 0.15 * (0.6 * z + 0.8 * other), 4, 6)
    values = np.stack([solution(t=t, x0=x0, y0=y0) for t in (1.0, 4.5)], axis=1)
    mean = values @ w
    centred = values - mean[:, :, None]
    given = {"under": under, "correlation": {("x0", "y0"): 0.6}}
    np.testing.assert_allclose(solution.mean([1.0, 4.5], **given), mean, rtol=1e-7)
    exact = np.einsum("ntq,mtq,q->nmt", centred, centred, w)
    np.testing.assert_allclose(solution.cov([1.0, 4.5], **given), exact, rtol=1e-6, atol=1e-8)


def test_samples_quantiles_densities_and_probabilities():
    solution = rated("a + b", names="ab")
    given = {"under": normal(solution), "correlation": {("a", "b"): -0.5}}
    drawn = solution.sample(40_000, seed=3, **given)
    assert np.corrcoef(drawn["a"], drawn["b"])[0, 1] == pytest.approx(-0.5, abs=0.02)
    assert drawn["b"].std() == pytest.approx(SIGMA, rel=0.02)
    total = scipy.stats.norm(2, SIGMA)  # 1 + 1 - 2 * 0.5 times the variance
    q = np.array([0.05, 0.5, 0.95])
    np.testing.assert_allclose(solution.quantile(q, 1.0, **given)[:, 0], total.ppf(q), atol=1e-3)
    found = solution.density(1.0, **given)
    np.testing.assert_allclose(found.density, total.pdf(found.values), atol=0.02 * total.pdf(2))
    failed = solution.probability(1.0, above=2.2, **given)
    assert abs(failed.value - total.sf(2.2)) <= 5 * failed.error


def test_main_effects_follow():
    """Given a, the mean of b is 1 + rho (a - 1); the mean of a*b given m is 1 + cov."""
    solution = rated("a*b + m")
    given = {"under": normal(solution), "correlation": {("a", "b"): 0.6}}
    effects = solution.main_effects(1.0, count=15, **given)
    for name in "ab":
        x = effects.values[name]
        inside = np.abs(x - 1) < 0.4  # at the ends the cut is felt
        exact = x * (1 + 0.6 * (x - 1)) + 1
        np.testing.assert_allclose(effects.means[name][0, inside], exact[inside], rtol=1e-7)
    m = effects.values["m"]
    np.testing.assert_allclose(effects.means["m"][0], 1 + 0.6 * SIGMA**2 + m, rtol=1e-8)


def test_no_correlation_is_none():
    solution = rated("a*b", names="ab")
    for none in ({}, None, {("a", "b"): 0.0}):
        np.testing.assert_array_equal(solution.var(1.0, correlation=none), solution.var(1.0))
    assert solution.sobol(1.0, correlation={}).first.shape == (1, 2, 1)


def test_what_is_not_there_for_correlations():
    solution = rated("a*b", names="ab")
    with pytest.raises(OptionError, match=r"not defined for correlated parameters.*main_effects"):
        solution.sobol(1.0, correlation={("a", "b"): 0.5})
    with pytest.raises(OptionError, match=r"third and fourth moments.*samples"):
        solution.skewness(1.0, correlation={("a", "b"): 0.5})
    second = solution.moment(2, 1.0, correlation={("a", "b"): 0.5})
    np.testing.assert_array_equal(second, solution.var(1.0, correlation={("a", "b"): 0.5}))


def test_a_quadrature_that_does_not_settle_is_said(monkeypatch):
    monkeypatch.setattr(moments, "SAME", 0.0)
    monkeypatch.setattr(moments, "_WARNED_CHANGE", 0.0)
    with pytest.warns(ro.RankoneWarning, match="has settled to"):
        rated("a*b", names="ab").mean(1.0, correlation={("a", "b"): 0.51})


@pytest.mark.parametrize(
    ("correlation", "message"),
    [
        (0.5, "correlation=0.5 is not a mapping"),
        ({"ab": 0.5}, "'ab' is not a pair of parameters"),
        ({("a", "b", "m"): 0.5}, "is not a pair of parameters"),
        ({("a", "q"): 0.5}, "there is no parameter `q`"),
        ({("a", "a"): 0.5}, "`a` is paired with itself"),
        ({("a", "b"): 0.5, ("b", "a"): 0.5}, "correlation of `a` and `b` is given twice"),
        ({("a", "b"): 1.0}, "is 1.0, not a number between -1 and 1; remedy: write one parameter"),
        ({("a", "b"): -2}, "is -2, not a number"),
        ({("a", "b"): float("nan")}, "is nan, not a number"),
        ({("a", "b"): "high"}, "is 'high', not a number"),
        ({("a", "b"): True}, "is True, not a number"),
        ({("a", "b"): 0.9, ("b", "m"): 0.9}, "contradict each other.*not positive definite"),
    ],
)
def test_bad_correlations(correlation, message):
    solution = rated("a*b*m")
    with pytest.raises(OptionError, match=message):
        solution.mean(1.0, correlation=correlation)
    with pytest.raises(OptionError, match=message):
        solution.sample(3, correlation=correlation)
