"""Populations whose distribution is known: a drug taken by mouth, two doses, thirty people."""

from __future__ import annotations

import functools

import numpy as np

import rankone as ro

MEANS = {"ka": 1.5, "CL": 2.8, "V": 32.0}
SPREADS = {"ka": 0.5, "CL": 0.3, "V": 0.2}
NOISE = {"sigma_C": 0.3, "relative_C": 0.1}
TRUE = {**MEANS, **{f"omega_{name}": spread for name, spread in SPREADS.items()}, **NOISE}
HOURS = np.array([0.25, 0.5, 1.0, 2.0, 4.0, 6.0, 9.0, 12.0, 18.0, 24.0])
BOX = {"ka": (0.15, 12), "CL": (0.6, 12), "V": (12, 80), "dose": (100, 500)}


@functools.cache
def oral():
    """A' = -ka A, C' = ka A / V - CL C / V, with the dose as a parameter."""
    problem = ro.Problem.from_strings(
        {"A": "-ka*A", "C": "ka*A/V - CL/V*C"}, {"A": "dose", "C": "0"}, BOX, (0, 24)
    )
    return ro.solve(problem, 1e-6)


def concentration(t, dose, ka, CL, V):
    """The same in closed form."""
    ke = CL / V
    return dose * ka / (V * (ka - ke)) * (np.exp(-ke * t) - np.exp(-ka * t))


def drawn(seed, count=30):
    """Parameters of subjects, (count,) each, and the generator that goes on."""
    generator = np.random.default_rng(seed)
    own = {
        name: MEANS[name] * np.exp(SPREADS[name] * generator.standard_normal(count))
        for name in MEANS
    }
    return own, generator


def table_of(seed, count=30):
    """Ten noisy concentrations of each subject; every second one takes the higher dose."""
    own, generator = drawn(seed, count)
    dose = np.where(np.arange(count) % 2, 320.0, 200.0)
    columns = {name: row[:, None] for name, row in own.items()}
    exact = concentration(HOURS, dose[:, None], **columns)
    sigma = np.hypot(NOISE["sigma_C"], NOISE["relative_C"] * exact)
    measured = exact + sigma * generator.standard_normal(exact.shape)
    return {
        "subject": np.repeat(np.arange(1, count + 1), HOURS.size),
        "t": np.tile(HOURS, count),
        "dose": np.repeat(dose, HOURS.size),
        "C": measured.ravel(),
    }


def population(seed, count=30, **options):
    """The fit of one data set."""
    options = {"random": ["ka", "CL", "V"], "noise": "combined", **options}
    return oral().fit_population(table_of(seed, count), **options)


@functools.cache
def level():
    """A state that is constant: u' = 0, u(0) = a."""
    problem = ro.Problem.from_strings({"u": "0*u"}, {"u": "a"}, {"a": (-20, 40)}, (0, 4))
    return ro.solve(problem, 1e-8)


def one_way(seed, subjects=12, times=4):
    """Levels of subjects around 10 with deviation 2, and noise of deviation 1."""
    generator = np.random.default_rng(seed)
    own = 10.0 + 2.0 * generator.standard_normal(subjects)
    return own[:, None] + generator.standard_normal((subjects, times))


def as_table(data):
    subjects, times = data.shape
    return {
        "subject": np.repeat(np.arange(subjects), times),
        "t": np.tile(np.linspace(0, 4, times), subjects),
        "u": data.ravel(),
    }


@functools.cache
def levels():
    """The fit of levels, which takes a few milliseconds."""
    table = as_table(one_way(1))
    return level().fit_population(table, random={"a": "normal"}, noise="constant")
