"""What happened in the loops of a solve: `plot_history`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from rankone.share.plotting.arguments import check_solution
from rankone.share.plotting.style import MOST_NAMED, several_axes
from rankone.solvers.engines.cross.cross_options import CrossRecord
from rankone.solvers.engines.greedy.slabs import EquationRecord, GreedySlabRecord
from rankone.solvers.outcome import SlabRecord
from rankone.support.errors import EvaluationError, OptionError
from rankone.support.wording import count

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from rankone.solution.solution import Solution


def plot_history(
    solution: Solution, *, slab: int = -1, ax: Sequence[Axes] | NDArray[np.object_] | None = None
) -> NDArray[np.object_]:
    """Plot what happened in the loops of a solve.

    For ``method="greedy"``, on one slab: change of each new mode in the passes of its fixed point,
    residual after every enrichment, amplitudes of the modes in the end; for all slabs: change of
    the unknowns in every update of the lagged terms. For ``method="train"``: change in every sweep
    of each slab, and the ranks of the slabs. For ``method="cross"``, which has one record for each
    attempt: size of the two highest modes of each parameter, and the ranks.

    Parameters
    ----------
    slab : int
        Slab of the first three plots of ``method="greedy"``: an index into the accepted slabs of
        the last attempt.
    ax : sequence of matplotlib.axes.Axes, optional
        Axes to draw into: four for ``method="greedy"``, else two. Those of a new figure, which has
        a title, if left out.

    Returns
    -------
    ndarray of matplotlib.axes.Axes
        One for each panel.

    Raises
    ------
    RankoneError
        If Matplotlib is not installed.
    EvaluationError
        If there is no history.
    OptionError
        If there is no such slab, or ``ax`` are not as many axes as there are panels.
    """
    check_solution("plot_history", solution)
    if not solution.history:
        raise EvaluationError("there is no history to plot")
    last = max(record.attempt for record in solution.history)
    records = [record for record in solution.history if record.attempt == last]
    if isinstance(records[-1], CrossRecord):
        return _plot_attempts(solution, records[-1].slabs, ax)
    accepted = [record for record in records if record.accepted] or records
    if not -len(accepted) <= slab < len(accepted):
        raise OptionError(f"slab={slab!r} is out of range", remedy=f"there are {len(accepted)}")
    chosen = accepted[slab]
    if isinstance(chosen, GreedySlabRecord) and chosen.equations:
        over = f"slab [{chosen.start:.3g}, {chosen.end:.3g}]"
        title = f"{solution.metadata.method}, {over}; updates of all slabs"
        axes = several_axes(ax, 4, title)
        _plot_fixed_points(axes[0], chosen.equations)
        _plot_residuals(axes[1], chosen.equations, chosen.tolerance)
        _plot_amplitudes(axes[2], chosen.equations)
        _plot_changes(axes[3], records, "update of the lagged terms")
        return axes
    title = f"{solution.metadata.method}, {count(len(records), 'slab')}"
    axes = several_axes(ax, 2, title)
    _plot_changes(axes[0], records, "sweep" if solution.metadata.method == "train" else "update")
    _plot_ranks(axes[1], records)
    return axes


def _plot_fixed_points(axes: Axes, equations: Sequence[EquationRecord]) -> None:
    """One line for each new mode; with lagged terms there are many, the later the darker."""
    runs = [mode.differences for record in equations for mode in record.modes]
    for i, differences in enumerate(runs):
        shade = 0.25 + 0.75 * (i + 1) / len(runs)
        axes.semilogy(
            range(1, len(differences) + 1), _positive(differences), "o-", color="C0", alpha=shade
        )
    axes.set(xlabel="pass over the dimensions", title="fixed point: change of a new mode")


def _plot_residuals(axes: Axes, equations: Sequence[EquationRecord], tolerance: float) -> None:
    """Residuals after every enrichment, over all updates, a line for each solve."""
    for color, state in enumerate(dict.fromkeys(record.state for record in equations)):
        count = 0
        for record in (record for record in equations if record.state == state):
            residuals = [mode.residual for mode in record.modes]
            steps = range(count + 1, count + 1 + len(residuals))
            label = state if not count and residuals else None
            axes.semilogy(steps, _positive(residuals), ".-", color=f"C{color}", label=label)
            count += len(residuals)
    axes.axhline(tolerance, color="grey", linestyle=":", label="tolerance")
    axes.set(xlabel="enrichment, over all updates", title="residual")
    axes.legend(fontsize="small")


def _plot_amplitudes(axes: Axes, equations: Sequence[EquationRecord]) -> None:
    """Amplitudes of the last solve of every state."""
    last = {record.state: record.amplitudes for record in equations}
    for state, amplitudes in last.items():
        axes.semilogy(range(1, len(amplitudes) + 1), _positive(amplitudes), "o-", label=state)
    axes.set(xlabel="mode", title="amplitudes in the end")
    axes.legend(fontsize="small")


def _plot_changes(axes: Axes, records: Sequence[SlabRecord], step: str) -> None:
    """Changes in every sweep or update, a line for each slab; rejected ones are dashed."""
    few = len(records) <= MOST_NAMED
    for i, record in enumerate(records):
        axes.semilogy(
            range(1, len(record.residuals) + 1),
            _positive(record.residuals),
            "o-" if record.accepted else "x--",
            label=f"[{record.start:.3g}, {record.end:.3g}]",
            color=f"C{i}" if few else "C0",
            alpha=1.0 if few else 0.35,
        )
    axes.set(xlabel=step, title="largest change of a state, in units of its size")
    if few:
        axes.legend(title="slab", fontsize="small")


def _plot_attempts(solution: Solution, slabs: int, ax: object) -> NDArray[np.object_]:
    """For each parameter its highest modes and the rank before it, a line for each attempt."""
    records = solution.history
    title = f"cross, {count(slabs, 'slab')}, {count(len(records), 'attempt')}"
    axes = several_axes(ax, 2, title)
    names = solution.metadata.parameters
    for record in records:
        label = f"{record.attempt + 1}"
        axes[0].semilogy(range(len(names)), _positive(record.residuals), "o-", label=label)
        axes[1].plot(range(len(names)), record.ranks, "o-", label=label)
    axes[0].set(title="two highest modes, in units of a state's size")
    axes[1].set(title="ranks before each parameter")
    for panel in axes:
        panel.set_xticks(range(len(names)), names)
        panel.set_xlabel("parameter")
        panel.legend(title="attempt", fontsize="small")
    return axes


def _plot_ranks(axes: Axes, records: Sequence[SlabRecord]) -> None:
    """Ranks of the accepted slabs over time, a line for each bond of the train."""
    accepted = [record for record in records if record.accepted and record.ranks]
    for bond in range(max((len(record.ranks) for record in accepted), default=0)):
        edges = [*(record.start for record in accepted), accepted[-1].end]
        axes.stairs([record.ranks[bond] for record in accepted], edges, label=f"{bond + 1}")
    axes.set(xlabel="time", title="ranks")
    if accepted:
        axes.legend(title="bond", fontsize="small")


def _positive(sizes: Sequence[float]) -> list[float]:
    """Sizes for a logarithmic axis: zeros and infinities leave gaps."""
    return [size if 0.0 < size < float("inf") else float("nan") for size in sizes]
