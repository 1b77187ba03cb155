"""Answers of solutions: errors of gradients, and seconds for Sobol indices and outputs.

Run ``OMP_NUM_THREADS=1 python -m tests.benchmarks.answers`` in the folder of the project.
"""

from __future__ import annotations

import time

import numpy as np
import sympy as sp

import rankone as ro
from tests.problems import EXAMPLES
from tests.solution.evaluation import test_smaller as gradients


def gradient_error(name, exact, rtol):
    """Largest error of the gradients over the largest sensitivity of each unknown."""
    solution = gradients.solved(name, rtol)
    lower, upper = np.array([*solution.parameters.values()]).T
    times = np.linspace(*solution.time, 9)
    worst = 0.0
    for share in np.random.default_rng(3).random((4, lower.size)):
        p = lower + (upper - lower) * share
        wanted = exact(p)(times)[: len(solution.unknowns)]
        found = solution.gradient(times, dict(zip(solution.parameters, p, strict=True)))
        size = np.abs(wanted).max(axis=(1, 2), keepdims=True)
        worst = max(worst, float((np.abs(found - wanted) / size).max()))
    return worst


def seconds(function):
    """Seconds of a first call, and the least of further ones."""
    taken = []
    for _ in range(6):
        began = time.perf_counter()
        function()
        taken.append(time.perf_counter() - began)
    return taken[0], min(taken[1:])


def main():
    print("gradients against the variational equations")
    for name, rtol in (("coupled", 1e-8), ("lotka_volterra", 1e-8), ("pendulum", 1e-6)):
        print(f"  {name:15} {gradient_error(name, getattr(gradients, name), rtol):.1e}")
    print("Sobol indices at 101 times: first call, later ones")
    for name, rtol in (("chain", 1e-4), ("kirchhoff", 1e-5), ("kirchhoff", 1e-6)):
        solution = ro.solve(EXAMPLES[name].problem, rtol, effort=4)
        times = np.linspace(*solution.time, 101)
        first, later = seconds(lambda s=solution, at=times: s.sobol(at))
        print(f"  {name:15} {rtol:g}  {1e3 * first:.0f} ms  {1e3 * later:.0f} ms")
    print("outputs of Lotka-Volterra at 1e-6")
    solution = ro.solve(EXAMPLES["lotka_volterra"].problem, 1e-6)
    x, y = (sp.Function(name)(sp.Symbol("t")) for name in "xy")
    for given in (x * y, ro.maximum(x), ro.first_crossing(x, 2), "integral(x*y)"):
        first, _ = seconds(lambda s=solution, q=given: s.output({"q": q}))
        print(f"  {given!s:25} {1e3 * first:.0f} ms")


if __name__ == "__main__":
    main()
