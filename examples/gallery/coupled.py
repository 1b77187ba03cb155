"""The coupled model: error against the updates of the coupling.

Each equation is solved for its own unknown with the others lagged (Gauss-Seidel); the run is
stopped after 1, 2, 3, ... rounds over the equations.
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
from examples import coupled

LEGENDRE = {"elements": "legendre", "time_nodes": 10, "parameter_nodes": 8, "time_slabs": 2}
VARIANTS: dict[str, dict[str, Any]] = {
    "slides, 8 modes": {"preset": "slides", **LEGENDRE, "max_modes": 8},
    "Volterra form, amplitudes, 8 modes": {
        "preset": "slides",
        **LEGENDRE,
        "formulation": "volterra",
        "max_modes": 8,
    },
    "defaults, 8 modes": {**LEGENDRE, "max_modes": 8},
    "defaults, 16 modes": {**LEGENDRE, "max_modes": 16},
}
POINT = (1.2, 0.8, 1.0)


@dataclass(frozen=True)
class Coupled:
    """Errors after each number of updates, and curves of the default solve."""

    updates: tuple[int, ...]
    errors: dict[str, list[float]]
    plain: float
    times: Array
    curves: Array
    exact: Array


def compute(
    updates: tuple[int, ...] = (1, 2, 3, 4, 5, 6, 8, 10, 14), variants: tuple[str, ...] = ()
) -> Coupled:
    compiled = ro.compile(coupled.problem)
    errors: dict[str, list[float]] = {}
    for name in variants or VARIANTS:
        errors[name] = []
        for count in updates:
            solution = compiled.solve(
                rtol=1e-6,
                method="greedy",
                check=0,
                tolerance=1e-7,
                max_iterations=count,
                **{"max_attempts": 1, **VARIANTS[name]},
            )
            reached = bool(solution.outcome.slabs)
            errors[name].append(error_of(compiled, solution) if reached else float("nan"))
    default = compiled.solve(rtol=1e-3, method="greedy")
    times = np.linspace(0, 0.5, 41)
    a1, a2, a3 = POINT
    curves = default(t=times, a1=a1, a2=a2, a3=a3)
    exact = trajectories(compiled, np.array([POINT]), times[::4])[:, 0]
    return Coupled(updates, errors, error_of(compiled, default), times, curves, exact)


def report(found: Coupled) -> str:
    lines = []
    shown = [n for n in (1, 2, 4, 8, 14) if n in found.updates]
    for name, errors in found.errors.items():
        lines.append(
            f"- **{name}**: "
            + ", ".join(f"{errors[found.updates.index(n)]:.1e} after {n}" for n in shown)
            + " updates."
        )
    lines.append(
        f'- `method="greedy"` without further options at `rtol=1e-3`: error {found.plain:.1e}.'
    )
    return "\n".join(lines)


def draw(found: Coupled) -> Figure:
    drawn, ((left, right),) = figure(1, 2, figsize=(9.3, 3.4))
    for name, errors in found.errors.items():
        left.semilogy(found.updates, errors, "o-", label=name)
    left.set(xlabel="updates of the coupling", ylabel="error", title="coupled model")
    left.legend()
    for i, name in enumerate(("u1", "u2", "u3")):
        right.plot(found.times, found.curves[i], color=f"C{i}", label=name)
        right.plot(found.times[::4], found.exact[i], "o", color=f"C{i}", mfc="none")
    start = ", ".join(f"{a:g}" for a in POINT)
    right.set(xlabel="t", title=f"from ({start}): PGD (lines), ODE solver (circles)")
    right.legend()
    return drawn


def main(folder: Path) -> None:
    found = compute()
    publish("coupled", report(found), {"coupled": draw(found)}, folder)


if __name__ == "__main__":
    run_script(main)
