"""What stabilised steps and Krylov methods would be worth: python tests/benchmarks/stabilised.py

Steps of RKC (Sommeijer, Shampine and Verwer, J. Comput. Appl. Math. 88 (1998), 315), whose stages
grow with the square root of the stiffness, beside the stacks of rankone, on the same stacks of
trajectories. Errors are those after a tenth of the horizon, relative to the largest value of each
state, against a stack at 1e-11; seconds are of the processor, for 32 trajectories.

Then one matrix of an implicit step, of networks whose factors fill: SuperLU with twenty solutions,
beside GMRES without a preconditioner and with incomplete factors, to 1e-8.
"""

from __future__ import annotations

import os

os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")

import sys
import time
from collections.abc import Callable
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "src")]

import numpy as np  # noqa: E402
import scipy.sparse  # noqa: E402
from scipy.sparse.linalg import LinearOperator, gmres, spilu, splu  # noqa: E402

import rankone as ro  # noqa: E402
from rankone.support.arrays import Array  # noqa: E402
from rankone.trajectories.integrators.integrator import Tolerances  # noqa: E402
from rankone.trajectories.stacks.stack import StackedIntegrator  # noqa: E402
from rankone.trajectories.system.system import System, pattern_of  # noqa: E402
from tests.benchmarks.many_states import brusselator, heat, mass_action  # noqa: E402

TRAJECTORIES = 32
DAMPING = 2.0 / 13.0
SAFETY = 0.8


def chebyshev(s: int, w0: float) -> Array:
    """Values, slopes and second slopes of T_0 ... T_s at w0: shape (3, s + 1)."""
    t = np.zeros((3, s + 1))
    t[:, 0], t[:, 1] = (1.0, 0.0, 0.0), (w0, 1.0, 0.0)
    for j in range(2, s + 1):
        t[0, j] = 2.0 * w0 * t[0, j - 1] - t[0, j - 2]
        t[1, j] = 2.0 * t[0, j - 1] + 2.0 * w0 * t[1, j - 1] - t[1, j - 2]
        t[2, j] = 4.0 * t[1, j - 1] + 2.0 * w0 * t[2, j - 1] - t[2, j - 2]
    return t


def rkc_step(rates: Callable[[Array], Array], y: Array, f: Array, h: float, s: int) -> Array:
    """One step of s stages of an autonomous system."""
    w0 = 1.0 + DAMPING / s**2
    t = chebyshev(s, w0)
    w1 = t[1, s] / t[2, s]
    b = np.empty(s + 1)
    b[2:] = t[2, 2:] / t[1, 2:] ** 2
    b[0], b[1] = b[2], 1.0 / w0
    a = 1.0 - b * t[0]
    before, now = y, y + b[1] * w1 * h * f
    for j in range(2, s + 1):
        mu, nu = 2.0 * b[j] * w0 / b[j - 1], -b[j] / b[j - 2]
        slope = 2.0 * b[j] * w1 / b[j - 1]
        after = (1.0 - mu - nu) * y + mu * now + nu * before
        after += slope * h * (rates(now) - a[j - 1] * f)
        before, now = now, after
    return now


def rkc(
    rates: Callable[[Array], Array], y: Array, end: float, radius: float, rtol: float, size: Array
) -> tuple[Array, int]:
    """The states at the end, and how often the rates were called."""
    t, f, calls = 0.0, rates(y), 1
    h = 1.0 / radius
    while t < end:
        h = min(h, end - t)
        s = max(int(1.0 + np.sqrt(1.54 * h * radius + 1.0)), 2)
        after = rkc_step(rates, y, f, h, s)
        slope = rates(after)
        calls += s
        missed = 0.8 * (y - after) + 0.4 * h * (f + slope)
        error = float(np.sqrt(np.mean((missed / (rtol * size)) ** 2, axis=0)).max())
        if error <= 1.0:
            t, y, f = t + h, after, slope
        h *= min(5.0, max(0.1, SAFETY * error ** (-1.0 / 3.0)))
    return y, calls


def compare(name: str, system: System) -> None:
    """Print errors and seconds of both at three tolerances."""
    box, n = np.array(system.box), system.n_differential
    shares = np.random.default_rng(0).random((TRAJECTORIES, len(box)))
    points = box[:, 0] + (box[:, 1] - box[:, 0]) * shares
    p, (start, end) = np.ascontiguousarray(points.T), first_part(system)
    initial = system.initial(p)
    exact = stack(system, points, 1e-11, np.ones((n, 1)))[0]
    size = np.maximum(np.abs(exact).max(axis=1, keepdims=True), 1e-3)
    pattern = pattern_of(system.jacobian)
    assert pattern is not None
    sums = np.zeros((n, TRAJECTORIES))
    np.add.at(sums, np.array(pattern.rows), np.abs(pattern.entries(start, initial, p)))
    radius = float(sums.max())
    for rtol in (1e-3, 1e-5, 1e-7):
        state, seconds, method = stack(system, points, rtol, size)
        error = float((np.abs(state - exact) / size).max())
        began = time.process_time()
        other, calls = rkc(
            lambda y: system.rhs(start, y, p), initial, end - start, radius, rtol, size
        )
        spent = time.process_time() - began
        missed = float((np.abs(other - exact) / size).max())
        print(
            f"| {name} | {rtol:g} | {method} {seconds:.2f} s, {error:.1e} | "
            f"{spent:.2f} s, {missed:.1e}, {calls} rates |",
            flush=True,
        )


def first_part(system: System) -> tuple[float, float]:
    """The first tenth of the horizon: diffusion comes to rest later."""
    start, end = system.horizon
    return start, start + 0.1 * (end - start)


def stack(system: System, points: Array, rtol: float, size: Array) -> tuple[Array, float, str]:
    """States at the end, seconds, and the method of a stack of rankone."""
    began = time.process_time()
    dense = StackedIntegrator().run(
        system, points, first_part(system), Tolerances(rtol, 1e-3 * rtol * size)
    )
    return dense.state, time.process_time() - began, dense.method


def factors(n: int, stiffness: float) -> None:
    """Print what a matrix I - h J of a random network costs, by factors and by GMRES."""
    system = ro.compile(mass_action(n)).system
    pattern = pattern_of(system.jacobian)
    assert pattern is not None
    p = np.array(system.box).mean(axis=1)[:, None]
    entries = pattern.entries(0.0, system.initial(p), p)[:, 0]
    slopes = scipy.sparse.csc_matrix((entries, (pattern.rows, pattern.columns)), (n, n))
    h = stiffness / float(np.abs(slopes).sum(axis=0).max())
    matrix = scipy.sparse.csc_matrix(scipy.sparse.eye(n) - h * slopes)
    sides = np.random.default_rng(1).standard_normal((20, n))
    began = time.process_time()
    lu = splu(matrix)
    made = time.process_time() - began
    for side in sides:
        lu.solve(side)
    direct = time.process_time() - began
    print(
        f"| {n} | {stiffness:g} | {lu.L.nnz + lu.U.nnz} of {matrix.nnz} | {made:.3f} + "
        f"{direct - made:.3f} s | {krylov(matrix, sides, None)} | {krylov(matrix, sides, spilu)} |",
        flush=True,
    )


def krylov(matrix: scipy.sparse.csc_matrix, sides: Array, incomplete: object) -> str:
    """Seconds of GMRES for all right-hand sides, with incomplete factors if they are given."""
    began, failed, steps = time.process_time(), 0, [0]
    operator = None
    if callable(incomplete):
        operator = LinearOperator(matrix.shape, incomplete(matrix, drop_tol=1e-2).solve)
    for side in sides:
        _, told = gmres(
            matrix, side, rtol=1e-8, restart=60, maxiter=20, M=operator,
            callback=lambda _: steps.__setitem__(0, steps[0] + 1), callback_type="pr_norm",
        )  # fmt: skip
        failed += told != 0
    seconds = time.process_time() - began
    lost = f", {failed} of {len(sides)} not solved" if failed else ""
    return f"{seconds:.3f} s, {steps[0] / len(sides):.0f} steps each{lost}"


if __name__ == "__main__":
    print("| system | rtol | stack, error | RKC, error |\n| --- | --- | --- | --- |")
    compare("heat in 80 cells", ro.compile(heat(80)).system)
    compare("heat in 300 cells", ro.compile(heat(300)).system)
    compare("Brusselator, 12 x 12", ro.compile(brusselator(12)).system)
    print("\n| states | h |J| | entries of factors | SuperLU | GMRES | with incomplete factors |")
    print("| --- | --- | --- | --- | --- | --- |")
    for n, stiffness in ((300, 100.0), (1000, 100.0), (1000, 1e4), (3000, 100.0)):
        factors(n, stiffness)
