"""A damped tower under a swinging wind: stiffness of its bars, damping and wind uncertain.

A plane truss of square bays, four wide, with columns, beams and one diagonal each; its feet are
held. A bar of length L pulls with k / L times its extension, with k for columns and beams and d for
diagonals. Damping is in proportion to stiffness. The wind pushes the nodes of the left column.
"""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING

import numpy as np
import scipy.sparse
import sympy as sp

import rankone as ro

if TYPE_CHECKING:
    from matplotlib.figure import Figure

RTOL, SIZE, END, WIDTH = 1e-4, 20, 40.0, 4
t, COLUMNS, DIAGONALS, DAMPING, WIND = sp.symbols("t k d c f")


def nodes(height: int) -> np.ndarray:
    """Places (nodes, 2), floor by floor from the feet."""
    return np.array([(i, j) for j in range(height + 1) for i in range(WIDTH + 1)], dtype=float)


def bars(height: int) -> tuple[list[tuple[int, int]], list[tuple[int, int]]]:
    """Pairs of nodes: columns and beams, and diagonals."""
    across = WIDTH + 1
    straight = [(a, a + across) for a in range(height * across)]
    diagonal = []
    for floor, i in itertools.product(range(1, height + 1), range(WIDTH)):
        a = floor * across + i
        straight.append((a, a + 1))
        diagonal.append((a - across, a + 1) if (floor + i) % 2 else (a - across + 1, a))
    return straight, diagonal


def stiffness(places: np.ndarray, pairs: list[tuple[int, int]]) -> scipy.sparse.csr_matrix:
    """The matrix of some bars over all nodes but the feet."""
    matrix = scipy.sparse.lil_matrix((places.size, places.size))
    for a, b in pairs:
        along = places[b] - places[a]
        block = np.outer(along, along) / np.linalg.norm(along) ** 3
        for p, q, sign in ((a, a, 1), (b, b, 1), (a, b, -1), (b, a, -1)):
            matrix[2 * p : 2 * p + 2, 2 * q : 2 * q + 2] += sign * block
    held = 2 * (WIDTH + 1)
    return matrix.tocsr()[held:, held:]


def problem(height: int) -> ro.Problem:
    """The tower with a mass of one at each node, at rest at first."""
    places = nodes(height)
    straight, diagonal = (stiffness(places, pairs) for pairs in bars(height))
    n = straight.shape[0]
    push = np.zeros(n)
    push[:: 2 * (WIDTH + 1)] = 20.0 / height**2
    return ro.Problem.from_matrices(
        scipy.sparse.eye(n),
        {DAMPING: 0.2 * (straight + diagonal)},
        {COLUMNS: straight, DIAGONALS: diagonal},
        {WIND * sp.sin(t / 5): push},
        time=(t, 0, END),
        parameters=dict.fromkeys((COLUMNS, DIAGONALS, DAMPING, WIND), (1 / 1.2, 1.2)),
        initial=np.zeros(n),
        name="damped tower",
    )


def draw(height: int) -> Figure:
    """The tower at the end for soft and stiff diagonals, and the bands of its top."""
    import matplotlib.pyplot as plt  # the problem alone needs no figures

    solution = ro.solve(problem(height), rtol=RTOL)
    print(solution)
    figure, (left, right) = plt.subplots(
        1, 2, figsize=(9, 3.6), layout="constrained", width_ratios=(1, 2)
    )
    places = nodes(height)
    for d, colour in ((1 / 1.2, "C0"), (1.2, "C1")):
        moved = solution(END, k=1.0, d=d, c=1.0, f=1.0)
        at = places + np.concatenate([np.zeros((WIDTH + 1, 2)), moved.reshape(-1, 2)])
        for a, b in itertools.chain(*bars(height)):
            left.plot(*at[[a, b]].T, color=colour, linewidth=0.7)
    left.set(xlabel="x", ylabel=f"y at t = {END:g}", aspect="equal")
    left.set_title("d = 0.83 (blue), 1.2 (orange)", fontsize="small")
    times, top = np.linspace(0, END, 81), len(solution.unknowns) - 2
    mean, std = solution.mean(times)[top], solution.std(times)[top]
    right.fill_between(times, mean - 2 * std, mean + 2 * std, alpha=0.3)
    right.plot(times, mean)
    right.set(xlabel="t", ylabel="sway of the top, mean and two deviations")
    return figure


if __name__ == "__main__":
    from common import run

    run("truss", SIZE, draw)
