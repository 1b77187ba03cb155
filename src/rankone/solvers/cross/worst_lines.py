"""How many nodes the worst points of an attempt need, read off trajectories on lines through them.

The modes of a train are means over the box and over time. Where a front is met in one corner
alone, or at the end of the horizon, the errors there are a hundred times the tails of these means,
and nodes that follow the means come too late. On a line through such a point the largest mode of a
state at any time tells the error at that point.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from rankone.discretization import Basis1D
from rankone.ir.request import Domain
from rankone.support.arrays import Array
from rankone.tensors.adaptive import LinePoints, needed

_LINE_RATIO = 1.5  # Nodes of a line over those of the attempt: they show what it missed
_MORE_NODES = 2  # Nodes of a line over those that did not resolve it
_TAIL_SHARE = 0.1  # Sum of the modes left out on a line, over rtol, that nodes aim at
# Sum of the modes that an attempt left out, over its error, that explains the error
_EXPLAINING_SHARE = 0.3


@dataclass(frozen=True)
class WorstLines:
    """What lines through the worst points tell of the bases of an attempt.

    ``nodes`` are those that each parameter needs, and ``missed`` is the largest sum of modes that
    an attempt left out, in units of the sizes of states.
    """

    nodes: tuple[int, ...]
    missed: float

    def explain(self, error: float) -> bool:
        """Whether too few nodes are the reason of an error."""
        return self.missed > _EXPLAINING_SHARE * error


@dataclass(frozen=True)
class LineLimits:
    """The most nodes of a line, and the most trajectories on all of them after the first ones."""

    nodes: int
    trajectories: float


def worst_lines(
    trajectories: Callable[[Array], Array],
    domain: Domain,
    bases: Sequence[Basis1D],
    points: Array,
    rtol: float,
    limits: LineLimits,
) -> WorstLines:
    """Draw lines of each parameter through points (m, d) of the box.

    The trajectories at points (k, d) are in units of the sizes of states: (n, T, k). Lines that
    their nodes do not resolve are drawn again with more, as far as the limits allow. Parameters
    with several elements keep their bases: these are halved where they do not suffice.
    """
    drawn = {
        j: replace(basis, degree=math.ceil(_LINE_RATIO * basis.size))
        for j, basis in enumerate(bases)
        if basis.elements == 1
    }
    nodes, missed, most = [basis.size for basis in bases], 0.0, limits.trajectories
    lines = LinePoints(domain.box, domain.first_coordinates, through=points)
    while drawn and most >= 0.0:
        counts = [len(points) * basis.size for basis in drawn.values()]
        states = trajectories(lines([(j, basis.nodes) for j, basis in drawn.items()]))
        on_each = np.split(states, np.cumsum(counts)[:-1], axis=2)
        finer = dict[int, Basis1D]()
        for (j, basis), on_lines in zip(drawn.items(), on_each, strict=True):
            modes = (on_lines.reshape(-1, basis.size) * np.sqrt(basis.weights)) @ basis.to_modal.T
            tails = np.cumsum(np.abs(modes).max(axis=0)[::-1])[::-1]
            missed = max(missed, float(tails[bases[j].size]))
            small = np.flatnonzero(tails <= _TAIL_SHARE * rtol)
            if small.size > 1:
                nodes[j] = int(small[0])
                continue
            nodes[j] = needed(tails, _TAIL_SHARE * rtol)
            if basis.size < limits.nodes:
                degree = min(max(_MORE_NODES * basis.size, nodes[j]), limits.nodes)
                finer[j] = replace(basis, degree=degree)
        most -= len(points) * sum(basis.size for basis in finer.values())
        drawn = finer
    return WorstLines(tuple(nodes), missed)
