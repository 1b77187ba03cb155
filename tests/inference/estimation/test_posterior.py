"""Posteriors against brute-force grids and closed forms."""

import multiprocessing
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
import scipy.stats

import rankone as ro
from rankone.inference.estimation.cube_distributions import Chain
from rankone.inference.estimation.posterior import PosteriorTuning
from rankone.support.errors import OptionError
from tests.inference.estimation.systems import FALL, FALL_TIMES, decay, fall, line, noisy

T = np.linspace(0, 1, 12)
SMALL_BLOCKS = PosteriorTuning(points_at_once=500)


class Counting(ThreadPoolExecutor):
    """Counts what it is given."""

    count = 0

    def submit(self, *arguments):
        self.count += 1
        return super().submit(*arguments)


DATA = noisy(0.4 - 1.1 * T, 0.3, 2)


def grid_moments(solution, times, data, sigma, prior=lambda *x: 0.0, count=600):
    """Means and standard deviations of two parameters by the midpoint rule."""
    middle = (np.arange(count) + 0.5) / count
    axes = [low + (high - low) * middle for low, high in solution.parameters.values()]
    values = solution.grid(times, dict(zip(solution.parameters, axes)))[0]
    squares = np.sum((values - data[:, None, None]) ** 2, axis=0)
    logs = -0.5 * squares / sigma**2 if sigma else -0.5 * len(data) * np.log(squares)
    logs = logs + prior(axes[0][:, None], axes[1][None, :])
    mass = np.exp(logs - logs.max())
    mass /= mass.sum()
    sides = mass.sum(axis=1), mass.sum(axis=0)
    means = [side @ axis for side, axis in zip(sides, axes)]
    stds = [np.sqrt(side @ (x - m) ** 2) for side, x, m in zip(sides, axes, means)]
    return means, stds, axes, sides


@pytest.mark.parametrize("sigma", [0.1, None])
def test_against_a_grid(sigma):
    """The ridge of free fall ends at the edges of the box."""
    data = noisy(fall()["u"](FALL_TIMES, FALL), 0.1, 1)
    found = fall().posterior(FALL_TIMES, data, sigma=sigma)
    means, stds, axes, sides = grid_moments(fall(), FALL_TIMES, data, sigma)
    assert found.success, found.message
    np.testing.assert_allclose(list(found.mean.values()), means, rtol=1e-3)
    np.testing.assert_allclose(list(found.std.values()), stds, rtol=2e-3)
    step = axes[1][1] - axes[1][0]
    np.testing.assert_allclose(found.density("m", axes[1][::40]), sides[1][::40] / step, rtol=0.05)
    median = np.interp(0.5, np.cumsum(sides[0]), axes[0])
    assert found.quantile(0.5)["C_D"] == pytest.approx(median, rel=3e-3)


def test_of_a_linear_model_is_normal():
    found = line().posterior(T, DATA, sigma=0.3)
    design = np.stack([np.ones_like(T), T], axis=1)
    covariance = 0.09 * np.linalg.inv(design.T @ design)
    mean = np.linalg.lstsq(design, DATA)[0]
    np.testing.assert_allclose(list(found.mean.values()), mean, rtol=1e-4)
    np.testing.assert_allclose(found.covariance, covariance, rtol=1e-3)
    normal = scipy.stats.norm(mean[1], np.sqrt(covariance[1, 1]))
    q = np.array([0.01, 0.3, 0.975])
    np.testing.assert_allclose(found.quantile(q)["b"], normal.ppf(q), atol=2e-4)
    np.testing.assert_allclose(
        found.density("b", [-1.0, -0.5]), normal.pdf([-1.0, -0.5]), rtol=1e-3
    )
    drawn = found.sample(20000, seed=1)
    assert scipy.stats.kstest(drawn["b"], normal.cdf).pvalue > 1e-3
    again = found.sample(20000, seed=1)["a"]
    np.testing.assert_array_equal(drawn["a"], again)
    np.testing.assert_allclose(np.cov(drawn["a"], drawn["b"]), covariance, rtol=0.05)


def test_priors():
    prior = scipy.stats.norm(-0.5, 0.2)
    found = line().posterior(T, DATA, sigma=0.3, prior={"b": prior})
    means, stds, _, _ = grid_moments(line(), T, DATA, 0.3, lambda a, b: prior.logpdf(b), count=1000)
    np.testing.assert_allclose(list(found.mean.values()), means, rtol=1e-3)
    np.testing.assert_allclose(list(found.std.values()), stds, rtol=1e-3)


@pytest.mark.parametrize("sigma", [1e-2, 1e-4, 1e-6])
def test_narrow_posteriors(sigma):
    """Of one parameter: as narrow as the noise says."""
    times = np.linspace(0.1, 2.0, 10)
    data = noisy(2 * np.exp(-1.3 * times), sigma, 5)
    found = decay().posterior(times, data, sigma=sigma, fixed={"a": 2.0})
    wanted = sigma / np.linalg.norm(2 * times * np.exp(-1.3 * times))
    assert found.success, found.message
    assert found.std["k"] == pytest.approx(wanted, rel=0.02)
    assert set(found.sample(3, seed=0)) == {"k", "a"}


@pytest.mark.slow
def test_by_a_chain():
    """Four parameters of a polynomial, whose posterior is normal."""
    pytest.importorskip("emcee")
    box = dict.fromkeys("abcd", (-4, 4))
    problem = ro.Problem.from_strings({"u": "b + 2*c*t + 3*d*t**2"}, {"u": "a"}, box, (0, 1))
    solution, t = ro.solve(problem, 1e-8), np.linspace(0, 1, 40)
    design = np.stack([t**0, t, t**2, t**3], axis=1)
    data = noisy(design @ [0.3, -0.5, 0.4, 0.2], 0.02, 1)
    found = solution.posterior(t, data, sigma=0.02, steps=800, seed=3)
    covariance = 0.02**2 * np.linalg.inv(design.T @ design)
    assert found.method == "mcmc"
    assert found.success, found.message
    deviations = np.sqrt(np.diag(covariance))
    mean = np.linalg.lstsq(design, data)[0]
    assert (np.abs(np.array(list(found.mean.values())) - mean) < 0.1 * deviations).all()
    np.testing.assert_allclose(list(found.std.values()), deviations, rtol=0.1)
    one, two = (solution.posterior(t, data, sigma=0.02, steps=100, seed=3) for _ in range(2))
    assert one.mean == two.mean


def test_bad_input():
    with pytest.raises(OptionError, match="there is no parameter `q`"):
        line().posterior(T, DATA, sigma=0.3, prior={"q": scipy.stats.norm()})
    with pytest.raises(OptionError, match="is fixed, and has a prior"):
        line().posterior(T, DATA, fixed={"a": 1}, prior={"a": scipy.stats.norm()})
    found = line().posterior(T, DATA, sigma=0.3)
    with pytest.raises(OptionError, match="not in"):
        found.quantile(2)
    with pytest.raises(OptionError, match="not a free parameter"):
        found.density("q", 0.0)


@pytest.mark.parametrize("sigma", [1e-1, 1e-3, 1e-5])
def test_two_modes(sigma):
    """u = k^2 t does not know the sign of k."""
    problem = ro.Problem.from_strings({"u": "k**2"}, {"u": "0"}, {"k": (-2, 2)}, (0, 1))
    found = ro.solve(problem, 1e-9).posterior(T[1:], 1.44 * T[1:], sigma=sigma)
    assert found.mean["k"] == pytest.approx(0.0, abs=1e-6)
    assert found.std["k"] == pytest.approx(1.2, rel=0.02)
    np.testing.assert_allclose(found.quantile([0.25, 0.75])["k"], [-1.2, 1.2], atol=sigma)


def test_the_posterior_of_a_fit_keeps_its_prior():
    decay = ro.solve(
        ro.Problem.from_strings({"u": "-k*u"}, {"u": "a"}, {"k": (0.1, 2), "a": (0.5, 2)}, (0, 2)),
        1e-5,
    )
    times = np.linspace(0.2, 2, 5)
    data = decay["u"](t=times, k=0.8, a=1.0) + 0.1 * np.array([1, -1, 1, -1, 1])
    prior = {"k": scipy.stats.norm(0.5, 0.01)}
    fit = decay.fit(times, data, sigma=0.1, prior=prior)
    kept, again = ro.posterior(fit), ro.posterior(fit, prior=prior)
    assert kept.mean["k"] == pytest.approx(again.mean["k"], abs=1e-6)
    assert abs(kept.mean["k"] - 0.5) < 0.03


def four_parameters():
    """A problem with four free parameters, and data: (solution, times, data)."""
    box = {"a": (0.5, 1.5), "b": (-1.5, -0.5), "c": (-0.5, 0.5), "d": (-0.5, 0.5)}
    rates = {"u": "b + 2*c*t + 3*d*t**2"}
    solution = ro.solve(ro.Problem.from_strings(rates, {"u": "a"}, box, (0, 1)), 1e-6)
    times = np.linspace(0, 1, 20)
    return solution, times, noisy(1.0 - times + 0.2 * times**3, 0.1, 5)


@pytest.mark.slow
def test_chains_that_know_nothing_of_each_other():
    pytest.importorskip("emcee")
    solution, times, data = four_parameters()
    one = solution.posterior(times, data, sigma=0.1, steps=100)
    three = solution.posterior(times, data, sigma=0.1, steps=100, chains=3)
    count = len(one._distribution.nodes)
    assert np.array_equal(three._distribution.nodes[:count], one._distribution.nodes)
    assert not np.array_equal(*three._distribution.nodes[count:].reshape(2, -1)[:, :count])
    assert "3 chains have 100 steps each" in three.message
    with ThreadPoolExecutor(2) as executor:
        there = solution.posterior(times, data, sigma=0.1, steps=100, chains=3, executor=executor)
    assert np.array_equal(there._distribution.nodes, three._distribution.nodes)


def test_chains_that_differ_are_no_success():
    rng = np.random.default_rng(0)
    chains = [Chain(centre + rng.normal(0, 0.01, (5000, 2)), 5.0, 1000) for centre in (0.3, 0.3)]
    assert Chain.of(chains).success
    assert Chain.of(chains).reduction == pytest.approx(1.0, abs=1e-3)
    apart = Chain.of([chains[0], replace(chains[1], nodes=chains[1].nodes + 0.02)])
    assert not apart.success
    assert apart.reduction == pytest.approx(np.sqrt(3.0), rel=0.05)  # means 2 deviations apart
    assert "too different" in apart.message


def test_cells_are_evaluated_by_any_executor(monkeypatch):
    monkeypatch.setattr("rankone.inference.estimation.posterior.TUNING", SMALL_BLOCKS)
    data = noisy(fall()["u"](FALL_TIMES, FALL), 0.1, 1)
    here = fall().posterior(FALL_TIMES, data, sigma=0.1)
    with Counting(2) as executor:
        there = fall().posterior(FALL_TIMES, data, sigma=0.1, executor=executor)
    assert executor.count > 10
    assert np.array_equal(here._distribution.densities, there._distribution.densities)
    assert here.mean == there.mean
    assert here.log_evidence == there.log_evidence


@pytest.mark.slow
def test_processes_give_the_same_bits(monkeypatch):
    monkeypatch.setattr("rankone.inference.estimation.posterior.TUNING", SMALL_BLOCKS)
    data = noisy(fall()["u"](FALL_TIMES, FALL), 0.1, 1)
    priors = {"C_D": scipy.stats.norm(0.3, 0.1)}
    options = {"sigma": 0.1, "prior": priors}
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as process:
        either = (None, process)
        here, there = (fall().posterior(FALL_TIMES, data, **options, executor=e) for e in either)
        assert np.array_equal(here._distribution.densities, there._distribution.densities)
        pytest.importorskip("emcee")
        solution, times, data = four_parameters()
        options = {"steps": 100, "chains": 2}
        here, there = (solution.posterior(times, data, **options, executor=e) for e in either)
        assert np.array_equal(here._distribution.nodes, there._distribution.nodes)


@pytest.mark.slow
def test_dask_gives_the_same_bits(monkeypatch):
    distributed = pytest.importorskip("distributed")
    monkeypatch.setattr("rankone.inference.estimation.posterior.TUNING", SMALL_BLOCKS)
    data = noisy(fall()["u"](FALL_TIMES, FALL), 0.1, 1)
    here = fall().posterior(FALL_TIMES, data, sigma=0.1)
    options = {"n_workers": 2, "threads_per_worker": 1, "dashboard_address": None}
    with distributed.LocalCluster(**options) as cluster, distributed.Client(cluster) as client:
        there = fall().posterior(FALL_TIMES, data, sigma=0.1, executor=client)
    assert np.array_equal(here._distribution.densities, there._distribution.densities)


def test_what_is_no_executor_or_number_of_chains():
    for wrong in ({"executor": 0}, {"executor": "x"}, {"chains": 0}, {"chains": 1.5}):
        with pytest.raises(OptionError, match=next(iter(wrong)) + "="):
            line().posterior(T, DATA, sigma=0.3, **wrong)
