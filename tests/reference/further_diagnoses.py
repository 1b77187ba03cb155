"""Further diagnoses: ten cases that have the cause of each, and ten near misses that do not.

They are shaped like those of :mod:`.diagnoses`, and counted with them.
"""

import functools

import numpy as np

import rankone as ro
from tests.inference.estimation import systems
from tests.reference.diagnoses import (
    CLOCK,
    SIGMA,
    Diagnosis,
    calibrated,
    failed,
    said,
    solved,
    standard,
    strings,
    table,
    tame,
)

ROWS = np.array([0.0, 1.0, 2.0, 3.0, 4.0, 6.0])
"""Times of the rows of a subject: two doses, at the times 0 and 3, and data at the others."""


@functools.cache
def ramp():
    """x = min(t, a), where the data tell the time a at which the rate ends."""
    return strings({"x": "Piecewise((1, t < a), (0, True))"}, {"x": "0"}, {"a": (1, 6)}, 8, 1e-5)


def kink(seed, cause):
    """Data after a time are a little below it, and the one at it is above, or is at it.

    The sum of squares falls up to that time and rises behind it; or it is least before it.
    """
    times, k = np.linspace(0.5, 8.0, 16), 5 + seed % 3
    exact = np.minimum(times, times[k])
    exact[k + 1 :] -= (0.12 + 0.005 * seed) / (15 - k)
    exact[k] += 0.3 if cause else 0.0
    return ramp().fit(times, exact, sigma=0.05)


def zeros(seed, cause):
    """Noise in shares of the prediction of a solution that missed its tolerance, or met it."""
    solution, times = failed() if cause else solved(), np.linspace(0.2, 3, 15)
    exact = solved()["x"](times, a=1.0 + 0.05 * seed, b=1.2)
    return solution.fit(times, exact * (1.0 + 0.2 * tame(seed, 15)), noise="proportional")


@functools.cache
def eliminated(linear):
    """One dose that is eliminated in proportion to the amount, or at a limited rate."""
    rate = "-k*u" if linear else "-k*u/(1 + u)"
    return strings({"u": rate}, {"u": "dose"}, {"k": (0.05, 1), "dose": (1, 2)}, 10)


def dosed(seed, solution, missing=False):
    """Eight subjects with two doses each, of which one may have no dose in the table."""
    generator = np.random.default_rng([5162, seed])
    k = 0.3 * np.exp(0.2 * standard(generator, 8))[:, None]
    each = [np.exp(-k * np.maximum(ROWS - at, 0.0)) * (at <= ROWS) for at in (0.0, 3.0)]
    data = 1.5 * sum(each) + 0.02 * generator.standard_normal((8, ROWS.size))
    doses = np.isin(ROWS, (0.0, 3.0))
    amounts = np.tile(np.where(doses, 1.5, np.nan), (8, 1))
    if missing:
        amounts[seed % 8] = np.nan
    rows = table(ROWS, np.where(doses, np.nan, data), amt=amounts.ravel())
    return solution.fit_population(rows, random=["k"], doses={"dose": "amt"}, noise="constant")


def no_box(seed, cause):
    """The horizon ends behind the blow-up at the time 1/a, or before it."""
    a = 0.6 + 0.005 * seed
    t = np.linspace(0.05, 1.0, 20)
    data = a / (1.0 - a * t) + SIGMA * tame(seed, 20)
    box = {"a": (0.1, 0.9, "log")}
    end = 1.9 if cause else 1.05
    return calibrated({"x": "x**2"}, {"x": "a"}, box, t, data, "x", box=True, end=end, rtol=1e-3)


ONCE = np.ones(2)
VALLEY = {"f": np.zeros(2), "g": np.array([1.0, 1.02])}
"""Data at the time 1, twice, of how far b is from the square of a, and of a."""


def valley(steepness):
    """What is observed: the sum of squares is a valley that bends, as steep as asked for."""
    return {"f": f"{steepness:.6g}*(y - x**2)", "g": "x"}


@functools.cache
def ramps(low):
    """x = a t and y = b t."""
    box = {"a": (low, 3), "b": (-9, 9)}
    return strings({"x": "a", "y": "b"}, {"x": "0", "y": "0"}, box, 2)


def unsettled(seed, cause):
    """A valley too steep for the steps of a search; or steps that shrink slowly, and far enough.

    The last ones are of a large residual whose curvature is nearly that of the model.
    """
    a = -2.0 + 0.05 * seed
    times, start = {"f": ONCE, "g": ONCE}, {"a": a, "b": a**2}
    if cause or seed < 5:
        steepness = 10.0 ** (5.0 + 0.1 * seed if cause else 0.5 * seed)
        return ramps(-3).fit(
            times, VALLEY, observe=valley(steepness), sigma=0.02, start=start, starts=0
        )
    bend, once = 0.88 + 0.01 * seed, {"f": ONCE[:1], "g": ONCE[:1]}
    data = {"f": np.array([-1.0]), "g": np.array([1.0])}
    observe, start = {"f": "x", "g": f"{bend:.2f}*x**2 + x"}, {"a": 0.1 * seed}
    return ramps(-0.02).fit(once, data, observe=observe, fixed={"b": 1.0}, start=start, starts=0)


def on_its_way(seed, cause):
    """The same valley for a calibration; and a decay from box to box."""
    if not cause and seed >= 5:
        t = np.linspace(0.2, 6.0, 30)
        data = 1e-5 * (2.0 * np.exp(-0.1 * seed * t) + SIGMA * tame(seed, 30))
        box = {"k": (0.01, 100, "log"), "a": (1e-6, 1e-3, "log")}
        options = {"sigma": None, "search": "boxes", "starts": 8, "seed": seed}
        return calibrated({"x": "-k*x"}, {"x": "a"}, box, t, data, "x", **options)
    steepness = 10.0 ** (5.0 + 0.1 * seed if cause else 0.6 * seed)
    times, rates, box = {"f": ONCE, "g": ONCE}, {"x": "a", "y": "b"}, {"a": (-3, 3), "b": (-9, 9)}
    problem = ro.Problem.from_strings(rates, {"x": "0", "y": "0"}, box, (0, 2))
    experiment = ro.Experiment(VALLEY, times, observe=valley(steepness), sigma=0.02)
    return ro.calibrate(problem, experiment, starts=1, seed=1, box=False)


def decayed(seed, cause):
    """Decays that are nearly over before the first value, by one deviation; or that are seen."""
    t, noise = np.linspace(0.2, 2.0, 10), tame(seed, 10)
    noise[:2] = 0.0
    return t, np.exp(-(20.0 + 0.3 * seed if cause else 3.0 + 0.1 * seed) * t) + SIGMA * noise


def one_side(seed, cause):
    """A rate that may be as large as one likes."""
    solution = strings({"x": "-k*x"}, {"x": "1"}, {"k": (1, 60, "log")}, 2, 1e-5)
    return solution.fit(*decayed(seed, cause), sigma=SIGMA)


def calibrated_side(seed, cause):
    """The same in a calibration."""
    box = {"k": (0.1, 1000, "log")}
    return calibrated({"x": "-k*x"}, {"x": "1"}, box, *decayed(seed, cause), "x")


def hardly_decayed(seed, cause):
    """Decays by one deviation of the rate from none at all; or by six."""
    t, noise = np.linspace(0.2, 2.0, 10), tame(seed, 10)
    noise -= (noise @ t) / (t @ t) * t
    return t, np.exp(-(0.004 + 2e-4 * seed if cause else 0.03 + 0.002 * seed) * t) + SIGMA * noise


def other_side(seed, cause):
    """A rate that may be as small as one likes."""
    solution = strings({"x": "-k*x"}, {"x": "1"}, {"k": (1e-4, 10, "log")}, 2, 1e-5)
    return solution.fit(*hardly_decayed(seed, cause), sigma=SIGMA)


def calibrated_other_side(seed, cause):
    """The same in a calibration."""
    box = {"k": (1e-4, 10, "log")}
    return calibrated({"x": "-k*x"}, {"x": "1"}, box, *hardly_decayed(seed, cause), "x")


def misfit_around(seed, cause):
    """The noise is twice as large as said, or 1.2 times: the last fit alone looks at it."""
    data = np.exp(-(1.0 + 0.05 * seed) * CLOCK)
    data += (2.0 if cause else 1.2) * SIGMA * tame(seed, 20, 2.5)
    box = {"k": (0.1, 10, "log")}
    return calibrated({"x": "-k*x"}, {"x": "1"}, box, CLOCK, data, "x", box=True)


def outlier_of_unknown_noise(seed, cause):
    """An inner one of ten values is twelve deviations off, or 2.8; the noise is estimated."""
    t, noise = np.linspace(0.2, 2.0, 10), tame(seed, 10)
    noise[1 + seed % 8] = 12.0 if cause else 2.8
    return systems.decay().fit(t, 1.5 * np.exp(-t) + SIGMA * noise)


def held(seed, cause):
    """The fit in the last box, beside rates of which the data tell the product alone."""
    data = {"x": np.exp(-CLOCK), "y": np.exp(-(1.0 + 0.05 * seed) * CLOCK)}
    data = {
        name: row + SIGMA * tame(seed, 20, salt=k) for k, (name, row) in enumerate(data.items())
    }
    box = dict.fromkeys("pqr", (0.03, 30, "log"))
    problem = ro.Problem.from_strings({"x": "-p*q*x", "y": "-r*y"}, {"x": 1, "y": 1}, box, (0, 2))
    experiment = ro.Experiment(data, dict.fromkeys(data, CLOCK), sigma=SIGMA)
    fixed = {} if cause else {"q": 1.0}
    return ro.calibrate(problem, experiment, starts=3, seed=1, fixed=fixed, rtol=1e-3).fit


def population_unsettled(seed, cause):
    """Subjects whose estimates are at kinks, or a steep valley; or none, and a mild one."""
    generator = np.random.default_rng([5163, seed])
    if seed % 2:
        return valley_of_subjects(generator, 10.0 ** (3.0 + 0.2 * seed if cause else 0.1 * seed))
    times = np.linspace(0.5, 8.0, 16)
    rows = np.minimum(times, (3.5 + standard(generator, 5))[:, None])
    for row in rows if cause else ():
        k = int(np.argmax(row))
        row[:] = np.minimum(times, times[k])
        row[k + 1 :] -= 0.12 / (15 - k)
        row[k] += 0.3
    rows = table(times, rows + 0.02 * generator.standard_normal(rows.shape), "x")
    return ramp().fit_population(rows, random=["a"], sigma=0.05)


def valley_of_subjects(generator, steepness):
    """The valley of :func:`unsettled`, with a rate of its own for each of eight subjects."""
    a = 1.0 + 0.1 * standard(generator, 8)[:, None]
    f, g = np.zeros((8, 2)), a + np.zeros(2)
    f, g = (each + 0.02 * generator.standard_normal((8, 2)) for each in (f, g))
    rows = table(ONCE, f, "f", g=g.ravel())
    start, observe = {"a": 0.0, "b": 0.0}, valley(steepness)
    return ramps(-3).fit_population(
        rows, random={"a": "normal"}, observe=observe, sigma=0.02, start=start
    )


CASES = {
    "search": (r"the search did not converge", unsettled),
    "population: search": (r"the search did not converge", population_unsettled),
    "on its way": (r"still on its way", on_its_way),
    "one side": (r"no upper bound, only a lower one", one_side),
    "calibration: one side": (r"no upper bound, only a lower one", calibrated_side),
    "other side": (r"no lower bound, only an upper one", other_side),
    "calibration: other side": (r"no lower bound, only an upper one", calibrated_other_side),
    "calibration: fit": (r"the fit around the optimum is no success", misfit_around),
    "outlier, noise unknown": (r"by the spread of the others", outlier_of_unknown_noise),
    "held": (r"the solution holds `p` and `q`, which the data do not determine", held),
    "kink": (r"at a kink of the sum of squares", kink),
    "zeros": (r"^the solution itself is not a success", zeros),
    "no dose": (r"has data and no dose", lambda seed, cause: dosed(seed, eliminated(True), cause)),
    "no sum of doses": (
        r"the effects of several doses `dose` do not add up",
        lambda seed, cause: dosed(seed, eliminated(not cause)),
    ),
    "no box": (r"no box around the optimum could be solved", no_box),
}


def further_diagnoses():
    """The diagnoses, with functions of a seed that return what is said."""

    def of(case, cause):
        return lambda seed: said(lambda: case(seed, cause))

    return [
        Diagnosis(key, pattern, of(case, True), of(case, False))
        for key, (pattern, case) in CASES.items()
    ]
