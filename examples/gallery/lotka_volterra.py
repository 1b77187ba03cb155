"""Predators and prey from uncertain initial populations: curves and orbits against the ODE solver.

The classic method up to the time 1; the tensor train over two periods.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

import numpy as np
from common import (
    Array,
    Figure,
    error_of,
    figure,
    lotka_volterra_until,
    march,
    publish,
    run_script,
    trajectories,
)

import rankone as ro

STARTS = np.array([[8.0, 4.0], [9.0, 4.5], [10.0, 5.0], [12.0, 6.0]])


@dataclass(frozen=True)
class Run:
    """A solve and curves from a few initial states, the ODE solver's at every eighth time."""

    method: str
    solution: ro.Solution
    seconds: float
    error: float
    times: Array
    curves: Array
    exact: Array


def compute(rtol: float = 1e-3, tight: float = 1e-6) -> dict[float, Run]:
    runs = {}
    for end, method, asked in ((1.0, "greedy", rtol), (6.0, "train", tight)):
        compiled = ro.compile(lotka_volterra_until(end))
        solution, seconds = march(compiled, rtol=asked, method=method)
        error = error_of(compiled, solution)
        times = np.linspace(0, end, 401)
        curves = solution(times, {"x0": STARTS[:, :1], "y0": STARTS[:, 1:]})
        runs[end] = Run(
            method,
            solution,
            seconds,
            error,
            times,
            curves,
            trajectories(compiled, STARTS, times[::8]),
        )
    return runs


def report(runs: dict[float, Run]) -> str:
    return "\n".join(
        f'- **T = {end:g}, `method="{run.method}"`**, `rtol={run.solution.rtol:.0e}`: '
        f"error {run.error:.1e} in {run.seconds:.2f} s, "
        f"{len(run.solution.ranks)} time slab(s), largest rank of the train {run.solution.rank}."
        for end, run in runs.items()
    )


def draw(runs: dict[float, Run]) -> Figure:
    drawn, grid = figure(2, 2, figsize=(9.3, 5.8))
    for (left, right), (end, run) in zip(grid, runs.items()):
        for i in range(len(STARTS)):
            for unknown, style in ((0, "-"), (1, "--")):
                left.plot(run.times, run.curves[unknown, i], style, color=f"C{i}")
                left.plot(
                    run.times[::8], run.exact[unknown, i], "o", color=f"C{i}", mfc="none", ms=3
                )
            start = ", ".join(f"{a:g}" for a in STARTS[i])
            right.plot(*run.curves[:, i], color=f"C{i}", label=f"({start})")
            right.plot(*run.exact[:, i], "o", color=f"C{i}", mfc="none", ms=3)
        left.set(xlabel="t", title=f"{run.method}, T = {end:g}: x (solid), y (dashed)")
        right.set(xlabel="x", ylabel="y", title="orbits; ODE solver: circles")
    grid[0, 1].legend(title="(x0, y0)")
    return drawn


def main(folder: Path) -> None:
    found = compute()
    publish("lotka_volterra", report(found), {"lotka_volterra": draw(found)}, folder)


if __name__ == "__main__":
    run_script(main)
