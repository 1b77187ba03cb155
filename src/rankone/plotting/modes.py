"""The base functions of one unknown: `plot_modes`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from rankone.plotting.asked import check_solution, only_unknown
from rankone.plotting.style import several_axes
from rankone.support.errors import OptionError

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from rankone.interface.solution import Solution

__all__ = ["plot_modes"]

_POINTS = 301
"""Points at which a base function is drawn."""


def plot_modes(
    solution: Solution,
    unknown: Any = None,
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
    name = solution[only_unknown(solution, "plot_modes") if unknown is None else unknown].name
    form = solution.to_canonical(rtol)[name]
    axes, new = several_axes(ax, len(form.axes) + 1)
    if new:
        title = f"{name}: {form.rank} modes, mean square error {form.error:.1e}"
        axes[0].figure.suptitle(title)
    shown = min(modes, form.rank)
    for panel, axis in zip(axes, form.axes, strict=False):
        points = np.linspace(axis.breaks[0], axis.breaks[-1], _POINTS)
        values = axis.interpolate(form.factors[axis.name][:, :shown], points)
        for i in range(shown):
            panel.plot(points, values[:, i], label=f"{i + 1}")
        panel.set(xlabel=axis.name, title=f"functions of {axis.name}")
    if shown:
        _legend(axes[0], shown, new)
        axes[-1].semilogy(range(1, form.rank + 1), form.amplitudes, "o-")
    axes[-1].set(xlabel="mode", title="amplitudes")
    return axes


def _legend(ax: Axes, shown: int, new: bool) -> None:
    """Numbers of the modes, beside all panels of a new figure."""
    lines = ax.get_lines()[-shown:]
    if new:
        figure = ax.get_figure()
        assert figure is not None
        figure.legend(handles=lines, title="mode", loc="outside right upper")
    else:
        ax.legend(handles=lines, title="mode", fontsize="small")
