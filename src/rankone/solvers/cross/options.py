"""Options of the cross engine, and the record of its attempts."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from rankone.discretization import BASES
from rankone.ir.outcome import SlabRecord
from rankone.support.executors import ExecutorLike, checked_executor
from rankone.support.options import Options, choice, integer


@dataclass(frozen=True)
class CrossOptions(Options):
    """Limits and discretisation of ``method="cross"``.

    Attributes
    ----------
    basis : {"chebyshev", "legendre"}
        Nodal basis of each parameter.
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
    max_attempts : int or None
        How often the interpolation may be repeated with more nodes or points;
        None: 10 times, and more while that pays.
    executor : concurrent.futures.Executor, distributed.Client, str, int or None
        Executor, or client of dask, that integrates trajectories, which is left running; the
        address of a scheduler of dask, or a number of processes. Solutions are the same to the bit.
    """

    basis: str = choice("chebyshev", BASES)
    time_nodes: int | None = integer(None, 4, 40)
    max_rank: int = integer(400)
    max_nodes: int = integer(1000, 4)
    max_slabs: int = integer(2000)
    max_trajectories: int = integer(4_000_000)
    max_attempts: int | None = integer(None)
    executor: ExecutorLike | None = field(default=None, metadata={"check": checked_executor})

    def nodes_in_time(self, rtol: float) -> int:
        """Gauss nodes per slab: more for tighter tolerances."""
        if self.time_nodes is not None:
            return self.time_nodes
        return int(min(max(round(5.6 + 1.4 * -math.log10(rtol)), 7), 20))


@dataclass(frozen=True, slots=True)
class CrossRecord(SlabRecord):
    """One interpolation over the whole horizon.

    ``tolerance`` is that of the skeletons, ``residuals`` holds for each parameter the size of its
    two highest modes, both in units of the states' sizes.

    Attributes
    ----------
    trajectories : int
        Number of trajectories integrated so far.
    slabs : int
        Number of time slabs.
    """

    trajectories: int = 0
    slabs: int = 1
