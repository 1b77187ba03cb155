"""Jumps, kinks and narrow features of known functions are found before anything is solved."""

import numpy as np
import pytest

from rankone.solvers.verification.cuts import located_cuts


def step(x):
    return np.heaviside(x, 0.5)


def found(function, lower, upper):
    return list(
        located_cuts(lambda x: np.stack([np.ones_like(x), function(x)]), lower, upper).points
    )


@pytest.mark.parametrize(
    "function",
    [np.ones_like, np.sin, lambda x: np.sin(40 * x), lambda x: x**3, lambda x: 1 / (2 + x)],
    ids=["one", "sin", "fast sin", "cubic", "rational"],
)
def test_functions_smooth_on_the_interval_have_none(function):
    assert found(function, 0.0, 10.0) == []


@pytest.mark.parametrize(
    ("function", "interval", "expected"),
    [
        (lambda t: 10 * step(t - 5) * step(5.1 - t), (0, 24), [5, 5.1]),
        (lambda t: step(t - 5) * step(5.02 - t), (0, 72), [5, 5.02]),
        (lambda t: step(t - 0.5), (0, 1), [0.5]),
        (lambda k: np.abs(k - 0.3017), (-1, 1), [0.3017]),
        (lambda t: np.mod(t, 0.3), (0, 1), [0.3, 0.6, 0.9]),
    ],
    ids=["pulse", "short pulse", "jump at the middle", "kink", "sawtooth"],
)
def test_jumps_and_kinks_are_located(function, interval, expected):
    np.testing.assert_allclose(found(function, *interval), expected, atol=1e-7)


def test_a_narrow_smooth_peak_is_enclosed():
    cuts = np.array(found(lambda t: np.exp(-(((t - 50.3) / 0.01) ** 2)), 0.0, 100.0))
    before, after = cuts[cuts < 50.3], cuts[cuts > 50.3]
    assert 50.3 - before.max() < 0.1
    assert after.min() - 50.3 < 0.1
