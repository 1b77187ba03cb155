"""The linear models of the slides: surface u(t, k) and base functions T_i(t), K_i(k).

k (u' + 1) = 10, whose solution is one product, and the decay u' + k u = 0, which needs several;
both with the plain choice of the slides: linear elements, Galerkin, amplitudes.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

import numpy as np
from common import Array, Figure, error_of, plt, publish, run_script, slope

import rankone as ro
from examples import decay, linear
from rankone.tensors.canonical import CanonicalForm

TITLES = {"linear": "k (u′ + 1) = 10", "decay": "u′ + k u = 0"}


@dataclass(frozen=True)
class Model:
    """One linear model: its solution with the most nodes, and errors for all node numbers."""

    solution: ro.Solution
    form: CanonicalForm
    times: Array
    rates: Array
    surface: Array
    nodes: tuple[int, ...]
    errors: tuple[float, ...]

    @property
    def order(self) -> float:
        """Observed order of the error in the element size."""
        return -slope([n - 1 for n in self.nodes], self.errors)


def compute(nodes: tuple[int, ...] = (21, 41, 81)) -> dict[str, Model]:
    found = {}
    for name, problem in (("linear", linear.problem), ("decay", decay.problem)):
        compiled = ro.compile(problem)
        errors = []
        for count in nodes:
            solution = compiled.solve(
                rtol=1e-3,
                method="greedy",
                preset="slides",
                time_nodes=count,
                parameter_nodes=count,
                tolerance=1e-8,
            )
            errors.append(error_of(compiled, solution))
        (low, high), end = compiled.system.box[0], compiled.system.horizon[1]
        times, rates = np.linspace(0, end, 41), np.linspace(low, high, 41)
        surface = solution.grid(t=times, k=rates)[0]
        form = solution.to_canonical(1e-3)["u"]
        found[name] = Model(solution, form, times, rates, surface, nodes, tuple(errors))
    return found


def report(found: dict[str, Model]) -> str:
    lines = []
    for name, model in found.items():
        record = model.solution.history[-1]
        count, residual = record.ranks[0], record.equations[-1].residual
        errors = ", ".join(
            f"{error:.1e} with {n} nodes" for n, error in zip(model.nodes, model.errors)
        )
        amplitudes = ", ".join(f"{a:.2e}" for a in model.form.amplitudes)
        lines.append(
            f"- **{TITLES[name]}**: error {errors} per dimension, observed order "
            f"{model.order:.2f}. With the most nodes the enrichment ended after {count} "
            f"{'mode' if count == 1 else 'modes'} at a residual of {residual:.1e}. Written with "
            f"orthonormal base functions the same solution needs {model.form.rank} to be within "
            f"1e-3, of amplitude {amplitudes}."
        )
    return "\n".join(lines)


def draw(found: dict[str, Model]) -> Figure:
    drawn = plt.figure(figsize=(9.3, 5.6), layout="constrained")
    for row, (name, model) in enumerate(found.items()):
        surface = drawn.add_subplot(2, 3, 3 * row + 1, projection="3d")
        t, k = np.meshgrid(model.times, model.rates, indexing="ij")
        surface.plot_surface(t, k, model.surface, cmap="viridis", rcount=25, ccount=25)
        surface.set(xlabel="t", ylabel="k", title=f"{TITLES[name]}: u(t, k)")
        for column, (label, axis) in enumerate(zip(("T", "K"), model.form.axes)):
            panel = drawn.add_subplot(2, 3, 3 * row + 2 + column)
            points = np.linspace(axis.breaks[0], axis.breaks[-1], 301)
            values = axis.interpolate(model.form.factors[axis.name], points)
            for i in range(min(model.form.rank, 4)):
                panel.plot(points, values[:, i], label=f"${label}_{i + 1}$")
            panel.set(xlabel=axis.name, title=f"base functions ${label}_i({axis.name})$")
            panel.legend()
    return drawn


def main(folder: Path) -> None:
    found = compute()
    publish("linear_model", report(found), {"linear_model": draw(found)}, folder)


if __name__ == "__main__":
    run_script(main)
