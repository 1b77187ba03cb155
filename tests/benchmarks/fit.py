"""How long a fit takes, and how often its 95 % intervals hold the true values.

    python -m tests.benchmarks.fit [SEEDS]

Prints, for free fall with 20 noisy values and six doses with 24, the times of a fit beside those of
one trajectory of SciPy and of a fit that integrates, and the counts of intervals.
"""

from __future__ import annotations

import sys
import time

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import least_squares

from tests.inference.estimation import systems


def timed(function, *arguments):
    begin = time.perf_counter()
    result = function(*arguments)
    return time.perf_counter() - begin, result


def seconds(times):
    return f"median {1e3 * np.median(times):.1f} ms, largest {1e3 * np.max(times):.1f} ms"


def integrated():
    """The same fit of C_D by SciPy, which integrates for every value of it."""
    times, data = systems.FALL_TIMES, systems.fall_fit(0).observations.values

    def residuals(p):
        def rate(_, u):
            return 0.06 * p[0] * u**2 - 9.81

        path = solve_ivp(rate, (0, 3), [0.0], "DOP853", times, rtol=1e-8, atol=1e-8)
        return (path.y[0] - data) / systems.NOISE

    return least_squares(residuals, [0.8], bounds=([0.1], [1.5]))


def main() -> None:
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 100
    systems.fall(), systems.drug()
    runs = [timed(systems.fall_fit, seed) for seed in range(count)]
    inside = sum(systems.covered(fit.interval_of("C_D/m"), 0.5) for _, fit in runs)
    unidentified = sum(not any(fit.identifiable.values()) for _, fit in runs)
    print(f"free fall, C_D and m, {count} seeds: {seconds([t for t, _ in runs])}")
    print(f"  C_D/m inside {inside}, C_D and m not identified alone {unidentified}")
    data = runs[0][1].observations.values
    one = [
        timed(lambda: systems.fall().fit(systems.FALL_TIMES, data, sigma=0.1, fixed={"m": 1}))[0]
        for _ in range(10)
    ]
    other = [timed(integrated)[0] for _ in range(10)]
    print(f"  C_D alone: {seconds(one)}; by integration: {seconds(other)}")
    runs = [timed(systems.drug_fit, seed) for seed in range(count)]
    print(f"six doses, four parameters, {count} seeds: {seconds([t for t, _ in runs])}")
    for name, value in systems.PERSON.items():
        inside = sum(systems.covered(fit.interval()[name], value) for _, fit in runs)
        print(f"  {name} inside {inside}")


if __name__ == "__main__":
    main()
