"""What an engine returns: separated tensors per slab, what was measured, and how it went."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from enum import Enum

from rankone.support.budget import OutOfBudgetError, OutOfWorkError
from rankone.tensors.slab import SlabTrain

__all__ = ["Measured", "Outcome", "SafeInterval", "SlabRecord", "Status"]


class Status(Enum):
    """How a solve ended; the value is the sentence a user reads first."""

    CONVERGED = "the measured error is within the tolerance"
    UNCHECKED = "no check was asked for, so the error is not known"
    TOLERANCE = "the measured error is above the tolerance"
    RANK_LIMIT = "the rank limit was reached"
    NODE_LIMIT = "the limit of parameter nodes was reached"
    SLAB_LIMIT = "the limit of time slabs was reached"
    MEMORY_LIMIT = "the memory limit was reached"
    WORK_LIMIT = "the budget of work was reached"
    TIME_LIMIT = "the time limit was reached"
    TRAJECTORY_LIMIT = "the limit of trajectories was reached"
    NO_CONVERGENCE = "the sweeps did not converge on any slab length"
    STEEP = "the solution depends steeply on a parameter"
    BLOW_UP = "a trajectory blows up inside the horizon"
    SWITCHES = "a trajectory switches to and fro without end"
    LEAVES = "a trajectory comes to where its right-hand side is not finite"

    @property
    def ends_early(self) -> bool:
        """Whether a trajectory does not reach the end of the horizon."""
        return self in (Status.BLOW_UP, Status.LEAVES, Status.SWITCHES)

    @classmethod
    def of_limit(cls, error: OutOfBudgetError) -> Status:
        """How a solve ended that ran out of its budget."""
        return cls.WORK_LIMIT if isinstance(error, OutOfWorkError) else cls.TIME_LIMIT


@dataclass(frozen=True, slots=True)
class SlabRecord:
    """One accepted or rejected slab.

    Attributes
    ----------
    attempt : int
        Index of the attempt, from 0: a solve is repeated with a tighter inner tolerance when
        the check asks for it.
    start, end : float
        The slab.
    tolerance : float
        Inner tolerance of the slab, in units of each state's size.
    residuals : tuple of float
        Largest change of the train in each sweep, in the same unit.
    ranks : tuple of int
        Ranks at the end of the sweeps.
    nodes : tuple of int
        Parameter nodes in each dimension.
    """

    attempt: int
    start: float
    end: float
    accepted: bool
    tolerance: float
    residuals: tuple[float, ...]
    ranks: tuple[int, ...]
    nodes: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class Measured:
    """Errors against SciPy trajectories over the whole horizon, relative to each state's size.

    Attributes
    ----------
    interior : tuple of float
        For each state the largest error over interior parameter points, and over the corners of
        the box where they count.
    corners : tuple of float
        For each state the largest error over corners of the box; empty without parameters.
    points : int
        Number of trajectories compared.
    method : str
        The SciPy method of the reference.
    cover : {"interior", "box"}
        Whether the corners are among the errors in ``interior``.
    quantile : float or None
        95 % of the points that count are no worse.
    worst : tuple of float
        The worst of them.
    counted : tuple of int or None
        The states that success is for; None for all.
    drift : float or None
        Largest difference between lifted states and what they stand for, relative to their sizes;
        None where none are lifted.
    """

    interior: tuple[float, ...]
    corners: tuple[float, ...]
    points: int
    method: str
    cover: str = "interior"
    quantile: float | None = None
    worst: tuple[float, ...] = ()
    counted: tuple[int, ...] | None = None
    drift: float | None = None

    @property
    def error(self) -> float:
        """Largest error of the states that count."""
        return self._largest(self.interior)

    @property
    def corner_error(self) -> float:
        """Largest of those at corners; 0 without any."""
        return self._largest(self.corners)

    def _largest(self, errors: tuple[float, ...]) -> float:
        counted = range(len(errors)) if self.counted is None else self.counted
        return max((errors[i] for i in counted if errors), default=0.0)


@dataclass(frozen=True, slots=True)
class SafeInterval:
    """A shorter interval of one parameter, without the trajectories seen to have an early end.

    Attributes
    ----------
    parameter : int
    lower, upper : float
    below : bool
        Whether the upper end was moved, and not the lower one.
    share : float
        Its length over that of the whole interval.
    """

    parameter: int
    lower: float
    upper: float
    below: bool
    share: float

    def shortened(self, kept: float) -> SafeInterval:
        """The same with a part of its length, away from where trajectories end."""
        length, share = kept * (self.upper - self.lower), kept * self.share
        if self.below:
            return replace(self, upper=self.lower + length, share=share)
        return replace(self, lower=self.upper - length, share=share)


@dataclass(frozen=True)
class Outcome:
    """The result of an engine.

    Attributes
    ----------
    slabs : tuple of SlabTrain
        Consecutive slabs, all differential states.
    message : str
        One or two sentences: how it ended, why, and what to do.
    measured : Measured or None
        None when no check was made.
    timings : dict of str to float
        Seconds by stage: ``reference``, ``march``, ``check``.
    work : dict of str to float
        Operations counted in the same stages: shares of the budget that ``effort`` sets.
    blow_up : tuple or None
        Time and parameter values near which a trajectory blows up.
    safe : tuple of SafeInterval
        Where the box would have to end instead, the one that keeps most of it first.
    switching : int or None
        The state whose rate switches to and fro where the reference trajectories came to an end.
    """

    slabs: tuple[SlabTrain, ...]
    status: Status
    message: str
    measured: Measured | None
    history: tuple[SlabRecord, ...]
    timings: dict[str, float] = field(default_factory=dict)
    work: dict[str, float] = field(default_factory=dict)
    blow_up: tuple[float, tuple[float, ...]] | None = None
    safe: tuple[SafeInterval, ...] = ()
    switching: int | None = None

    @property
    def error(self) -> float:
        """Largest measured error; infinite if there is none."""
        return math.inf if self.measured is None else self.measured.error
