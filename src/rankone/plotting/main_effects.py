"""Main effects: means of the unknowns over all parameters but one.

With ``a(t) c_1(p_1) ... c_d(p_d)`` the mean given ``p_j`` is the product with all other matrices
replaced by their means.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from rankone.arrays import Array
from rankone.statistics.moments import TrainMoments

if TYPE_CHECKING:
    from rankone.solution import Solution

__all__ = ["MainEffects", "main_effects_of"]


@dataclass(frozen=True)
class MainEffects:
    """Means given one parameter, at one time.

    Attributes
    ----------
    parameters : tuple of str
    values : dict of str to ndarray (count,)
        For each parameter where the means are.
    means : dict of str to ndarray (unknowns, count)
    """

    parameters: tuple[str, ...]
    values: dict[str, Array]
    means: dict[str, Array]


def main_effects_of(
    solution: Solution, time: float | None, count: int, under: Mapping[Any, Any] | None
) -> MainEffects:
    """The main effects of all parameters at one time; None if nothing depends on time."""
    method = getattr(solution, "main_effects", None)
    if method is not None:
        found: MainEffects = method(time, count=count, under=under)
        return found
    names, box = solution.metadata.parameters, solution.metadata.box
    statistics = solution._statistics(under)
    slabs = statistics.slabs
    when = solution.time[0] if time is None else time
    slab = slabs[int(np.searchsorted([s.start for s in slabs[1:]], when, side="right"))]
    moments = TrainMoments(slab.cores[1:], slab.bases, statistics.measures)
    first = slab.in_time(np.array([when]))[statistics.rows, 0]
    values, means = {}, {}
    for j, name in enumerate(names):
        values[name] = np.linspace(*box[j], count)
        modes = slab.bases[j].modal_values(values[name])
        given = np.einsum("gm,rms,s->rg", modes, slab.cores[1 + j], moments.after[j + 1])
        means[name] = first @ given
        first = first @ moments.means[j]
    return MainEffects(names, values, means)
