"""Solutions that are fitted, and how often intervals have the true values in them."""

from __future__ import annotations

import bisect
import functools

import numpy as np
import scipy.stats

import rankone as ro
from examples import doses

FALL = {"C_D": 0.5, "m": 1.0}
FALL_TIMES = np.linspace(0.15, 3.0, 20)
PERSON = {"V": 30.0, "Vmax": 10.0, "Km": 2.5, "k12": 0.25}
DOSE_TIMES = np.linspace(1.0, 71.5, 24)
NOISE, DOSE_NOISE = 0.1, 0.05


@functools.cache
def decay():
    """u' = -k u, u(0) = a."""
    problem = ro.Problem.from_strings(
        {"u": "-k*u"}, {"u": "a"}, {"k": (0.2, 4), "a": (0.5, 3)}, (0, 2)
    )
    return ro.solve(problem, 1e-9)


@functools.cache
def line():
    """u = a + b t: linear in its parameters."""
    problem = ro.Problem.from_strings({"u": "b"}, {"u": "a"}, {"a": (-5, 5), "b": (-5, 5)}, (0, 1))
    return ro.solve(problem, 1e-10)


@functools.cache
def fall():
    """A body that falls through air; only C_D/m matters."""
    rate = "1.2*0.1*C_D*u**2/(2*m) - 9.81"
    box = {"C_D": (0.1, 1.5), "m": (0.5, 2)}
    return ro.solve(ro.Problem.from_strings({"u": rate}, {"u": "0"}, box, (0, 3)), 1e-6)


@functools.cache
def drug():
    """The six doses of the example, on a wider box."""
    box = {"V": (20, 45), "Vmax": (5, 20), "Km": (1, 6), "k12": (0.15, 0.4)}
    return ro.compile(doses.problem).solve(rtol=1e-5, parameters=box)


def noisy(exact, sigma, seed):
    return exact + np.random.default_rng(seed).normal(0.0, sigma, exact.shape)


def fall_fit(seed):
    data = noisy(fall()["u"](FALL_TIMES, FALL), NOISE, seed)
    return fall().fit(FALL_TIMES, data, sigma=NOISE)


def drug_fit(seed):
    data = noisy(drug()["c"](DOSE_TIMES, PERSON), DOSE_NOISE, seed)
    return drug().fit(DOSE_TIMES, data, observe="c", sigma=DOSE_NOISE)


def covered(interval, value):
    low, high = interval
    return low <= value <= high


STEPS = 0.2 * np.arange(1, 17)  # Half widths of intervals in normal deviations


def reaching_squares(fits, truth):
    """For each parameter a sum of squares over the fits, and bounds of what it may be.

    An interval of some level just reaches the truth. In normal deviations that level has unit
    variance if intervals hold as often as they say.
    """
    rows = []
    for fit in fits:
        intervals = functools.cache(fit.interval)
        rows.append({name: _reaching(name, intervals, truth[name]) for name in fit.x})
    squares = {name: sum(row[name] ** 2 for row in rows if name in row) for name in rows[-1]}
    return squares, *scipy.stats.chi2.ppf([5e-4, 1.0 - 5e-4], len(rows))


def _reaching(name, intervals, value):
    """The half width of the interval of a parameter that just reaches a value."""

    def holds(step):
        return covered(intervals(2.0 * scipy.stats.norm.cdf(step) - 1.0)[name], value)

    return 0.2 * bisect.bisect_left(STEPS, True, key=holds) + 0.1
