"""Time of evaluation: points, curves and grids of solved problems, points of random trains.

Run with one BLAS thread::

    OMP_NUM_THREADS=1 python -m tests.benchmarks.evaluation

Of the random trains only the shapes matter. Of the solved problems these are measured, in
medians of processor time for each value of (time, parameter point), with all unknowns:

``points``       random times and parameters, each on its own
``curve``        one parameter point at 1,000 times; ``short`` at 100 times, for the whole call
``one time``     1,000 parameter points at one time
``curves``       100 parameter points x 200 times, shared by all points
``own times``    the same, each point with times of its own
``grid``         of the same size, with two values of the first parameters
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from typing import Any

import numpy as np

import rankone as ro
from rankone.solution.solution import Solution
from rankone.solvers.outcome import Outcome, SolutionMetadata
from rankone.tensors import ChebyshevBasis
from rankone.tensors.slab import SlabTrain
from rankone.tensors.train import Train
from rankone.trajectories.system.verdict import Status
from tests.problems import EXAMPLES


def random_solution(
    *,
    slabs: int,
    states: int,
    time_modes: int,
    ranks: tuple[int, ...],
    modes: tuple[int, ...],
    elements: int = 1,
) -> Solution:
    """A solution on the unit box with random cores; ``elements`` are those of parameter 1."""
    rng = np.random.default_rng(0)
    bases = tuple(
        ChebyshevBasis(0.0, 1.0, count // (elements if j == 0 else 1), elements if j == 0 else 1)
        for j, count in enumerate(modes)
    )
    trains = [
        SlabTrain(
            i / slabs,
            (i + 1) / slabs,
            Train(
                (
                    rng.standard_normal((states, time_modes, ranks[0])),
                    *(
                        rng.standard_normal((left, basis.size, right))
                        for left, basis, right in zip(ranks, bases, (*ranks[1:], 1), strict=True)
                    ),
                )
            ),
            bases,
        )
        for i in range(slabs)
    ]
    names = tuple(f"u{i}" for i in range(states))
    parameters = tuple(f"p{j}" for j in range(len(modes)))
    metadata = SolutionMetadata(
        states=names,
        roles=("unknown",) * states,
        parameters=parameters,
        box=((0.0, 1.0),) * len(modes),
        time="t",
        horizon=(0.0, 1.0),
        rtol=1e-6,
    )
    return Solution(Outcome(tuple(trains), Status.UNCHECKED, None, ()), metadata)


CASES = {
    "Lotka-Volterra": (
        random_solution(slabs=30, states=2, time_modes=13, ranks=(10, 16), modes=(50, 31)),
        100_000,
    ),
    "Lotka-Volterra, two elements": (
        random_solution(
            slabs=30, states=2, time_modes=13, ranks=(10, 16), modes=(50, 31), elements=2
        ),
        100_000,
    ),
    "Kirchhoff": (
        random_solution(
            slabs=3,
            states=6,
            time_modes=13,
            ranks=(33, 75, 114, 67, 26, 8),
            modes=(7, 9, 13, 11, 7, 13),
        ),
        30_000,
    ),
}


def best_of(repeats: int, work: Callable[[], object]) -> float:
    """The least of several times, in seconds."""
    times = []
    for _ in range(repeats):
        began = time.perf_counter()
        work()
        times.append(time.perf_counter() - began)
    return min(times)


SOLVED = {"kirchhoff": 1e-4, "lotka_volterra": 1e-6, "decay": 1e-6, "chain": 1e-4}
"""Examples and their tolerances."""
_COUNTS = {
    "points": 100_000,
    "curve": 1000,
    "short": 100,
    "one time": 1000,
    "curves": 20_000,
    "own times": 20_000,
    "grid": 20_000,
}
"""Values in each call."""


def calls(solution: Any) -> dict[str, Callable[[], object]]:
    """What is measured of a solution."""
    rng = np.random.default_rng(2)

    def drawn(*shape: int) -> dict[str, Any]:
        return {name: rng.uniform(*ends, shape) for name, ends in solution.parameters.items()}

    def times(*shape: int) -> Any:
        return np.sort(rng.uniform(*solution.time, shape))

    one, many, lines, rows = drawn(), drawn(1000), drawn(100), drawn(100, 1)
    everywhere, apart = (times(100_000), drawn(100_000)), times(100, 200)
    rng.shuffle(everywhere[0])
    sizes = _grid_sizes(len(solution.parameters))
    axes = {name: drawn(size)[name] for name, size in zip(solution.parameters, sizes, strict=True)}
    t1000, t100, t200, middle = times(1000), times(100), times(200), 0.5 * sum(solution.time)
    return {
        "points": lambda: solution(*everywhere),
        "curve": lambda: solution(t1000, one),
        "short": lambda: solution(t100, one),
        "one time": lambda: solution(middle, many),
        "curves": lambda: solution(t200[:, None], lines),
        "own times": lambda: solution(apart, rows),
        "grid": lambda: solution.grid(t200, axes),
    }


def _grid_sizes(parameters: int) -> list[int]:
    """Sizes of axes whose product is a hundred, the first ones small."""
    factors = [2, 2, 5, 5]
    while len(factors) > parameters:
        factors = [*factors[:-2], factors[-2] * factors[-1]]
    return [1] * (parameters - len(factors)) + factors


def median_of(repeats: int, work: Callable[[], object]) -> float:
    """The median processor time, in seconds; short work is repeated until 20 ms have passed."""
    work()
    spent = []
    for _ in range(repeats):
        began, count = time.process_time(), 0
        while not count or time.process_time() - began < 0.02:
            work()
            count += 1
        spent.append((time.process_time() - began) / count)
    return statistics.median(spent)


def main() -> None:
    print(f"{'us for a value; short: for a call':34}", *(f"{name:>10}" for name in _COUNTS))
    for name, rtol in SOLVED.items():
        solution = ro.solve(EXAMPLES[name].problem, rtol=rtol)
        spent = {what: 1e6 * median_of(7, work) for what, work in calls(solution).items()}
        each = (spent[what] / (1 if what == "short" else _COUNTS[what]) for what in spent)
        print(f"{f'{name}, {rtol:g}':34}", *(f"{value:10.3g}" for value in each), flush=True)
    print()
    rng = np.random.default_rng(1)
    for title, (solution, count) in CASES.items():
        names = ("t", *solution.parameters)
        points = dict(zip(names, rng.uniform(size=(len(names), count)), strict=True))
        batch = best_of(5, lambda s=solution, p=points: s(**p))
        singles = [{name: float(points[name][k]) for name in names} for k in range(500)]
        one = best_of(5, lambda s=solution, p=singles: [s(**point) for point in p]) / len(singles)
        print(f"{title:30} {count / batch:10.3g} points/s   one point {1e6 * one:6.1f} us")


if __name__ == "__main__":
    main()
