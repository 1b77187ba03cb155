"""Judgement of the sweeps on one slab by their residuals."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

__all__ = ["Convergence"]

_SLOWEST = 0.6
"""A residual that falls by less, after four sweeps, will not get there."""
_RELIABLE = 0.5
"""A smaller ratio of residuals says how far the next would fall ..."""
_LEAST_RATIO = 0.15
"""... but it is never trusted below this."""
_HOPELESS = 1e2
_STAGNANT = 0.3


@dataclass
class Convergence:
    """How fine the next sweep truncates, whether the slab is solved, whether it is hopeless.

    The residual of a sweep is the largest change of a pair of cores, in units of the states'
    sizes. What is still missing after a sweep is about the residual times the contraction.

    Parameters
    ----------
    tolerance : float
        Accuracy wanted of the slab.
    coarse : float
        Tolerance of the first sweep, which need not be fine.

    Attributes
    ----------
    residuals : list of float
        Of all sweeps on the slab.
    contraction : float
        Ratio of the last two residuals, 0.1 before it is known.
    """

    tolerance: float
    coarse: float
    residuals: list[float] = field(default_factory=list)
    contraction: float = 0.1
    _since_restart: int = 0

    @property
    def next_tolerance(self) -> float:
        """Truncation tolerance of the next sweep."""
        return self.tolerance if self._since_restart else max(self.tolerance, self.coarse)

    def add(self, residual: float) -> None:
        """Take notice of a sweep."""
        if self._since_restart:
            last = self.residuals[-1]
            self.contraction = residual / last if last > 0.0 else 0.0
        self._final = self.next_tolerance == self.tolerance
        self.residuals.append(residual)
        self._since_restart += 1

    def restart(self) -> None:
        """Parameter nodes were added: count anew, from the last residual."""
        self._since_restart = min(self._since_restart, 1)
        self.contraction = 0.1

    def solved(self, limited: bool) -> bool:
        """Whether the slab is as accurate as wanted, or as the rank limit allows."""
        if limited and self._since_restart >= 3 and self.contraction > _STAGNANT:
            return True
        known = self._since_restart > 1 and self.contraction < _RELIABLE
        ahead = self.residuals[-1] * (max(self.contraction, _LEAST_RATIO) if known else 1.0)
        return self._final and ahead <= self.tolerance

    def hopeless(self, limited: bool) -> bool:
        """Whether the sweeps diverge or fall too slowly."""
        residual = self.residuals[-1]
        if not math.isfinite(residual) or residual > _HOPELESS:
            return True
        return self._since_restart >= 4 and self.contraction > _SLOWEST and not limited
