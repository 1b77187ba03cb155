"""Fits whose likelihood jumps, because an event passes a time of the data."""

import functools

import numpy as np
import pytest

import rankone as ro

TIMES = np.linspace(0.5, 8.0, 16)
NOISE = 0.3


@functools.cache
def late_dose():
    """A dose of ten units after an unknown lag."""
    events = [{"when": "t - lag", "direction": "rising", "then": {"A": "A + 10"}, "name": "dose"}]
    problem = ro.Problem.from_strings(
        {"A": "-k*A"}, {"A": "0"}, {"k": (0.2, 0.5), "lag": (0.6, 2.9)}, (0, 8), events=events
    )
    return ro.solve(problem, 1e-6)


@functools.cache
def fitted(seed):
    noise = NOISE * np.random.default_rng(seed).standard_normal(16)
    data = late_dose()["A"](TIMES, k=0.3, lag=1.5 + 0.02 * (seed - 2)) + noise
    return late_dose().fit(TIMES, data, sigma=NOISE), data


def closed(k, lag):
    return np.where(lag <= TIMES, 10.0 * np.exp(-k * (TIMES - lag)), 0.0)


@pytest.mark.parametrize("seed", range(5))
def test_the_best_of_all_pieces_is_found(seed):
    """No point of a fine grid over both sides of all jumps fits better."""
    fit, data = fitted(seed)
    k, lag = np.meshgrid(np.linspace(0.2, 0.5, 61), np.linspace(0.6, 2.9, 231))
    curves = np.array([closed(*point) for point in zip(k.ravel(), lag.ravel(), strict=True)])
    least = np.sum(((curves - data) / NOISE) ** 2, axis=1).min()
    assert fit.chi2 <= least + 1e-3


@pytest.mark.slow
def test_an_end_at_a_jump_and_a_jump_in_an_interval_are_said():
    fits = [fitted(seed)[0] for seed in range(5)]
    stuck = [fit for fit in fits if fit.stuck]
    assert stuck
    for fit in stuck:
        assert not fit.success
        assert "the search ended where the sum of squares jumps" in fit.message
        assert "an event passes the time 1.5 of the data there" in fit.message
    near = [fit for fit in fits if fit.success and fit.jumps]
    assert near
    assert all("inside the intervals of" in " ".join(fit.checks) for fit in near)


def test_solutions_without_events_have_no_jumps():
    problem = ro.Problem.from_strings({"A": "-k*A"}, {"A": "10"}, {"k": (0.2, 0.5)}, (0, 8))
    fit = ro.solve(problem, 1e-6).fit(TIMES, 10.0 * np.exp(-0.3 * TIMES) + 0.1, sigma=0.3)
    assert (fit.stuck, fit.jumps) == (False, ())


@functools.cache
def switched():
    """A rate that ends at an unknown time; the state has a kink there, and no jump."""
    rates, box = {"x": "Piecewise((r, t < a), (0, True)) - k*x"}, {"k": (0.2, 1), "r": (0.5, 3)}
    problem = ro.Problem.from_strings(rates, {"x": "0"}, {"a": (1, 6), **box}, (0, 8))
    return ro.solve(problem, 1e-4)


@functools.cache
def clipped():
    """A rate that ends where the state falls to an unknown level."""
    rates = {"x": "-k*Max(0, x - c) - 0.05*x"}
    box = {"k": (0.2, 3), "c": (0.5, 2)}
    return ro.solve(ro.Problem.from_strings(rates, {"x": "3"}, box, (0, 8)), 1e-4)


@pytest.mark.parametrize(
    ("model", "seed", "noise", "every"),
    [
        pytest.param(switched, 9, 0.3, 1, marks=pytest.mark.slow),
        pytest.param(switched, 22, 0.3, 4, marks=pytest.mark.slow),
        (clipped, 7, 0.3, 1),
        pytest.param(clipped, 5, 0.03, 4, marks=pytest.mark.slow),
    ],
)
def test_models_that_switch_have_no_jumps(model, seed, noise, every):
    """Steep curves and kinks are none, though the solution has stretches between switches."""
    solution, generator = model(), np.random.default_rng(seed)
    at = {
        name: low + generator.uniform() * (high - low)
        for name, (low, high) in solution.parameters.items()
    }
    times = TIMES if every == 1 else TIMES[1::every]
    data = solution["x"](times, at) + noise * generator.standard_normal(times.size)
    fit = solution.fit(times, data, sigma=noise)
    assert (fit.stuck, fit.jumps) == (False, ())
    assert fit.kinked is (model is switched)
    assert ("at a kink of the sum of squares" in fit.message) is fit.kinked
    assert "event" not in " ".join([fit.message, *fit.checks])
