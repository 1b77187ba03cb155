"""Further diagnoses: ten cases that have the cause of each, and ten near misses that do not.

They are shaped like those of :mod:`.diagnoses`, and counted with them.
"""

import functools

import numpy as np

from tests.reference.diagnoses import (
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


CASES = {
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
