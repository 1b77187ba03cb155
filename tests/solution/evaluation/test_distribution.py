"""Higher moments, main effects, densities against closed forms, quadrature and SciPy."""

import functools

import numpy as np
import pytest
import scipy.stats

import rankone as ro
from rankone.solution.statistics import moments as higher_moments
from rankone.support.errors import EvaluationError, OptionError
from rankone.tensors.distributions import Measure, gauss_rule
from tests.problems import EXAMPLES

TIMES = np.array([0.5, 1.0, 2.0])
PI = np.pi


@functools.cache
def solved(name, rtol):
    return ro.solve(EXAMPLES[name].problem, rtol)


@functools.cache
def rated(rate, **box):
    """u' = rate from zero, at t = 1 the rate itself."""
    return ro.solve(ro.Problem.from_strings({"u": rate}, {"u": "0"}, box, (0, 1)), 1e-9)


def power_mean(power, t):
    """Mean of exp(-k t)**power, with k uniform as in the example."""
    a, b = 0.5, 5.0
    return (np.exp(-a * power * t) - np.exp(-b * power * t)) / (power * t * (b - a))


def test_moments_of_the_decay():
    solution = solved("decay", 1e-8)
    raw = [1.0, *(power_mean(power, TIMES) for power in (1, 2, 3, 4))]
    for order in (1, 2, 3, 4):
        found = solution.moment(order, TIMES, central=False)[0]
        np.testing.assert_allclose(found, raw[order], rtol=1e-7)
    m = raw[1]
    third = raw[3] - 3 * m * raw[2] + 2 * m**3
    fourth = raw[4] - 4 * m * raw[3] + 6 * m**2 * raw[2] - 3 * m**4
    np.testing.assert_allclose(solution.moment(3, TIMES)[0], third, atol=1e-9)
    np.testing.assert_allclose(solution.moment(4, TIMES)[0], fourth, atol=1e-9)
    variance = raw[2] - m**2
    np.testing.assert_allclose(solution.skewness(TIMES)[0], third / variance**1.5, rtol=1e-6)
    np.testing.assert_allclose(solution.kurtosis(TIMES)[0], fourth / variance**2 - 3, rtol=1e-6)
    np.testing.assert_array_equal(solution.moment(1, TIMES), np.zeros((1, 3)))
    np.testing.assert_array_equal(solution.moment(2, TIMES), solution.var(TIMES))
    assert solution.skewness(TIMES.reshape(3, 1)).shape == (1, 3, 1)
    assert solution.at(1.0).skewness()[0] == pytest.approx(solution.skewness(1.0)[0])


def test_moments_of_several_states_against_quadrature():
    solution, times = solved("lotka_volterra", 1e-5), np.linspace(0, 6, 7)
    nodes, weights = np.polynomial.legendre.leggauss(40)
    values = solution.grid(t=times, x0=10 + 2 * nodes, y0=5 + nodes)
    w = 0.25 * np.outer(weights, weights)
    centred = values - np.einsum("ntab,ab->nt", values, w)[:, :, None, None]
    for order in (3, 4):
        exact = np.einsum("ntab,ab->nt", centred**order, w)
        found = solution.moment(order, times)
        np.testing.assert_allclose(found, exact, rtol=1e-9, atol=1e-9 * np.abs(exact).max())


@pytest.mark.parametrize(
    ("distribution", "cut"),
    [
        (scipy.stats.norm(1.0, 0.05), scipy.stats.norm(1.0, 0.05)),
        (scipy.stats.norm(1.0713, 1e-6), scipy.stats.norm(1.0713, 1e-6)),
        (scipy.stats.beta(2, 5, 0.5, 1.0), scipy.stats.beta(2, 5, 0.5, 1.0)),
        (scipy.stats.gamma(9, scale=0.05), None),
        (None, scipy.stats.uniform(0.5, 1.1)),
    ],
)
@pytest.mark.filterwarnings("ignore::rankone.RankoneWarning")
def test_moments_of_a_parameter(distribution, cut):
    """u = k: skewness and kurtosis are those of its distribution, cut at the ends of the box."""
    if cut is None:
        nodes, weights = np.polynomial.legendre.leggauss(200)
        k = 1.05 + 0.55 * nodes
        weights = weights * distribution.pdf(k)
        weights /= weights.sum()
        y = k - weights @ k
        second, third, fourth = (weights @ y**power for power in (2, 3, 4))
        skewness, kurtosis = third / second**1.5, fourth / second**2 - 3
    else:
        skewness, kurtosis = cut.stats("sk")
    solution, under = rated("k", k=(0.5, 1.6)), distribution and {"k": distribution}
    assert solution.skewness(1.0, under=under)[0] == pytest.approx(skewness, abs=1e-5)
    assert solution.kurtosis(1.0, under=under)[0] == pytest.approx(kurtosis, abs=2e-5)


def test_distributions_of_the_problem_count():
    k = scipy.stats.beta(2, 5, 0.5, 1.0)
    problem = ro.Problem.from_strings({"u": "k"}, {"u": "0"}, {"k": k}, (0, 1))
    solution = ro.solve(problem, 1e-8)
    assert solution.skewness(1.0)[0] == pytest.approx(float(k.stats("s")), abs=1e-6)
    density = solution.density(1.0)
    np.testing.assert_allclose(density.density, k.pdf(density.values), atol=0.02 * k.pdf(0.7))
    found = solution.probability(1.0, above=0.8)
    assert abs(found.value - k.sf(0.8)) <= 5 * found.error


def test_a_kink_is_in_the_moments():
    """|k - 0.3| on [0, 1], where elements end at the kink."""
    solution = rated("Abs(k - 3/10)", k=(0, 1))
    raw = [(0.3 ** (n + 1) + 0.7 ** (n + 1)) / (n + 1) for n in range(5)]
    for order in (3, 4):
        assert solution.moment(order, 1.0, central=False)[0] == pytest.approx(raw[order], rel=1e-9)


def test_what_does_not_vary_has_no_shape():
    still = ro.solve(ro.Problem.from_strings({"x": "-x"}, {"x": 1}, {}, (0, 1)), 1e-8)
    assert np.isnan(still.skewness(1.0)).all()
    assert still.moment(3, 1.0)[0] == 0.0
    assert still.moment(4, 1.0, central=False)[0] == pytest.approx(np.exp(-4), rel=1e-6)
    solution = rated("k", k=(0.5, 1.6))
    assert np.isnan(solution.kurtosis([0.0, 0.0])).all()
    assert solution.moment(3, 0.0)[0] == pytest.approx(0.0, abs=1e-30)
    with pytest.raises(OptionError, match=r"order=5.*choose an integer from 1 to 4"):
        solution.moment(5, 1.0)
    with pytest.raises(EvaluationError, match="no times were given"):
        solution.skewness()


def test_high_ranks_are_truncated_and_said(monkeypatch):
    solution = solved("lotka_volterra", 1e-5)
    exact = solution.kurtosis(4.5)
    monkeypatch.setattr(higher_moments, "_LARGEST_RANK", 2)
    with pytest.warns(ro.RankoneWarning, match="is truncated to .* of its standard deviation"):
        found = solution.kurtosis(4.5)
    np.testing.assert_allclose(found, exact, atol=0.2)
    assert not np.array_equal(found, exact)


def test_gauss_rules():
    nodes, weights = gauss_rule(*np.polynomial.legendre.leggauss(100), 12)
    exact, exact_weights = np.polynomial.legendre.leggauss(12)
    np.testing.assert_allclose(nodes, exact, atol=1e-14)
    np.testing.assert_allclose(weights, exact_weights, atol=1e-14)
    basis = ro.solve(EXAMPLES["decay"].problem, 1e-4).outcome.slabs[0].bases[0]
    points, weights = Measure("k", 0.5, 5.0, scipy.stats.norm(2, 0.1)).rule(basis, 4)
    assert points.size <= 2 * basis.degree
    assert weights @ (points - 2) ** 4 == pytest.approx(3e-4, rel=1e-9)


# --- main effects ------------------------------------------------------------------------------


def test_main_effects_of_ishigami():
    box = dict.fromkeys("xyz", (-PI, PI))
    solution = rated("sin(x) + 7*sin(y)**2 + 0.1*z**4*sin(x)", **box)
    effects = solution.main_effects([0.5, 1.0], count=11)
    assert effects.parameters == ("x", "y", "z")
    assert effects.unknowns == ("u",)
    x, y = effects.values["x"], effects.values["y"]
    exact = {
        "x": 3.5 + (1 + 0.1 * PI**4 / 5) * np.sin(x),
        "y": 7 * np.sin(y) ** 2,
        "z": np.full(11, 3.5),
    }
    for name, curve in exact.items():
        assert effects.means[name].shape == (1, 11, 2)
        np.testing.assert_allclose(effects.means[name][0, :, 1], curve, atol=1e-7)
        np.testing.assert_allclose(effects.means[name][0, :, 0], 0.5 * curve, atol=1e-7)
    assert solution.main_effects(1.0).means["x"].shape == (1, 101)
    assert solution.at(1.0).main_effects(count=5).means["x"].shape == (1, 5)
    with pytest.raises(OptionError, match="count=1 is not valid"):
        solution.main_effects(1.0, count=1)


def test_main_effects_have_the_first_order_variances():
    solution = solved("lotka_volterra", 1e-5)
    under = {"x0": scipy.stats.norm(10, 0.3)}
    effects = solution.main_effects(4.5, under=under, count=2001)
    x = effects.values["x0"]
    weights = scipy.stats.norm(10, 0.3).pdf(x)
    weights /= weights.sum()
    curve = effects.means["x0"]
    variance = (curve - (curve @ weights)[:, None]) ** 2 @ weights
    share = solution.sobol(4.5, under=under).first[:, 0, 0]
    np.testing.assert_allclose(variance, share * solution.var(4.5, under=under), rtol=1e-4)


# --- densities and probabilities ---------------------------------------------------------------


@pytest.mark.slow
def test_density_of_the_decay():
    """u = exp(-k t) with k uniform has the density 1/(t u (b - a)), which jumps at both ends."""
    solution = solved("decay", 1e-6)
    inside = np.linspace(np.exp(-4.5), np.exp(-0.6), 50)
    found = solution.density(1.0, values=inside)
    np.testing.assert_allclose(found.density, 1 / (4.5 * inside), rtol=0.1)
    assert np.median(np.abs(found.density * 4.5 * inside - 1)) < 0.01
    assert solution.density(1.0, values=[-1.0, 0.9]).density.tolist() == [0.0, 0.0]
    whole = solution.density(1.0)
    assert np.trapezoid(whole.density, whole.values) == pytest.approx(1.0, abs=0.01)
    assert whole.unknown == "u"


def test_density_of_a_normal_parameter():
    given = scipy.stats.norm(1.0, 0.1)
    found = rated("k", k=(0.5, 1.6)).density(1.0, unknown="u", under={"k": given})
    np.testing.assert_allclose(found.density, given.pdf(found.values), atol=0.015 * given.pdf(1.0))
    assert 0.0 < found.bandwidth < 0.05


def test_density_with_a_gap():
    """Two bumps: the kernel is as wide as a bump needs, not as both."""
    edges = [0.6, 0.61, 0.62, 1.5, 1.51, 1.52]
    given = scipy.stats.rv_histogram((np.array([1, 2, 0, 1, 3]), np.array(edges)), density=False)
    found = rated("k", k=(0.5, 1.6)).density(1.0, under={"k": given}, values=[0.615, 1.0, 1.505])
    np.testing.assert_allclose(found.density, given.pdf([0.615, 1.0, 1.505]), atol=2.5)
    assert found.density[1] == pytest.approx(0.0, abs=1e-9)


def test_probabilities_of_the_decay():
    solution = solved("decay", 1e-6)
    found = solution.probability(TIMES, below=np.exp(-2))
    exact = np.clip((5.0 - 2 / TIMES) / 4.5, 0, 1)
    assert found.value.shape == found.error.shape == (3,)
    assert (np.abs(found.value - exact) <= np.maximum(4 * found.error, 1e-4)).all()
    assert (np.abs(found.value - exact) <= found.half_width).all()
    above = solution.probability(1.0, unknown="u", above=np.exp(-2))
    assert above.value == pytest.approx(1 - exact[1], abs=1e-3)
    between = solution.probability(1.0, above=np.exp(-3), below=np.exp(-2))
    assert between.value == pytest.approx(1 / 4.5, abs=1e-3)
    assert solution.probability(1.0, above=5.0).error == 1 / 2**15


def test_the_error_of_a_probability_is_honest():
    """A sum of four normal parameters, for thresholds up to three deviations."""
    box = dict.fromkeys("abcd", (0.4, 1.6))
    solution = rated("a + b + c + d", **box)
    under = {name: scipy.stats.norm(1, 0.1) for name in box}
    for level in (0.0, 1.0, 2.0, 3.0):
        found = solution.probability(1.0, above=4 + 0.2 * level, under=under)
        assert abs(found.value - scipy.stats.norm.sf(level)) <= 5 * found.error
        assert found.error < 2e-3


def test_what_has_no_density_or_probability():
    solution = solved("lotka_volterra", 1e-5)
    with pytest.raises(EvaluationError, match=r"several unknowns, `x` and `y`.*unknown='x'"):
        solution.density(1.0)
    with pytest.raises(EvaluationError, match="no unknown `z`"):
        solution.probability(1.0, unknown="z", above=1.0)
    with pytest.raises(OptionError, match="a probability needs a limit"):
        solution.probability(1.0, unknown="x")
    with pytest.raises(OptionError, match="not the ends of an interval"):
        solution.probability(1.0, unknown="x", above=2.0, below=1.0)
    with pytest.raises(OptionError, match="above='a' are not real numbers"):
        solution.probability(1.0, unknown="x", above="a")
    with pytest.raises(OptionError, match="t is not one time"):
        solution.density([1.0, 2.0], unknown="x")
    with pytest.raises(OptionError, match="are not real numbers"):
        solution.density(1.0, unknown="x", values=["a"])
    with pytest.raises(EvaluationError, match="`u` does not vary there"):
        rated("k", k=(0.5, 1.6)).density(0.0)


def test_heavy_tails():
    """They are refused where it matters how they are cut."""
    solution = rated("k", k=(0.5, 1.6))
    with pytest.raises(OptionError, match="no finite mean and variance"):
        solution.kurtosis(1.0, under={"k": scipy.stats.cauchy(1, 0.01)})
    found = solution.kurtosis(1.0, under={"k": scipy.stats.cauchy(1, 1e-5)})
    assert np.isfinite(found).all()
