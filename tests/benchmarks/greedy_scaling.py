"""Time of the classic method against nodes: python tests/benchmarks/greedy_scaling.py

The coupled problem (three initial values are parameters) with N nodes in time and in every
parameter, N = 5 ... 40, against one SciPy trajectory for each of the N^3 parameter nodes (timed on
at most 200 of them). Fitted is the slope of log(time) over log(N); the crossing is where the lines
through the measured times meet, in nodes per dimension.
"""

from __future__ import annotations

import os

os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")

import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "src")]

import numpy as np  # noqa: E402
import scipy.integrate  # noqa: E402

import rankone as ro  # noqa: E402
from examples import coupled  # noqa: E402
from rankone.solvers.greedy import GreedyOptions, solve_greedy  # noqa: E402
from rankone.system import System  # noqa: E402

NODES = (5, 9, 13, 19, 27, 40)
TOLERANCE = 1e-4
VARIANTS = {
    "Legendre elements": {"elements": "legendre"},
    "linear elements": {"elements": "linear"},
    "slides, Volterra form": {"preset": "slides", "weak_form": "volterra", "time_slabs": 2},
}


def seconds(run: Callable[[], object], repeats: int = 3) -> float:
    """Median time of a few runs."""
    times = []
    for _ in range(repeats):
        began = time.perf_counter()
        run()
        times.append(time.perf_counter() - began)
    return statistics.median(times)


def grid_of_trajectories(system: System, nodes: int) -> float:
    """Seconds for one trajectory at each of nodes^3 parameter values, from a sample."""
    rng = np.random.default_rng(1)
    box = np.array(system.BOX)
    count = min(nodes**3, 200)
    points = box[:, 0] + (box[:, 1] - box[:, 0]) * rng.random((count, len(box)))
    times = np.linspace(*system.TIME, nodes)

    def run() -> None:
        for point in points:
            scipy.integrate.solve_ivp(
                lambda t, u: system.rhs(t, u, point),  # noqa: B023
                system.TIME,
                point,
                t_eval=times,
                rtol=TOLERANCE,
                atol=1e-3 * TOLERANCE,
            )

    return seconds(run, 1) / count * nodes**3


def main() -> None:
    compiled = ro.compile(coupled.problem)
    system = compiled.system
    grid = [grid_of_trajectories(system, nodes) for nodes in NODES]
    rows = {"SciPy RK45 on the grid": (grid, [float("nan")] * len(NODES))}
    for name, options in VARIANTS.items():
        times, errors = [], []
        for nodes in NODES:
            chosen = GreedyOptions.of(
                **{
                    "time_slabs": 2,
                    "tolerance": TOLERANCE,
                    "max_attempts": 1,
                    **options,
                    "time_nodes": nodes,
                    "parameter_nodes": nodes,
                }
            )
            outcome = solve_greedy(system, compiled.separated, 1e-2, chosen)
            errors.append(max(outcome.measured.interior) if outcome.measured else float("nan"))
            times.append(
                seconds(
                    lambda chosen=chosen: solve_greedy(
                        system, compiled.separated, 1e-2, chosen, check=0
                    )
                )
            )
        rows[name] = times, errors
    print("| seconds (error) | " + " | ".join(f"N = {n}" for n in NODES) + " | slope | crossing |")
    print("|---" * (len(NODES) + 3) + "|")
    grid_fit = np.polyfit(np.log(NODES), np.log(grid), 1)
    for name, (times, errors) in rows.items():
        fit = np.polyfit(np.log(NODES), np.log(times), 1)
        cells = [
            f"{t:.3g}" + ("" if np.isnan(e) else f" ({e:.0e})")
            for t, e in zip(times, errors, strict=True)
        ]
        crossing = "" if name.startswith("SciPy") else f"N = {_crossing(fit, grid_fit):.2g}"
        print(f"| {name} | " + " | ".join(cells) + f" | {fit[0]:.2f} | {crossing} |")


def _crossing(a: np.ndarray, b: np.ndarray) -> float:
    """Number of nodes at which two fitted lines meet."""
    return float(np.exp((a[1] - b[1]) / (b[0] - a[0])))


if __name__ == "__main__":
    main()
