"""What an engine returns: separated tensors per slab, what was measured, and how it went."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

from rankone.ir.metadata import SolutionMetadata
from rankone.ir.timeline import BranchedTimeline, Timeline
from rankone.ir.verdict import Cause, Note, Status, Verdict
from rankone.support.errors import EvaluationError
from rankone.tensors.slab import SlabTrain, fixed


@dataclass(frozen=True, slots=True)
class SlabRecord:
    """One accepted or rejected slab, with the train's ranks and parameter nodes at the end.

    ``attempt`` counts from 0: a solve is repeated with a tighter inner tolerance when the check
    asks for it. ``tolerance``, and ``residuals``, the largest change of the train in each sweep,
    are in units of each state's size. ``integrator`` integrated the trajectories that were sampled,
    or those of the reference where none are sampled: "stack", "single" or "compiled".
    """

    attempt: int
    start: float
    end: float
    accepted: bool
    tolerance: float
    residuals: tuple[float, ...]
    ranks: tuple[int, ...]
    nodes: tuple[int, ...]
    integrator: str = field(default="stack", kw_only=True)


@dataclass(frozen=True, slots=True)
class Measured:
    """Errors against SciPy trajectories over the whole horizon, relative to each state's size.

    ``interior`` has for each state the largest error over interior parameter points, and over the
    corners of the box where ``cover`` is "box"; ``corners`` that over corners, empty without
    parameters. ``points`` trajectories were compared, made by the ``integrator`` with its
    ``method``; 95 % of those that count are no worse than ``quantile``, and ``worst`` is the worst
    of them; ``also_bad`` are the next ones at other places of the box. ``counted`` are the states
    that success is for, None for all. ``drift`` is the largest difference between lifted states and
    what they stand for, relative to their sizes; None where none are lifted. ``time_error`` is the
    largest error of the time of an event, over the horizon, and ``share_error`` the largest one of
    a state at equal shares of stretches, relative to its size; both None without events.
    ``constraint_drift`` is how far states are from satisfying algebraic equations, relative to
    their sizes, and a part of the errors; None without any.
    """

    interior: tuple[float, ...]
    corners: tuple[float, ...]
    points: int
    method: str
    cover: str = "interior"
    quantile: float | None = None
    worst: tuple[float, ...] = ()
    also_bad: tuple[tuple[float, ...], ...] = ()
    counted: tuple[int, ...] | None = None
    drift: float | None = None
    integrator: str = "stack"
    time_error: float | None = None
    share_error: float | None = None
    constraint_drift: float | None = None

    @property
    def error(self) -> float:
        """Largest error of the states that count."""
        return self._largest(self.interior)

    @property
    def corner_error(self) -> float:
        """Largest of those at corners; 0 without any."""
        return self._largest(self.corners)

    @property
    def worst_first(self) -> list[int]:
        """The states that count, by their errors."""
        states = range(len(self.interior)) if self.counted is None else self.counted
        return sorted(states, key=lambda i: -self.interior[i])

    def _largest(self, errors: tuple[float, ...]) -> float:
        counted = range(len(errors)) if self.counted is None else self.counted
        return max((errors[i] for i in counted if errors), default=0.0)


@dataclass(frozen=True, slots=True)
class SafeInterval:
    """A shorter interval of one parameter on which no trajectory was seen to end early.

    ``below`` says that the upper end was moved, not the lower one; ``share`` is its length over
    that of the whole interval.
    """

    parameter: int
    lower: float
    upper: float
    below: bool
    share: float

    def shortened(self, kept: float) -> SafeInterval:
        """The interval with a part of its length, away from where trajectories end."""
        length, share = kept * (self.upper - self.lower), kept * self.share
        if self.below:
            return replace(self, upper=self.lower + length, share=share)
        return replace(self, lower=self.upper - length, share=share)


@dataclass(frozen=True)
class Piece:
    """What an engine returned on one part of a box."""

    outcome: Outcome
    metadata: SolutionMetadata


@dataclass(frozen=True)
class Outcome:
    """The result of an engine: consecutive slabs of all differential states, and how it ended.

    ``measured`` is None when no check was made. ``timings`` are seconds, and ``work`` operations of
    the budget that ``effort`` sets, by stage: ``reference``, ``march``, ``check``. ``blow_up`` has
    time and parameter values near which a trajectory blows up, ``safe`` where the box would have to
    end instead, the one that keeps most of it first. ``switching`` is the state whose rate switches
    to and fro where the reference trajectories came to an end. With events, the slabs are over the
    stretches of a ``timeline``, or of one branch after the other. ``pieces`` tile the box of a
    solution that was joined of them, which has no slabs of its own. Where something was
    ``observed``, slabs and errors are of that alone.
    """

    slabs: tuple[SlabTrain, ...]
    status: Status
    measured: Measured | None
    history: tuple[SlabRecord, ...]
    timings: dict[str, float] = field(default_factory=dict)
    work: dict[str, float] = field(default_factory=dict)
    blow_up: tuple[float, tuple[float, ...]] | None = None
    safe: tuple[SafeInterval, ...] = ()
    switching: int | None = None
    cause: Cause | None = None
    notes: tuple[Note, ...] = ()
    timeline: Timeline | BranchedTimeline | None = None
    pieces: tuple[Piece, ...] = ()
    observed: bool = False

    @property
    def is_solved(self) -> bool:
        """Whether there is anything to evaluate."""
        return bool(self.slabs or self.pieces)

    @property
    def verdict(self) -> Verdict:
        """How it ended: status, cause and notes."""
        return Verdict(self.status, self.cause, self.notes)

    @property
    def message(self) -> str:
        """One or two sentences: how it ended, why, and what to do."""
        return str(self.verdict)

    def fixed(self, parameter: int, value: float) -> Outcome:
        """The outcome where the parameter at a position is no longer a coordinate."""
        timeline = self.timeline and self.timeline.fixed(parameter, value)
        return replace(self, slabs=fixed(self.slabs, parameter, value), timeline=timeline)

    def refuse_pieces(self, what: str) -> None:
        """Raise an EvaluationError that names it, if the solution is joined of pieces."""
        if self.pieces:
            raise EvaluationError(
                f"{what} does not take solutions that were joined of pieces",
                remedy="take the pieces one by one: `solution.pieces`",
            )

    def timeline_of_one_order(self, what: str) -> Timeline | None:
        """The timeline, for what takes one order of events alone.

        An EvaluationError that names it, if the order changes inside the box, or the solution is
        joined of pieces.
        """
        self.refuse_pieces(what)
        if isinstance(self.timeline, BranchedTimeline):
            raise EvaluationError(
                f"{what} does not take solutions in which the order of events changes inside the "
                "box",
                remedy="solve on a box in which one order holds (print solution.timeline), or "
                "evaluate the solution at points",
            )
        return self.timeline

    def slabs_over_clock_time(self, what: str) -> tuple[SlabTrain, ...]:
        """The slabs, for what reads them as functions of time.

        An EvaluationError that names it, if they are over the stretches of a timeline.
        """
        if self.timeline_of_one_order(what) is not None:
            raise EvaluationError(
                f"{what} does not take solutions over stretches between events or switches",
                remedy="give solution.in_clock_time(), which everything takes where events reset "
                "nothing, or evaluate the solution at points",
            )
        return self.slabs

    def keeping(self, rows: tuple[int, ...], states: int) -> Outcome:
        """The outcome for ``rows`` alone, of all ``states``; guards and the clock stay."""
        if self.observed:
            return self
        measured, timeline, switching = self.measured, self.timeline, self.switching
        if measured is not None:
            measured = replace(
                measured,
                interior=tuple(measured.interior[i] for i in rows),
                corners=tuple(measured.corners[i] for i in rows if measured.corners),
                counted=None,
            )
        if isinstance(timeline, BranchedTimeline):
            timeline = replace(timeline, tolerances=tuple(timeline.tolerances[i] for i in rows))
        return replace(
            self,
            slabs=tuple(
                slab.with_first(slab.cores[0][[*rows, *range(states, len(slab.cores[0]))]])
                for slab in self.slabs
            ),
            measured=measured,
            switching=rows.index(switching) if switching in rows else None,
            timeline=timeline,
            observed=True,
        )

    @property
    def error(self) -> float:
        """Largest measured error; infinite if there is none."""
        return math.inf if self.measured is None else self.measured.error
