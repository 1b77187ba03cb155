"""An epidemic on a random graph: who is susceptible and who is infected, node by node.

Node i catches it from a neighbour j at the rate b s_i y_j, and recovers at the rate g y_i. These
are reactions of mass action. Asked is the share of the infected among all.
"""

from __future__ import annotations

import matplotlib.pyplot as plt
import numpy as np
import scipy.sparse
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
    """The n susceptible shares, then the n infected ones; every fiftieth node begins with 10 %."""
    edges = neighbours(n)
    reactions = len(edges) + n
    stoichiometry = scipy.sparse.lil_matrix((2 * n, reactions))
    orders = scipy.sparse.lil_matrix((2 * n, reactions))
    for reaction, (i, j) in enumerate(edges):
        stoichiometry[i, reaction], stoichiometry[n + i, reaction] = -1, 1
        orders[i, reaction] = orders[n + j, reaction] = 1
    for i in range(n):
        stoichiometry[n + i, len(edges) + i] = -1
        orders[n + i, len(edges) + i] = 1
    infected = np.where(np.arange(n) % 50 == 0, 0.1, 0.001)
    return ro.Problem.from_reactions(
        stoichiometry,
        [CATCHING] * len(edges) + [RECOVERY] * n,
        orders=orders,
        time=(t, 0, END),
        parameters={CATCHING: (0.2 / 1.4, 0.2 * 1.4), RECOVERY: (0.2 / 1.4, 0.2 * 1.4)},
        initial=np.concatenate([1.0 - infected, infected]),
        names=[f"{kind}{i}" for kind in "sy" for i in range(n)],
        name="epidemic on a graph",
    )


def draw(n: int) -> Figure:
    """The infected share for several rates of catching it, and its peak over the box."""
    share = f"({' + '.join(f'y{i}' for i in range(n))})/{n}"
    solution = ro.solve(problem(n), rtol=RTOL, outputs={"infected": share})
    print(solution)
    times = np.linspace(0, END, 101)
    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.2), layout="constrained")
    for b in np.linspace(*solution.parameters["b"], 5):
        left.plot(times, solution["infected"](times, b=b, g=0.2), label=f"b = {b:.2f}")
    left.set(xlabel="t", ylabel="infected share at g = 0.2")
    left.legend()
    grid = [np.linspace(*ends, 30) for ends in solution.parameters.values()]
    peaks = solution.grid(t=times, b=grid[0], g=grid[1])[0].max(axis=0)
    lines = right.contour(*grid, peaks.T, levels=8)
    right.clabel(lines)
    right.set(xlabel="b", ylabel="g", title="largest infected share")
    return figure


if __name__ == "__main__":
    run("epidemic", SIZE, draw)
