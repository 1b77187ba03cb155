"""Distributions of the random functions against closed forms, samples, and trajectories."""

import itertools

import numpy as np
import pytest
from scipy.special import factorial
from scipy.stats import qmc

from tests.reference.random_functions import (
    PROBABILITIES,
    TRUTH,
    RandomFunction,
    Term,
    random_functions,
    snippet,
)

FUNCTIONS = [snippet(), *random_functions()]


def sampled(function, log_count):
    points = qmc.Sobol(len(function.box), rng=7).random_base2(log_count)
    lower, upper = np.array(list(function.box.values())).T
    return function(dict(zip(function.box, (lower + points * (upper - lower)).T, strict=True)))


def test_there_are_two_hundred_and_they_do_not_change():
    assert len({function.name for function in FUNCTIONS}) == 201
    again = [function.terms for function in random_functions()]
    assert again == [function.terms for function in FUNCTIONS[1:]]
    assert {len(function.box) for function in FUNCTIONS} == set(range(1, 11))


def test_sums_of_uniform_numbers_in_closed_form():
    """The distribution of a weighted sum of uniform numbers, by inclusion and exclusion."""
    for function in FUNCTIONS:
        if function.family not in ("sum", "oblique ridge") or len(function.terms) > 5:
            continue
        weights = [float(term.text.split("*")[0]) for term in function.terms]
        sides = [box for name, box in function.box.items()
                 if name in {n for term in function.terms for n in term.parameters}]  # fmt: skip
        ends = [sorted((w * a, w * b)) for w, (a, b) in zip(weights, sides, strict=True)]
        spans = np.array([b - a for a, b in ends])
        x = function.quantile(np.array([0.03, 0.2, 0.5, 0.9]))
        above = x / function.scale - sum(a for a, _ in ends)
        n = len(spans)
        terms = [
            (-1) ** sum(v) * np.maximum(above - spans @ v, 0.0) ** n
            for v in itertools.product((0, 1), repeat=n)
        ]
        exact = sum(terms) / factorial(n) / spans.prod()
        np.testing.assert_allclose(function.cdf(x), exact, atol=0.1 * TRUTH)
        shares = spans**2 / (spans @ spans)
        first, total = function.sobol
        np.testing.assert_allclose(first[first > 0.01], shares[shares > 0.01], atol=TRUTH)
        np.testing.assert_allclose(total, first, atol=TRUTH)


def test_ishigami_in_closed_form():
    """Ishigami and Homma (1990), with a = 7 and b = 0.1."""
    terms = (Term("sin(p1)*(1 + 0.1*p3**4)", ("p1", "p3")), Term("7*sin(p2)**2", ("p2",)))
    box = dict.fromkeys(("p1", "p2", "p3"), (-np.pi, np.pi))
    first, total = RandomFunction("Ishigami", "", box, terms, "u").sobol
    np.testing.assert_allclose(first, [0.31390519, 0.44241114, 0.0], atol=TRUTH)
    np.testing.assert_allclose(total, [0.55758886, 0.44241114, 0.24368366], atol=TRUTH)


@pytest.mark.filterwarnings("ignore::rankone.RankoneWarning")
@pytest.mark.parametrize("function", FUNCTIONS[::9], ids=lambda f: f.name)
def test_dynamics_end_at_the_function(function):
    shares = np.linspace(0.2, 0.9, len(function.box))
    at = {n: a + s * (b - a) for s, (n, (a, b)) in zip(shares, function.box.items(), strict=True)}
    values = function.problem().trajectory([0.0, function.end], **at).values
    exact = float(function({name: np.array(x) for name, x in at.items()}))
    assert values[0, -1] == pytest.approx(exact, rel=1e-6, abs=1e-7)


@pytest.mark.slow
@pytest.mark.parametrize("function", FUNCTIONS[::4], ids=lambda f: f.name)
def test_quantiles_and_moments_against_samples(function):
    x = sampled(function, 16)
    q = np.array(PROBABILITIES)
    at = function.quantile(q)
    np.testing.assert_allclose(function.cdf(at), q, atol=1e-6)
    np.testing.assert_allclose([np.mean(x <= value) for value in at], q, atol=2e-3)
    mean, variance = function.moments
    assert x.mean() == pytest.approx(mean, abs=2e-3 * np.sqrt(variance))
    assert x.var() == pytest.approx(variance, rel=1e-2)
    lower, upper = function.range
    slack = 1e-6 * (upper - lower)
    assert lower - slack <= x.min()
    assert x.max() <= upper + slack
    first, total = function.sobol
    assert (first >= -TRUTH).all()
    assert (total >= first - TRUTH).all()
    assert first.sum() <= 1.0 + TRUTH <= total.sum() + 3 * TRUTH
