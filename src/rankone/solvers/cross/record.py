"""What happened in an attempt of the cross engine, as data."""

from __future__ import annotations

from dataclasses import dataclass

from rankone.ir.outcome import SlabRecord

__all__ = ["CrossRecord"]


@dataclass(frozen=True, slots=True)
class CrossRecord(SlabRecord):
    """One interpolation over the whole horizon.

    ``tolerance`` is that of the row spaces, ``residuals`` holds for each parameter the size of its
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
