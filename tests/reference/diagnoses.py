"""Each diagnosis that fits, populations and calibrations print: ten cases that have its cause, and
ten near misses that do not.

A case is a function of a seed, 0 to 9, that returns all that was said: the message, the notes, or
the text of the error. Data are closed forms with noise of fixed seeds, shaped where chance alone
could turn a case around. PATTERNS is what tells a diagnosis in the text: where wording changes,
this table alone changes with it.
"""

from __future__ import annotations

import functools
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import rankone as ro
from tests.inference.calibration import conversion
from tests.inference.estimation import experiments, systems
from tests.inference.populations import simulated

PATTERNS = {
    # fits: findings
    "jump at the end": r"the search ended where the sum of squares jumps",
    "combination": r"do not identify .* alone, only",
    "not identified": r"the data do not identify (?!.* alone, only)",
    "noise to zero": r"the level of noise .* tends to zero",
    "at an end": r"is at the (lower|upper) end of its bounds",
    "other values": r"other values fit as well",
    "misfit": r"times as large as sigma",
    "solution": r"the solution itself is not a success",
    "error of the solution": r"the error of the solution, .* is not small beside the noise",
    # fits: notes
    "event inside": r"an event passes the time",
    "outlier": r"standard deviations off",
    "runs": r"keep their sign for long",
    "growing": r"residuals of .* grow with its values",
    "shrinking": r"residuals of .* shrink with its values",
    "experiments apart": r"is too high for .* and too low for",
    "idle level": r"is zero: the data show no such part of the noise",
    # fits: errors
    "no noise": r"noise that is relative to it vanishes",
    "not finite": r"the likelihood is not finite, wherever it was tried",
    "too few values": r"there are \d+ values? for \d+ parameters?",
    # minimize
    "infeasible": r"no parameters were found that fulfil the constraints",
    "minimize: solution": r"is not a success",
    # populations
    "subject at an end": r"is at the (lower|upper) end of the box",
    "population not identified": r"the data do not identify",
    "idle effect": r"is zero: the data show no such variation between subjects",
    "idle noise": r"is zero: the data show no such noise",
    "narrow box": r"the box does not hold 3 standard deviations",
    "shrinkage": r"the shrinkage of .* is \d+ %",
    "far data": r"are far from all curves in the box",
    "effects not apart": r"do not tell the random effects of .* apart|the data do not identify",
    "population: solution": r"the solution itself is not a success",
    "population: error": r"the error of the solution, .* is not small beside the noise",
    "one subject": r"has 1 subject: variances need several",
    "population: too few": r"there are \d+ values? for \d+ parameters of the population",
    "covariate constant": r"covariates: .* is .* for all \d+ subjects",
    "covariate changes": r"covariates: .* changes within the subject",
    "outside the box": r"of simulated subjects (were|are) outside of the box",
    # calibrations
    "no trajectory": r"no trajectory reaches all of the data",
    "one start": r"only one start found this optimum",
    "calibration not identified": r"the data do not identify",
    "calibration at an end": r"is at the (lower|upper) end of its bounds",
    "no parameter": r"no box around the optimum: the data identify no parameter",
    "many parameters": r"it would have \d+ parameters, and 6 are the most",
    "jump in time": r"rates jump where .* says",
    "jump with states": r"rates jump with the states",
    "events": r"events? .*(have no sensitivities|depends? on (its|the) states)",
    "noise not positive": r"noise has to be positive",
    "no logarithm": r"has no logarithm",
}

Case = Callable[[int], str]
CASES: dict[str, dict[bool, Case]] = {}


@dataclass(frozen=True)
class Diagnosis:
    """A diagnosis, and functions of a seed that return what is said with and without its cause."""

    key: str
    pattern: str
    present: Case
    absent: Case


def diagnoses() -> list[Diagnosis]:
    """All diagnoses in the order of PATTERNS."""
    return [Diagnosis(key, PATTERNS[key], CASES[key][True], CASES[key][False]) for key in PATTERNS]


def both(*keys):
    """Mark a function of a seed and of whether the cause is there as the cases of diagnoses."""

    def mark(function):
        def of(cause):
            return lambda seed: said(lambda: function(seed, cause))

        for key in keys:
            CASES[key] = {cause: of(cause) for cause in (True, False)}
        return function

    return mark


def said(run) -> str:
    """All that is said of what a function returns, or the text of its error."""
    try:
        result = run()
    except ro.RankoneError as error:
        return str(error)
    if isinstance(result, str):
        return result
    texts = [result.message, *getattr(result, "checks", ()), getattr(result, "remark", "")]
    return "\n".join(texts)


def draws(seed, size, salt=0):
    return np.random.default_rng([5151, salt, seed]).standard_normal(size)


def tame(seed, size, most=2.0, salt=0):
    """Normal numbers of mean square one, none beyond ``most``."""
    z = np.clip(draws(seed, size, salt), -most, most)
    return np.clip(z / np.sqrt(np.mean(z**2)), -most, most)


def signs(seed, size):
    return np.sign(draws(seed, size))


# --- models --------------------------------------------------------------------------------------

CLOCK = np.linspace(0.1, 2.0, 20)
SIGMA = 0.02


def strings(rates, initial, box, end, rtol=1e-6, **options):
    return ro.solve(ro.Problem.from_strings(rates, initial, box, (0, end)), rtol, **options)


def decay_data(k, a, noise, t=CLOCK):
    return a * np.exp(-k * t) + SIGMA * noise


@functools.cache
def pair():
    """Two decays, of which the second tells one factor of the first rate."""
    return strings(
        {"x": "-p*q*x", "y": "-p*y"}, {"x": "1", "y": "1"}, {"p": (0.4, 2), "q": (0.4, 2)}, 2
    )


@functools.cache
def kinked(which):
    """Models without events whose rates have kinks, switches in time, or none."""
    rates, box = (
        ("-k*Max(0, x - 1) - 0.05*x", {"k": (0.2, 3), "a": (2, 6)}),
        ("Piecewise((r, t < 4), (0, True)) - k*x", {"k": (0.2, 1), "r": (0.5, 3), "a": (0, 2)}),
        ("Min(1, x)*(k - 0.4*x)", {"k": (0.5, 3), "a": (0.1, 0.8)}),
        ("k*x*(1 - x/5)", {"k": (0.3, 4), "a": (0.02, 0.4)}),
        ("-k*x", {"k": (0.02, 8), "a": (0.5, 3)}),
    )[which]
    return strings({"x": rates}, {"x": "a"}, box, 10, 1e-4)


@functools.cache
def late_dose():
    """A dose of ten units after an unknown lag."""
    events = [{"when": "t - lag", "direction": "rising", "then": {"A": "A + 10"}, "name": "dose"}]
    problem = ro.Problem.from_strings(
        {"A": "-k*A"}, {"A": "0"}, {"k": (0.2, 0.5), "lag": (0.6, 2.9)}, (0, 8), events=events
    )
    return ro.solve(problem, 1e-6)


@functools.cache
def failed():
    """A solution that is no success: its ranks were not allowed."""
    rates = {"x": "cos(a*b*t + a*x)"}
    return strings(rates, {"x": "0"}, {"a": (0.5, 2), "b": (0.5, 2)}, 3, 1e-8, max_rank=3)


@functools.cache
def solved():
    rates = {"x": "cos(a*b*t + a*x)"}
    return strings(rates, {"x": "0"}, {"a": (0.5, 2), "b": (0.5, 2)}, 3, 1e-3)


@functools.cache
def coarse():
    return strings({"u": "-k*u**2"}, {"u": "a"}, {"k": (0.2, 4), "a": (0.5, 3)}, 2, 1e-3)


@functools.cache
def lines():
    """u = a + b t of a subject."""
    return strings({"u": "b"}, {"u": "a"}, {"a": (-20, 40), "b": (-20, 40)}, 4, 1e-8)


@functools.cache
def lagged():
    """A dose by mouth after a lag, as an event."""
    events = [{"when": "t - lag", "direction": "rising", "then": {"A": "A + 100"}, "name": "dose"}]
    problem = ro.Problem.from_strings(
        {"A": "-ka*A", "C": "ka*A/V - CL/V*C"},
        {"A": "0", "C": "0"},
        {"ka": (0.3, 6), "CL": (0.5, 6), "V": (5, 40), "lag": (0.05, 1.2)},
        (0, 24),
        events=events,
    )
    return ro.solve(problem, 1e-5)


# --- fits ----------------------------------------------------------------------------------------

DOSE_TIMES = np.linspace(0.5, 8.0, 16)


@both("jump at the end")
def _(seed, cause):
    """The amounts want a lag beyond a time at which the dose was there; or no event."""
    if not cause:
        return without_events(seed)
    lag, late = DOSE_TIMES[1 + seed % 4], 0.2 + 0.02 * seed
    data = np.where(lag <= DOSE_TIMES, 10.0 * np.exp(-0.3 * (DOSE_TIMES - lag - late)), 0.0)
    return late_dose().fit(DOSE_TIMES, data + 0.06 * tame(seed, 16), sigma=0.3)


@both("event inside")
def _(seed, cause):
    """The lag ends within its uncertainty before a time of the data; or no event."""
    if not cause:
        return without_events(seed)
    lag, early = DOSE_TIMES[1 + seed % 4], 0.04 + 0.003 * seed
    data = np.where(lag <= DOSE_TIMES, 10.0 * np.exp(-0.3 * (DOSE_TIMES - lag + early)), 0.0)
    return late_dose().fit(DOSE_TIMES, data + 0.03 * tame(seed, 16), sigma=0.3)


def without_events(seed):
    """Fits of models without events: few data, large steps, kinks."""
    solution = kinked(seed % 5)
    times = np.linspace(0.5, 8.0, 16) if seed < 5 else np.array([1.0, 2.0, 3.0, 8.0])
    middle = {name: (0.7 * low + 0.3 * high) for name, (low, high) in solution.parameters.items()}
    exact = solution["x"](times, middle)
    sigma = (0.02, 0.1)[seed % 2] * float(np.abs(exact).max())
    return solution.fit(times, exact + sigma * tame(seed, times.size), sigma=sigma)


@both("combination")
def _(seed, cause):
    """The product of two parameters alone acts; the near miss measures one of them as well."""
    p, q = 0.7 + 0.05 * seed, 1.3 - 0.05 * seed
    x = np.exp(-p * q * CLOCK) + SIGMA * tame(seed, 20)
    y = np.exp(-p * CLOCK) + SIGMA * tame(seed, 20, salt=1)
    if cause:
        return pair().fit(CLOCK, x, observe="x", sigma=SIGMA)
    return pair().fit(CLOCK, [x, y], observe=["x", "y"], sigma=SIGMA)


@both("not identified")
def _(seed, cause):
    """Absorption is over at the first sample; the near miss has three early ones."""
    times = np.linspace(10.0, 23.0, 14)
    times = times if cause else np.concatenate([[0.25, 1.0, 2.0], times])
    exact = simulated.concentration(times, 100.0, 3.0, 3.0, 10.0)
    data = exact + 0.02 * tame(seed, times.size)
    return wide_oral().fit(times, data, observe="C", sigma=0.02, fixed={"dose": 100})


@functools.cache
def wide_oral():
    box = {"ka": (1, 8), "CL": (1, 6), "V": (5, 20), "dose": (50, 200)}
    return strings({"A": "-ka*A", "C": "ka*A/V - CL/V*C"}, {"A": "dose", "C": "0"}, box, 24)


@both("noise to zero")
def _(seed, cause):
    """One value of the gut has a level of noise of its own; the near miss has eight."""
    hours = experiments.HOURS
    gut = np.array([1.0]) if cause else hours[:8]
    blood = experiments.bateman(hours) + 0.15 * tame(seed, hours.size)
    amounts = 100.0 * np.exp(-1.2 * gut) + 2.0 * tame(seed, gut.size, salt=1)
    data = {"C": blood, "A": amounts}
    return experiments.oral().fit({"C": hours, "A": gut}, data, fixed={"dose": 100})


@both("at an end")
def _(seed, cause):
    """The rate is beyond its bounds, 4; or inside by more than three deviations."""
    k = 4.6 + 0.1 * seed if cause else 3.0 + 0.04 * seed
    return systems.decay().fit(CLOCK, decay_data(k, 2.0, tame(seed, 20)), sigma=SIGMA)


@both("other values")
def _(seed, cause):
    """A square does not tell the sign of a line; with a cubic part it does."""
    t = np.linspace(0.05, 1, 20)
    line = 1.0 + 0.1 * seed + 2.0 * t
    cubic = 0.0 if cause else 0.05
    data = line**2 + cubic * line**3 + 0.1 * tame(seed, 20)
    options = {"observe": {"s": f"u**2 + {cubic}*u**3"}, "sigma": 0.1}
    return systems.line().fit(t, data, starts=8, **options)


@both("misfit")
def _(seed, cause):
    """The noise is twice as large as said, or 1.2 times."""
    noise = (2.0 if cause else 1.2) * tame(seed, 20, 2.5)
    return systems.decay().fit(CLOCK, decay_data(1.0, 1.5, noise), sigma=SIGMA)


@both("solution")
def _(seed, cause):
    """The solution missed its tolerance; the near miss has a loose one and met it."""
    solution, t = failed() if cause else solved(), np.linspace(0.2, 3, 15)
    exact = solution["x"](t, a=1.0 + 0.05 * seed, b=1.2)
    return solution.fit(t, exact + 0.2 * tame(seed, 15), sigma=0.2)


@both("error of the solution")
def _(seed, cause):
    """The noise is a third of the error of the solution, or a hundred times as large."""
    sigma = coarse().error * (0.3 if cause else 100.0)
    data = 1.5 / (1.0 + 1.5 * (1.0 + 0.1 * seed) * CLOCK) + sigma * tame(seed, 20)
    return coarse().fit(CLOCK, data, sigma=sigma)


@both("outlier")
def _(seed, cause):
    """One of twenty values is eight deviations off, or 2.8."""
    noise = tame(seed, 20)
    noise[3 + seed] = 8.0 if cause else 2.8
    return systems.decay().fit(CLOCK, decay_data(1.0, 1.5, noise), sigma=SIGMA)


@both("runs")
def _(seed, cause):
    """The data have a second exponential; the near miss has the sign of noise change often."""
    t = np.linspace(0.05, 2.0, 40)
    noise = tame(seed, 40)
    extra = 0.8 * np.exp(-6.0 * t) if cause else 0.0
    noise = noise if cause else np.abs(noise) * np.tile([1.0, -1.0, -1.0, 1.0], 10)
    return systems.decay().fit(t, decay_data(0.8, 1.2, noise, t) + extra, noise="constant")


@both("growing")
def _(seed, cause):
    """Noise in shares of the values, or of one size, fitted as constant."""
    t = np.linspace(0.05, 2.0, 40)
    exact = 2.0 * np.exp(-2.0 * t)
    noise = 0.1 * exact * np.abs(1.0 + 0.2 * draws(seed, 40)) if cause else 0.05 * magnitudes(40)
    return systems.decay().fit(t, exact + noise * signs(seed, 40), noise="constant")


@both("shrinking")
def _(seed, cause):
    """Noise of one size, or in shares of the values, fitted as proportional."""
    t = np.linspace(0.05, 2.0, 40)
    exact = 2.0 * np.exp(-2.0 * t)
    noise = 0.01 * np.abs(1.0 + 0.2 * draws(seed, 40)) if cause else 0.1 * exact * magnitudes(40)
    return systems.decay().fit(t, exact + noise * signs(seed, 40), noise="proportional")


def magnitudes(size):
    """Sizes of normal noise whose order has nothing to do with time."""
    return np.tile([0.3, 1.4, 0.7, 1.1, 0.5], size // 5)


@both("experiments apart")
def _(seed, cause):
    """One of two experiments had a dose 40 % above the one that is said, or 1 %."""
    t, pairs = experiments.HOURS, []
    for k, dose in enumerate((50.0, 100.0)):
        true = dose * (1.4 if cause else 1.01) if k else dose
        data = experiments.bateman(t, true) + 0.1 * tame(seed, t.size, salt=k)
        one = ro.Experiment(
            data, t, observe="C", sigma=0.1, fixed={"dose": dose}, name=f"{dose:g} mg"
        )
        pairs.append((experiments.oral(), one))
    return ro.fit(pairs)


@both("idle level")
def _(seed, cause):
    """Noise in shares over three decades, which shrink with the values; or a constant part too."""
    t = np.linspace(0.02, 2.0, 40)
    exact = 2.5 * np.exp(-3.5 * t)
    shares = 0.1 * np.linspace(1.1, 0.9, 40) * np.tile([1.2, 0.6], 20)
    noise = shares * exact * signs(seed, 40)
    noise = noise if cause else noise + 0.03 * tame(seed, 40, salt=1)
    return systems.decay().fit(t, exact + noise, noise="combined")


@both("no noise")
def _(seed, cause):
    """A value at the time 0, where the concentration is zero; or soon after."""
    t = np.concatenate([[0.0 if cause else 0.05], experiments.HOURS])
    data = experiments.bateman(t) * (1.0 + 0.1 * tame(seed, t.size))
    return experiments.oral().fit(t, data, observe="C", noise="proportional", fixed={"dose": 100})


@both("not finite")
def _(seed, cause):
    """The logarithm above a background that no curve reaches; or that only some do not."""
    background = 3.1 if cause else 0.2
    exact = 2.0 * np.exp(-0.8 * CLOCK) + (1.2 + background if cause else 0.0)
    data = np.log(exact - background) + 0.05 * tame(seed, 20)
    return systems.decay().fit(CLOCK, data, observe={"s": f"log(u - {background})"}, sigma=0.05)


@both("too few values")
def _(seed, cause):
    """Two values for two parameters and sigma, or three."""
    t = np.array([0.3 + 0.05 * seed, 1.5]) if cause else np.array([0.3, 1.0 + 0.05 * seed, 1.9])
    return systems.decay().fit(t, decay_data(1.0, 1.5, tame(seed, t.size), t))


@both("infeasible")
def _(seed, cause):
    """A limit below the least value in the box, 0.5 exp(-8), or above it."""
    least = 0.5 * np.exp(-8.0)
    most = least * (0.5 + 0.04 * seed if cause else 1.2 + 0.2 * seed)
    return systems.decay().minimize("u", 1.0, constraints={"u": (None, most, [2.0])}, effort="low")


@both("minimize: solution")
def _(seed, cause):
    """The solution missed its tolerance, or met a loose one."""
    solution = failed() if cause else solved()
    return solution.minimize("x", 1.0 + 0.2 * seed)


# --- populations ---------------------------------------------------------------------------------

FOUR = np.linspace(0.0, 4.0, 5)


def line_table(seed, spreads, noise, subjects=12, middle=(10.0, 5.0), exact=False):
    """Lines of subjects; with ``exact``, noise that moves no intercept and no slope."""
    generator = np.random.default_rng([5152, seed])
    a = middle[0] + spreads[0] * standard(generator, subjects)
    b = middle[1] + spreads[1] * standard(generator, subjects)
    z = generator.standard_normal((subjects, FOUR.size))
    if exact:
        basis = np.stack([np.ones(FOUR.size), FOUR])
        z -= (z @ np.linalg.pinv(basis)) @ basis
    data = a[:, None] + b[:, None] * FOUR + noise * z
    return table(FOUR, data)


def standard(generator, size):
    """Normal numbers of mean zero and deviation one."""
    z = generator.standard_normal(size)
    return (z - z.mean()) / z.std() if size > 1 else 0.0 * z


def table(times, data, name="u", **columns):
    subjects = len(data)
    return {
        "subject": np.repeat(np.arange(1, subjects + 1), times.size),
        "t": np.tile(times, subjects),
        name: np.ravel(data),
        **columns,
    }


def of_lines(table_, **options):
    options = {"random": {"a": "normal", "b": "normal"}, "noise": "constant", **options}
    return lines().fit_population(table_, **options)


@both("subject at an end")
def _(seed, cause):
    """The level of a subject is beyond the box, 40, or inside by many deviations."""
    generator = np.random.default_rng([5153, seed])
    own = 10.0 + 6.0 * standard(generator, 12)
    own[seed] = 48.0 if cause else 34.0
    data = own[:, None] + standard(generator, 48).reshape(12, 4)
    return simulated.level().fit_population(
        table(np.linspace(0, 4, 4), data), random={"a": "normal"}, noise="constant"
    )


@both("population not identified")
def _(seed, cause):
    """Of two typical values the product alone acts; the near miss measures one as well."""
    generator = np.random.default_rng([5154, seed])
    p = 1.0 * np.exp(0.2 * standard(generator, 12))[:, None]
    x = np.exp(-p * 1.2 * CLOCK) + SIGMA * generator.standard_normal((12, 20))
    y = np.exp(-p * CLOCK) + SIGMA * generator.standard_normal((12, 20))
    columns = table(CLOCK, x, "x", **({} if cause else {"y": y.ravel()}))
    return pair().fit_population(columns, random=["p"], noise="constant")


@both("idle effect")
def _(seed, cause):
    """All slopes are the same, or differ."""
    spread = 0.0 if cause else 1.0
    return of_lines(line_table(seed, (2.0, spread), 0.5, exact=cause))


@both("idle noise")
def _(seed, cause):
    """Noise in shares of levels over decades, or a constant part as well."""
    generator = np.random.default_rng([5155, seed])
    k = 1.0 * np.exp(0.2 * standard(generator, 12))[:, None]
    t = np.linspace(0.1, 2.0, 8)
    exact = 2.0 * np.exp(-k * 1.5 * t)
    shares = 0.1 * np.linspace(1.4, 0.6, 8) * np.sign(generator.standard_normal(exact.shape))
    data = exact * (1.0 + shares)
    data = data if cause else data + 0.1 * generator.standard_normal(exact.shape)
    return systems.decay().fit_population(table(t, data), random=["k"], noise="combined")


@both("narrow box")
def _(seed, cause):
    """The box up to 40 holds two deviations of the levels, or nine."""
    spread, middle = (5.0, 29.0) if cause else (3.0, 10.0)
    return of_lines(line_table(seed, (spread, 1.0), 0.3, middle=(middle, 5.0)))


@both("shrinkage")
def _(seed, cause):
    """Noise three times the variation of levels, or a tenth; means vary by both, as they should."""
    noise, times = 6.0 if cause else 0.2, np.linspace(0, 4, 5)
    generator = np.random.default_rng([5161, seed])
    means = 10.0 + np.hypot(2.0, noise / np.sqrt(5.0)) * standard(generator, 12)
    residuals = np.stack([standard(generator, 5) for _ in means])
    data = means[:, None] + noise * np.sqrt(0.8) * residuals
    return simulated.level().fit_population(
        table(times, data), random={"a": "normal"}, noise="constant"
    )


def population_table(seed, times, lag=False):
    """Twelve subjects with a dose of 100 by mouth and proportional noise of 10 %."""
    generator = np.random.default_rng([5156, seed])

    def around(mean, spread):
        return mean * np.exp(spread * standard(generator, 12))[:, None]

    ka, CL, V = around(1.5, 0.3), around(2.0, 0.25), around(15.0, 0.2)
    late = np.maximum(times - 0.4, 0.0) if lag else times
    exact = simulated.concentration(late, 100.0, ka, CL, V)
    return table(times, exact * (1.0 + 0.1 * generator.standard_normal(exact.shape)), "C")


@both("far data")
def _(seed, cause):
    """A positive value at the time 0, where no curve is above zero; or at 0.25."""
    times = np.array([0.0 if cause else 0.25, 0.5, 1, 2, 4, 6, 9, 12, 18, 24])
    columns = population_table(seed, times)
    columns["C"] = np.where(columns["t"] == 0.0, 0.3, columns["C"])
    return simulated.oral().fit_population(
        columns, random=["ka", "CL", "V"], noise="proportional", fixed={"dose": 100}
    )


@both("effects not apart")
def _(seed, cause):
    """All values are at the same time; or a lag may pass the first sample, noise proportional."""
    if cause:
        generator = np.random.default_rng([5157, seed])
        own = 15.0 + 2.0 * standard(generator, 12)[:, None]
        data = own + generator.standard_normal((12, 4))
        return of_lines(table(np.full(4, 1.0), data))
    times = np.array([0.75, 1.0, 1.5, 2.0, 4.0, 6.0, 9.0, 12.0, 18.0, 24.0])
    return lagged().fit_population(
        population_table(seed, times, lag=True),
        random=["ka", "CL", "V"],
        noise="proportional",
    )


@both("population: solution")
def _(seed, cause):
    """The solution missed its tolerance, or met a loose one."""
    generator, t = np.random.default_rng([5158, seed]), np.linspace(0.2, 3, 8)
    a = 1.1 * np.exp(0.1 * standard(generator, 8))
    solution = failed() if cause else solved()
    exact = np.stack([solved()["x"](t, a=each, b=1.2) for each in a])
    data = exact + 0.1 * generator.standard_normal(exact.shape)
    return solution.fit_population(table(t, data, "x"), random=["a"], noise="constant")


@both("population: error")
def _(seed, cause):
    """The noise is a third of the error of the solution, or fifty times as large."""
    generator = np.random.default_rng([5159, seed])
    k = 1.2 * np.exp(0.2 * standard(generator, 8))[:, None]
    sigma = coarse().error * (0.3 if cause else 50.0)
    exact = 1.5 / (1.0 + 1.5 * k * CLOCK)
    data = exact + sigma * generator.standard_normal(exact.shape)
    return coarse().fit_population(table(CLOCK, data), random=["k"], sigma=sigma)


@both("one subject")
def _(seed, cause):
    """One subject, or two with many values."""
    return of_lines(line_table(seed, (2.0, 1.0), 0.5, subjects=1 if cause else 2, middle=(9, 4)),
                    random={"a": "normal"}, fixed={"b": 4})  # fmt: skip


@both("population: too few")
def _(seed, cause):
    """Four values for the five parameters of a population of lines, or many."""
    columns = line_table(seed, (2.0, 1.0), 0.5, subjects=4)
    if cause:
        first = np.arange(20) % 5 == seed % 5
        columns = {name: column[first] for name, column in columns.items()}
    return of_lines(columns)


@both("covariate constant")
def _(seed, cause):
    """All subjects weigh the same, or one weighs a little more."""
    columns = line_table(seed, (2.0, 1.0), 0.5)
    weight = np.full(12, 70.0 + seed)
    weight[seed] += 0.0 if cause else 5.0
    columns["weight"] = np.repeat(weight, 5)
    return of_lines(columns, covariates={"a": "weight/70 - 1"})


@both("covariate changes")
def _(seed, cause):
    """The weight of a subject changes within its rows, or from subject to subject alone."""
    columns = line_table(seed, (2.0, 1.0), 0.5)
    weight = np.repeat(60.0 + np.arange(12.0), 5)
    weight[5 * seed + 2] += 1.0 if cause else 0.0
    columns["weight"] = weight
    return of_lines(columns, covariates={"a": "weight/70 - 1"})


@both("outside the box")
def _(seed, cause):
    """The box cuts off a sixth of simulated levels, or none."""
    spread, middle = (6.0, 34.5) if cause else (2.0, 10.0)
    generator = np.random.default_rng([5160, seed])
    own = middle + spread * np.clip(standard(generator, 12), -2.0, 0.8)
    data = own[:, None] + 0.3 * generator.standard_normal((12, 4))
    fit = simulated.level().fit_population(
        table(np.linspace(0, 4, 4), data), random={"a": "normal"}, noise="constant"
    )
    return fit.predictive_check(count=50).message


# --- calibrations --------------------------------------------------------------------------------


def calibrated(rates, initial, bounds, t, data, observe, sigma=SIGMA, end=None, **options):
    events = options.pop("events", None)
    extra = {} if events is None else {"events": events}
    problem = ro.Problem.from_strings(rates, initial, bounds, (0, end or float(t[-1])), **extra)
    experiment = ro.Experiment(data, t, observe=observe, sigma=sigma)
    options = {"starts": 3, "seed": 1, "box": False, **options}
    return ro.calibrate(problem, experiment, **options)


@both("no trajectory")
def _(seed, cause):
    """Every trajectory blows up before the last value; or those of a part of the bounds."""
    t = np.linspace(0.1, 1.0, 10)
    box = {"k": (1.5, 10.0, "log") if cause else (0.05, 10.0, "log")}
    k = 0.3 + 0.04 * seed
    data = 1.0 / (1.0 - k * t) + SIGMA * tame(seed, 10)
    return calibrated({"x": "k*x**2"}, {"x": "1"}, box, t, data, "x", seed=seed)


@both("one start")
def _(seed, cause):
    """A frequency that one of three starts may reach; or a decay that all reach."""
    t = np.linspace(0.2, 6.0, 30)
    if not cause:
        data = decay_data(1.0, 1.5, tame(seed, 30), t)
        box = {"k": (0.01, 50, "log"), "a": (0.01, 50, "log")}
        return calibrated({"x": "-k*x"}, {"x": "a"}, box, t, data, "x", seed=seed)
    data = np.cos(3.0 * t) + 0.1 * tame(seed, 30)
    box = {"w": (2.0 + 0.05 * seed, 30.0, "log")}  # 3 is in the first of three cells of the starts
    return calibrated({"x": "w"}, {"x": "0"}, box, t, data, {"s": "cos(x)"}, 0.1)


@both("calibration not identified", "no parameter")
def _(seed, cause):
    """A product of two parameters alone acts; the near miss fixes one of them."""
    data = decay_data(1.0 + 0.05 * seed, 1.0, tame(seed, 20))
    box = {"p": (0.03, 30, "log"), "q": (0.03, 30, "log")}
    fixed = {} if cause else {"q": 1.0}
    return calibrated({"x": "-p*q*x"}, {"x": "1"}, box, CLOCK, data, "x", fixed=fixed, box=True)


@both("calibration at an end")
def _(seed, cause):
    """The rate is beyond its bounds, 2, or inside."""
    k = 2.5 + 0.1 * seed if cause else 1.5 + 0.02 * seed
    box = {"k": (0.02, 2, "log"), "a": (0.1, 10, "log")}
    data = decay_data(k, 1.5, tame(seed, 20))
    return calibrated({"x": "-k*x"}, {"x": "a"}, box, CLOCK, data, "x")


@both("many parameters")
def _(seed, cause):
    """Seven rates that the data identify, or six are found and one is not seen."""
    names = "abcdefg"
    seen = names if cause else names[:6]
    t = np.linspace(0.2, 2.0, 6)
    rates = {f"x{n}": f"-{n}*x{n}" for n in names}
    data = {
        f"x{n}": decay_data(0.7 + 0.05 * i, 1.0, tame(seed, 6, salt=i), t)
        for i, n in enumerate(seen)
    }
    problem = ro.Problem.from_strings(
        rates, dict.fromkeys(rates, "1"), dict.fromkeys(names, (0.1, 10, "log")), (0, 2)
    )
    experiment = ro.Experiment(data, dict.fromkeys(data, t), sigma=SIGMA)
    fixed = {} if cause else {"g": 1.0}
    return ro.calibrate(problem, experiment, starts=2, seed=1, fixed=fixed, rtol=1e-3)


@both("jump in time")
def _(seed, cause):
    """A rate jumps at an unknown time, or at a known one."""
    t, lag = np.linspace(0.2, 4.0, 20), 1.0 + 0.05 * seed
    data = np.where(t < lag, 0.0, 1.0 - np.exp(-np.maximum(t - lag, 0.0))) + SIGMA * tame(seed, 20)
    box = {"lag": (0.5, 3), "k": (0.1, 10, "log")}
    rates = {"x": "Piecewise((0, t < lag), (1, True)) - k*x"}
    fixed = {} if cause else {"lag": lag}
    return calibrated(rates, {"x": "0"}, box, t, data, "x", fixed=fixed)


@both("jump with states")
def _(seed, cause):
    """A rate jumps where the state passes a half, or has a kink there."""
    rate = "-k*Heaviside(x - 0.5) - 0.1*x" if cause else "-k*Max(0, x - 0.5) - 0.1*x"
    data = decay_data(1.0, 1.0 + 0.02 * seed, tame(seed, 20))
    return calibrated({"x": rate}, {"x": "1"}, {"k": (0.05, 5, "log")}, CLOCK, data, "x")


@both("events")
def _(seed, cause):
    """An event depends on a state; or a dose is given at a fixed time."""
    event = {"when": "x - 0.5", "direction": "falling", "then": {"x": "x + 1"}, "name": "dose"}
    data = decay_data(0.5, 1.0 + 0.02 * seed, tame(seed, 20))
    box = {"k": (0.05, 5, "log")}
    if cause:
        return calibrated({"x": "-k*x"}, {"x": "1"}, box, CLOCK, data, "x", events=[event])
    problem = ro.Problem.from_strings(
        {"x": "-k*x"}, {"x": "1"}, box, (0, 2), jumps={1.0: {"x": "x + 1"}}
    )
    more = np.where(CLOCK >= 1.0, np.exp(-0.5 * np.maximum(CLOCK - 1.0, 0.0)), 0.0)
    experiment = ro.Experiment(data + more, CLOCK, observe="x", sigma=SIGMA)
    return ro.calibrate(problem, experiment, starts=2, seed=1, box=False)


@functools.cache
def conversion_problem():
    folder = Path(tempfile.mkdtemp())
    return ro.read_petab(conversion.write(folder))


@both("noise not positive")
def _(seed, cause):
    """A deviation below zero, or small."""
    value = -0.1 * (1 + seed) if cause else 0.01 * (1 + seed)
    return f"{conversion_problem().objective({'sd_B': value}):g}"


@both("no logarithm")
def _(seed, cause):
    """An output below zero whose logarithm is measured, or small and above."""
    value = -1.0 - seed if cause else 0.01 * (1 + seed)
    return f"{conversion_problem().objective({'scale': value}):g}"
