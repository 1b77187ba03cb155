"""Options of the tensor-train engine."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

from rankone.discretization import BASES
from rankone.support.options import Options, choice, integer, number


@dataclass(frozen=True)
class TrainOptions(Options):
    """Limits and discretisation of ``method="train"``.

    Attributes
    ----------
    basis : {"chebyshev", "legendre"}
        Nodal basis of the parameters.
    time_nodes : int or None
        Radau nodes per slab; None chooses by the tolerance.
    max_rank : int
        Largest rank of the train.
    max_degree : int
        Largest number of nodes of one parameter element; beyond it the interval is split.
    max_nodes : int
        Largest number of nodes in one parameter.
    max_slabs : int
        Largest number of accepted and rejected slabs in one attempt.
    max_sweeps : int
        Largest number of sweeps on one slab.
    max_attempts : int or None
        How often the solve may be repeated with a tighter inner tolerance;
        None: 5 times, and more while that pays.
    max_memory : float
        Largest estimated working memory in bytes.
    """

    usual_attempts: ClassVar[int] = 5

    basis: str = choice("chebyshev", BASES)
    time_nodes: int | None = integer(None, 2, 32)
    max_rank: int = integer(250)
    max_degree: int = integer(64, 4)
    max_nodes: int = integer(400, 4)
    max_slabs: int = integer(2000)
    max_sweeps: int = integer(14, 3)
    max_attempts: int | None = integer(None)
    max_memory: float = number(4e9, 1)

    def nodes_in_time(self, rtol: float) -> int:
        """Radau nodes per slab: more for tighter tolerances, 9 at 1e-3 and 16 at 1e-8."""
        if self.time_nodes is not None:
            return self.time_nodes
        digits = -math.log10(rtol)
        return int(min(max(round(4.6 + 1.4 * digits), 6), 18))
