"""Options of the cross engine."""

from __future__ import annotations

import math
from dataclasses import dataclass

from rankone.discretization import BASES
from rankone.options import Options, choice, integer

__all__ = ["CrossOptions"]


@dataclass(frozen=True)
class CrossOptions(Options):
    """Limits and discretisation of ``method="cross"``.

    Attributes
    ----------
    basis : {"chebyshev", "legendre"}
        Nodal basis of the parameters.
    time_nodes : int or None
        Gauss nodes per slab; None chooses by the tolerance.
    max_rank : int
        Largest rank of the train.
    max_nodes : int
        Largest number of nodes in one parameter.
    max_slabs : int
        Largest number of slabs on which the reference is resolved.
    max_trajectories : int
        Largest number of trajectories integrated in all.
    max_attempts : int
        How often the interpolation may be repeated with more nodes or points.
    """

    basis: str = choice("chebyshev", BASES)
    time_nodes: int | None = integer(None, 4, 40)
    max_rank: int = integer(400)
    max_nodes: int = integer(500, 4)
    max_slabs: int = integer(2000)
    max_trajectories: int = integer(200_000)
    max_attempts: int = integer(10)

    def nodes_in_time(self, rtol: float) -> int:
        """Gauss nodes per slab: more for tighter tolerances."""
        if self.time_nodes is not None:
            return self.time_nodes
        return int(min(max(round(5.6 + 1.4 * -math.log10(rtol)), 7), 20))
