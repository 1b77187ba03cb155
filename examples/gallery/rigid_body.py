"""A rigid body in an ideal fluid (Kirchhoff): velocities against the ODE solver.

The classic method up to the time 0.25, the tensor train up to 1; the six initial velocities are
parameters, so that there are seven dimensions.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

import numpy as np
from common import Array, Figure, error_of, figure, march, publish, run_script, trajectories

import rankone as ro
from examples import kirchhoff

START = np.array([0.9, 0.6, 0.8, 0.55, 0.7, 0.95])


@dataclass(frozen=True)
class Run:
    """A solve and the velocities from one initial state."""

    method: str
    solution: ro.Solution
    seconds: float
    error: float
    times: Array
    curves: Array
    exact: Array


def compute(rtol: float = 1e-3, tight: float = 1e-4) -> dict[float, Run]:
    runs = {}
    for end, method, asked in ((0.25, "greedy", rtol), (1.0, "train", tight)):
        compiled = ro.compile(kirchhoff.motion(end))
        solution, seconds = march(compiled, rtol=asked, method=method)
        error = error_of(compiled, solution)
        times = np.linspace(0, end, 101)
        curves = solution(times, dict(zip(solution.parameters, START)))
        exact = trajectories(compiled, START[None], times[::8])[:, 0]
        runs[end] = Run(method, solution, seconds, error, times, curves, exact)
    return runs


def report(runs: dict[float, Run]) -> str:
    return "\n".join(
        f'- **T = {end:g}, `method="{run.method}"`**, `rtol={run.solution.rtol:.0e}`: '
        f"error {run.error:.1e} in {run.seconds:.2f} s, "
        f"{len(run.solution.ranks)} time slab(s), largest rank of the train "
        f"{run.solution.rank}; at a corner of the box up to {run.solution.corner_error:.1e}."
        for end, run in runs.items()
    )


def draw(runs: dict[float, Run]) -> Figure:
    drawn, grid = figure(2, 2, figsize=(9.3, 5.6))
    for row, (end, run) in zip(grid, runs.items()):
        for axes, first, label in zip(row, (0, 3), ("u", "ω")):
            for i in range(3):
                axes.plot(run.times, run.curves[first + i], color=f"C{i}", label=f"{label}{i + 1}")
                axes.plot(run.times[::8], run.exact[first + i], "o", color=f"C{i}", mfc="none")
            kind = "translational" if label == "u" else "angular"
            axes.set(xlabel="t", title=f"{run.method}, T = {end:g}: {kind} velocity")
            axes.legend(ncols=3)
    return drawn


def main(folder: Path) -> None:
    found = compute()
    publish("rigid_body", report(found), {"rigid_body": draw(found)}, folder)


if __name__ == "__main__":
    run_script(main)
