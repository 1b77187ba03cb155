"""Options of the tensor-train engine."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from rankone.discretization import BASES
from rankone.errors import OptionError
from rankone.solvers.request import checked_number

__all__ = ["TrainOptions"]

_LEAST = {"time_nodes": 2, "max_degree": 4, "max_nodes": 4, "max_sweeps": 3}
_MOST = {"time_nodes": 32}
"""Ranges of the numbers; otherwise from one on."""


@dataclass(frozen=True, slots=True)
class TrainOptions:
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
    max_attempts : int
        How often the solve may be repeated with a tighter inner tolerance.
    max_memory : float
        Largest estimated working memory in bytes.
    """

    basis: str = "chebyshev"
    time_nodes: int | None = None
    max_rank: int = 250
    max_degree: int = 64
    max_nodes: int = 400
    max_slabs: int = 2000
    max_sweeps: int = 14
    max_attempts: int = 5
    max_memory: float = 4e9

    def __post_init__(self) -> None:
        if self.basis not in list(BASES):
            raise OptionError(f"basis={self.basis!r} is unknown", remedy=f"one of {sorted(BASES)}")
        for name in list(self.__dataclass_fields__)[1:]:
            least, most = _LEAST.get(name, 1), _MOST.get(name, math.inf)
            kind = float if name == "max_memory" else int
            value = getattr(self, name)
            if value is not None or name != "time_nodes":
                object.__setattr__(self, name, checked_number(name, value, least, most, kind))

    @classmethod
    def of(cls, /, **changes: Any) -> TrainOptions:
        """Options with changes.

        Raises
        ------
        OptionError
            If an option is unknown or out of its range.
        """
        known = sorted(cls.__dataclass_fields__)
        for name in sorted(changes.keys() - known):
            raise OptionError(f"unknown option {name!r}", remedy=f"choose from {', '.join(known)}")
        return cls(**changes)

    def nodes_in_time(self, rtol: float) -> int:
        """Radau nodes per slab: more for tighter tolerances, 9 at 1e-3 and 16 at 1e-8."""
        if self.time_nodes is not None:
            return self.time_nodes
        digits = -math.log10(rtol)
        return int(min(max(round(4.6 + 1.4 * digits), 6), 18))
