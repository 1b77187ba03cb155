"""Distributions as parameters of a problem: their intervals, texts, files and statistics."""

import pickle

import numpy as np
import pytest
import scipy.stats
import sympy as sp

import rankone as ro
from rankone.support.errors import ProblemError, RankoneError
from rankone.tensors.distributions import as_text, from_text

t, k = sp.symbols("t k")
u = sp.Function("u")(t)


def decay(distribution, **options):
    return ro.Problem([sp.Eq(u.diff(t), -k * u)], (t, 0, 2), {k: distribution}, {u: 1}, **options)


def test_bounded_ones_stand_for_their_support():
    assert decay(scipy.stats.uniform(0.5, 4.5)).parameters[k] == (0.5, 5.0)
    assert decay(scipy.stats.beta(2, 3, loc=1, scale=2)).parameters[k] == (1.0, 3.0)


def test_unbounded_ones_are_cut_at_quantiles():
    normal = scipy.stats.norm(2, 0.1)
    lower, upper = decay(normal, tail=1e-4).parameters[k]
    assert np.isclose(normal.cdf(lower), 1e-4)
    assert np.isclose(normal.sf(upper), 1e-4)
    gamma = scipy.stats.gamma(4, scale=0.5)  # bounded on one side: cut at both
    assert np.allclose(decay(gamma).parameters[k], (gamma.ppf(1e-6), gamma.isf(1e-6)))


@pytest.mark.parametrize(
    "distribution",
    [
        scipy.stats.norm(1, 0.1),
        scipy.stats.gamma(4, scale=0.5),
        scipy.stats.lognorm(s=0.3, scale=np.float64(2)),
        scipy.stats.truncnorm(-1, 1, loc=2),
    ],
)
def test_texts(distribution):
    again = from_text(as_text(distribution))
    shares = np.linspace(0.01, 0.99, 9)
    assert np.array_equal(again.ppf(shares), distribution.ppf(shares))


def laplace(distribution, lower, upper, time):
    """Mean and variance of exp(-k t) under a distribution that is cut."""
    first, second = (
        distribution.expect(lambda x, n=n: np.exp(-n * x * time), lb=lower, ub=upper)
        / (distribution.cdf(upper) - distribution.cdf(lower))
        for n in (1, 2)
    )
    return first, second - first**2


@pytest.mark.parametrize(
    "distribution",
    [scipy.stats.uniform(0.5, 4.5), scipy.stats.gamma(9, scale=0.2)],
    ids=["uniform", "gamma"],
)
def test_statistics_are_under_it(distribution):
    solution = ro.solve(decay(distribution), rtol=1e-8)
    lower, upper = solution.parameters["k"]
    mean, variance = laplace(distribution, lower, upper, 1.5)
    assert abs(solution.mean(1.5)[0] - mean) < 1e-8
    assert abs(solution.var(1.5)[0] - variance) < 1e-8


def test_closed_forms_of_gamma():
    """The moment generating function of the whole distribution, with hardly any of it cut."""
    shape, scale = 9.0, 0.2
    problem = decay(scipy.stats.gamma(shape, scale=scale), tail=1e-10)
    solution = ro.solve(problem, rtol=1e-8)
    times = np.linspace(0, 2, 9)
    first, second = ((1 + n * scale * times) ** -shape for n in (1, 2))
    assert np.abs(solution.mean(times)[0] - first).max() <= 1e-7
    assert np.abs(solution.var(times)[0] - (second - first**2)).max() <= 1e-7


def test_they_go_with_the_solution(tmp_path):
    solution = ro.solve(decay(scipy.stats.norm(2, 0.1)), rtol=1e-6)
    mean = solution.mean(1.0)
    assert not np.isclose(mean, solution.mean(1.0, under={k: scipy.stats.norm(2.1, 0.1)}))
    assert np.array_equal(ro.load(solution.save(tmp_path / "u.npz")).mean(1.0), mean)
    assert np.array_equal(pickle.loads(pickle.dumps(solution)).mean(1.0), mean)
    assert np.allclose(solution.at(1.0).mean(), mean)
    assert "~ norm(2.0, 0.1)" in repr(solution)
    assert abs(solution.sample(4000, seed=1)["k"].std() - 0.1) < 0.01
    assert np.allclose(solution.fix(k=2.0).mean(1.0), solution(t=1.0, k=2.0))


def test_problems_from_text(tmp_path):
    parts = {"rhs": {"u": "-k*u"}, "initial": {"u": 1}, "time": (0, 2)}
    problem = ro.Problem.from_strings(**parts, parameters={"k": "norm(2, 0.1)"}, tail=1e-4)
    assert dict(problem.distributions) == {"k": "norm(2.0, 0.1)"}
    again = pickle.loads(pickle.dumps(problem))
    assert (again.distributions, again.parameters) == (problem.distributions, problem.parameters)
    assert "k in [1.62" in repr(problem)
    assert "~ norm(2.0, 0.1)" in repr(problem)


@pytest.mark.parametrize(
    ("given", "match"),
    [
        (scipy.stats.cauchy(), "no finite mean and variance"),
        (scipy.stats.pareto(1.5), "no finite mean and variance"),
        (scipy.stats.poisson(3), "not a frozen continuous distribution|pair of numbers"),
        (scipy.stats.norm, "not a frozen continuous distribution"),
        (scipy.stats.norm([1, 2], 0.1), "not a frozen continuous distribution"),
        (scipy.stats.multivariate_normal([0, 0]), "pair of numbers"),
        (scipy.stats.norm(1, -0.1), "not a frozen|not defined|no finite"),
        ("nrom(1, 0.1)", "no continuous distribution `nrom`.*norm"),
        ("norm(1, 0.1", "not the name of a distribution with numbers"),
        ("norm(__import__('os'))", "not the name of a distribution with numbers"),
        ("norm(1, 2, 3)", "norm"),
        ("norm(1, -1)", "not defined for these numbers"),
    ],
)
def test_what_is_refused(given, match):
    with pytest.raises(ProblemError, match=match):
        decay(given)


@pytest.mark.parametrize("tail", [0, 0.5, 1, -1e-3, "1e-3", True, float("nan")])
def test_tails_that_are_refused(tail):
    with pytest.raises(RankoneError, match="tail is"):
        decay(scipy.stats.norm(2, 0.1), tail=tail)


def test_own_distributions_are_for_statistics_alone():
    class Triangle(scipy.stats.rv_continuous):
        def _pdf(self, x):
            return 2 * x

    with pytest.raises(ProblemError, match=r"scipy.stats knows no distribution.*under="):
        decay(Triangle(a=0, b=1, name="mine")())


c = sp.Symbol("c")


def correlated(correlation):
    return ro.Problem(
        [sp.Eq(u.diff(t), -k * u)],
        (t, 0, 1),
        {k: scipy.stats.norm(2, 0.1), c: (0.9, 1.1)},
        {u: c},
        correlation=correlation,
    )


def test_correlations_go_with_the_solution(tmp_path):
    solution = ro.solve(correlated({(c, k): 0.6}), rtol=1e-6)
    given = solution.var(1.0, correlation={(k, c): 0.6})
    assert np.array_equal(solution.var(1.0), given)
    assert not np.isclose(solution.var(1.0, correlation={}), given, rtol=1e-3)
    assert np.array_equal(ro.load(solution.save(tmp_path / "u.npz")).var(1.0), given)
    assert solution.fix(c=1.0).metadata.correlations == ()
    assert pickle.loads(pickle.dumps(correlated({(c, k): 0.6}))).correlation == {("k", "c"): 0.6}
    with pytest.raises(RankoneError, match="not defined for correlated"):
        solution.sobol(1.0)
    alone = ro.solve(correlated(None), rtol=1e-6)
    assert np.allclose(solution.sobol(1.0, correlation={}).first, alone.sobol(1.0).first, atol=1e-9)
    assert np.allclose(solution.skewness(1.0, correlation={}), alone.skewness(1.0), rtol=1e-6)


@pytest.mark.parametrize(
    ("given", "match"),
    [
        ({(k, c): 1.5}, "between -1 and 1"),
        ({(k, "q"): 0.5}, "no parameter `q`"),
        ({k: 0.5}, "not a pair"),
        (0.5, "not a mapping"),
    ],
)
def test_correlations_that_are_refused(given, match):
    with pytest.raises(ProblemError, match=match):
        correlated(given)
