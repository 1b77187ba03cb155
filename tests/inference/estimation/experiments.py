"""A drug taken by mouth, and designs in which it is measured with noise of several kinds."""

from __future__ import annotations

import functools

import numpy as np

import rankone as ro

TRUE = {
    "ka": 1.2,
    "ke": 0.3,
    "V": 10.0,
    "scale": 2.5,
    "offset": 0.4,
    "sigma_C": 0.15,
    "sigma_A": 2.0,
    "relative_C": 0.1,
    "sigma_signal": 0.3,
}
HOURS = np.array([0.25, 0.5, 0.75, 1, 1.5, 2, 3, 4, 5, 6, 8, 10, 12, 14, 16, 20])
DOSES = (50.0, 100.0, 200.0)


@functools.cache
def oral():
    """A' = -ka A, C' = ka A / V - ke C, with the dose as a parameter."""
    problem = ro.Problem.from_strings(
        {"A": "-ka*A", "C": "ka*A/V - ke*C"},
        {"A": "dose", "C": "0"},
        {"ka": (0.5, 4), "ke": (0.1, 0.5), "V": (4, 25), "dose": (20, 250)},
        (0, 24),
    )
    return ro.solve(problem, 1e-6)


def bateman(t, dose=100.0):
    """The concentration in closed form."""
    ka, ke, volume = (TRUE[name] for name in ("ka", "ke", "V"))
    return dose * ka / (volume * (ka - ke)) * (np.exp(-ke * t) - np.exp(-ka * t))


def draws(seed, shape=HOURS.shape):
    return np.random.default_rng(seed).standard_normal(shape)


def constant(seed):
    data = bateman(HOURS) + TRUE["sigma_C"] * draws(seed)
    return oral().fit(HOURS, data, observe="C", noise="constant", fixed={"dose": 100})


def proportional(seed):
    data = bateman(HOURS) * (1.0 + TRUE["relative_C"] * draws(seed))
    return oral().fit(HOURS, data, observe="C", noise="proportional", fixed={"dose": 100})


def log_normal(seed):
    data = bateman(HOURS) * np.exp(TRUE["sigma_C"] * draws(seed))
    return oral().fit(HOURS, data, observe="C", noise="log-normal", fixed={"dose": 100})


def scaled(seed):
    """A signal with scale and offset of its own; the volume is known."""
    data = TRUE["scale"] * bateman(HOURS) + TRUE["offset"] + TRUE["sigma_signal"] * draws(seed)
    return oral().fit(
        HOURS,
        data,
        observe={"signal": "scale*C + offset"},
        noise="constant",
        fixed={"dose": 100, "V": TRUE["V"]},
    )


def conditions(seed):
    """Three doses, with few samples of each."""
    times = HOURS[::2]
    noise = draws(seed, (len(DOSES), times.size))
    pairs = [
        (
            oral(),
            ro.Experiment(
                bateman(times, dose) * (1.0 + TRUE["relative_C"] * row),
                times,
                fixed={"dose": dose},
                observe="C",
                noise="proportional",
                name=f"{dose:g} mg",
            ),
        )
        for dose, row in zip(DOSES, noise, strict=True)
    ]
    return ro.fit(pairs)


def combined(seed):
    """A constant and a relative part, and concentrations over a decade."""
    level = bateman(HOURS)
    deviations = np.hypot(TRUE["sigma_C"], TRUE["relative_C"] * level)
    data = level + deviations * draws(seed)
    return oral().fit(HOURS, data, observe="C", noise="combined", fixed={"dose": 100})


def student(seed):
    """Heavy tails, whose standard deviation is that of the constant noise."""
    tails = np.random.default_rng(seed).standard_t(4, HOURS.shape) / np.sqrt(2.0)
    data = bateman(HOURS) + TRUE["sigma_C"] * tails
    return oral().fit(HOURS, data, observe="C", noise="student", fixed={"dose": 100})


def two_observables(seed):
    """The blood and, half as often, the gut, each with noise of its own."""
    times, noise = HOURS[::2], draws(seed, (2, HOURS.size))
    gut = 100.0 * np.exp(-TRUE["ka"] * times) + TRUE["sigma_A"] * noise[1, : times.size]
    blood = bateman(HOURS) + TRUE["sigma_C"] * noise[0]
    clock = {"C": HOURS, "A": times}
    return oral().fit(clock, {"C": blood, "A": gut}, fixed={"dose": 100})


DESIGNS = {
    "constant noise": constant,
    "proportional noise": proportional,
    "log-normal noise": log_normal,
    "scale and offset": scaled,
    "three conditions": conditions,
    "combined noise": combined,
    "Student's noise": student,
    "two observables": two_observables,
}
