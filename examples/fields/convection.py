"""Dye that a flow carries over a square, for every speed and angle of the flow.

u' = D Δu - c (cos(θ) u_x + sin(θ) u_y) by central differences on n x n cells, with no dye on the
border. The cells are fine enough for the flow: c h / D is below two.
"""

from __future__ import annotations

import matplotlib.pyplot as plt
import numpy as np
import scipy.sparse as ss
import sympy as sp
from common import run
from matplotlib.figure import Figure

import rankone as ro

RTOL, SIZE, END, DIFFUSION = 1e-4, 100, 0.5, 0.02
t, SPEED, ANGLE = sp.symbols("t c theta")
FLOWS = ((0.4, -0.4), (0.8, 0.4))


def problem(n: int) -> ro.Problem:
    """The dye in the cells, a round drop at first."""
    spacing, one = 1.0 / (n + 1), ss.eye_array(n)
    second = ss.diags_array([1.0, -2.0, 1.0], offsets=(-1, 0, 1), shape=(n, n)) / spacing**2
    first = ss.diags_array([-1.0, 1.0], offsets=(-1, 1), shape=(n, n)) / (2.0 * spacing)
    spreads = ss.kron(second, one) + ss.kron(one, second)
    x, y = np.meshgrid(*2 * [spacing * np.arange(1, n + 1)], indexing="ij")
    drop = np.exp(-60.0 * ((x - 0.3) ** 2 + (y - 0.5) ** 2)).ravel()
    u = ro.field("u", n * n)
    along_x = SPEED * sp.cos(ANGLE) * ro.apply(ss.kron(first, one), u)
    along_y = SPEED * sp.sin(ANGLE) * ro.apply(ss.kron(one, first), u)
    return ro.Problem(
        {u: DIFFUSION * ro.apply(spreads, u) - along_x - along_y},
        (t, 0, END),
        {SPEED: (0.4, 0.8), ANGLE: (-0.4, 0.4)},
        {u: drop},
        name="dye in a flow",
    )


def draw(n: int) -> Figure:
    """The dye at the end in two flows, and how uncertain it is where all flows are as likely."""
    solution = ro.solve(problem(n), rtol=RTOL, method="reduced")
    print(solution)
    pictures = {f"c = {c:g}, θ = {a:g}": solution["u"](END, c=c, theta=a) for c, a in FLOWS}
    pictures["standard deviation"] = solution.std(END)
    figure, axes = plt.subplots(1, 3, figsize=(9, 3.0), layout="constrained")
    for ax, (title, values) in zip(axes, pictures.items(), strict=True):
        image = ax.imshow(values.reshape(n, n).T, origin="lower", extent=(0, 1, 0, 1))
        ax.set(title=title, xticks=[0, 1], yticks=[0, 1])
        figure.colorbar(image, ax=ax, shrink=0.8)
    return figure


if __name__ == "__main__":
    run("convection", SIZE, draw)
