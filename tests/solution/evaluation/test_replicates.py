"""Densities, quantiles, probabilities and their half-widths against closed forms."""

import copy
import functools
import pickle
import warnings

import numpy as np
import pytest
from scipy.special import ndtri

import rankone as ro
from rankone.solution.statistics import composite_statistics
from rankone.solution.statistics import lines as line_averages
from rankone.solution.statistics.densities import density_of
from rankone.tensors.joint_distribution import (
    SETS,
    even_shares,
    half_width,
    sets_of_shares,
    share_of,
)


def l1_error(density, exact):
    apart = np.abs(density.density - exact(density.values))
    return float(apart.mean() * np.ptp(density.values))


@pytest.fixture(scope="module")
def decay():
    box = {"k": (0.5, 1.0), "u0": (0.9, 1.1)}
    return ro.solve(ro.Problem.from_strings({"u": "-k*u"}, {"u": "u0"}, box, (0, 2)), 1e-5)


def test_the_density_of_a_decay(decay):
    """u0 exp(-2 k): the integral of 5/s² over the s = exp(-2 k) that fit, between 1/e² and 1/e."""

    def exact(u):
        low = np.maximum(u / 1.1, np.exp(-2))
        high = np.minimum(u / 0.9, np.exp(-1))
        return 5.0 * np.maximum(1 / low - 1 / np.maximum(high, low), 0.0)

    density = decay.density(2.0)
    np.testing.assert_allclose(
        density.density, exact(density.values), atol=0.03 * density.density.max()
    )
    assert l1_error(density, exact) < 0.01
    within = np.abs(density.density - exact(density.values)) <= density.half_width
    assert within.mean() > 0.93
    some = decay.density(2.0, values=[[0.2, 0.3]])
    assert some.half_width.shape == (1, 2)
    np.testing.assert_allclose(some.density, exact(some.values), rtol=0.02)


@pytest.mark.parametrize("d", [1, 2, 5, 10])
def test_the_density_of_a_normal_sum(d):
    sets = [ndtri(np.clip(each, 1e-7, 1 - 1e-7)) for each in sets_of_shares(2**17, d, 1)]
    x, density, error, bandwidth = density_of([z.sum(axis=0) / np.sqrt(d) for z in sets], None)
    exact = np.exp(-0.5 * x**2) / np.sqrt(2 * np.pi)
    np.testing.assert_allclose(density, exact, atol=0.02 * exact.max())
    assert np.mean(np.abs(density - exact)) * np.ptp(x) < 0.02
    assert np.mean(np.abs(density - exact) <= error) > 0.9
    assert bandwidth < 0.25


@pytest.mark.parametrize("power", [1, 2])
def test_poles_and_jumps_at_the_ends_are_resolved(power):
    """Of cos² the density has poles at both ends, that of a uniform number jumps there."""
    phase = [0.5 * np.pi * each[0] for each in sets_of_shares(2**16, 1, 1)]
    sample = [np.cos(each) ** 2 if power == 2 else each for each in phase]
    x, density, _, bandwidth = density_of(sample, None)
    if power == 1:
        np.testing.assert_allclose(density, 2 / np.pi, rtol=0.02)
        return
    inside = (x > bandwidth) & (x < 1 - bandwidth)
    exact = 1 / (np.pi * np.sqrt(x[inside] * (1 - x[inside])))
    assert np.mean(np.abs(density[inside] - exact)) < 0.03


@pytest.mark.filterwarnings("ignore:parameter")
@pytest.mark.parametrize(
    ("names", "weights"), [("p2 p1", (1, -0.6396)), ("p3 p2", (1, -0.6396)), ("p5 p3", (1, 0.1))]
)
def test_no_oblique_ridge_resonates(names, weights):
    """The quantile q of u + w v is at sqrt(2 q |w|), or beyond |w|/2 at q + |w|/2, from below."""
    box = {f"p{i}": (0, 1) for i in range(1, 6)}
    one, other = names.split()
    ridge = {"x": f"{weights[0]}*{one} + ({weights[1]})*{other}"}
    solution = ro.solve(ro.Problem.from_strings({"x": "0"}, ridge, box, (0, 1)), 1e-6)
    size, q = abs(weights[1]), np.array([0.25, 0.5])
    low = min(weights[1], 0.0)
    exact = np.where(q < 0.5 * size, np.sqrt(2 * q * size), q + 0.5 * size) + low
    found = solution.quantile(q, 1.0)
    inverse = found[:, 0] - low
    reached = np.where(inverse < size, 0.5 * inverse**2 / size, inverse - 0.5 * size)
    assert (found.half_width[:, 0] <= 1e-2).all()
    assert (np.abs(reached - q) <= found.half_width[:, 0]).all()
    np.testing.assert_allclose(reached, q, atol=2e-3)
    for share, value in zip(q, exact, strict=True):
        below = solution.probability(1.0, below=value)
        assert abs(below.value - share) <= below.half_width
        assert below.half_width <= 5e-3
    assert solution.density(1.0).bandwidth < 0.1


@pytest.mark.slow
def test_half_widths_hold():
    """Of 400 probabilities of sums of 1 to 10 uniform numbers: 95 %, and 93 % by bad luck."""
    held = []
    for seed in range(100):
        generator = np.random.default_rng(seed)
        d = 1 + seed % 10
        weights = generator.normal(size=d)
        sums = np.array([weights @ each for each in sets_of_shares(2**12, d, seed)])
        many = np.sort(weights @ even_shares(2**16, d, (7, seed)))
        for q in (0.05, 0.3, 0.5, 0.9):
            hits = (sums <= many[int(q * many.size)]).sum(axis=1)
            share, error, width = share_of(hits, np.full(SETS, sums.shape[1]))
            assert error < width
            held.append(abs(share - q) <= width + 2e-4)
    assert np.mean(held) >= 0.93


def test_quantiles_are_an_array_with_half_widths(decay):
    found = decay.quantile([0.1, 0.9], [0.5, 1.0, 2.0])
    assert found.shape == found.half_width.shape == (2, 1, 3)
    assert type(found[0]) is type(found - 1.0) is np.ndarray
    again = pickle.loads(pickle.dumps(found))
    assert np.array_equal(again, found)
    assert np.array_equal(again.half_width, found.half_width)
    low, high = found
    assert (low < high).all()


def test_a_limit_at_values_that_the_error_may_move_is_in_the_half_width():
    """Half of the box is at 1 but for the error of the solution, and half is above."""
    problem = ro.Problem.from_strings({"x": "0"}, {"x": "Max(1, a)"}, {"a": (0, 2)}, (0, 1))
    solution = ro.solve(problem, 1e-4)
    found = solution.probability(1.0, above=1.0)
    assert abs(found.value - 0.5) <= found.half_width
    assert found.half_width > 0.2
    assert solution.probability(1.0, above=1.1).half_width < 1e-2


def test_sets_of_another_dimension_or_count():
    assert even_shares(5, 0, 1).shape == (0, 5)
    assert even_shares(4, 21202, 1).shape == (21202, 4)
    assert sets_of_shares(1, 2, 1).shape == (SETS, 2, 1)
    assert half_width(np.ones((SETS, 3))).tolist() == [0.0, 0.0, 0.0]


@pytest.fixture(scope="module")
def dosed():
    dose = {"when": "t - a", "direction": "rising", "then": {"x": "x + b"}, "name": "dose"}
    problem = ro.Problem.from_strings(
        {"x": "-x/2"}, {"x": 1}, {"a": (1, 2), "b": (0.5, 1.5)}, (0, 4), events=[dose]
    )
    return ro.solve(problem, 1e-4)


def test_half_widths_of_indices_across_events(dosed):
    """x = exp(-t/2) + b exp(-(t - a)/2) where t > a: by a fine grid."""
    times = np.array([1.3, 1.7, 4.0])
    steps = []
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        sobol = dosed.sobol(times, progress=lambda done, total: steps.append((done, total)))
    assert steps == [(k, SETS) for k in range(1, SETS + 1)]
    middles = (np.arange(1500) + 0.5) / 1500
    a, b = np.meshgrid(1 + middles, 0.5 + middles, indexing="ij")
    for k, t in enumerate(times):
        x = np.where(t > a, b * np.exp(-(t - a) / 2), 0.0)
        first = np.array([x.mean(axis=1).var(), x.mean(axis=0).var()]) / x.var()
        apart = np.abs(sobol.first[0, :, k] - first)
        assert (apart <= 1.5 * sobol.first_half_width[0, :, k]).all()
        apart = np.abs(sobol.total[0, :, k] - (1 - first[::-1]))
        assert (apart <= 1.5 * sobol.total_half_width[0, :, k]).all()
        second = sobol.second[0, 0, 1, k] - (1 - first.sum())
        assert abs(second) <= 1.5 * sobol.second_half_width[0, 0, 1, k]
    assert sobol.first_half_width.max() < 2e-2
    fewer = dosed.sobol(times, count=256)
    assert (fewer.first_half_width > sobol.first_half_width).all()


@pytest.mark.slow
def test_outputs_and_main_effects_tell_their_progress(dosed):
    events, steps = [], []
    dosed.output({"m": "maximum(x)"}, progress=events.append)
    assert events[0].fraction == 0.0
    assert all(0.0 <= event.fraction <= 1.0 for event in events)
    dosed.main_effects(2.5, count=2, progress=lambda *step: steps.append(step))
    assert steps == [(1, 2), (2, 2)]
    for statistic in (dosed.mean, dosed.std, dosed.var, dosed.cov):
        steps.clear()
        statistic([1.0, 2.5], progress=lambda *step: steps.append(step))
        assert [done for done, _ in steps] == sorted(done for done, _ in steps)
        assert steps[-1][0] == steps[-1][1] > 1


def test_half_widths_of_main_effects_hold_the_exact_means(dosed):
    """Against lines on each face, which are divided where the solution jumps."""
    effects = dosed.main_effects([1.0, 2.5], count=3)
    for name, values in effects.values.items():
        for k, value in enumerate(values):
            exact = dosed.fix({name: value}).mean([1.0, 2.5])
            apart = np.abs(effects.means[name][:, k] - exact)
            assert (apart <= 1.5 * effects.half_widths[name][:, k] + 1e-4).all()
            assert effects.half_widths[name][:, k].max() < 2e-2


def test_many_times_take_fewer_lines_and_warn_once(dosed, monkeypatch):
    """The points of all times together are bounded, and one warning says what they are good for."""
    taken, kind = [], type(dosed._evaluator)
    curves = kind.curves

    def counted(self, times, points, rows):
        taken.append(times.size * points.shape[1])
        return curves(self, times, points, rows)

    monkeypatch.setattr(kind, "curves", counted)
    monkeypatch.setattr(composite_statistics, "_EVALUATIONS", 2**18)
    monkeypatch.setattr(line_averages, "_MOST_POINTS", 2**14)
    times = np.linspace(0.5, 2.9, 40)
    effects = functools.partial(dosed.main_effects, count=11)
    for statistic, most in ((dosed.mean, 4 * 2**14), (effects, 2**18)):
        taken.clear()
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            statistic(times)
        assert len(caught) <= 1
        assert 0 < sum(taken) < most


def test_only_quantiles_themselves_have_half_widths(decay):
    quantiles = decay.quantile([0.25, 0.5], [1.0, 2.0])
    for same in (copy.copy(quantiles), copy.deepcopy(quantiles)):
        np.testing.assert_array_equal(same, quantiles)
        np.testing.assert_array_equal(same.half_width, quantiles.half_width)
    for other in (quantiles.T, quantiles.copy(), quantiles.ravel(), quantiles.astype(int)):
        assert other.half_width is None
    assert type(quantiles[0]) is type(quantiles + 1.0) is np.ndarray
