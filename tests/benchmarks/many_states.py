"""Solve systems of many states: python tests/benchmarks/many_states.py [NAME ...] [--method METHOD]

With ``--basis`` it says what the basis costs in which the samples of (state, time) are compressed.

Each row runs in a process of its own. Seconds are of the processor, with compiling; the peak is of
the whole process. The error is that at random parameters against SciPy's BDF with the sparse
Jacobian at rtol 1e-10, relative to each unknown's largest value. The break-even is the time over
that of one BDF trajectory at a tenth of the tolerance.
"""

from __future__ import annotations

import os

os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")

import argparse
import resource
import runpy
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import scipy.integrate
import scipy.sparse
import sympy as sp

import rankone as ro
from rankone.solvers.engines import cross_samples as trajectories
from rankone.tensors.cross import GrowingBasis
from rankone.trajectories.system.system import PatternJacobian

FIELDS = Path(__file__).resolve().parents[2] / "examples" / "fields"
POINTS, TIMES = 3, 11  # Random parameters and times at which errors are measured
PARTS = (7, 30, 13, 13, 8, 7, 9, 9, 10)  # Widths of the columns


@dataclass(frozen=True)
class Case:
    """A problem and its tolerance."""

    problem: Callable[[], ro.Problem]
    rtol: float = 1e-3


def around(*names: str, factor: float = 1.4, **nominal: float) -> dict[str, tuple[float, float]]:
    """Intervals × and ÷ a factor around one, or other nominal values."""
    values = dict.fromkeys(names, 1.0) | nominal
    return {name: (value / factor, value * factor) for name, value in values.items()}


def chain(n: int) -> ro.Problem:
    """A line of compartments that exchange, with an inflow into the first and losses from all."""
    rhs = {}
    for i in range(n):
        before = f"k1*(x{i - 1} - x{i})" if i else "k3"
        after = f" - k1*(x{i} - x{i + 1})" if i + 1 < n else ""
        rhs[f"x{i}"] = f"{before}{after} - 0.1*k2*x{i}"
    initial = {f"x{i}": round(float(np.exp(-i / n)), 3) for i in range(n)}
    return ro.Problem.from_strings(rhs, initial, around("k1", "k2", "k3"), (0, 10))


def mass_action(n: int) -> ro.Problem:
    """Random reactions A + B -> C and A -> B, two for each species; every third shares a rate."""
    generator = np.random.default_rng(0)
    terms: dict[str, list[str]] = {f"x{i}": [] for i in range(n)}
    for reaction in range(2 * n):
        a, b, c = generator.choice(n, 3, replace=False)
        rate = f"{generator.uniform(0.2, 2):.3f}*k{reaction % 3}*x{a}"
        if reaction % 2:
            terms[f"x{a}"].append(f"- {rate}")
            terms[f"x{b}"].append(f"+ {rate}")
            continue
        for product, sign in ((a, "-"), (b, "-"), (c, "+")):
            terms[f"x{product}"].append(f"{sign} {rate}*x{b}")
    rhs = {name: " ".join(own) or "0" for name, own in terms.items()}
    initial = {name: f"{generator.uniform(0.5, 1.5):.3f}" for name in rhs}
    return ro.Problem.from_strings(rhs, initial, around("k0", "k1", "k2"), (0, 2))


def heat(n: int) -> ro.Problem:
    """A bar of three layers, heated at one end from zero on."""
    scale, layer = (n + 1) ** 2, [f"D{1 + min(3 * i // n, 2)}" for i in range(n)]
    rhs = {}
    for i in range(n):
        before = f"{layer[i - 1]}*(u{i - 1} - u{i})" if i else "D1*(1 - u0)"
        after = f"{layer[i]}*(u{i + 1} - u{i})" if i + 1 < n else f"-D3*u{i}"
        rhs[f"u{i}"] = f"{scale}*({before} + {after})"
    return ro.Problem.from_strings(rhs, dict.fromkeys(rhs, 0), around("D1", "D2", "D3"), (0, 0.2))


def truss(height: int) -> ro.Problem:
    """The damped tower of the examples: a plane truss of 4 x ``height`` bays."""
    made: ro.Problem = runpy.run_path(str(FIELDS / "truss.py"))["problem"](height)
    return made


def springs(n: int) -> ro.Problem:
    """A row of masses on springs of two stiffnesses, damped, with a load on all that swings."""
    t, *p = sp.symbols("t k1 k2 c f")
    spring = scipy.sparse.diags([-np.ones(n - 1), np.full(n, 2.0), -np.ones(n - 1)], [-1, 0, 1])
    half = scipy.sparse.diags((np.arange(n) < n // 2).astype(float))
    stiffness = {p[0]: half @ spring @ half, p[1]: spring - half @ spring @ half}
    return ro.Problem.from_matrices(
        scipy.sparse.eye(n),
        {p[2]: 0.2 * spring},
        stiffness,
        {p[3] * sp.sin(t / 5): np.ones(n)},
        time=(t, 0, 20),
        parameters=dict(zip(p, around("k1", "k2", "c", "f", factor=1.2).values(), strict=True)),
        initial=np.zeros(n),
    )


def brusselator(n: int) -> ro.Problem:
    """The Brusselator with diffusion on a square of n x n cells (Prigogine and Lefever, 1968)."""
    rhs, initial = {}, {}
    for i, j in np.ndindex(n, n):
        near = [(i - 1, j), (i + 1, j), (i, j - 1), (i, j + 1)]
        cells = [(k, m) for k, m in near if 0 <= k < n and 0 <= m < n]
        flows = [
            f"0.002*{n * n}*("
            + " + ".join(f"{s}{k}_{m}" for k, m in cells)
            + f" - {len(cells)}*{s}{i}_{j})"
            for s in "uv"
        ]
        u, v = f"u{i}_{j}", f"v{i}_{j}"
        rhs[u] = f"A + {u}**2*{v} - (B + 1)*{u} + {flows[0]}"
        rhs[v] = f"B*{u} - {u}**2*{v} + {flows[1]}"
        initial[u], initial[v] = f"{0.5 + (j + 0.5) / n:.4f}", f"{1 + 5 * (i + 0.5) / n:.4f}"
    return ro.Problem.from_strings(rhs, initial, around(factor=1.1, A=1.0, B=1.7), (0, 2))


def epidemic(n: int) -> ro.Problem:
    """Susceptible and infected shares on a random graph of n nodes, four neighbours each."""
    generator = np.random.default_rng(1)
    near: list[set[int]] = [{(i - 1) % n, (i + 1) % n} for i in range(n)]
    for i, j in generator.integers(0, n, (n, 2)):
        if i != j:
            near[i].add(int(j))
            near[j].add(int(i))
    rhs, initial = {}, {}
    for i in range(n):
        force = " + ".join(f"y{j}" for j in sorted(near[i]))
        rhs[f"s{i}"] = f"-b*s{i}*({force})"
        rhs[f"y{i}"] = f"b*s{i}*({force}) - g*y{i}"
        initial[f"s{i}"], initial[f"y{i}"] = ("0.9", "0.1") if i % 50 == 0 else ("0.999", "0.001")
    return ro.Problem.from_strings(rhs, initial, around(factor=1.4, b=0.2, g=0.2), (0, 20))


def saturation(n: int) -> ro.Problem:
    """Random Michaelis-Menten conversions between species, two for each."""
    generator = np.random.default_rng(3)
    terms: dict[str, list[str]] = {f"x{i}": [] for i in range(n)}
    for reaction in range(2 * n):
        a, b = generator.choice(n, 2, replace=False)
        fastest, half = generator.uniform(0.2, 2), generator.uniform(0.3, 2)
        rate = f"{fastest:.3f}*k{reaction % 3}*x{a}/({half:.3f} + x{a})"
        terms[f"x{a}"].append(f"- {rate}")
        terms[f"x{b}"].append(f"+ {rate}")
    rhs = {name: " ".join(own) or "0" for name, own in terms.items()}
    initial = {name: f"{generator.uniform(0.5, 1.5):.3f}" for name in rhs}
    return ro.Problem.from_strings(rhs, initial, around("k0", "k1", "k2"), (0, 2))


def genes(n: int) -> ro.Problem:
    """Genes that activate and repress each other by Hill's law, of powers of their own."""
    generator = np.random.default_rng(4)
    rhs = {}
    for i in range(n):
        by, power = f"x{generator.integers(n)}", f"{generator.uniform(1.5, 3.5):.2f}"
        half, rate = f"{generator.uniform(0.5, 1.5):.3f}", f"{generator.uniform(0.5, 2):.3f}"
        law = f"{by}**{power}/({half}**{power} + {by}**{power})"
        rhs[f"x{i}"] = f"{rate}*a*{law if i % 2 else f'(1 - {law})'} - b*x{i}"
    initial = {name: f"{generator.uniform(0.2, 1.2):.3f}" for name in rhs}
    return ro.Problem.from_strings(rhs, initial, around("a", "b", factor=1.2), (0, 3))


def neurons(n: int) -> ro.Problem:
    """A random network of rate neurons, six inputs each (Hopfield, 1984)."""
    generator = np.random.default_rng(5)
    rhs = {}
    for i in range(n):
        inputs = sorted({int(j) for j in generator.integers(n, size=6)})
        total = " + ".join(f"{generator.normal():.3f}*x{j}" for j in inputs)
        rhs[f"x{i}"] = f"-d*x{i} + s*tanh({total})"
    initial = {name: f"{generator.uniform(-1, 1):.3f}" for name in rhs}
    return ro.Problem.from_strings(rhs, initial, around("d", "s"), (0, 3))


CASES = {
    "chain of 100": Case(lambda: chain(100)),
    "chain of 1,000": Case(lambda: chain(1000)),
    "mass action, 300": Case(lambda: mass_action(300)),
    "mass action, 1,000": Case(lambda: mass_action(1000)),
    "heat, 500": Case(lambda: heat(500), 1e-5),
    "truss, 200 degrees of freedom": Case(lambda: truss(20), 1e-4),
    "springs, 200": Case(lambda: springs(200), 1e-4),
    "Brusselator, 30 x 30": Case(lambda: brusselator(30), 1e-4),
    "epidemic, 1,000 nodes": Case(lambda: epidemic(1000)),
    "saturation, 1,000": Case(lambda: saturation(1000)),
    "genes, 500": Case(lambda: genes(500)),
    "neurons, 1,000": Case(lambda: neurons(1000)),
}


class Peer:
    """SciPy's BDF with the sparse Jacobian of a compiled system, at one parameter point."""

    def __init__(self, compiled: ro.CompiledProblem) -> None:
        self.system = compiled.system
        assert isinstance(self.system.jacobian, PatternJacobian)
        self.pattern = self.system.jacobian

    def __call__(self, point: np.ndarray, times: np.ndarray, rtol: float) -> np.ndarray:
        """States (n, times)."""
        system, pattern, p = self.system, self.pattern, point[:, None]
        places, n = (pattern.rows, pattern.columns), system.n_differential
        integrated = scipy.integrate.solve_ivp(
            lambda t, u: system.rhs(t, u[:, None], p)[:, 0],
            system.horizon,
            system.initial(p)[:, 0],
            method="BDF",
            t_eval=times,
            rtol=rtol,
            atol=1e-3 * rtol,
            jac=lambda t, u: scipy.sparse.csc_matrix(
                (pattern.entries(t, u[:, None], p)[:, 0], places), (n, n)
            ),
        )
        return integrated.y


class TimedBasis(GrowingBasis):
    """The basis of the samples, which remembers what it took."""

    seconds, largest = 0.0, (0, 0)

    def coefficients(self, columns: np.ndarray, tolerance: float) -> np.ndarray:
        began = time.process_time()
        coefficients = super().coefficients(columns, tolerance)
        TimedBasis.seconds += time.process_time() - began
        TimedBasis.largest = max(TimedBasis.largest, self.vectors.shape)
        return coefficients

    @classmethod
    def cost(cls, seconds: float) -> str:
        length, rank = cls.largest
        size = 8e-6 * length * rank
        share = cls.seconds / seconds
        return f"    basis: {rank} x {length:,} numbers, {size:.0f} MB; {share:.0%} of the seconds"


def points_of(compiled: ro.CompiledProblem) -> np.ndarray:
    """Random parameters (m, d)."""
    box = np.array(compiled.system.box)
    shares = np.random.default_rng(5).random((POINTS, len(box)))
    return box[:, 0] + (box[:, 1] - box[:, 0]) * shares


def largest_error(compiled: ro.CompiledProblem, solution: ro.Solution) -> float:
    """Largest error of an unknown over its size, against SciPy's BDF."""
    peer, system = Peer(compiled), compiled.system
    times, points = np.linspace(*system.horizon, TIMES), points_of(compiled)
    exact = np.stack([peer(point, times, 1e-10) for point in points])
    ours = np.stack([solution(times, dict(zip(system.parameters, q))) for q in points.tolist()])
    exact = exact[:, : ours.shape[1]]  # without derivatives that are states
    size = np.abs(exact).max(axis=(0, 2))
    return float((np.abs(ours - exact).max(axis=(0, 2)) / np.where(size > 0, size, 1)).max())


def row(name: str, method: str, basis: bool) -> str:
    """One line of the table."""
    if basis:
        trajectories.GrowingBasis = TimedBasis
    case, clock = CASES[name], time.process_time
    began = clock()
    compiled = ro.compile(case.problem())  # with building the problem
    compiling = clock() - began
    solution = compiled.solve(rtol=case.rtol, method=method)
    seconds = clock() - began
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
    peer, system = Peer(compiled), compiled.system
    times, points = np.linspace(*system.horizon, TIMES), points_of(compiled)
    error = largest_error(compiled, solution)
    began = clock()
    peer(points[0], times, 0.1 * case.rtol)
    one = clock() - began
    cells = (
        f"{system.n_differential:,}",
        name,
        "success" if solution.success else "refused",
        f"{error:.1e} of {case.rtol:.0e}",
        f"{compiling:.1f}",
        f"{seconds:.1f}",
        f"{peak:,.0f}",
        f"{1e3 * one:,.0f}",
        f"{seconds / one:,.0f}",
    )
    if basis:
        print(TimedBasis.cost(seconds), flush=True)
    return line(cells) + ("" if solution.success else f"\n    {solution.message}")


def line(cells: tuple[str, ...]) -> str:
    return "  ".join(cell.ljust(width) for cell, width in zip(cells, PARTS, strict=True)).rstrip()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", help="rows whose names begin so; all by default")
    parser.add_argument("--method", default="auto")
    parser.add_argument("--basis", action="store_true", help="what compressing samples costs")
    parser.add_argument("--row", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.row:
        print(row(arguments.row, arguments.method, arguments.basis), flush=True)
        return
    for given in arguments.names:
        if not any(name.startswith(given) for name in CASES):
            parser.error(f"no row begins with {given!r}; rows: {', '.join(CASES)}")
    titles = (
        "states",
        "system",
        "",
        "error",
        "compile",
        "solved",
        "peak MB",
        "BDF, ms",
        "break-even",
    )
    print(line(titles), flush=True)
    for name in CASES:
        if not arguments.names or any(name.startswith(given) for given in arguments.names):
            call = [sys.executable, __file__, "--row", name, "--method", arguments.method]
            call += ["--basis"] if arguments.basis else []
            subprocess.run(call, check=False)


if __name__ == "__main__":
    main()
