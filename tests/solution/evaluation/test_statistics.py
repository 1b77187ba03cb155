"""Means, variances and sensitivities against closed forms, quadrature and sampling."""

import functools
import warnings
from dataclasses import replace

import numpy as np
import pytest
import scipy.special
import scipy.stats
import sympy as sp

import rankone as ro
from rankone.support.errors import EvaluationError, OptionError
from rankone.tensors.distributions import Measure
from tests.problems import EXAMPLES

TIMES = np.array([0.0, 0.5, 1.0, 2.0])
PI = np.pi


@functools.cache
def solved(name, rtol):
    return ro.solve(EXAMPLES[name].problem, rtol)


def trivial(function, box):
    """u' = f(p) from zero: u = t f(p)."""
    return ro.solve(ro.Problem.from_strings({"u": function}, {"u": "0"}, box, (0, 1)), 1e-9)


def test_decay_uniform():
    """Of exp(-k t) with k uniform on (a, b)."""
    solution, (a, b) = solved("decay", 1e-8), (0.5, 5.0)

    def mean(t):
        return np.where(
            t > 0, (np.exp(-a * t) - np.exp(-b * t)) / (np.maximum(t, 1e-9) * (b - a)), 1.0
        )

    np.testing.assert_allclose(solution.mean(TIMES)[0], mean(TIMES), atol=1e-7)
    variance = mean(2 * TIMES) - mean(TIMES) ** 2
    np.testing.assert_allclose(solution.var(TIMES)[0], variance, atol=1e-7)
    np.testing.assert_allclose(solution.std(TIMES)[0] ** 2, solution.var(TIMES)[0], atol=1e-16)
    assert solution.mean(1.0).shape == (1,)
    assert solution.var(TIMES.reshape(2, 2)).shape == (1, 2, 2)


def test_decay_gamma():
    """Of exp(-k t) with k gamma-distributed, cut at the ends of the box."""
    shape, rate = 20.0, 10.0
    gamma = scipy.stats.gamma(shape, scale=1 / rate)

    def mean(t):
        def integral(k):
            inside = scipy.special.gammainc(shape, k * (rate + t))
            return inside * (rate / (rate + t)) ** shape

        return (integral(5.0) - integral(0.5)) / (gamma.cdf(5.0) - gamma.cdf(0.5))

    solution, k = solved("decay", 1e-8), sp.Symbol("k")
    np.testing.assert_allclose(solution.mean(TIMES, under={k: gamma})[0], mean(TIMES), atol=1e-7)
    variance = mean(2 * TIMES) - mean(TIMES) ** 2
    np.testing.assert_allclose(solution.var(TIMES, under={"k": gamma})[0], variance, atol=1e-7)


def test_several_states_against_quadrature():
    solution = solved("lotka_volterra", 1e-5)
    nodes, weights = np.polynomial.legendre.leggauss(24)
    x0, y0 = 10 + 2 * nodes, 5 + nodes
    values = solution.grid(t=[1.0, 4.5], x0=x0, y0=y0)
    w = 0.25 * np.outer(weights, weights)
    mean = np.einsum("ntab,ab->nt", values, w)
    centred = values - mean[:, :, None, None]
    covariance = np.einsum("ntab,mtab,ab->nmt", centred, centred, w)
    np.testing.assert_allclose(solution.mean([1.0, 4.5]), mean, rtol=1e-10)
    np.testing.assert_allclose(solution.cov([1.0, 4.5]), covariance, rtol=1e-8, atol=1e-12)
    given_x0 = np.einsum("ntab,b->nta", centred, 0.5 * weights)
    first = np.einsum("nta,a->nt", given_x0**2, 0.5 * weights)
    sobol = solution.sobol([1.0, 4.5])
    np.testing.assert_allclose(sobol.first[:, 0], first / np.einsum("nnt->nt", covariance))
    np.testing.assert_allclose(sobol.first.sum(axis=1) + sobol.second[:, 0, 1], 1.0)
    np.testing.assert_allclose(sobol.total[:, 0], 1.0 - sobol.first[:, 1])


def test_ishigami():
    """Ishigami & Homma (1990), a = 7, b = 0.1; t cancels from the indices."""
    box = dict.fromkeys("xyz", (-PI, PI))
    solution = trivial("sin(x) + 7*sin(y)**2 + 0.1*z**4*sin(x)", box)
    first_x = 0.5 * (1 + 0.1 * PI**4 / 5) ** 2
    first_y, both = 49 / 8, 0.01 * PI**8 * (1 / 18 - 1 / 50)
    total = first_x + first_y + both
    sobol = solution.sobol([0.5, 1.0])
    assert sobol.parameters == ("x", "y", "z")
    for now in range(2):
        first = np.array([first_x, first_y, 0]) / total
        np.testing.assert_allclose(sobol.first[0, :, now], first, atol=1e-9)
        totals = np.array([first_x + both, first_y, both]) / total
        np.testing.assert_allclose(sobol.total[0, :, now], totals, atol=1e-9)
        second = np.zeros((3, 3))
        second[0, 2] = second[2, 0] = both / total
        np.testing.assert_allclose(sobol.second[0, :, :, now], second, atol=1e-9)
    assert solution.var(1.0)[0] == pytest.approx(total, rel=1e-9)


def test_g_function():
    """Saltelli & Sobol (1995): products of (|4 x - 2| + a)/(1 + a), with kinks."""
    a = np.array([0, 1, 4.5, 9, 99])
    rate = "*".join(f"(Abs(4*x{i} - 2) + {v})/(1 + {v})" for i, v in enumerate(a))
    sobol = trivial(rate, {f"x{i}": (0, 1) for i in range(5)}).sobol(1.0)
    parts = 1 / (3 * (1 + a) ** 2)
    variance = np.prod(1 + parts) - 1
    np.testing.assert_allclose(sobol.first[0, :, 0], parts / variance, atol=1e-9)
    others = np.prod(1 + parts) / (1 + parts)
    np.testing.assert_allclose(sobol.total[0, :, 0], parts * others / variance, atol=1e-9)
    assert sobol.second[0, 0, 1, 0] == pytest.approx(parts[0] * parts[1] / variance, abs=1e-9)


@functools.cache
def rule():
    """Nodes and weights on (-1, 1); they take longer to compute than all that uses them."""
    return np.polynomial.legendre.leggauss(2000)


@pytest.mark.parametrize(
    "distribution",
    [
        pytest.param(scipy.stats.norm(1.0, 0.1), marks=pytest.mark.slow),
        scipy.stats.beta(0.5, 0.5, loc=0.5, scale=1.0),
        scipy.stats.truncnorm(-3, 5, loc=1.2, scale=0.1),
        scipy.stats.triang(0.3, loc=0.5, scale=1.0),
        scipy.stats.lognorm(0.2),
        scipy.stats.norm(1.1, 1e-4),
        scipy.stats.expon(0.5, 0.05),
    ],
)
def test_measures_against_adaptive_quadrature(distribution):
    """Moments of a polynomial of the parameter; the densities are as SciPy gives them."""
    problem = ro.Problem.from_strings({"u": "k**3 - k"}, {"u": "0"}, {"k": (0.5, 1.5)}, (0, 1))
    solution = ro.solve(problem, 1e-8)
    below, up_to = distribution.cdf([0.5, 1.5])
    q, w = rule()
    shares = below + (up_to - below) * 0.5 * (1 + np.sin(0.5 * PI * q))  # graded to both ends
    k = distribution.ppf(shares)
    weights = 0.25 * PI * w * np.cos(0.5 * PI * q)
    mean = weights @ (k**3 - k)
    variance = weights @ (k**3 - k - mean) ** 2
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ro.RankoneWarning)
        found = solution.mean(1.0, under={"k": distribution})[0]
        spread = solution.var(1.0, under={"k": distribution})[0]
    assert found == pytest.approx(mean, rel=1e-6, abs=1e-9)
    assert spread == pytest.approx(variance, rel=1e-5, abs=1e-12)


def linear():
    """u = k t: its moments are those of the parameter."""
    problem = ro.Problem.from_strings({"u": "k"}, {"u": "0"}, {"k": (0.5, 1.6)}, (0, 1))
    return ro.solve(problem, 1e-8)


def histogram_moments(counts, edges):
    """Mean and variance of a piecewise constant density."""
    mass = np.array(counts) / np.sum(counts)
    a, b = np.array(edges[:-1]), np.array(edges[1:])
    mean = mass @ (a + b) / 2
    return mean, mass @ ((a**2 + a * b + b**2) / 3) - mean**2


def test_histograms():
    """Densities that jump, with gaps and bins of any width."""
    generator, solution = np.random.default_rng(5), linear()
    random = generator.integers(0, 2, 60)
    cases = [
        ([1, 0, 1e-5], [0.6, 0.60001, 1.59, 1.59001]),
        (random, np.linspace(0.55, 1.55, 61)),
        (generator.random(100), np.linspace(0.5, 1.6, 101)),
    ]
    for counts, edges in cases:
        given = scipy.stats.rv_histogram((np.array(counts), np.array(edges)), density=False)
        mean, variance = histogram_moments(counts, edges)
        assert solution.mean(1.0, under={"k": given})[0] == pytest.approx(mean, rel=1e-9)
        assert solution.var(1.0, under={"k": given})[0] == pytest.approx(variance, rel=1e-8)


@pytest.mark.filterwarnings("ignore::rankone.RankoneWarning")
@pytest.mark.parametrize(("mean", "sigma"), [(-0.7, 0.15), (-0.5, 0.15), (3.2, 0.2)])
def test_tails_of_distributions(mean, sigma):
    solution, given = linear(), {"k": scipy.stats.norm(mean, sigma)}
    cut = scipy.stats.truncnorm((0.5 - mean) / sigma, (1.6 - mean) / sigma, loc=mean, scale=sigma)
    assert solution.mean(1.0, under=given)[0] == pytest.approx(cut.mean(), rel=1e-6)
    assert solution.std(1.0, under=given)[0] == pytest.approx(cut.std(), rel=1e-4)
    median = solution.quantile(0.5, 1.0, under=given)[0]
    assert median == pytest.approx(cut.median(), abs=1e-3)
    assert np.unique(solution.sample(100, seed=1, under=given)["k"]).size == 100


@pytest.mark.parametrize("sigma", [1e-4, 1e-6, 1e-8, 1e-10])
def test_narrow_distributions(sigma):
    given = {"k": scipy.stats.norm(1.0713, sigma)}
    assert linear().std(1.0, under=given)[0] == pytest.approx(sigma, rel=1e-4)


def test_jumps_are_in_the_statistics():
    problem = ro.Problem.from_strings(
        {"x": "0"}, {"x": "0"}, {"d": (1, 2)}, (0, 4), jumps={2: {"x": "x + d"}}
    )
    solution = ro.solve(problem, 1e-8)
    np.testing.assert_allclose(solution.mean([1.9, 2.0, 3.0])[0], [0, 1.5, 1.5], atol=1e-9)
    np.testing.assert_allclose(solution.var([1.9, 2.0])[0], [0, 1 / 12], atol=1e-9)
    assert np.isnan(solution.sobol(1.0).first).all()


def test_quantiles_and_samples():
    """exp(-k t) falls with k: its quantiles are those of k, the other way round."""
    solution, q = solved("decay", 1e-6), np.array([0.05, 0.5, 0.95])
    exact = np.exp(-np.outer(0.5 + 4.5 * (1 - q), TIMES))
    found = solution.quantile(q, TIMES)
    assert found.shape == (3, 1, 4)
    np.testing.assert_allclose(found[:, 0], exact, atol=2e-3)
    np.testing.assert_array_equal(solution.quantile(0.5, 1.0), found[1, :, 2])
    norm = scipy.stats.norm(2, 0.3)
    median = solution.quantile(0.5, 1.0, under={"k": norm})[0]
    assert median == pytest.approx(np.exp(-2), rel=2e-3)
    drawn = solution.sample(4000, seed=1, under={"k": norm})
    assert drawn["k"].mean() == pytest.approx(2.0, abs=0.02)
    assert solution(t=1.0, **drawn).shape == (1, 4000)
    np.testing.assert_array_equal(drawn["k"], solution.sample(4000, seed=1, under={"k": norm})["k"])
    with pytest.raises(OptionError, match=r"q=1\.5 is not in"):
        solution.quantile(1.5, 1.0)
    with pytest.raises(OptionError, match="are not numbers"):
        solution.quantile("a", 1.0)
    with pytest.raises(OptionError, match="count"):
        solution.sample(-1)
    with pytest.raises(OptionError, match="seed"):
        solution.sample(1, seed=-1)
    with pytest.raises(OptionError, match="more than one dimension"):
        solution.sobol([[1.0]])
    for times in ("a", [0.0, "b"], sp.Symbol("t")):
        with pytest.raises(EvaluationError, match="not a real number"):
            solution.sobol(t=times)
    for empty in (solution.mean([]), solution.sobol([]).first[:, 0], solution.var([])):
        assert empty.shape == (1, 0)


def test_without_parameters():
    solution = ro.solve(ro.Problem.from_strings({"x": "-x"}, {"x": 1}, {}, (0, 1)), 1e-8)
    assert solution.mean(1.0)[0] == pytest.approx(np.exp(-1), rel=1e-7)
    assert solution.var(1.0)[0] == 0.0
    assert solution.quantile(0.3, 1.0)[0] == pytest.approx(np.exp(-1), rel=1e-7)
    assert solution.sample(3) == {}
    assert solution.sobol(1.0).first.shape == (1, 0, 1)


def test_samples_of_a_measure():
    shares = (np.arange(10_000) + 0.5) / 10_000
    values = Measure("k", 0.5, 1.5, scipy.stats.norm(1, 0.1)).sample(shares)
    assert values.std() == pytest.approx(0.1, rel=1e-2)
    assert Measure("k", 0.5, 1.5).sample(np.array([0.0, 1.0])).tolist() == [0.5, 1.5]


@pytest.mark.parametrize(
    ("under", "message"),
    [
        ({"q": scipy.stats.norm()}, "there is no parameter `q`"),
        ({"k": 3}, "the distribution of `k` is 3, not a frozen"),
        ({"k": scipy.stats.poisson(3)}, "not a frozen"),
        ({"k": scipy.stats.norm}, "not a frozen"),
        ({"k": scipy.stats.multivariate_normal([1, 2])}, "not a frozen"),
        ({"k": scipy.stats.binom(3, 0.5)}, "not a frozen"),
        ({"k": scipy.stats.norm([1, 2], 0.1)}, "not a frozen"),
        ({"k": scipy.stats.norm(-50, 0.1)}, "has no probability in"),
        (5, "under=5 is not a mapping"),
        ({"k": scipy.stats.norm(), sp.Symbol("k"): scipy.stats.norm()}, "`k` is given twice"),
    ],
)
def test_bad_distributions(under, message):
    with pytest.raises(OptionError, match=message):
        solved("decay", 1e-8).mean(1.0, under=under)


def test_what_is_cut_is_said():
    with pytest.warns(ro.RankoneWarning, match=r"15\.9 % of the distribution of `k` is outside"):
        solved("decay", 1e-8).mean(1.0, under={"k": scipy.stats.norm(1.0, 0.5)})


def test_times_outside():
    with pytest.raises(EvaluationError, match="`t` = 3 is outside its horizon"):
        solved("decay", 1e-8).mean([1.0, 3.0])


def test_the_same_as_by_sampling():
    """SALib's estimates from values of the solution are within its intervals, widened twice."""
    pytest.importorskip("SALib", reason="needs SALib: pip install SALib")
    from tests.benchmarks.sobol import by_sampling

    solution = solved("lotka_volterra", 1e-5)
    sobol, sampled = solution.sobol(4.5), by_sampling(solution, 4.5, 2**11)
    assert sampled["evaluations"] == 4 * 2**11
    for found, key in ((sobol.first, "S1"), (sobol.total, "ST")):
        apart = np.abs(found[0, :, 0] - sampled[key])
        assert (apart <= 2 * sampled[f"{key}_conf"]).all()
        assert (sampled[f"{key}_conf"] < 0.2).all()


def hidden_and_vague():
    """``u`` varies clearly, ``v`` by 2.9 and ``w`` by 0.14 of the error that is stated."""
    rates = {"u": "k", "v": "1 + 1e-3*k", "w": "1 + 5e-5*k"}
    problem = ro.Problem.from_strings(rates, dict.fromkeys(rates, "1"), {"k": (0, 1)}, (0, 1))
    solution = ro.solve(problem, 1e-6)
    measured = replace(solution.outcome.measured, interior=(5e-5,) * 3)
    return ro.Solution(replace(solution.outcome, measured=measured), solution.metadata)


def test_indices_below_the_error_are_said():
    with pytest.warns(ro.RankoneWarning) as caught:
        sobol = hidden_and_vague().sobol([0.0, 0.9, 1.0])
    assert np.isnan(sobol.first[2]).all()
    assert np.isfinite(sobol.first[1, :, 2]).all()
    (message,) = (str(warning.message) for warning in caught)
    assert "indices of `w` are NaN at 2 times between t = 0.9 and 1: its spread" in message
    assert "over the box, 1.4e-05, is below the error of the solution, 0.0001" in message
    assert "indices of `v` are uncertain" in message
    assert "`u`" not in message
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        hidden_and_vague().sobol(0.0)
