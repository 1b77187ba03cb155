"""What trajectories over the pseudo-time of stretches share."""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np

from rankone.support.arrays import Array


class PseudoTimeTrajectories(ABC):
    """Trajectories from 0 to the number of stretches, all of which go to their end.

    Subclasses fulfil :class:`DenseTrajectories`.
    """

    @property
    @abstractmethod
    def end(self) -> float:
        """The number of stretches."""

    @abstractmethod
    def __call__(self, times: Array) -> Array:
        """States at pseudo-times (T,): shape (n, m, T)."""

    @property
    def start(self) -> float:
        return 0.0

    @property
    def has_begun(self) -> bool:
        return True

    @property
    def state(self) -> Array:
        return self(np.array([self.end]))[:, :, 0]

    @property
    def last(self) -> Array:
        return self.state
