"""The base functions of one unknown: `plot_modes`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from rankone.errors import EvaluationError, OptionError
from rankone.plotting.asked import check_solution
from rankone.plotting.style import panels

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from rankone.solution import Solution

__all__ = ["plot_modes"]

_POINTS = 301
"""Points at which a base function is drawn."""


def plot_modes(
    solution: Solution, unknown: Any = None, *, modes: int = 5, rtol: float = 1e-3
) -> Figure:
    """Plot the base functions of one unknown, T_i(t), P_i(p), ..., and their amplitudes.

    They are those of :meth:`rankone.Solution.to_canonical`: of unit mean square, and in one
    parameter orthonormal.

    Parameters
    ----------
    unknown : symbol or str, optional
        May be left out if there is only one.
    modes : int
        Most modes drawn; the amplitudes are always shown for all.
    rtol : float
        Tolerance of the canonical form.

    Raises
    ------
    RankoneError
        If Matplotlib is not installed.
    EvaluationError
        If there are several unknowns and none was chosen, or there is no such unknown.
    OptionError
        If an option is out of its range.
    """
    check_solution("plot_modes", solution)
    if modes < 1:
        raise OptionError(f"modes={modes!r} is too small", remedy="at least 1")
    if unknown is None:
        if len(solution.unknowns) > 1:
            raise EvaluationError(
                f"there are {len(solution.unknowns)} unknowns: {', '.join(solution.unknowns)}",
                remedy="choose one: plot_modes(solution, unknown)",
            )
        unknown = solution.unknowns[0]
    name = solution[unknown].name
    form = solution.to_canonical(rtol)[name]
    figure, axes = panels(len(form.axes) + 1)
    figure.suptitle(f"{name}: {form.rank} modes, mean square error {form.error:.1e}")
    shown = min(modes, form.rank)
    for panel, axis in zip(axes, form.axes, strict=False):
        points = np.linspace(axis.breaks[0], axis.breaks[-1], _POINTS)
        values = axis.interpolate(form.factors[axis.name][:, :shown], points)
        for i in range(shown):
            panel.plot(points, values[:, i], label=f"{i + 1}")
        panel.set(xlabel=axis.name, title=f"functions of {axis.name}")
    if shown:
        figure.legend(handles=axes[0].get_lines(), title="mode", loc="outside right upper")
        axes[-1].semilogy(range(1, form.rank + 1), form.amplitudes, "o-")
    axes[-1].set(xlabel="mode", title="amplitudes")
    return figure
