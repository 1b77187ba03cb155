"""Five methods on six systems: error against modes, and error against time.

The classic method with 1, 2, 3, ... modes for each unknown and slab: as on the slides (derivative
form, Galerkin, amplitudes), with minimal residual instead of Galerkin, with the Volterra form
instead of the derivative form, and with all modes updated on the Volterra form; against
``method="train"`` with tighter and tighter tolerances, whose modes are its largest rank. Legendre
elements, so that errors are those of the methods and not of linear elements.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent))

import numpy as np
from common import (
    ROOT,
    Figure,
    error_of,
    figure,
    lotka_volterra_until,
    march,
    publish,
    run_script,
    table,
)

import rankone as ro
from examples import coupled, decay, free_fall, kirchhoff, linear

PAGE = ROOT / "docs" / "classic-method.md"
MODES = (1, 2, 3, 4, 6, 8, 12)
RTOLS = (1e-1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8)
UNSETTLED = 1e-3
VARIANTS: dict[str, dict[str, Any]] = {
    "slides": {"preset": "slides"},
    "minimal residual": {"preset": "slides", "projection": "minimal-residual"},
    "Volterra": {"preset": "slides", "formulation": "volterra"},
    "all modes": {},
}


@dataclass(frozen=True)
class Case:
    """A system with its discretisation: slabs, nodes in time and in the parameters."""

    problem: ro.Problem
    slabs: int
    time_nodes: int
    parameter_nodes: int
    tightest: float = 1e-8
    """Tightest tolerance asked of the train."""


CASES = {
    "decay, T = 2": Case(decay.problem, 1, 20, 20),
    "linear, T = 5": Case(linear.problem, 1, 4, 48),
    "free fall, T = 3": Case(free_fall.problem, 2, 20, 16),
    "coupled, T = 0.5": Case(coupled.problem, 2, 10, 8),
    "Lotka–Volterra, T = 1": Case(lotka_volterra_until(1), 5, 12, 10),
    "Kirchhoff, T = 0.25": Case(kirchhoff.motion(0.25), 1, 8, 5, 1e-6),
}


@dataclass(frozen=True)
class Point:
    """One solve: modes allowed (rank of the train), seconds, error, and how it ended."""

    modes: int
    seconds: float
    error: float
    ending: str


Study = dict[str, dict[str, list[Point]]]


def ending(solution: ro.Solution, end: float) -> str:
    """Whether the lagged terms settled on all slabs."""
    if not solution.outcome.slabs or solution.time[1] < end:
        return "diverged"
    if solution.metadata.method == "train":
        return "settled"
    lagged = [record.residuals for record in solution.history if len(record.residuals) > 1]
    return "stalled" if any(changes[-1] > UNSETTLED for changes in lagged) else "settled"


def compute(
    cases: tuple[str, ...] = (), modes: tuple[int, ...] = MODES, rtols: tuple[float, ...] = RTOLS
) -> Study:
    study: Study = {}
    for name in cases or CASES:
        case = CASES[name]
        compiled = ro.compile(case.problem)
        end = compiled.system.horizon[1]
        lines: dict[str, list[Point]] = {}
        for variant, options in VARIANTS.items():
            lines[variant] = []
            for count in modes:
                given = {
                    **options,
                    "elements": "legendre",
                    "time_slabs": case.slabs,
                    "time_nodes": case.time_nodes,
                    "parameter_nodes": case.parameter_nodes,
                    "max_modes": count,
                    "max_attempts": 1,
                    "tolerance": 1e-9,
                }
                solution, seconds = march(compiled, rtol=1e-6, method="greedy", **given)
                error = error_of(compiled, solution) if solution.outcome.slabs else float("nan")
                lines[variant].append(Point(count, seconds, error, ending(solution, end)))
        lines["train"] = []
        for rtol in rtols:
            if rtol >= case.tightest:
                solution, seconds = march(compiled, rtol=rtol, method="train", max_attempts=1)
                error = error_of(compiled, solution)
                lines["train"].append(Point(solution.rank, seconds, error, ending(solution, end)))
        study[name] = lines
    return study


def cell(point: Point) -> str:
    mark = {"settled": "", "stalled": " †", "diverged": " ‡"}[point.ending]
    return f"{point.error:.0e}{mark}" if np.isfinite(point.error) else f"–{mark}"


def report(study: Study) -> str:
    counts = sorted({p.modes for lines in study.values() for p in lines["slides"]})
    shown = [n for n in counts if n in (2, 4, 8, 12)] or counts
    head = ["system", "method", *(f"{n} modes" for n in shown), "smallest", "modes", "seconds"]
    rows = []
    for name, lines in study.items():
        for variant, points in lines.items():
            by_modes = {point.modes: cell(point) for point in points}
            finite = [point for point in points if np.isfinite(point.error)]
            least = min((point.error for point in finite), default=float("nan"))
            # the fewest modes that come near the smallest error
            best = next((point for point in finite if point.error <= 1.5 * least), None)
            cells = ["" if variant == "train" else by_modes[n] for n in shown]
            found = [cell(best), f"{best.modes}", f"{best.seconds:.2g}"] if best else ["–"] * 3
            rows.append([name, variant, *cells, *found])
    note = (
        "† the lagged terms did not settle in up to 30 updates: the last one still changes an "
        "unknown by more than 1e-3 of its size. ‡ the lagged iteration diverged, or a slab was "
        "not finished. *Smallest* is the error of the fewest modes within a factor of 1.5 of the "
        "smallest error, with its modes (train: largest rank) and seconds."
    )
    return f"{table(head, rows).replace('|--:', '|---', 1)}\n\n{note}"


def draw(study: Study) -> dict[str, Figure]:
    drawn = {}
    for title, label in (("modes", "modes (train: rank)"), ("seconds", "seconds")):
        rows = -(-len(study) // 3)
        one, grid = figure(rows, 3, figsize=(9.3, 2.9 * rows))
        for axes, (name, lines) in zip(grid.flat, study.items()):
            for i, (variant, points) in enumerate(lines.items()):
                x = [getattr(point, title) for point in points]
                y = [point.error for point in points]
                style = "k*--" if variant == "train" else f"C{i}o-"
                (axes.semilogy if title == "modes" else axes.loglog)(x, y, style, label=variant)
                lost = [point for point in points if not np.isfinite(point.error)]
                if lost:  # at the upper edge
                    x = [getattr(point, title) for point in lost]
                    edge = axes.get_xaxis_transform()
                    axes.plot(x, [0.97] * len(x), f"C{i}x", transform=edge)
            axes.set(title=name, xlabel=label)
            low, high = axes.get_ylim()
            if high < 1e-10:  # exact to rounding
                axes.set_ylim(1e-16, 1e-8)
            low, high = axes.get_xlim()
            if title == "seconds":
                axes.xaxis.set_minor_formatter("")
                if high < 20 * low:  # at least two labels
                    axes.set_xlim(0.3 * low, 3 * high)
            if title == "modes":
                axes.xaxis.get_major_locator().set_params(integer=True)
        for axes in list(grid.flat)[len(study) :]:
            axes.remove()
        grid[0, 0].set_ylabel("error")
        grid[0, 0].legend(fontsize=7)
        drawn[f"convergence_{title}"] = one
    return drawn


def main(folder: Path) -> None:
    study = compute()
    publish("convergence_study", report(study), draw(study), folder, PAGE)


if __name__ == "__main__":
    run_script(main)
