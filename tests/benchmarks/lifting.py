"""Lift every published system that does not separate: python tests/benchmarks/lifting.py

Prints a Markdown table: how many unknowns are added, the seconds of lifting and code generation,
the measured errors of ``method="train"`` on the lifted system and of ``method="cross"`` on the
system as it is, over the tolerance, and the largest difference of the two solutions at 50 random
points, relative to the size of each unknown and divided by the sum of their measured errors.
"""

from __future__ import annotations

import os

os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")

import argparse
import sys
import time
import warnings
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "src")]

import rankone as ro  # noqa: E402
from tests.reference.published import PUBLISHED  # noqa: E402

POINTS, TIMES = 50, 15


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rtol", type=float, default=1e-4)
    parser.add_argument("--seconds", type=float, default=10.0, help="limit of each solve")
    given = parser.parse_args()
    warnings.simplefilter("ignore", ro.RankoneWarning)
    print("| system | added | lift, s | train, s | train | cross | difference |")
    print("| --- | ---: | ---: | ---: | ---: | ---: | ---: |")
    for name, system in PUBLISHED.items():
        compiled = ro.compile(system.problem())
        if compiled.quadratic is None:
            print(f"| {name} | {row(compiled, given.rtol, given.seconds)} |", flush=True)


def row(compiled: ro.CompiledProblem, rtol: float, seconds: float) -> str:
    """The cells of a system."""
    began = time.perf_counter()
    lifted = compiled.lifted
    if lifted is None:
        return f"{compiled.methods['train'].split('; ')[-1]} | | | | |"
    _ = lifted.source
    lifting = time.perf_counter() - began
    began = time.perf_counter()
    train = compiled.solve(rtol, method="train", effort=seconds / 25)
    spent = time.perf_counter() - began
    cross = compiled.solve(rtol, method="cross", effort=seconds / 25)
    kept = [f"{s.error / rtol:.2g}" if s.success else "refused" for s in (train, cross)]
    apart = f"{difference(train, cross):.2g}" if train.success and cross.success else ""
    return f"{lifted.lifting.count} | {lifting:.2f} | {spent:.1f} | {' | '.join(kept)} | {apart}"


def difference(one: ro.Solution, two: ro.Solution) -> float:
    """Largest difference over the sum of the measured errors."""
    generator = np.random.default_rng(2)
    points = {k: generator.uniform(*v, POINTS)[:, None] for k, v in one.parameters.items()}
    times = np.linspace(*one.time, TIMES)
    values = two(t=times, **points)
    apart = np.abs(one(t=times, **points) - values).max(axis=(1, 2))
    return float((apart / np.abs(values).max(axis=(1, 2))).max() / (one.error + two.error))


if __name__ == "__main__":
    main()
