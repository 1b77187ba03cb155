"""What the next attempt costs at least, from the nodes and the ranks of the last one."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from rankone.solvers.attempts import LEAST_COST_RATIO

# Rank over the largest one for its nodes from which it is that of a front, and grows with them
_FULL_RANK = 0.5


@dataclass(frozen=True)
class AttemptCost:
    """An attempt with some ``nodes`` of the parameters: its ranks, trajectories and work."""

    nodes: Sequence[int]
    ranks: Sequence[int]
    trajectories: int
    work: float

    def least(self, nodes: Sequence[int]) -> float:
        """Least work of the next attempt, which has other nodes."""
        return LEAST_COST_RATIO * self._least_ratio(nodes) * self.work

    def _least_ratio(self, nodes: Sequence[int]) -> float:
        """Trajectories of the next attempt over those of this one, at least.

        At the first bond they are as many as nodes times the rank behind it. Later bonds have left
        points as well, at least as many as before: of their ratios the least counts.
        """
        behind, ratios = [*self.ranks[1:], 1], list[float]()
        for b, rank in enumerate(behind):
            before, after = math.prod(self.nodes[b + 1 :]), math.prod(nodes[b + 1 :])
            grows = rank >= _FULL_RANK * before
            factor = max(after / before, 1.0) if grows else 1.0
            ratios.append(nodes[b] / self.nodes[b] * factor)
        first = min(self.nodes[0] * behind[0] / max(self.trajectories, 1), 1.0)
        return first * ratios[0] + (1.0 - first) * min(ratios[1:], default=ratios[0])
