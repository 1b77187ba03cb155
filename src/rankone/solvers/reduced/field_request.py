"""What is asked of a solve of fields, what it came to, and the numbers that it goes by."""

from __future__ import annotations

from dataclasses import dataclass, field

from rankone.solvers.engines.engine_options import CrossOptions
from rankone.solvers.outcome import Outcome, SolutionMetadata
from rankone.solvers.reduced.field_modes import FieldModes
from rankone.solvers.request import Domain, Limits
from rankone.support.tasks import ExecutorLike
from rankone.trajectories.system.verdict import Verdict


@dataclass(frozen=True)
class FieldTuning:
    """The numbers of a solve by modes; shares are of the tolerance that was asked for."""

    integrated: float = 0.05
    """Error of full trajectories."""
    integrated_motion: float = 0.01
    """The same where there are velocities: stiff bodies amplify rough parts of modes."""
    first_step: float = 0.01
    """Tolerance of a step at first; it is lowered until the error above is met."""
    finer: float = 0.1
    """Factor on the tolerance of trajectories that tell errors of others."""
    least_step: float = 1e-12
    tolerance_times: int = 48
    kept: float = 0.01
    """What compressed trajectories leave out."""
    kept_motion: float = 0.001
    """The same where there are velocities."""
    modes: float = 0.4
    """What the modes leave out of all trajectories so far, at first."""
    fewest_left_out: float = 0.02
    """The same at least."""
    tightened: float = 0.3
    """Factor on it where the reduced system adds much to what the modes leave out."""
    added: float = 3.0
    """Error of the reduced system over what its modes leave out that is much."""
    reduced: float = 0.8
    """Error of the reduced system at which it is solved, in two rounds of points."""
    far_below: float = 0.3
    """The same in one round."""
    solved: float = 0.4
    """Tolerance of its solution, at first."""
    solution: float = 0.5
    """Error of its solution, against trajectories of the reduced system, that suffices."""
    settled: float = 0.7
    """Factor on that error by which a tighter tolerance has to lower it to be tightened again."""
    first_corners: int = 4
    """Corners among the first points, beside the centre."""
    at_once: int = 3
    """Further points of a round."""
    candidates: int = 64
    """Points, and corners, at which the residual is looked at."""
    residual_times: int = 24
    distance: float = 0.15
    """Least distance of new points, in widths of the box."""
    effort: float = 16.0
    """Budget of the solve for coefficients, over that of a system without fields."""
    spread_checks: int = 12
    worst_checks: int = 8
    most_modes: int = 150
    """Coefficients of all unknowns together."""
    most_trajectories: int = 100
    line_places: int = 1025
    """Places on a line through the box, and times, at which rates are looked at."""
    looked_at: int = 16
    """Entries of elementwise functions that are looked at."""
    narrow: float = 0.1
    """Part of a line on which a coefficient is far from its median that is narrow."""
    slow: float = 0.02
    """Change of a coefficient from one time to the next, over all of it, that needs no care."""
    jump: float = 0.5
    """The same that is too much to be followed."""
    coefficient_checks: int = 16
    """Points, and corners, at which a solution for the coefficients is compared with these."""
    rounds: int = 4
    """Solutions that are measured at most: what disagrees becomes modes."""


FIELDS = FieldTuning()


@dataclass(frozen=True)
class FieldRequest:
    """What is asked of a solve of fields.

    ``check`` is the number of evenly spread points at which errors are measured, beside the worst
    ones; none are with 0. ``options`` are those of the cross engine, ``executor`` takes the full
    trajectories, of which there are ``trajectories`` at most.
    """

    rtol: float
    domain: Domain
    check: int = FIELDS.spread_checks
    limits: Limits = field(default_factory=Limits)
    options: CrossOptions = field(default_factory=CrossOptions)
    executor: ExecutorLike | None = None
    trajectories: int = FIELDS.most_trajectories

    @property
    def checked(self) -> int:
        """Full trajectories of a check, at least."""
        if not self.check:
            return 0
        return self.check + FIELDS.worst_checks if self.domain.box else 1

    @property
    def fewest(self) -> int:
        """Full trajectories of a solve, at least: the first ones, a round of others, the check."""
        d = len(self.domain.box)
        return (1 + min(2**d, FIELDS.first_corners) + FIELDS.at_once if d else 2) + self.checked


@dataclass(frozen=True)
class ReducedOutcome:
    """What a solve of fields came to: modes, the outcome of the coefficients, and how it ended.

    Without any, where it ended before.
    """

    verdict: Verdict
    modes: FieldModes | None = None
    outcome: Outcome | None = None
    metadata: SolutionMetadata | None = None
    timings: dict[str, float] = field(default_factory=dict)
    work: float = 0.0
    trajectories: int = 0
