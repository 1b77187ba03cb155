"""Choices of the engine, measured: python tests/benchmarks/choices.py

Chebyshev–Gauss against Gauss–Legendre parameter nodes (option ``basis``), and sweeps with one
attempt, so that both run with the same inner tolerance. Errors are relative to each unknown's
size, against SciPy trajectories at 256 random interior points and at 64 corners × 21 times.
"""

from __future__ import annotations

import os

os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")

import statistics
import sys
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))
sys.path.insert(0, str(ROOT / "src"))

import numpy as np
from examples import coupled, kirchhoff, lotka_volterra

import rankone as ro
from rankone.solvers.reference import integrate_reference

CASES = [
    ("coupled", coupled.problem, 1e-6),
    ("Lotka–Volterra, T = 6", lotka_volterra.problem, 1e-6),
    ("Kirchhoff, T = 1", kirchhoff.motion(1), 1e-4),
    ("Kirchhoff, T = 3", kirchhoff.motion(3), 1e-3),
]


def main() -> None:
    print("| problem | rtol | basis | random points | corners | largest rank | solve |")
    print("|---|---|---|--:|--:|--:|--:|")
    for title, problem, rtol in CASES:
        compiled = ro.compile(problem)
        for basis in ("legendre", "chebyshev"):
            solution, seconds = _solve(compiled, rtol, basis)
            inside, corners = _errors(compiled, solution)
            print(
                f"| {title} | {rtol:g} | {basis} | {inside:.1e} | {corners:.1e} "
                f"| {solution.rank} | {seconds:.3g} s |",
                flush=True,
            )


def _solve(compiled: ro.CompiledProblem, rtol: float, basis: str) -> tuple[ro.Solution, float]:
    """The solution after one attempt, and the median seconds of three."""
    seconds = []
    for _ in range(3):
        began = time.perf_counter()
        solution = compiled.solve(rtol, basis=basis, max_attempts=1)
        seconds.append(time.perf_counter() - began)
    return solution, statistics.median(seconds)


def _errors(compiled: ro.CompiledProblem, solution: ro.Solution) -> tuple[float, float]:
    """Largest error at random interior points and at corners."""
    rng = np.random.default_rng(4711)
    box = np.array(list(solution.parameters.values()))
    d = len(box)
    inside = rng.uniform(box[:, 0], box[:, 1], (256, d))
    if d <= 6:
        corners = np.stack(np.meshgrid(*box, indexing="ij"), axis=-1).reshape(-1, d)
    else:
        corners = rng.choice(2, size=(64, d)) * (box[:, 1] - box[:, 0]) + box[:, 0]
    times = np.linspace(*solution.time, 21)
    points = np.concatenate([inside, corners])
    exact = integrate_reference(compiled.system, points, *solution.time, 1e-11)(times)
    exact = exact[: len(solution.unknowns)]
    values = {
        name: column[:, None] for name, column in zip(solution.parameters, points.T, strict=True)
    }
    errors = np.abs(solution(times, values) - exact)
    errors = errors.max(axis=2) / np.abs(exact).max(axis=(1, 2))[:, None]
    return float(errors[:, :256].max()), float(errors[:, 256:].max())


if __name__ == "__main__":
    main()
