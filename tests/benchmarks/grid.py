"""rankone's solve beside a tuned grid of trajectories: python tests/benchmarks/grid.py

The grid is what an expert writes in twenty lines: a tensor Chebyshev grid of trajectories that
SciPy integrates as one stacked system, interpolated in the parameters and in time. Its nodes in
each parameter and in time, its integrator and tolerance are searched for the very problem
(``--search``), until the error is just within the tolerance: that of tests/reference/measure.py,
256 random points × 21 times. The search is not timed, and nothing is verified. rankone's solve
chooses all that by itself, and checks it.

Both times are measured in one process, the least of repetitions made in turns, in processor time.
"""

from __future__ import annotations

import os

os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")

import argparse
import itertools
import math
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path

import numpy as np
import scipy.sparse
from scipy.integrate import solve_ivp

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "src")]

import rankone as ro  # noqa: E402
from tests.benchmarks.peer_tools import STACKED, cardinals, chebyshev  # noqa: E402
from tests.benchmarks.report import TITLES  # noqa: E402
from tests.problems import MEASURED  # noqa: E402
from tests.reference.measure import Array, Independent, trajectories  # noqa: E402
from tests.reference.systems import INDEPENDENT  # noqa: E402

SHARES = (0.3, 0.5, 0.7, 0.85)
"""Shares of the error that interpolation in the parameters may take: each gives a grid to try."""
TOLERANCES = 10.0 ** -np.arange(1.0, 11.0, 0.25)
"""Tolerances of SciPy that are tried, the loosest first."""
EXACT = 1e-3
"""Tolerance of SciPy, over that of the grid, while the nodes are searched."""
STIFF_GRADING = 4.0
"""Power of the shares of the horizon at which stiff systems are read: they begin with a layer."""
MOST_NODES, MOST_TIME_NODES = 40, 200
"""Most nodes of a parameter and in time."""


@dataclass(frozen=True)
class Case:
    """The largest ratio of times that is wanted, and the grid that was tuned to the problem."""

    bar: float
    nodes: tuple[int, ...]
    times: int
    method: str
    tolerance: float

    def grid(self, system: Independent) -> Grid:
        return Grid(system, self.nodes, self.times, self.method, self.tolerance)


CASES = {
    ("coupled", 1e-6): Case(5.0, (7, 6, 6), 10, "DOP853", 1e-2),
    ("lotka_volterra", 1e-4): Case(4.0, (21, 12), 121, "DOP853", 10**-4.75),
    ("lotka_volterra", 1e-6): Case(3.0, (28, 15), 178, "DOP853", 1e-7),
    ("robertson", 1e-4): Case(3.0, (4, 5, 6), 71, "BDF", 1e-4),
}
"""By problem and tolerance, as ``--search`` chose them."""


@dataclass(frozen=True, eq=False)
class Grid:
    """Chebyshev nodes of each parameter and of time, and how SciPy integrates the trajectories."""

    system: Independent
    nodes: tuple[int, ...]
    times: int
    method: str
    tolerance: float

    @property
    def count(self) -> int:
        """Number of trajectories."""
        return math.prod(self.nodes)

    @cached_property
    def time_nodes(self) -> Array:
        """Chebyshev nodes, drawn to the start where the system is stiff."""
        start, end = self.system.start, self.system.end
        shares = (chebyshev(self.times) + 1.0) / 2.0
        return np.asarray(start + (end - start) * shares**self._grading)

    @property
    def _grading(self) -> float:
        return STIFF_GRADING if self.system.stiff else 1.0

    def _in_time(self, times: Array) -> Array:
        """Interpolation from the time nodes to times."""
        shares = (times - self.system.start) / (self.system.end - self.system.start)
        return cardinals(chebyshev(self.times), 2.0 * shares ** (1.0 / self._grading) - 1.0)

    def integrated(self) -> Array:
        """States at the nodes: (unknowns, parameters' nodes..., time nodes)."""
        axes = [
            lower + (upper - lower) * (chebyshev(size) + 1.0) / 2.0
            for (lower, upper), size in zip(self.system.box, self.nodes, strict=True)
        ]
        points = np.stack([x.ravel() for x in np.meshgrid(*axes, indexing="ij")])
        stacks = np.array_split(points, -(-points.shape[1] // STACKED), axis=1)
        states = np.concatenate([self._stack(stack) for stack in stacks], axis=1)
        return np.asarray(states.reshape(len(states), *self.nodes, self.times))

    def _stack(self, points: Array) -> Array:
        """States (n, m, times) at points (d, m)."""
        system, count = self.system, points.shape[1]
        start = np.stack([np.broadcast_to(row, count) for row in system.initial(points)])
        start, n = start.astype(float), len(start)

        def rates(t: float, u: Array) -> Array:
            rows = system.rhs(t, u.reshape(n, count), points)
            return np.concatenate([np.broadcast_to(row, count) for row in rows])

        options: dict[str, object] = {"method": self.method, "rtol": self.tolerance}
        if self.method != "DOP853":
            options["jac_sparsity"] = scipy.sparse.kron(
                np.ones((n, n)), scipy.sparse.eye_array(count)
            )
        options["atol"] = self.tolerance * np.repeat(np.array(system.sizes), count)
        span = system.start, system.end
        with np.errstate(all="ignore"):
            run = solve_ivp(rates, span, start.ravel(), t_eval=self.time_nodes, **options)
        if not run.success:
            return np.full((n, count, self.times), np.inf)
        return np.asarray(run.y.reshape(n, count, -1))

    def error(self, states: Array) -> float:
        """Largest error of the states, interpolated, in units of each unknown's size."""
        points, times, exact = trajectories(self.system)
        if not np.isfinite(states).all():
            return math.inf
        product = np.ones((points.shape[1], 1))
        for x, (lower, upper), size in zip(points, self.system.box, self.nodes, strict=True):
            weights = cardinals(chebyshev(size), 2.0 * (x - lower) / (upper - lower) - 1.0)
            product = (product[:, :, None] * weights[:, None]).reshape(len(x), -1)
        in_time = states.reshape(len(exact), -1, self.times)
        in_time = in_time @ self._in_time(times).T
        errors = np.abs(product @ in_time - exact).max(axis=(1, 2))
        return float((errors / np.abs(exact).max(axis=(1, 2))).max())


@dataclass(frozen=True)
class Row:
    """What both took for one problem."""

    problem: str
    rtol: float
    bar: float
    grid: Grid
    grid_error: float
    grid_seconds: float
    solution: ro.Solution
    seconds: float

    def cells(self) -> list[str]:
        ratio = self.seconds / self.grid_seconds
        return [
            TITLES[self.problem],
            f"{self.rtol:.0e}".replace("e-0", "e-"),
            f"{ratio:.2g}",
            f"{self.bar:g}",
            f"{1e3 * self.seconds:.3g} ms",
            f"{1e3 * self.grid_seconds:.3g} ms",
            " × ".join(map(str, self.grid.nodes)) + f" = {self.grid.count}",
            f"{self.grid.method}, {self.grid.tolerance:.0e}, {self.grid.times} times",
            f"{self.grid_error / self.rtol:.2g}",
        ]


HEADER = ["problem", "rtol", "ratio", "bar", "rankone", "grid", "trajectories", "integrated by"]
HEADER += ["grid's error ÷ rtol"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--problem", action="append", help="only this one")
    parser.add_argument("--repetitions", type=int, default=15, help="turns (default: %(default)s)")
    parser.add_argument("--search", action="store_true", help="tune the grids again: takes minutes")
    parser.add_argument("--integrator", default="auto", help="of rankone (default: %(default)s)")
    arguments = parser.parse_args()
    print("| " + " | ".join(HEADER) + " |")
    print("| --- |" + " --: |" * (len(HEADER) - 1))
    for (name, rtol), case in CASES.items():
        if not arguments.problem or name in arguments.problem:
            system = INDEPENDENT[name]
            grid = _tuned(system, rtol) if arguments.search else case.grid(system)
            solve = partial(
                ro.compile(MEASURED[name]()).solve, rtol, integrator=arguments.integrator
            )
            row = _measured(name, rtol, case.bar, grid, solve, arguments.repetitions)
            print("| " + " | ".join(row.cells()) + " |", flush=True)


def _measured(
    name: str,
    rtol: float,
    bar: float,
    grid: Grid,
    solve: Callable[[], ro.Solution],
    repetitions: int,
) -> Row:
    """Time both in turns."""
    error = grid.error(grid.integrated())
    assert error <= rtol, f"the grid has an error of {error:.1e}"
    solution = solve()
    pair: list[Callable[[], object]] = [solve, grid.integrated]
    seconds, spent = _fastest(pair, repetitions)
    return Row(name, rtol, bar, grid, error, spent, solution, seconds)


def _tuned(system: Independent, rtol: float) -> Grid:
    """The fastest of the grids within the tolerance."""
    candidates = list(tuned_grids(system, rtol))
    return candidates[int(np.argmin(_fastest([grid.integrated for grid in candidates], 3)))]


def tuned_grids(system: Independent, rtol: float) -> Iterator[Grid]:
    """Grids within the tolerance, for each share of the error and each integrator."""
    methods = ("Radau", "BDF") if system.stiff else ("DOP853",)
    nodes = [2] * len(system.box)
    for share in sorted(SHARES, reverse=True):
        exact = Grid(system, tuple(nodes), MOST_TIME_NODES, methods[0], EXACT * rtol)
        grid = _fewest_nodes(exact, share * rtol)
        nodes = list(grid.nodes)
        for method in methods:
            within = _loosest(replace(grid, method=method), rtol)
            if within is not None:
                yield within


def _fewest_nodes(grid: Grid, target: float) -> Grid:
    """Nodes that are raised where that lowers the error most, then lowered, in time at last."""
    states = grid.integrated()
    while grid.error(states) > target and max(grid.nodes) < MOST_NODES:
        tried = [_with_nodes(grid, j, grid.nodes[j] + 1) for j in range(len(grid.nodes))]
        tried += [replace(grid, nodes=tuple(size + 1 for size in grid.nodes))]
        # errors of a single parameter show only once those of the others are small
        errors = [each.error(each.integrated()) for each in tried]
        gains = [
            math.log(grid.error(states) / error) / math.log(each.count / grid.count)
            for each, error in zip(tried, errors, strict=True)
        ]
        grid = tried[int(np.argmax(gains))]
        states = grid.integrated()
    lowered = True
    while lowered:
        lowered = False
        for j in np.argsort([-size for size in grid.nodes]):
            fewer = _with_nodes(grid, int(j), grid.nodes[j] - 1)
            if fewer.nodes[j] > 1 and fewer.error(fewer.integrated()) <= target:
                grid, lowered = fewer, True
    return grid


def _with_nodes(grid: Grid, j: int, size: int) -> Grid:
    return replace(grid, nodes=(*grid.nodes[:j], size, *grid.nodes[j + 1 :]))


def _loosest(grid: Grid, rtol: float) -> Grid | None:
    """The loosest tolerance, and then the fewest times, that are within the tolerance."""
    for tolerance in TOLERANCES:
        within = replace(grid, tolerance=float(tolerance))
        if within.error(within.integrated()) <= rtol:
            break
    else:
        return None
    for times in itertools.takewhile(lambda n: n < grid.times, _growing()):
        fewer = replace(within, times=times)
        if fewer.error(fewer.integrated()) <= rtol:
            return fewer
    return within


def _growing() -> Iterator[int]:
    """Numbers of nodes in time that are tried."""
    size = 4.0
    while True:
        yield round(size)
        size = max(1.08 * size, size + 1.0)


def _fastest(runs: list[Callable[[], object]], repetitions: int) -> list[float]:
    """Least processor seconds of calls made in turns."""
    seconds: list[list[float]] = [[] for _ in runs]
    for _ in range(repetitions):
        for run, spent in zip(runs, seconds, strict=True):
            began = time.process_time()
            run()
            spent.append(time.process_time() - began)
    return [min(spent) for spent in seconds]


if __name__ == "__main__":
    main()
