"""Heat in a bar of three layers whose conductivities are uncertain, by finite differences.

The left end is held at one from the start on, the right end at zero. Inner points i satisfy
u_i' = D_{i+1/2} (u_{i+1} - u_i) / h^2 - D_{i-1/2} (u_i - u_{i-1}) / h^2.
"""

from __future__ import annotations

import matplotlib.pyplot as plt
import numpy as np
import scipy.sparse as ss
import sympy as sp
from common import run
from matplotlib.figure import Figure

import rankone as ro

RTOL, SIZE, END = 1e-5, 500, 0.2
TIMES = (0.005, 0.02, 0.2)
t = sp.Symbol("t")
CONDUCTIVITIES = sp.symbols("D1 D2 D3")


def problem(n: int) -> ro.Problem:
    """The bar with n inner points; conductivities are known up to a factor of 1.4."""
    scale, faces = (n + 1) ** 2, n + 1
    u = ro.field("u", n)
    difference = ss.diags_array([1.0, -1.0], offsets=(0, -1), shape=(faces, n)).tocsr()
    heated = np.zeros(n)
    heated[0] = scale
    rate = ro.apply(heated, CONDUCTIVITIES[0])
    layer = np.minimum(3 * np.arange(faces) // faces, 2)
    for k, conductivity in enumerate(CONDUCTIVITIES):
        of_layer = ss.diags_array((layer == k).astype(float))
        rate -= conductivity * ro.apply(scale * difference.T @ of_layer @ difference, u)
    box = dict.fromkeys(CONDUCTIVITIES, (1 / 1.4, 1.4))
    return ro.Problem({u: rate}, (t, 0, END), box, {u: 0}, name="bar of three layers")


def draw(n: int) -> Figure:
    """Bands of the temperature along the bar, and which conductivity matters where."""
    solution = ro.solve(problem(n), rtol=RTOL)
    print(solution)
    x = np.arange(1, n + 1) / (n + 1)
    mean, std = solution.mean(TIMES), solution.std(TIMES)
    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.2), layout="constrained")
    for k, time in enumerate(TIMES):
        band = mean[:, k] - 2 * std[:, k], mean[:, k] + 2 * std[:, k]
        left.fill_between(x, *band, alpha=0.3)
        left.plot(x, mean[:, k], label=f"t = {time:g}")
    left.set(xlabel="x", ylabel="temperature, mean and band")
    left.legend()
    total = solution.sobol(TIMES[1])["u"].total[:, :, 0]
    for name, share in zip(solution.parameters, total.T, strict=True):
        right.plot(x, share, label=name)
    right.set(xlabel="x", ylabel=f"total Sobol index at t = {TIMES[1]:g}", ylim=(0, 1))
    right.legend()
    return figure


if __name__ == "__main__":
    run("heat", SIZE, draw)
