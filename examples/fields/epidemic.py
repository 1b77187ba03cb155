"""An epidemic on a random graph: who is susceptible and who is infected, node by node.

Node i catches it from a neighbour j at the rate b s_i y_j, and recovers at the rate g y_i. With the
matrix A of the graph it is s' = -b s (A y), y' = b s (A y) - g y. Asked is the infected share.
"""

from __future__ import annotations

import matplotlib.pyplot as plt
import numpy as np
import scipy.sparse as ss
import sympy as sp
from common import run
from matplotlib.figure import Figure

import rankone as ro

RTOL, SIZE, END = 1e-3, 1000, 20.0
t, CATCHING, RECOVERY = sp.symbols("t b g")


def neighbours(n: int) -> list[tuple[int, int]]:
    """Directed edges of a ring with n random chords."""
    chords = np.random.default_rng(1).integers(0, n, (n, 2))
    ring = np.stack([np.arange(n), (np.arange(n) + 1) % n], axis=1)
    edges = {(i, j) for i, j in np.concatenate([ring, chords]).tolist() if i != j}
    return sorted(edges | {(j, i) for i, j in edges})


def problem(n: int) -> ro.Problem:
    """The susceptible and infected shares of n nodes; every fiftieth node begins with 10 %."""
    rows, columns = np.transpose(neighbours(n))
    graph = ss.csr_array((np.ones(rows.size), (rows, columns)), shape=(n, n))
    s, y = ro.field("s", n), ro.field("y", n)
    caught = CATCHING * s * ro.apply(graph, y)
    infected = np.where(np.arange(n) % 50 == 0, 0.1, 0.001)
    return ro.Problem(
        {s: -caught, y: caught - RECOVERY * y},
        (t, 0, END),
        {CATCHING: (0.2 / 1.4, 0.2 * 1.4), RECOVERY: (0.2 / 1.4, 0.2 * 1.4)},
        {s: 1.0 - infected, y: infected},
        name="epidemic on a graph",
    )


def mean(n: int) -> sp.Expr:
    """The infected share of all nodes."""
    return ro.apply(np.full((1, n), 1 / n), ro.field("y", n))


def draw(n: int) -> Figure:
    """The infected share for several rates of catching it, and its peak over the box."""
    solution = ro.solve(problem(n), rtol=RTOL)
    print(solution)
    share = solution.output({"infected": mean(n)})
    times = np.linspace(0, END, 101)
    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.2), layout="constrained")
    for b in np.linspace(*solution.parameters["b"], 5):
        left.plot(times, share["infected"](times, b=b, g=0.2), label=f"b = {b:.2f}")
    left.set(xlabel="t", ylabel="infected share at g = 0.2")
    left.legend()
    grid = [np.linspace(*ends, 30) for ends in solution.parameters.values()]
    peaks = share.grid(t=times, b=grid[0], g=grid[1])[0].max(axis=0)
    lines = right.contour(*grid, peaks.T, levels=8)
    right.clabel(lines)
    right.set(xlabel="b", ylabel="g", title="largest infected share")
    return figure


if __name__ == "__main__":
    run("epidemic", SIZE, draw)
