"""Sobol indices of the Kirchhoff body: from the cores of its solution, and by SALib.

Run with one BLAS thread::

    pip install SALib
    OMP_NUM_THREADS=1 python -m tests.benchmarks.sobol

SALib (Herman & Usher, Journal of Open Source Software 2, 2017; Iwanaga, Usher & Herman,
Socio-Environmental Systems Modelling 4, 2022) samples and estimates; the values it needs are those
of the solution, evaluated at its points. Both answer for the same function: what is compared is
the estimate of the indices, not the solve, whose error is measured elsewhere. Times are those
after the solve.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from typing import Any

import numpy as np

import rankone as ro
from examples import kirchhoff
from rankone.solution.statistics.solution_statistics import Sobol


def timed(call: Callable[[], Any]) -> tuple[Any, float]:
    """A result and the seconds it took."""
    start = time.perf_counter()
    return call(), time.perf_counter() - start


def by_sampling(solution: ro.Solution, t: float, samples: int) -> dict[str, Any]:
    """First and total indices of the first unknown at one time, with half widths of intervals of
    95 %, by Saltelli's scheme: ``samples * (parameters + 2)`` evaluations."""
    from SALib.analyze import sobol as analysis
    from SALib.sample import sobol as sampling

    problem = {
        "num_vars": len(solution.parameters),
        "names": list(solution.parameters),
        "bounds": [list(interval) for interval in solution.parameters.values()],
    }
    points = sampling.sample(problem, samples, calc_second_order=False, seed=1)
    values = solution(t=t, **dict(zip(solution.parameters, points.T)))[0]
    found = analysis.analyze(problem, values, calc_second_order=False, seed=1)
    return {**found, "evaluations": len(points)}


def table(sobol: Sobol, sampled: dict[str, Any]) -> str:
    """Both answers, a line for each parameter, with differences over half widths."""
    rows = ["parameter   first   SALib    +-        total   SALib    +-        differences / +-"]
    for j, name in enumerate(sobol.parameters):
        first, total = sobol.first[0, j, 0], sobol.total[0, j, 0]
        s1, c1, st, ct = (float(sampled[key][j]) for key in ("S1", "S1_conf", "ST", "ST_conf"))
        rows.append(
            f"{name:<10} {first:7.4f} {s1:7.4f}  {c1:.1e}  {total:7.4f} {st:7.4f}  {ct:.1e}"
            f"  {(first - s1) / c1:+6.2f} {(total - st) / ct:+6.2f}"
        )
    return "\n".join(rows)


def main() -> None:
    """Print the table and the times."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rtol", type=float, default=1e-5)
    parser.add_argument("--samples", type=int, default=2**16)
    chosen = parser.parse_args()
    solution, solve = timed(lambda: ro.solve(kirchhoff.problem, rtol=chosen.rtol))
    t = solution.time[1]
    sobol, cold = timed(lambda: solution.sobol(t))
    warm = min(timed(lambda: solution.sobol(t))[1] for _ in range(20))
    sampled, sampling = timed(lambda: by_sampling(solution, t, chosen.samples))
    print(f"Kirchhoff, {solution.unknowns[0]} at t = {t:g}, measured error {solution.error:.1e}")
    print(table(sobol, sampled))
    print(f"solve                        {solve:9.4f} s")
    print(f"solution.sobol, first call   {cold:9.4f} s, {sampling / cold:8.0f} times faster")
    print(f"solution.sobol, later calls  {warm:9.4f} s, {sampling / warm:8.0f} times faster")
    print(
        f"SALib, {chosen.samples} samples, {sampled['evaluations']} evaluations of the solution, "
        f"{sampling:.2f} s"
    )
    inside = np.abs(sobol.total[0, :, 0] - sampled["ST"]) <= sampled["ST_conf"]
    print(f"{np.count_nonzero(inside)} of {inside.size} total indices inside of SALib's intervals")


if __name__ == "__main__":
    main()
