"""What an engine returns, and the problem and the request behind it as plain data."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum

from rankone.solvers.request import Observation
from rankone.support.errors import EvaluationError, did_you_mean
from rankone.tensors.slab import SlabTrain, fixed
from rankone.trajectories.system.timeline import BranchedTimeline, Timeline
from rankone.trajectories.system.verdict import Cause, Note, Status, Verdict

_ONE_WORD = re.compile(r"[^\s/*^·⋅()+-]+")  # A unit that needs no brackets


class Role(StrEnum):
    """The role of a state."""

    UNKNOWN = "unknown"
    """The user asked for it."""
    DERIVATIVE = "derivative"
    """A time derivative of an unknown, made a state by the reduction to first order."""
    AUXILIARY = "auxiliary"
    """A product of states, defined by an algebraic equation."""
    LIFTED = "lifted"
    """A function of other states, made a state so that the system separates."""


@dataclass(frozen=True, slots=True)
class SolutionMetadata:
    """The problem and the request as plain data: a solution needs neither SymPy nor the problem.

    ``states`` are in the order of the slabs' states, with derivatives that became states as
    ``x_t``, ``x_tt``, ...; ``parameters`` in the order of the slabs' cores. ``horizon`` is what was
    asked for; a partial solution ends earlier. ``equations`` are the problem as text, a line for
    each equation and initial value; ``source`` is the text of the generated module, ``version`` the
    rankone that solved it. ``timeless`` says that no value depends on time, which then is no
    coordinate. ``units`` has names of coordinates and states. ``distributions`` are texts,
    ``norm(1.0, 0.1)``; other parameters are uniform. ``correlations`` are pairs of parameters and
    the correlation of their Gaussian copula. ``fixed`` has the coordinates that ``fix`` or ``at``
    set. ``name`` is empty if the problem has none. ``constants`` are numbers by name, and
    ``definitions`` formulas by name, of states, coordinates and numbers. ``atol`` has absolute
    tolerances of states by name: errors are relative to the largest value plus that over ``rtol``.
    ``additive`` are parameters such as the amount of a dose: all states are proportional to each,
    and the effects of several add up, each counted from its own time. ``left_out`` are the states
    of the problem that the solve was not asked for.
    """

    states: tuple[str, ...]
    roles: tuple[Role, ...]
    parameters: tuple[str, ...]
    box: tuple[tuple[float, float], ...]
    time: str
    horizon: tuple[float, float]
    rtol: float
    method: str = "train"
    equations: tuple[str, ...] = ()
    version: str = ""
    source: str | None = None
    timeless: bool = False
    units: tuple[tuple[str, str], ...] = ()
    distributions: tuple[tuple[str, str], ...] = ()
    correlations: tuple[tuple[str, str, float], ...] = ()
    fixed: tuple[tuple[str, float], ...] = ()
    name: str = ""
    constants: tuple[tuple[str, float], ...] = ()
    definitions: tuple[tuple[str, str], ...] = ()
    atol: tuple[tuple[str, float], ...] = ()
    additive: tuple[str, ...] = ()
    left_out: tuple[str, ...] = ()

    def keeping(self, names: tuple[str, ...]) -> SolutionMetadata:
        """The metadata of a solution that holds some of the states, or quantities beside them."""
        kept = {*self.coordinates, *(name for name in names if name in self.states)}
        return replace(
            self,
            states=names,
            roles=(Role.UNKNOWN,) * len(names),
            units=tuple(unit for unit in self.units if unit[0] in kept),
            atol=tuple(size for size in self.atol if size[0] in kept),
            left_out=tuple(name for name in self.states if name not in kept),
        )

    def observing(self, observed: Observation) -> SolutionMetadata:
        """The metadata of a solution that holds what is observed in place of the states."""
        return replace(
            self.keeping(observed.names),
            equations=observed.texts,
            source=None,
            definitions=(),
            atol=(),
            additive=(),
        )

    def hint(self, name: str, *others: str) -> str:
        """What to say behind a name that is no state: that it was left out, or a similar one.

        It may also have been meant for one of the ``others``.
        """
        if name in self.left_out:
            return ", which `unknowns=` left out of the solve"
        return did_you_mean(name, [*self.states, *others])

    def derivative(self, coordinate: str) -> SolutionMetadata:
        """The metadata of a solution that holds the derivatives of the states."""
        return replace(
            self,
            equations=(),
            source=None,
            units=_of_derivatives(self.units, self.states, coordinate),
            definitions=(),
            atol=(),
            additive=(),
        )

    @property
    def coordinates(self) -> tuple[str, ...]:
        """Names of all coordinates: time, unless the solution is timeless, and the parameters."""
        return self.parameters if self.timeless else (self.time, *self.parameters)

    @property
    def statements(self) -> tuple[str, ...]:
        """The equations, and the values of fixed coordinates, as texts."""
        return *self.equations, *(f"{name} = {at!r}" for name, at in self.fixed)

    @property
    def unknowns(self) -> tuple[str, ...]:
        """Names of the unknowns."""
        return tuple(self.states[row] for row in self.unknown_rows)

    @property
    def unknown_rows(self) -> tuple[int, ...]:
        """Positions of the unknowns among the states."""
        return tuple(row for row, role in enumerate(self.roles) if role == Role.UNKNOWN)


def per(unit: str, by: str, times: int = 1) -> str:
    """The unit of a derivative, as text: a unit over another, to a power.

    >>> per("m", "s"), per("m", "s", 2), per("m/s", "1/s"), per("kg", "1")
    ('m/s', 'm/s^2', '(m/s)/(1/s)', 'kg')
    """
    if by == "1":
        return unit
    power = "" if times == 1 else f"^{times}"
    return f"{_bracketed(unit)}/{_bracketed(by)}{power}"


def _of_derivatives(
    units: tuple[tuple[str, str], ...], states: tuple[str, ...], coordinate: str
) -> tuple[tuple[str, str], ...]:
    """Units after a derivative of all states with respect to a coordinate.

    A state whose unit, or that of the coordinate, is not known has none.
    """
    by = dict(units).get(coordinate)
    return tuple(
        (name, unit if name not in states or by is None else per(unit, by))
        for name, unit in units
        if name not in states or by is not None
    )


def with_unit(text: str, units: Mapping[str, str], name: str) -> str:
    """A text with the unit of a name behind it, if there is one."""
    return f"{text} {units[name]}" if name in units else text


def _bracketed(unit: str) -> str:
    return unit if _ONE_WORD.fullmatch(unit) else f"({unit})"


# -----------------------------------------------------------------------------
# What an engine returns: separated tensors per slab, what was measured, and how it went.


@dataclass(frozen=True, slots=True)
class SlabRecord:
    """One accepted or rejected slab, with the train's ranks and parameter nodes at the end.

    ``attempt`` counts from 0: a solve is repeated with a tighter inner tolerance when the check
    asks for it. ``tolerance``, and ``residuals``, the largest change of the train in each sweep,
    are in units of each state's size. ``integrator`` integrated the trajectories that were sampled,
    or those of the reference where none are sampled: "stack" or "single".
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
