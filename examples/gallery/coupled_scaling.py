"""The coupled model: time against nodes per dimension, PGD against a grid of ODE solves.

N nodes in time and in each of the three initial values. The grid is one SciPy trajectory (RK45) for
each of its N^3 points: measured in full for small N, for large N the mean time of a sample of
trajectories times N^3.
"""

from __future__ import annotations

import statistics
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent))

import numpy as np
import scipy.integrate
from common import Figure, error_of, figure, publish, run_script, slope, table, trajectories

import rankone as ro
from examples import coupled

NODES = (5, 7, 10, 14, 20, 28, 40)
DIRECT = 14
SAMPLE = 300
TOLERANCE = 1e-5
VARIANTS: dict[str, dict[str, Any]] = {
    "PGD, defaults": {},
    "PGD, linear elements": {"elements": "linear"},
    "PGD, slides with Volterra form": {"preset": "slides", "formulation": "volterra"},
}


@dataclass(frozen=True)
class Scaling:
    """Seconds for each number of nodes, and the errors."""

    nodes: tuple[int, ...]
    grid: list[float]
    stacked: list[float]
    grid_error: float
    times: dict[str, list[float]]
    errors: dict[str, list[float]]

    def crossing(self, name: str) -> float:
        """Number of nodes at which the lines through the logarithms meet."""
        a = np.polyfit(np.log(self.nodes), np.log(self.times[name]), 1)
        b = np.polyfit(np.log(self.nodes), np.log(self.grid), 1)
        return float(np.exp((a[1] - b[1]) / (b[0] - a[0])))


def median_seconds(run: Callable[[], object], repeats: int) -> float:
    times = []
    for _ in range(repeats):
        began = time.perf_counter()
        run()
        times.append(time.perf_counter() - began)
    return statistics.median(times)


def grid_seconds(compiled: ro.CompiledProblem, nodes: int, sample: int = SAMPLE) -> float:
    """Seconds for a trajectory at every point of the grid."""
    system = compiled.system
    axes = [np.linspace(low, high, nodes) for low, high in system.box]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(axes))
    if nodes > DIRECT:
        points = np.random.default_rng(1).choice(points, sample, replace=False)
    times = np.linspace(*system.horizon, nodes)
    began = time.perf_counter()
    for point in points:
        one_trajectory(compiled, point, times)
    return (time.perf_counter() - began) / len(points) * nodes ** len(axes)


def stacked_seconds(compiled: ro.CompiledProblem, nodes: int) -> float:
    """Seconds for all points of the grid integrated as one system, vectorised."""
    system = compiled.system
    axes = [np.linspace(low, high, nodes) for low, high in system.box]
    points = np.stack(np.meshgrid(*axes, indexing="ij")).reshape(len(axes), -1)
    began = time.perf_counter()
    scipy.integrate.solve_ivp(
        lambda t, u: system.rhs(t, u.reshape(3, -1), points).ravel(),
        system.horizon,
        points.ravel(),
        t_eval=np.linspace(*system.horizon, nodes),
        rtol=1e-4,
        atol=1e-7,
    )
    return time.perf_counter() - began


def one_trajectory(compiled: ro.CompiledProblem, point: Any, times: Any) -> Any:
    system = compiled.system
    return scipy.integrate.solve_ivp(
        lambda t, u: system.rhs(t, u, point),
        system.horizon,
        point,
        t_eval=times,
        rtol=1e-4,
        atol=1e-7,
    ).y


def grid_error(compiled: ro.CompiledProblem) -> float:
    """Error of such trajectories at a few points, relative to the size of the unknowns."""
    times = np.linspace(*compiled.system.horizon, 21)
    points = np.random.default_rng(2).uniform(0.5, 1.5, (32, 3))
    exact = trajectories(compiled, points, times)
    got = np.stack([one_trajectory(compiled, point, times) for point in points], axis=1)
    sizes = np.abs(exact).max(axis=(1, 2))
    return float((np.abs(got - exact).max(axis=(1, 2)) / sizes).max())


def compute(
    nodes: tuple[int, ...] = NODES, repeats: int = 3, variants: tuple[str, ...] = ()
) -> Scaling:
    compiled = ro.compile(coupled.problem)
    names = variants or tuple(VARIANTS)
    times: dict[str, list[float]] = {name: [] for name in names}
    errors: dict[str, list[float]] = {name: [] for name in names}
    for name in names:
        for count in nodes:
            options = {
                "time_slabs": 2,
                "tolerance": TOLERANCE,
                "max_attempts": 1,
                **VARIANTS[name],
                "time_nodes": count,
                "parameter_nodes": count,
            }

            def solve(options: dict[str, Any] = options) -> ro.Solution:
                return compiled.solve(rtol=1e-2, method="greedy", check=0, **options)

            errors[name].append(error_of(compiled, solve()))
            times[name].append(median_seconds(solve, 1 if "preset" in options else repeats))
    grid = [grid_seconds(compiled, count) for count in nodes]
    stacked = [stacked_seconds(compiled, count) for count in nodes]
    return Scaling(nodes, grid, stacked, grid_error(compiled), times, errors)


def report(found: Scaling) -> str:
    head = [
        "seconds (error)",
        *(f"N = {n}" for n in found.nodes),
        "slope",
        "last three",
        "crossing",
    ]

    def slopes(times: list[float]) -> list[str]:
        last = slope(found.nodes[-3:], times[-3:])
        return [f"{slope(found.nodes, times):.2f}", f"{last:.2f}"]

    cells = [f"{t:.2g}" + ("" if n <= DIRECT else " *") for n, t in zip(found.nodes, found.grid)]
    rows = [["ODE solver on the grid", *cells, *slopes(found.grid), ""]]
    cells = [f"{t:.2g}" for t in found.stacked]
    rows.append(["ODE solver, all points stacked", *cells, *slopes(found.stacked), ""])
    for name, times in found.times.items():
        cells = [f"{t:.2g} ({e:.0e})" for t, e in zip(times, found.errors[name])]
        rows.append([name, *cells, *slopes(times), f"N = {found.crossing(name):.1f}"])
    note = (
        f"\\* mean time of {SAMPLE} trajectories times N³; without a star every trajectory of the "
        f"grid was run. The ODE solver's error is {found.grid_error:.0e} (RK45 at rtol 1e-4)."
    )
    return f"{table(head, rows)}\n\n{note}"


def draw(found: Scaling) -> Figure:
    drawn, ((axes,),) = figure(1, 1, figsize=(5.6, 3.9))
    direct = [n <= DIRECT for n in found.nodes]
    line = f"ODE solver on the grid, slope {slope(found.nodes, found.grid):.2f}"
    axes.loglog(found.nodes, found.grid, "k-", label=line)
    for full, one, seconds in zip(direct, found.nodes, found.grid):
        axes.loglog(one, seconds, "ko", mfc="k" if full else "none")
    axes.loglog(found.nodes, found.stacked, "k:", label="ODE solver, all points stacked")
    for i, (name, times) in enumerate(found.times.items()):
        label = f"{name}, slope {slope(found.nodes, times):.2f}"
        axes.loglog(found.nodes, times, "s-", color=f"C{i}", label=label)
    axes.set(xlabel="nodes per dimension N", ylabel="seconds", title="coupled model, 4 dimensions")
    axes.set_xticks(found.nodes, [str(n) for n in found.nodes])
    axes.minorticks_off()
    axes.legend()
    return drawn


def main(folder: Path) -> None:
    found = compute()
    publish("coupled_scaling", report(found), {"coupled_scaling": draw(found)}, folder)


if __name__ == "__main__":
    run_script(main)
