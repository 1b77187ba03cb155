"""Solve 60 random systems that depend steeply on a parameter: python tests/benchmarks/steep.py

Bistable equations whose initial value crosses the unstable point, thresholds, ``tanh`` of up to
1,000 times a parameter, and steps; rtol 1e-2 to 1e-4. A success is *wrong* if it is off by more
than 5 × rtol at one of 48 random points × 21 times, against LSODA.
"""

from __future__ import annotations

import os

os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")

import argparse
import random
import time
from collections.abc import Iterator

import numpy as np
import scipy.integrate
import sympy as sp

import rankone as ro

WITHIN = 5.0
t, a, k, s = sp.symbols("t a k s")
x = sp.Function("x")(t)

Case = tuple[str, float, sp.Expr, dict[sp.Symbol, tuple[float, float]], sp.Expr, float]


def cases() -> Iterator[Case]:
    """Name, rtol, right-hand side, box, initial value, end."""
    draw = random.Random(7)
    for i in range(60):
        rtol = (1e-2, 1e-3, 1e-4)[(i // 5) % 3]
        match i % 5:
            case 0:
                end, box = draw.uniform(2, 9), (-draw.uniform(0.3, 1.2), draw.uniform(0.3, 1.2))
                yield "bistable", rtol, x - x**3, {k: box}, k, end
            case 1:
                end, shift, most = draw.uniform(2, 9), draw.uniform(0.02, 0.2), draw.uniform(0.3, 1)
                box = {k: (-most, most), a: (-shift, shift)}
                yield "bistable, shifted", rtol, x - x**3 + a, box, k, end
            case 2:
                end, threshold = draw.uniform(2, 6), round(draw.uniform(0.3, 0.6), 3)
                least = draw.uniform(0.5, 1)
                box = {k: (0.05, 0.95), s: (least, least + draw.uniform(0.5, 3))}
                yield "threshold", rtol, s * x * (1 - x) * (x - threshold), box, k, end
            case 3:
                steep, place = 10 ** draw.uniform(1, 3), round(draw.uniform(0.2, 0.8), 3)
                rate = -x + sp.tanh(round(steep, 2) * (k - place))
                yield f"tanh {steep:.0f}", rtol, rate, {k: (0, 1)}, sp.S.Zero, draw.uniform(1, 4)
            case _:
                place, end = round(draw.uniform(0.2, 0.8), 3), draw.uniform(1, 4)
                free = i % 2
                rate = -(1 + a * free) * x + sp.Heaviside(k - place)
                box = {k: (0, 1), a: (0, 1)} if free else {k: (0, 1)}
                yield "step", rtol, rate, box, sp.Integer(free), end


def error(solution: ro.Solution, case: Case) -> float:
    """Largest error over the size of the unknown."""
    _, _, rate, box, initial, end = case
    generator, times = np.random.default_rng(5), np.linspace(0.0, end, 21)
    rhs, start = sp.lambdify([t, x, *box], rate), sp.lambdify([*box], initial)
    largest = size = 0.0
    for _ in range(48):
        point = [generator.uniform(*interval) for interval in box.values()]
        options = {"method": "LSODA", "rtol": 1e-9, "atol": 1e-11, "t_eval": times}
        exact = scipy.integrate.solve_ivp(
            lambda now, u, at=point: [rhs(now, u[0], *at)],
            (0.0, end),
            [float(start(*point))],
            **options,
        ).y[0]
        names = [str(symbol) for symbol in box]
        found = solution["x"](t=times, **dict(zip(names, point, strict=True)))
        largest = max(largest, float(np.abs(found - exact).max()))
        size = max(size, float(np.abs(exact).max()))
    return largest / size


def main() -> None:
    """Print a line for each system, and the counts."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--method", default="auto")
    arguments = parser.parse_args()
    count = {"ok": 0, "refused": 0, "wrong": 0}
    longest = 0.0
    for case in cases():
        name, rtol, rate, box, initial, end = case
        began = time.perf_counter()
        problem = ro.Problem(
            equations=[sp.Eq(x.diff(t), rate)],
            time=(t, 0, end),
            parameters=box,
            initial={x: initial},
        )
        solution = ro.solve(problem, rtol=rtol, method=arguments.method)
        seconds = time.perf_counter() - began
        verdict, kept = "refused", solution.error / rtol
        if solution.success:
            kept = error(solution, case) / rtol
            verdict = "ok" if kept <= WITHIN else "wrong"
        count[verdict] += 1
        longest = max(longest, seconds)
        print(f"{name}, rtol {rtol:g}, T = {end:.1f}: {verdict}, {kept:.2g}, {seconds:.2f} s")
    print(", ".join(f"{number} {verdict}" for verdict, number in count.items()), end="; ")
    print(f"longest {longest:.1f} s")


if __name__ == "__main__":
    main()
