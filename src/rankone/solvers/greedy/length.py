"""The lengths of slabs: as many as asked for, or as the lagged terms settle."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from rankone.ir.outcome import Status
from rankone.solvers.greedy.options import GreedyOptions
from rankone.solvers.greedy.slabs import GreedyTrial
from rankone.solvers.march import Span

__all__ = ["SlabLengths"]

_SHORTEST = 1e-6
"""Shortest slab, relative to the horizon."""
_FEW, _MANY = 10, 16
"""Lagged iterations after which the next slab is longer, or shorter."""
_GROW, _SHRINK, _HALVE = 1.5, 0.7, 0.5


@dataclass
class SlabLengths:
    """The controller of the lengths of slabs.

    Parameters
    ----------
    start, end : float
        The horizon.
    longest : float
        Of the first slab if the lengths adapt.
    cuts : sequence of float
        Times, ascending, that no slab crosses.
    """

    start: float
    end: float
    options: GreedyOptions
    longest: float = math.inf
    cuts: Sequence[float] = ()

    def __post_init__(self) -> None:
        self.horizon, count = self.end - self.start, self.options.time_slabs
        self.adaptive = count is None
        self.length = self.horizon / count if count else min(self.horizon, self.longest)
        self._hopeless = False

    def propose(self, start: float) -> Span | Status:
        """The next of equal slabs that fill what remains up to the end, or to the next cut."""
        if self._hopeless:
            return Status.NO_CONVERGENCE
        border = next((cut for cut in self.cuts if start < cut < self.end), self.end)
        remaining = border - start
        length = remaining / max(math.ceil(remaining / self.length - 1e-9), 1)
        if border == self.end:
            self.length = length
        end = border if remaining < 1.01 * length else start + length
        return Span(start, length, end)

    def adapt(self, span: Span, trial: GreedyTrial) -> bool:
        """Halve after a rejection, lengthen where few iterations were needed."""
        if not trial.record.accepted:
            self.length = _HALVE * span.length
            self._hopeless = not self.adaptive or self.length <= _SHORTEST * self.horizon
        elif self.adaptive:
            iterations = len(trial.record.residuals)
            factor = _GROW if iterations <= _FEW else _SHRINK if iterations > _MANY else 1.0
            longer = span.length * (_HALVE if Status.RANK_LIMIT in trial.limits else factor)
            self.length = max(longer, self.length) if span.end in self.cuts else longer
        return trial.record.accepted
