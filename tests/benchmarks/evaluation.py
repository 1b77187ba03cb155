"""Points evaluated per second, for trains of the size of the reference problems.

Run with one BLAS thread::

    OMP_NUM_THREADS=1 python -m tests.benchmarks.evaluation

The trains are random; only their shapes matter.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from rankone.discretization import ChebyshevBasis
from rankone.metadata import SolutionMetadata
from rankone.solution import Solution
from rankone.solvers.outcome import Outcome, Status
from rankone.tensors.slab import SlabTrain


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
            (
                rng.standard_normal((states, time_modes, ranks[0])),
                *(
                    rng.standard_normal((left, basis.size, right))
                    for left, basis, right in zip(ranks, bases, (*ranks[1:], 1), strict=True)
                ),
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
    return Solution(Outcome(tuple(trains), Status.UNCHECKED, "", None, ()), metadata)


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


def main() -> None:
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
