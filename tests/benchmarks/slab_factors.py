"""What solving with the matrix of a slab of the train engine costs.

``python tests/benchmarks/slab_factors.py`` takes D / h - A over states and time nodes, with the
Jacobian A in the middle of a slab, and solves in three ways: by the sparse factors of the whole, by
the Schur form of D, and by its eigenvectors. Seconds are of the processor, for the factors and ten
solutions of twenty right-hand sides; residuals are relative to these. Then the train engine solves
with the factors of the whole alone, and with the Schur form where the Jacobian hardly changes.
"""

from __future__ import annotations

import os

os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")

import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "src")]

import numpy as np  # noqa: E402

import rankone as ro  # noqa: E402
from rankone.solvers.engines import train_operators as inverse_module  # noqa: E402
from rankone.solvers.engines.train_operators import SchurInverse, SlabJacobian, SparseInverse  # noqa: E402
from rankone.support.arrays import Array  # noqa: E402
from rankone.tensors import RadauCollocation  # noqa: E402
from rankone.trajectories.stacks.newton import Solver, elimination_of  # noqa: E402
from rankone.trajectories.system.system import PatternJacobian, pattern_of  # noqa: E402
from tests.benchmarks.many_states import epidemic, heat, mass_action, truss  # noqa: E402

COLUMNS, SOLUTIONS = 20, 10  # Right-hand sides of a solution, and solutions with one matrix
TURNS = 2  # Solves of each kind, of which the faster counts


def shifted(pattern: PatternJacobian, entries: Array, shifts: Array) -> Callable[[Array], Array]:
    """Solutions (m, n, r) with ``shifts`` (m,) minus the Jacobian, for (m, n, r)."""
    elimination = elimination_of(pattern)
    numbers = np.zeros((shifts.size, elimination.stored), dtype=complex)
    numbers[:, elimination.places] -= entries
    numbers[:, elimination.diagonal] += shifts[:, None]
    solver: Solver = elimination.factored(numbers)
    order = elimination.columns

    def solve(right: Array) -> Array:
        m, n, r = right.shape
        rows = right[:, order].transpose(0, 2, 1).reshape(m * r, n)
        found = np.empty((m, n, r), dtype=complex)
        solved = solver(rows, np.repeat(np.arange(m), r))
        found[:, order] = solved.reshape(m, r, n).transpose(0, 2, 1)
        return found

    return solve


def by_eigenvectors(
    pattern: PatternJacobian, entries: Array, derivative: Array
) -> Callable[[Array], Array]:
    """Solutions (n, K, r) by the eigenvectors of the time matrix; one of each pair is enough."""
    values, vectors = np.linalg.eig(derivative)
    upper = np.flatnonzero(values.imag >= 0.0)
    weights = np.where(values[upper].imag > 0.0, 2.0, 1.0)
    back, there = vectors[:, upper] * weights, np.linalg.inv(vectors)[upper]
    solve = shifted(pattern, entries, values[upper])

    def solution(right: Array) -> Array:
        n, count, r = right.shape
        over = right.transpose(1, 0, 2).reshape(count, n * r)
        found = solve((there @ over).reshape(-1, n, r)).reshape(-1, n * r)
        return (back @ found).real.reshape(count, n, r).transpose(1, 0, 2)

    return solution


def compare(name: str, problem: ro.Problem, count: int, share: float) -> None:
    """Print the seconds of all three on the first slab, a share of the horizon."""
    system = ro.compile(problem).system
    pattern = pattern_of(system.jacobian)
    assert pattern is not None
    collocation, (start, end) = RadauCollocation(count), system.horizon
    n, length = system.n_differential, share * (end - start)
    at = start + 0.5 * length
    p = np.array(system.box).mean(axis=1)
    named = dict(zip(system.parameters, p.tolist(), strict=True))
    states = np.asarray(problem.trajectory([at], **named))
    entries = np.broadcast_to(pattern.entries(at, states, p[:, None]), (pattern.rows.size, 1))[:, 0]
    same = np.repeat(entries[:, None], count, axis=1)
    jacobian = SlabJacobian(n, pattern.rows, pattern.columns, same)
    mass, derivative = np.full(n, 1.0 / length), collocation.derivative / length
    right = np.random.default_rng(0).standard_normal((n, count, COLUMNS))

    def by(kind: type[SparseInverse | SchurInverse]) -> Callable[[Array], Array]:
        inverse = kind(jacobian, mass, collocation)
        return lambda b: inverse.solve(b.reshape(n * count, -1)).reshape(b.shape)

    dense = np.zeros((n, n))
    dense[pattern.rows, pattern.columns] = entries
    cells = []
    for make in (
        lambda: by(SparseInverse),
        lambda: by(SchurInverse),
        lambda: by_eigenvectors(pattern, entries, derivative),
    ):
        began = time.process_time()
        solve = make()
        made = time.process_time() - began
        for _ in range(SOLUTIONS):
            found = solve(right)
        spent = time.process_time() - began - made
        off = np.einsum("kj,njr->nkr", derivative, found) - np.einsum("nm,mkr->nkr", dense, found)
        residual = np.abs(off - right).max() / np.abs(right).max()
        cells.append(f"{made:.3f} + {spent:.3f} s, {residual:.0e}")
    print(f"| {name} | {count} | {' | '.join(cells)} |", flush=True)


def solves(name: str, problem: ro.Problem, rtol: float) -> None:
    """Print the seconds of solves by the train engine, in turns."""
    compiled, limit = ro.compile(problem), inverse_module.TRAIN.largest_change
    seconds: dict[float, list[float]] = {-1.0: [], limit: []}
    sweeps = dict.fromkeys(seconds, 0)
    for _ in range(TURNS):
        for change in seconds:
            inverse_module.TRAIN = replace(inverse_module.TRAIN, largest_change=change)
            began = time.process_time()
            solution = compiled.solve(rtol, method="train")
            seconds[change].append(time.process_time() - began)
            assert solution.success
            sweeps[change] = sum(len(record.residuals) for record in solution.history)
    whole, schur = (f"{min(times):.1f} s, {sweeps[c]}" for c, times in seconds.items())
    print(f"| {name} | {whole} | {schur} |", flush=True)


if __name__ == "__main__":
    print("| system | nodes | whole, residual | Schur form | eigenvectors |")
    print("| --- | --- | --- | --- | --- |")
    for nodes in (8, 13):
        compare("heat, 500", heat(500), nodes, 0.04)
        compare("mass action, 300", mass_action(300), nodes, 0.25)
    print("\n| solve | whole: seconds, sweeps | Schur form |\n| --- | --- | --- |")
    solves("heat, 500", heat(500), 1e-5)
    solves("mass action, 300", mass_action(300), 1e-3)
    solves("truss, 60 degrees of freedom", truss(6), 1e-4)
    solves("epidemic, 150 nodes", epidemic(150), 1e-3)
