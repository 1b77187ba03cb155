"""What worker processes are worth: python tests/benchmarks/workers.py

One solve with 1 and with 4 worker processes, on a problem whose trajectories cost more than a
millisecond each: a nonlinear chain with a slow function of the user.
"""

from __future__ import annotations

import os

os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")

import sys
import time
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "src")]

import numpy as np  # noqa: E402
import sympy as sp  # noqa: E402

import rankone as ro  # noqa: E402

TERMS = 600
"""Terms of the series that the function of the user sums up."""


def series(x: Any) -> Any:
    """The sine by a long sum, some microseconds for each number."""
    total, term = np.zeros_like(x), np.array(x)
    for k in range(TERMS):
        total, term = total + term, -term * x * x / ((2 * k + 2) * (2 * k + 3))
    return total


def slope(x: Any) -> Any:
    """Its derivative."""
    return np.cos(x)


def problem() -> ro.Problem:
    """A driven pendulum with damping, three parameters."""
    t, k, c, w = sp.symbols("t k c w")
    x, v = sp.Function("x")(t), sp.Function("v")(t)
    sine = ro.function("sine", series, slope)
    return ro.Problem(
        [sp.Eq(x.diff(t), v), sp.Eq(v.diff(t), -k * sine(x) - c * v + sp.cos(w * t))],
        (t, 0, 6),
        {k: (0.8, 1.2), c: (0.1, 0.3), w: (0.7, 1.3)},
        {x: 1, v: 0},
    )


def main() -> None:
    compiled = ro.compile(problem())
    seconds, values = {}, {}
    for workers in (None, 1, 4):
        began = time.perf_counter()
        solution = compiled.solve(1e-5, method="cross", executor=workers, effort="high")
        seconds[workers] = time.perf_counter() - began
        middle = {name: sum(ends) / 2 for name, ends in solution.parameters.items()}
        values[workers] = solution(np.linspace(0.0, 6.0, 50), middle).tobytes()
        count = sum(record.trajectories for record in solution.history)
        print(
            f"executor={workers}: {seconds[workers]:.2f} s, {count} trajectories, "
            f"{1e3 * seconds[workers] / count:.2f} ms each, {solution.message}",
            flush=True,
        )
    assert len(set(values.values())) == 1, "the bits differ"
    print(f"4 against 1: {seconds[1] / seconds[4]:.2f} x faster, the same bits")
    print(f"1 against none: {seconds[1] / seconds[None]:.2f} x the time")


if __name__ == "__main__":
    main()
