"""The Brusselator with diffusion on a square, for every supply A and every B of a box.

u' = A + u^2 v - (B + 1) u + D Δu, v' = B u - u^2 v + D Δv (Prigogine and Lefever, J. Chem. Phys. 48
(1968), 1695), by finite volumes on n x n cells whose borders let nothing through.
"""

from __future__ import annotations

import matplotlib.pyplot as plt
import numpy as np
from common import run
from matplotlib.figure import Figure

import rankone as ro

RTOL, SIZE, END, DIFFUSION = 1e-4, 30, 2.0, 0.002
CORNERS = ((0.91, 1.55), (1.0, 1.7), (1.1, 1.87))


def problem(n: int) -> ro.Problem:
    """The reactions in n x n cells that exchange with their neighbours."""
    rhs, initial = {}, {}
    for i, j in np.ndindex(n, n):
        near = [(i - 1, j), (i + 1, j), (i, j - 1), (i, j + 1)]
        cells = [(k, m) for k, m in near if 0 <= k < n and 0 <= m < n]
        u, v = f"u{i}_{j}", f"v{i}_{j}"
        flows = [
            f"{DIFFUSION * n * n:.6g}*({' + '.join(f'{s}{k}_{m}' for k, m in cells)}"
            f" - {len(cells)}*{s}{i}_{j})"
            for s in "uv"
        ]
        rhs[u] = f"A + {u}**2*{v} - (B + 1)*{u} + {flows[0]}"
        rhs[v] = f"B*{u} - {u}**2*{v} + {flows[1]}"
        initial[u], initial[v] = f"{0.5 + (j + 0.5) / n:.4f}", f"{1 + 5 * (i + 0.5) / n:.4f}"
    box = {"A": (1 / 1.1, 1.1), "B": (1.7 / 1.1, 1.7 * 1.1)}
    return ro.Problem.from_strings(rhs, initial, box, (0, END), name="Brusselator on a square")


def draw(n: int) -> Figure:
    """The field u at the end for three pairs of A and B."""
    solution = ro.solve(problem(n), rtol=RTOL)
    print(solution)
    fields = [solution(END, A=a, B=b)[::2].reshape(n, n) for a, b in CORNERS]
    lowest, highest = min(map(np.min, fields)), max(map(np.max, fields))
    figure, axes = plt.subplots(1, 3, figsize=(9, 3.2), layout="constrained")
    for ax, field, (a, b) in zip(axes, fields, CORNERS, strict=True):
        image = ax.imshow(field, origin="lower", extent=(0, 1, 0, 1), vmin=lowest, vmax=highest)
        ax.set(title=f"A = {a:g}, B = {b:g}", xticks=[0, 1], yticks=[0, 1])
    figure.colorbar(image, ax=axes, label=f"u at t = {END:g}")
    return figure


if __name__ == "__main__":
    run("brusselator", SIZE, draw)
