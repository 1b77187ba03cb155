"""How far an attempt of the cross engine is, reported batch after batch."""

from __future__ import annotations

from dataclasses import replace

from rankone.support.progress import ProgressEvent, Report

__all__ = ["Pace"]

_LINES = 0.1
"""Part of an attempt that the lines take on which nodes are chosen."""
_LEAST = 0.005
"""Smallest change that is reported."""


class Pace:
    """The part of an attempt that is done: first lines through the box, then a sweep over bonds.

    Parameters
    ----------
    report : callable
    event : ProgressEvent
        The beginning of the attempt.
    """

    def __init__(self, report: Report, event: ProgressEvent) -> None:
        self.report, self.event = report, event
        self._stage = 0.0, _LINES

    def bond(self, done: int, total: int, rank: int) -> None:
        """A sweep has done so many bonds; ``rank`` is the largest so far."""
        width = (1.0 - _LINES) / total
        begin = _LINES + done * width
        self._stage = begin, begin + width
        self.event = replace(self.event, rank=max(rank, self.event.rank))
        self.batch(0.0)

    def batch(self, share: float) -> None:
        """So much of the trajectories that are being integrated is done."""
        begin, end = self._stage
        fraction = begin + share * (end - begin)
        if fraction >= self.event.fraction + _LEAST:
            self.event = replace(self.event, fraction=fraction)
            self.report(self.event)
