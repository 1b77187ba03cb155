"""What the choices of the engine are worth: python tests/benchmarks/choices.py

Each choice is undone on its own, by an option or by replacing one function, and the solve is made
once with the same inner tolerance (one attempt). Errors are relative to each unknown's size,
against SciPy trajectories at 256 random interior points and at corners × 21 times. A second table
says for each choice how much larger errors are and how much longer a solve takes without it;
``--update`` writes that one to docs/engine.md.
"""

from __future__ import annotations

import os

os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")

import statistics
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path
from typing import Any
from unittest import mock

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "src")]

import numpy as np  # noqa: E402

import rankone as ro  # noqa: E402
from examples import coupled, kirchhoff, linear, lotka_volterra, robertson  # noqa: E402
from rankone.solvers.engines import train_engine as engine  # noqa: E402
from rankone.solvers.engines import train_length as nodes  # noqa: E402
from rankone.solvers.engines import train_sweep as sweep  # noqa: E402
from rankone.solvers.verification.reference import integrate_reference  # noqa: E402
from rankone.tensors.train import truncated_svd  # noqa: E402
from tests.benchmarks.report import machine, update  # noqa: E402

AS_IT_IS = "as it is"
PROBLEMS = {
    "linear": (linear.problem, 1e-6),
    "coupled": (coupled.problem, 1e-6),
    "Lotka–Volterra, T = 6": (lotka_volterra.problem, 1e-6),
    "Kirchhoff, T = 1": (kirchhoff.motion(1), 1e-4),
    "Kirchhoff, T = 3": (kirchhoff.motion(3), 1e-3),
    "Robertson": (robertson.problem, 1e-4),
}


class BothWays(sweep.Sweeper):
    """Solve the pairs on the way right as well."""

    def iterate(self, tolerance: float) -> tuple[float, list[Any]]:
        for b in range(self.dimensions - 1):
            new, _ = self._pair_block(b)
            shape = self.cores[b + 1].shape
            rows = self.cores[b + 1].reshape(shape[0], -1)
            left, weights, right = truncated_svd(new, tolerance, self.max_rank, rows)
            self.cores[b] = left.reshape(*self.cores[b].shape[:-1], weights.size)
            self.cores[b + 1] = (weights[:, None] * right).reshape(weights.size, *shape[1:])
            self._changed(b)
            self._contract_left(b + 1)
        with mock.patch.object(self, "_shift_right"), mock.patch.object(self, "_contract_left"):
            return super().iterate(tolerance)


class Unsettled(sweep.Sweeper):
    """Leave the first core as the sweep left it."""

    def settle(self, tolerance: float, steps: int) -> float:
        return super().settle(tolerance, steps) if self.dimensions == 0 else 0.0


def _full_svd(matrix: Any, tolerance: float, max_rank: int, rows: Any = None) -> Any:
    return truncated_svd(matrix, tolerance, max_rank)


def _no_growth(*_: Any, **__: Any) -> Callable[[float], float]:
    return lambda t: 1.0


@contextmanager
def _replaced(module: Any, name: str, value: Any) -> Iterator[None]:
    with mock.patch.object(module, name, value):
        yield


VARIANTS: dict[
    str, tuple[dict[str, Any], Callable[[], AbstractContextManager[None]], list[str]]
] = {
    AS_IT_IS: ({}, nullcontext, list(PROBLEMS)),
    "Gauss–Legendre nodes": ({"basis": "legendre"}, nullcontext, list(PROBLEMS)[1:]),
    "sweeps both ways": (
        {},
        lambda: _replaced(engine, "Sweeper", BothWays),
        list(PROBLEMS)[1:],
    ),
    "first core not settled": (
        {},
        lambda: _replaced(engine, "Sweeper", Unsettled),
        list(PROBLEMS)[1:],
    ),
    "full SVD": (
        {},
        lambda: _replaced(sweep, "truncated_svd", _full_svd),
        ["Kirchhoff, T = 1", "Kirchhoff, T = 3"],
    ),
    "frame not widened": (
        {},
        lambda: _replaced(engine, "widened", lambda cores, extra: list(cores)),
        list(PROBLEMS)[1:],
    ),
    "tolerance not divided by growth": (
        {},
        lambda: _replaced(engine, "amplification", _no_growth),
        ["Lotka–Volterra, T = 6", "Kirchhoff, T = 3", "Robertson"],
    ),
    "all entries kept": (
        {},
        lambda: _replaced(engine, "thinned", lambda cores, tolerance: list(cores)),
        ["Kirchhoff, T = 1", "Kirchhoff, T = 3", "Robertson"],
    ),
    "known functions to the tolerance": (
        {},
        lambda: _replaced(nodes, "FEW_PARAMETERS", 0),
        ["linear", "Lotka–Volterra, T = 6"],
    ),
}


LEAST_RATIO = 1.05
"""Smaller ratios cannot be told from one."""
HEADERS = (
    "problem",
    "rtol",
    "engine",
    "random points",
    "corners",
    "largest rank",
    "entries",
    "solve",
)


def main() -> None:
    compiled = {title: ro.compile(problem) for title, (problem, _) in PROBLEMS.items()}
    rows = []
    for title, (_, rtol) in PROBLEMS.items():
        exact = _trajectories(compiled[title])
        for variant, (options, replacement, titles) in VARIANTS.items():
            if title not in titles:
                continue
            print(f"{title}, {variant} ...", file=sys.stderr, flush=True)
            with replacement():
                solution, seconds = _solve(compiled[title], rtol, options)
            row = [title, f"{rtol:.0e}".replace("e-0", "e-"), variant]
            if solution.time[1] < solution.metadata.horizon[1]:
                row += [solution.status.value, "", "", "", ""]
            else:
                row += [f"{error:.1e}" for error in _errors(solution, *exact)]
                cores = (core for slab in solution.outcome.slabs for core in slab.cores)
                entries = sum(np.count_nonzero(core) for core in cores)
                row += [str(solution.rank), f"{entries:,}", f"{seconds:.2g} s"]
            rows.append(row)
    print(_table(HEADERS, rows))
    worth = worth_of_choices(rows)
    print(f"\n{worth}")
    if "--update" in sys.argv[1:]:
        update(
            ROOT / "docs" / "engine.md", f"{worth}\n\nMeasured on {', '.join(machine().values())}."
        )


def worth_of_choices(rows: Sequence[Sequence[str]]) -> str:
    """For each choice by how much errors and seconds grow without it, where they grow most."""
    usual = {row[0]: row for row in rows if row[2] == AS_IT_IS}
    lines = []
    for variant in VARIANTS:
        solved = [row for row in rows if row[2] == variant != AS_IT_IS and row[-1]]
        failures = [row[0] for row in rows if row[2] == variant and not row[-1]]
        if solved:
            worst = [_largest_ratio(solved, usual, column) for column in (3, 4, 7)]
            lines.append([variant, *worst, ", ".join(failures) or "–"])
    headers = ("choice undone", "error inside", "error at corners", "time", "not solved")
    return _table(headers, lines)


def _largest_ratio(
    rows: Sequence[Sequence[str]], usual: dict[str, Sequence[str]], column: int
) -> str:
    """The largest ratio of a column to the same as it is, and the problem; a dash for none."""
    ratio, problem = max(
        (float(row[column].split()[0]) / float(usual[row[0]][column].split()[0]), row[0])
        for row in rows
    )
    if ratio < LEAST_RATIO:
        return "–"
    return f"× {ratio:,.0f} ({problem})" if ratio > 10 else f"× {ratio:.1f} ({problem})"


def _table(headers: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    rule = ["---"] * len(headers)
    return "\n".join(f"| {' | '.join(row)} |" for row in [headers, rule, *rows])


def _solve(
    compiled: ro.CompiledProblem, rtol: float, options: dict[str, Any]
) -> tuple[ro.Solution, float]:
    """The solution after one attempt, and the median seconds of five."""
    seconds = []
    for _ in range(5):
        began = time.perf_counter()
        solution = compiled.solve(rtol, max_attempts=1, **options)
        seconds.append(time.perf_counter() - began)
    return solution, statistics.median(seconds)


def _trajectories(compiled: ro.CompiledProblem) -> tuple[Any, Any, Any]:
    """Times, points (random ones, then corners) and states."""
    system = compiled.system
    box = np.array(system.box)
    d = len(box)
    inside = np.random.default_rng(4711).uniform(box[:, 0], box[:, 1], (256, d))
    corners = np.stack(np.meshgrid(*box, indexing="ij"), axis=-1).reshape(-1, d)
    points = np.concatenate([inside, corners])
    times = np.linspace(*system.horizon, 21)
    return times, points, integrate_reference(system, points, system.horizon, 1e-10)(times)


def _errors(solution: ro.Solution, times: Any, points: Any, exact: Any) -> tuple[float, float]:
    """Largest error at random interior points and at corners."""
    values = {
        name: column[:, None] for name, column in zip(solution.parameters, points.T, strict=True)
    }
    exact = exact[: len(solution.unknowns)]
    errors = np.abs(solution(times, values) - exact)
    errors = errors.max(axis=2) / np.abs(exact).max(axis=(1, 2))[:, None]
    return float(errors[:, :256].max()), float(errors[:, 256:].max())


if __name__ == "__main__":
    main()
