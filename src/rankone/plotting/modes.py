"""The base functions of one unknown: `plot_modes`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from rankone.discretization import Logarithm
from rankone.plotting.arguments import check_solution, state_of
from rankone.plotting.style import figure_of, several_axes
from rankone.support.errors import OptionError

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from rankone.interface.solution import Solution

_POINTS = 301  # Points at which a base function is drawn


def plot_modes(
    solution: Solution,
    unknown: object = None,
    *,
    modes: int = 5,
    rtol: float = 1e-3,
    ax: Sequence[Axes] | NDArray[np.object_] | None = None,
) -> NDArray[np.object_]:
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
    ax : sequence of matplotlib.axes.Axes, optional
        Axes to draw into, one for each coordinate and one for the amplitudes. Those of a new
        figure, which has a title, if left out.

    Returns
    -------
    ndarray of matplotlib.axes.Axes
        One for each panel.

    Raises
    ------
    RankoneError
        If Matplotlib is not installed.
    EvaluationError
        If there are several unknowns and none was chosen, or there is no such unknown.
    OptionError
        If an option is out of its range, or ``ax`` are not as many axes as there are panels.
    """
    check_solution("plot_modes", solution)
    if modes < 1:
        raise OptionError(f"modes={modes!r} is too small", remedy="at least 1")
    name = state_of(solution, unknown, "plot_modes")
    form = solution.to_canonical(rtol)[name]
    title = f"{name}: {form.rank} modes, mean square error {form.error:.1e}"
    axes = several_axes(ax, len(form.axes) + 1, title)
    shown = min(modes, form.rank)
    for panel, axis in zip(axes, form.axes, strict=False):
        start, end = axis.scale.to_scale(np.array([axis.breaks[0], axis.breaks[-1]]))
        points = axis.scale.from_scale(np.linspace(start, end, _POINTS))
        functions = axis.interpolate(form.factors[axis.name][:, :shown], points)
        for i, column in enumerate(functions.T):
            panel.plot(points, column, label=f"{i + 1}")
        panel.set(xlabel=axis.name, title=f"functions of {axis.name}")
        if isinstance(axis.scale, Logarithm):
            panel.set_xscale("log")
    if shown:
        lines = axes[0].get_lines()[-shown:]
        if ax is None:
            figure_of(axes[0]).legend(handles=lines, title="mode", loc="outside right upper")
        else:
            axes[0].legend(handles=lines, title="mode", fontsize="small")
        axes[-1].semilogy(range(1, form.rank + 1), form.amplitudes, "o-")
    axes[-1].set(xlabel="mode", title="amplitudes")
    return axes
