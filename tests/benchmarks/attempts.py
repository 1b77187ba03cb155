"""How close each attempt of a solve comes to its tolerance: python tests/benchmarks/attempts.py

For the reference problems and the published systems: the error of each attempt over the tolerance,
as the solve measured it, the trajectories sampled by then, and the work of the solve in millions
of operations. An attempt that ends just above the tolerance costs a second one, and one that ends
far below it wastes. The last lines sum up. Work is counted, so a busy machine changes nothing.
"""

from __future__ import annotations

import os

os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")

import argparse
import json
import math
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "src")]

import rankone as ro  # noqa: E402
from rankone.solvers import attempts  # noqa: E402
from tests.benchmarks.report import TITLES  # noqa: E402
from tests.problems import MEASURED  # noqa: E402
from tests.reference.published import PUBLISHED  # noqa: E402


@dataclass(frozen=True)
class Row:
    """One solve: the errors of its attempts over the tolerance, and what they took."""

    system: str
    rtol: float
    method: str
    success: bool
    errors: tuple[float, ...]
    trajectories: tuple[int, ...]
    work: dict[str, float]
    seconds: float

    @property
    def total(self) -> float:
        return sum(self.work.values())

    def line(self) -> str:
        stages = " ".join(f"{stage} {1e-6 * work:.0f}" for stage, work in self.work.items())
        errors = " ".join(f"{error:.2g}" for error in self.errors)
        counts = " ".join(map(str, self.trajectories))
        cells = [self.system, f"{self.rtol:.0e}".replace("e-0", "e-"), self.method]
        cells += ["yes" if self.success else "no", errors, counts]
        return "| " + " | ".join([*cells, f"{1e-6 * self.total:.0f}", stages]) + " |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rtol", type=float, nargs="+", default=[1e-3, 1e-4, 1e-6])
    parser.add_argument("--only", nargs="+", metavar="NAME", help="names, with wildcards")
    parser.add_argument("--most", type=float, help="leave out solves above this work, in millions")
    parser.add_argument("--json", metavar="PATH", type=Path, help="write the numbers to PATH")
    parser.add_argument("--beside", metavar="PATH", type=Path, help="compare with such numbers")
    arguments = parser.parse_args()
    before = json.loads(arguments.beside.read_text()) if arguments.beside else []
    dear = {(row["system"], row["rtol"]): sum(row["work"].values()) for row in before}
    rows = []
    print("| system | rtol | method | success | errors ÷ rtol | trajectories | work | stages |")
    print("| --- | --: | --- | --- | --- | --: | --: | --- |")
    for rtol in arguments.rtol:
        for name, problem in _problems():
            if arguments.only and not any(fnmatch(name, form) for form in arguments.only):
                continue
            if arguments.most and dear.get((name, rtol), 0.0) > 1e6 * arguments.most:
                continue
            rows.append(_solved(name, problem, rtol))
            print(rows[-1].line(), flush=True)
            if arguments.json:
                arguments.json.write_text(json.dumps([asdict(row) for row in rows]) + "\n")
        print(_summary([row for row in rows if row.rtol == rtol], dear), flush=True)


def _problems() -> Iterator[tuple[str, Callable[[], ro.Problem]]]:
    for name, problem in MEASURED.items():
        yield TITLES.get(name, name), problem
    for name, entry in PUBLISHED.items():
        yield name, entry.problem


def _solved(name: str, problem: Callable[[], ro.Problem], rtol: float) -> Row:
    """Solve, and note each attempt."""
    compiled = ro.compile(problem())
    began = time.process_time()
    with _noted() as errors:
        try:
            solution = compiled.solve(rtol)
        except ro.RankoneError as error:
            seconds = time.process_time() - began
            return Row(name, rtol, type(error).__name__, False, (), (), {}, seconds)
    seconds = time.process_time() - began
    over = tuple(error / rtol for error in errors)
    counts = tuple(getattr(record, "trajectories", 0) for record in solution.history)
    if solution.method != "cross":
        counts = counts[-1:]
    work = dict(solution.outcome.work)
    ended = solution.method, solution.success
    return Row(name, rtol, *ended, over, counts, work, seconds)


@contextmanager
def _noted() -> Iterator[list[float]]:
    """Errors of the attempts made inside."""
    original, errors = attempts.Progress.add, list[float]()

    def noted(progress: Any, error: float, best: float) -> None:
        errors.append(error)
        original(progress, error, best)

    attempts.Progress.add = noted
    try:
        yield errors
    finally:
        attempts.Progress.add = original


def _summary(rows: list[Row], dear: dict[tuple[str, float], float]) -> str:
    """How many solves end with the first attempt, how close, and the work of all."""
    ended = [row for row in rows if row.success and row.method == "cross"]
    single = [row for row in ended if len(row.errors) == 1]
    last = np.array([row.errors[-1] for row in ended])
    work = sum(row.total for row in rows)
    text = f"{sum(row.success for row in rows)} of {len(rows)}; "
    if ended:
        text += f"of {len(ended)} by cross {len(single)} by the first attempt; last error ÷ rtol: "
        text += f"median {np.median(last):.2g}, tenth {np.quantile(last, 0.1):.2g}; "
    text += f"work {1e-9 * work:.2f}e9, {sum(row.seconds for row in rows):.1f} s"
    both = [row for row in rows if row.total and dear.get((row.system, row.rtol))]
    if both:
        logs = [math.log(row.total / dear[row.system, row.rtol]) for row in both]
        text += f"; work over that before: geometric mean {math.exp(np.mean(logs)):.3f}"
        text += f", sum {work / sum(dear[row.system, row.rtol] for row in both):.3f}"
    return text


if __name__ == "__main__":
    main()
