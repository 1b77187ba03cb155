"""Free fall with drag: error against the updates of the lagged nonlinear term.

The run is stopped after 1, 2, 3, ... updates of u^2; for each number of updates the error against
SciPy trajectories is measured.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent))

import numpy as np
from common import Array, Figure, error_of, figure, publish, run_script, trajectories

import rankone as ro
from examples import free_fall

LEGENDRE = {"elements": "legendre", "time_nodes": 20, "parameter_nodes": 16}
VARIANTS: dict[str, dict[str, Any]] = {
    "slides, 1 slab": {"preset": "slides", "time_slabs": 1},
    "slides, 2 slabs": {"preset": "slides", "time_slabs": 2},
    "slides on Legendre elements, 2 slabs": {"preset": "slides", "time_slabs": 2, **LEGENDRE},
    "defaults, 1 slab": {"time_slabs": 1, **LEGENDRE},
    "defaults, 2 slabs": {"time_slabs": 2, **LEGENDRE},
}
SHOWN = (0.1, 0.4, 0.8, 1.5)


@dataclass(frozen=True)
class Fall:
    """Errors after each number of updates, and curves of the default solve."""

    updates: tuple[int, ...]
    errors: dict[str, list[float]]
    plain: float
    times: Array
    curves: Array
    exact: Array


def compute(updates: tuple[int, ...] = (*range(1, 13), 14, 16, 20, 25, 30)) -> Fall:
    compiled = ro.compile(free_fall.problem)
    errors: dict[str, list[float]] = {}
    for name, options in VARIANTS.items():
        errors[name] = []
        for count in updates:
            solution = compiled.solve(
                rtol=1e-6,
                method="greedy",
                check=0,
                max_attempts=1,
                tolerance=1e-8,
                max_iterations=count,
                **options,
            )
            reached = bool(solution.outcome.slabs)
            errors[name].append(error_of(compiled, solution) if reached else float("nan"))
    default = compiled.solve(rtol=1e-4, method="greedy")
    times = np.linspace(0, 3, 61)
    curves = default.grid(t=times, C_D=np.array(SHOWN))[0]
    exact = trajectories(compiled, np.array(SHOWN)[:, None], times[::4])[0]
    return Fall(updates, errors, error_of(compiled, default), times, curves, exact)


def report(found: Fall) -> str:
    lines = []
    for name, errors in found.errors.items():
        first = next(n for n, e in zip(found.updates, errors) if e <= 1.5 * np.nanmin(errors))
        failed = sum(np.isnan(errors))
        lines.append(
            f"- **{name}**: "
            + ", ".join(
                f"{e:.1e} after {n}" for n, e in zip(found.updates, errors) if n in (2, 5, 10, 30)
            )
            + f" updates; smallest {np.nanmin(errors):.1e}, near it from update {first} on"
            + (f"; {failed} runs diverged." if failed else ".")
        )
    lines.append(
        f'- `method="greedy"` without further options at `rtol=1e-4`: error {found.plain:.1e}.'
    )
    return "\n".join(lines)


def draw(found: Fall) -> Figure:
    drawn, ((left, right),) = figure(1, 2, figsize=(9.3, 3.4))
    for name, errors in found.errors.items():
        left.semilogy(found.updates, errors, "o-", label=name)
    left.set(xlabel="updates of the lagged term", ylabel="error", title="free fall")
    left.set_ylim(top=1e3)
    left.legend(loc="upper right", fontsize=7)
    for i, drag in enumerate(SHOWN):
        right.plot(found.times, found.curves[:, i], color=f"C{i}", label=f"$C_D$ = {drag:g}")
        right.plot(found.times[::4], found.exact[i], "o", color=f"C{i}", mfc="none")
    right.set(xlabel="t", ylabel="velocity", title="PGD (lines), ODE solver (circles)")
    right.legend()
    return drawn


def main(folder: Path) -> None:
    found = compute()
    publish("free_fall", report(found), {"free_fall": draw(found)}, folder)


if __name__ == "__main__":
    run_script(main)
