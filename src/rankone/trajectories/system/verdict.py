"""How a solve ended: status, cause and notes as data, and the message made of them.

A cause says more than the status why a solve ended; a note says what else matters. Each knows its
sentence: nothing else writes what users read of the end of a solve.
"""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass, replace
from enum import Enum
from typing import ClassVar

import numpy as np

from rankone.support.arrays import Array
from rankone.support.budget import OutOfBudgetError, OutOfMemoryError, OutOfWorkError
from rankone.support.errors import LISTED, listing, quote
from rankone.support.files import Tagged
from rankone.support.options import in_words
from rankone.trajectories.system.system import SHARED_UNIT, System

_LEAST_SHARE = 0.005  # Share of the budget from which a stage is named: it rounds to one percent
# What messages call the stages of a solve
_STAGES = {
    "reference": "the reference trajectories",
    "samples": "samples",
    "march": "the march",
    "ranks": "ranks",
    "check": "the check",
}


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
    NARROW = "steps of trajectories pass over something narrow in the rates"
    LEAVES = "a trajectory reaches a point where its right-hand side is not finite"
    STALLS = "the steps of a trajectory shrink without end, although its rates are finite"

    @property
    def ends_early(self) -> bool:
        """Whether a trajectory does not reach the end of the horizon."""
        return self in (Status.BLOW_UP, Status.LEAVES, Status.SWITCHES, Status.STALLS)

    @classmethod
    def of_limit(cls, error: OutOfBudgetError) -> Status:
        """How a solve ended that ran out of its budget."""
        if isinstance(error, OutOfMemoryError):
            return cls.MEMORY_LIMIT
        return cls.WORK_LIMIT if isinstance(error, OutOfWorkError) else cls.TIME_LIMIT


class Remark:
    """A cause or a note; ``text`` is its sentence, with its fields and the status in braces."""

    text: ClassVar[str]

    def sentence(self, status: Status) -> str:
        """What the message says."""
        return self.text.format(**vars(self), status=status.value)


class Cause(Remark, Tagged):
    """Why a solve ended, where the status does not say enough: in place of the status."""


class Note(Remark, Tagged):
    """What else matters about how a solve ended; ``lead`` stands before it."""

    lead: ClassVar[str] = "; "


@dataclass(frozen=True)
class Verdict:
    """How a solve ended; ``str`` is the message."""

    status: Status
    cause: Cause | None = None
    notes: tuple[Note, ...] = ()

    @property
    def remedy(self) -> str | None:
        """What to do about it."""
        remedies = [note.advice for note in self.notes if isinstance(note, Remedy)]
        return "; ".join(remedies) or None

    @property
    def narrower(self) -> dict[str, tuple[float, float]]:
        """Intervals of parameters on which the solve is predicted to converge; empty if unknown."""
        boxes = [note.intervals for note in self.notes if isinstance(note, NarrowBox)]
        return {name: (lower, upper) for box in boxes for name, lower, upper in box}

    @property
    def undecided(self) -> float:
        """The share of the box in which values are NaN: the order of events is undecided there."""
        remarks = (self.cause, *self.notes)
        return next(
            (r.share for r in remarks if isinstance(r, UndecidedOrder | UndecidedShare)), 0.0
        )

    @property
    def lacked_memory(self) -> bool:
        """Whether this engine, or another that was tried, met the limit on memory."""
        others = (note.others for note in self.notes if isinstance(note, OtherEngines))
        return (
            self.status is Status.MEMORY_LIMIT
            or any(isinstance(note, MemoryNeeded) for note in self.notes)
            or any(verdict.lacked_memory for each in others for _, verdict in each)
        )

    def without_remedy(self) -> Verdict:
        """The same but for what to do about it."""
        return replace(self, notes=tuple(n for n in self.notes if not isinstance(n, Remedy)))

    def __str__(self) -> str:
        first = self.status.value if self.cause is None else self.cause.sentence(self.status)
        text = first + "".join(note.lead + note.sentence(self.status) for note in self.notes)
        methods = [note.method for note in self.notes if isinstance(note, OtherEngines)]
        return ": ".join([*methods, text])


# --- causes ------------------------------------------------------------------------------------


@dataclass(frozen=True)
class ReferenceLimit(Cause):
    """A limit was reached while the reference trajectories were integrated.

    ``time`` and ``steps`` say how far they came, ``chattering`` names the state whose rate switches
    to and fro there.
    """

    time: float | None = None
    steps: int = 0
    chattering: str | None = None

    def sentence(self, status: Status) -> str:
        if self.time is not None and not self.steps:
            return f"{status.value} before the reference trajectories could begin"
        text = f"{status.value} by the reference trajectories"
        if self.time is not None:
            text += f", at t = {self.time:.6g} after {self.steps} steps"
        if self.chattering is not None:
            text += f", where the rate of {quote(self.chattering)} switches to and fro"
        return text


@dataclass(frozen=True)
class OrderSearchLimit(Cause):
    """A limit was reached while orders of events were looked for, since they differ.

    The ``reason`` says where they do.
    """

    reason: str
    text = "{status} while the orders of events over the box were looked for: {reason}"


@dataclass(frozen=True)
class UndecidedOrder(Cause):
    """The share of the box in which it is undecided in which order events come is too large."""

    share: float

    def sentence(self, status: Status) -> str:
        return UndecidedShare(self.share).sentence(status)


@dataclass(frozen=True)
class TrajectoryStops(Cause):
    """A sampled trajectory that cannot be integrated to the end."""

    time: float
    text = "a trajectory cannot be integrated beyond t = {time:.6g}"


@dataclass(frozen=True)
class UnsettledTerms(Cause):
    """Lagged terms that still change, in sizes of the unknowns, after many updates on a slab."""

    updates: int
    start: float
    end: float
    change: float
    text = (
        "the lagged terms did not settle: after {updates} updates on [{start:.4g}, {end:.4g}] the "
        "unknowns still change by {change:.1e} times their size"
    )


@dataclass(frozen=True)
class SteepParameter(Cause):
    """A parameter on which the solution depends steeply, between ``lower`` and ``upper``.

    ``unknown`` changes most, by ``change`` times its size. ``jump`` says that the interval is too
    short to be told from a point, ``at_end`` that the states at the end of the horizon differ as
    well. ``others`` are values of the other parameters.
    """

    parameter: str
    unknown: str
    lower: float
    upper: float
    change: float
    jump: bool
    at_end: bool
    others: tuple[tuple[str, float], ...] = ()

    def sentence(self, status: Status) -> str:
        place = ", ".join(f"{name} = {at:.4g}" for name, at in self.others)
        place = f" (at {place})" if place else ""
        if self.jump:
            differ = "end in different states" if self.at_end else "differ"
            return (
                f"the solution depends on {quote(self.parameter)} as on a jump: trajectories on "
                f"both sides of {self.parameter} = {self.lower:.6g} {differ}{place}"
            )
        largest = max(abs(self.lower), abs(self.upper))
        digits = max(6, 2 + math.ceil(math.log10(largest / (self.upper - self.lower))))
        return (
            f"the solution depends steeply on {quote(self.parameter)}: {self.unknown} changes by "
            f"{self.change:.2g} of its size between {self.parameter} = {self.lower:.{digits}g} and "
            f"{self.upper:.{digits}g}{place}"
        )


@dataclass(frozen=True)
class MovingFeatures(Cause):
    """A limit was reached where the rates are not smooth at times that depend on parameters."""

    text = (
        "{status} (the rates switch, or are narrow, at times that depend on parameters: rescale "
        "time, or a part of the horizon, so that these times are constant)"
    )


def _near(time: float, at: tuple[tuple[str, float], ...]) -> str:
    """A time, and the values of parameters."""
    return f"near t = {time:.9g}" + "".join(f", {name} = {value:.6g}" for name, value in at)


@dataclass(frozen=True)
class HiddenRate(Cause):
    """A rate is narrow between the steps of a reference trajectory, at a time and parameters."""

    remedy: ClassVar[str] = "make it wider, or replace it by an event that resets the states"
    state: str
    time: float
    at: tuple[tuple[str, float], ...]

    def sentence(self, status: Status) -> str:
        return (
            f"the rate of {quote(self.state)} is so narrow {_near(self.time, self.at)} that steps "
            "pass over it: the error is not known"
        )


@dataclass(frozen=True)
class DerivativeOf(Cause):
    """The solution is a derivative of another one."""

    coordinate: str
    text = "the derivative with respect to `{coordinate}`: its error was not measured"


@dataclass(frozen=True)
class UncertainPart(Cause):
    """A part of a solution that is not accurate at the corners of its box."""

    corners: float
    text = (
        "the error is not known: on this part of the box it may be that at the corners, "
        "{corners:.1e}"
    )


@dataclass(frozen=True)
class UnknownOutputError(Cause):
    """Outputs of states, or of derivatives, whose error was not measured."""

    interpolation: float
    text = (
        "the error is not known: the interpolation adds {interpolation:.1e} to an error of the "
        "solution's states, or of their derivatives, that was not measured"
    )


@dataclass(frozen=True)
class LessAccurateOutput(Cause):
    """Outputs within a tolerance of their own, but not within that ``asked`` of the solve."""

    error: float
    asked: float
    text = (
        "less accurate than the solve asked for, {error:.1e} instead of {asked:.1e}, relative to "
        "the largest value of an output; {status}"
    )


@dataclass(frozen=True)
class EarlyEnd(Cause):
    """Outputs of a solution that ends before its horizon.

    ``horizon`` is the end that was asked for; ``outputs`` says how the outputs ended, ``solution``
    how the solution did.
    """

    start: float
    end: float
    horizon: float
    outputs: Verdict
    solution: Verdict
    text = (
        "the solution ends at {end:.6g} instead of {horizon:.6g}, and so do its outputs on "
        "[{start:g}, {end:.6g}] ({outputs}); {solution}"
    )


# --- notes -------------------------------------------------------------------------------------


@dataclass(frozen=True)
class MeasuredError(Note):
    """The error that was measured, and the tolerance.

    ``unknown`` names the worst of several unknowns; ``corners`` is the error at corners of the box
    where it is larger and does not count; ``drift`` is that of lifted states, if the error is not
    that of the lifted system.
    """

    error: float
    rtol: float
    unknown: str | None = None
    corners: float | None = None
    drift: float | None = None

    lead: ClassVar[str] = ""

    def sentence(self, status: Status) -> str:
        if status is Status.CONVERGED:
            interior = "" if self.corners is None else " in the interior of the box"
            text = f"{interior}: {self.error:.1e} of {self.rtol:.1e}"
        else:
            worst = "" if self.unknown is None else f" in {quote(self.unknown)}"
            digits = next(
                (d for d in range(1, 17) if f"{self.error:.{d}e}" != f"{self.rtol:.{d}e}"), 1
            )
            text = f": measured error {self.error:.{digits}e}{worst}, asked {self.rtol:.{digits}e}"
        if self.corners is not None:
            text += f" (up to {self.corners:.1e} at the corners, which count with cover='box')"
        if self.drift is not None:
            text += f" (of the system as it was written; lifted states drift by {self.drift:.1e})"
        return text


@dataclass(frozen=True)
class AccurateUnknowns(Note):
    """Unknowns that are within the tolerance, where others are not; the worst of those first."""

    accurate: tuple[str, ...]
    inaccurate: tuple[str, ...]

    def sentence(self, status: Status) -> str:
        if len(self.accurate) <= LISTED:
            names = [*self.accurate]
            are, them = ("is", "it") if len(names) == 1 else ("are", "them")
            return f"{listing(names)} {are} within it: unknowns={names!r} asks for {them} alone"
        worst = listing(self.inaccurate[:LISTED])
        hidden = len(self.inaccurate) - LISTED
        more = f" and {hidden} more" if hidden > 0 else ""
        return f"all but {worst}{more} are within it: unknowns= asks for some alone"


@dataclass(frozen=True)
class StoppedAt(Note):
    """The time up to which there is a solution; None if there is nothing."""

    time: float | None

    def sentence(self, status: Status) -> str:
        if self.time is None:
            return "stopped before the first slab"
        return f"stopped at t = {self.time:.6g}"


@dataclass(frozen=True)
class NothingInterpolated(Note):
    """The solution is the trajectory at the centre of the box."""

    text = "rank 1: nothing was interpolated yet, the values are those at the centre"


@dataclass(frozen=True)
class Budget(Note):
    """The shares of the budget that the stages took."""

    shares: tuple[tuple[str, float], ...]

    @classmethod
    def of(cls, work: dict[str, float], operations: float) -> tuple[Budget, ...]:
        """The note, if there is a budget and a stage that took much of it.

        Attempts that still improve may go beyond the ``operations`` that are meant for them.
        """
        if operations <= 0.0:
            return ()
        whole = max(operations, sum(work.values()))
        shares = tuple((stage, done / whole) for stage, done in work.items())
        told = tuple((stage, share) for stage, share in shares if share >= _LEAST_SHARE)
        return (cls(told),) if told else ()

    def sentence(self, status: Status) -> str:
        (first, share), *others = self.shares
        further = "".join(f", {_STAGES[stage]} {100 * each:.0f} %" for stage, each in others)
        return f"{_STAGES[first]} took {100 * share:.0f} % of the budget{further}"


@dataclass(frozen=True)
class MemoryNeeded(Note):
    """The bytes that the next step needs, by counts of arrays, and the limit."""

    needed: float
    limit: float

    @classmethod
    def of(cls, out: OutOfBudgetError) -> MemoryNeeded | None:
        """What was needed, if a limit was that on memory."""
        return cls(out.needed, out.limit) if isinstance(out, OutOfMemoryError) else None

    def sentence(self, status: Status) -> str:
        return f"it needs about {in_words(self.needed)}, and max_memory is {in_words(self.limit)}"


@dataclass(frozen=True)
class Remedy(Note):
    """What to do about it."""

    advice: str
    text = "{advice}"


@dataclass(frozen=True)
class NarrowBox(Note):
    """Parameters to narrow, each with an interval on which the solve is predicted to converge.

    The nodes that the best attempt had, and the modes that it lacked, tell the intervals; or
    ``one_order`` of events holds there, or the solve was ``tried`` on them.
    """

    intervals: tuple[tuple[str, float, float], ...]
    tried: bool = False
    one_order: bool = False

    def sentence(self, status: Status) -> str:
        ranges = [
            f"{quote(name)} to [{lower:.12g}, {upper:.12g}]"
            for name, lower, upper in self.intervals
        ]
        narrow = f"narrow {' and '.join(ranges)}"
        if self.tried:
            return f"{narrow}: it was solved there"
        if self.one_order:
            return f"{narrow}: events come in one order there"
        return f"it is predicted to converge if you {narrow}"


@dataclass(frozen=True)
class NumericallyZero(Note):
    """An unknown that stays below what can be resolved, and the size that stands for it.

    So do ``further`` unknowns, of the same numbers.
    """

    unknown: str
    rounding: float
    size: float
    further: int = 0
    text = (
        "`{unknown}` is numerically zero: it stays below {rounding:.1e}, where rounding errors or "
        "underflow hide it; its error counts relative to {size:.1e}"
    )

    def sentence(self, status: Status) -> str:
        same = f" (the same holds for {self.further} more)" if self.further else ""
        return super().sentence(status) + same


@dataclass(frozen=True)
class SharedUnit(Note):
    """Unknowns that are tiny beside another of the same unit, and the errors that do not count."""

    unknowns: tuple[str, ...]
    tolerance: float

    @classmethod
    def of(
        cls, system: System, sizes: Array, rtol: float, asked: Collection[int] | None
    ) -> tuple[SharedUnit, ...]:
        """The notes on states of sizes (n,), one for each unit, that are ``asked`` for."""
        tiny: dict[float, list[str]] = {}
        shared = {name for alike in system.alike for name in alike} - dict(system.atol).keys()
        for i, tolerance in enumerate(system.tolerances(sizes).tolist()):
            name = system.states[i]
            if name in shared and (asked is None or i in asked) and rtol * sizes[i] < tolerance:
                tiny.setdefault(tolerance, []).append(name)
        return tuple(cls(tuple(names), tolerance) for tolerance, names in tiny.items())

    def sentence(self, status: Status) -> str:
        first, *others = self.unknowns
        more = f" and {len(others)} more" if others else ""
        return (
            f"errors of {quote(first)}{more} below {self.tolerance:.1e} do not count, which is "
            f"{SHARED_UNIT:g} of the largest unknown of the same unit; an `atol` of 0 asks for the "
            "size of the unknown itself"
        )


@dataclass(frozen=True)
class TinyUnknowns(Note):
    """Unknowns that are tiny beside the largest, the smallest first, and what would relieve them.

    Errors below ``tolerance`` are no part of the largest that matters.
    """

    unknowns: tuple[str, ...]
    smallest: float
    tolerance: float

    @classmethod
    def of(
        cls, system: System, sizes: Array, asked: Collection[int] | None
    ) -> tuple[TinyUnknowns, ...]:
        """The note on states of sizes (n,), if it applies to some that are ``asked`` for."""
        sizes = sizes[: len(system.unknowns)]
        tolerance = SHARED_UNIT * float(sizes.max(initial=0.0))
        own = (sizes > 0.0) & (sizes < tolerance) & (system.tolerances(sizes) == 0.0)
        tiny = [int(i) for i in np.argsort(sizes, kind="stable") if own[i]]
        tiny = [i for i in tiny if asked is None or i in asked]
        if not tiny:
            return ()
        names = tuple(system.states[i] for i in tiny)
        return (cls(names, float(sizes[tiny[0]]), tolerance),)

    def sentence(self, status: Status) -> str:
        first = self.unknowns[:LISTED]
        more = len(self.unknowns) - len(first)
        names = listing(first) + (f" and {more} more" if more else "")
        return (
            f"{names} are as small as {self.smallest:.1e}, and the digits of what is so small cost "
            f"most; if errors below {self.tolerance:.0e} do not matter, give "
            f'`atol={{"{first[0]}": {self.tolerance:.0e}, …}}`, or declare in `units` that the '
            "unknowns share a unit"
        )


def _percent(share: float) -> str:
    """A share in percent, with two digits."""
    return f"{100 * share:.{2 if share < 0.1 else 3}g}"


@dataclass(frozen=True)
class UndecidedShare(Note):
    """The share of the box in which it is undecided in which order events come."""

    share: float

    def sentence(self, status: Status) -> str:
        return (
            f"in {_percent(self.share)} % of the box it is undecided in which order events come, "
            "and values are NaN"
        )


@dataclass(frozen=True)
class OtherEngines(Note):
    """The engine of the solution, and how the others ended that were tried."""

    method: str
    others: tuple[tuple[str, Verdict], ...]

    lead: ClassVar[str] = ""

    def sentence(self, status: Status) -> str:
        ended = status is Status.CONVERGED
        endings = [(method, each.status.value if ended else each) for method, each in self.others]
        return "".join(f". Also tried {method}: {ending}" for method, ending in endings)


@dataclass(frozen=True)
class SteadyBranch(Note):
    """The steady states of a solution: at the centre of the box, and how perturbations grow.

    ``growth`` is the largest rate at which any perturbation grows, negative where all decay;
    ``settled`` is the time by which trajectories from the initial values came close.
    """

    centre: tuple[tuple[str, float], ...]
    growth: float
    settled: float

    def sentence(self, status: Status) -> str:
        shown = self.centre[:LISTED]
        names = ", ".join(f"{name} = {at:.4g}" for name, at in shown)
        more = f" and {len(self.centre) - len(shown)} more" if len(shown) < len(self.centre) else ""
        way = f"reached from the initial values by t = {self.settled:.4g}"
        if not self.settled:
            way = "which the initial values are"
        if self.growth < 0.0:
            stable = f"stable: perturbations decay at rates of {-self.growth:.3g} or more"
        else:
            stable = f"unstable: some perturbation grows at a rate of {self.growth:.3g}"
        return f"the branch with {names}{more} at the centre of the box, {way}, is {stable}"


@dataclass(frozen=True)
class SwitchingTerm(Note):
    """A term that switches where ``boundary`` takes one of some levels, and how to smooth it.

    The levels are None for all whole numbers; ``smooth`` is empty for more than one. It has a
    ``width`` in it, by a name that nothing else has.
    """

    term: str
    place: str
    boundary: str
    smooth: str
    levels: tuple[float, ...] | None = (0.0,)
    width: str = "w"

    def sentence(self, status: Status) -> str:
        smooth = "the switches"
        if self.smooth:
            width = f"a width {self.width} too small to matter"
            example = f"for example by {quote(self.smooth)} with {width}"
            smooth = f"the switch, {example}"
        return (
            f"the term {quote(self.term)} in {self.place} switches {self._where()}: narrow the box "
            f"to where all trajectories cross that in the same order, or smooth {smooth}"
        )

    def _where(self) -> str:
        boundary = quote(self.boundary)
        if self.levels is None:
            return f"wherever {boundary} is a whole number"
        shown = ", ".join(f"{level:.4g}" for level in self.levels[:LISTED])
        hidden = len(self.levels) - LISTED
        return f"at {boundary} = {shown}" + (f" and {hidden} more" if hidden > 0 else "")


@dataclass(frozen=True)
class SwitchesNotHeld(Note):
    """Why trajectories are not followed from switch to switch of the rates, or stick there."""

    reason: str
    text = "between its switches the solve failed: {reason}"


@dataclass(frozen=True)
class SeveralOrders(Note):
    """Why orders of events are not solved as branches, where in one order the solution is steep."""

    reason: str
    text = "events do not come in one order over the box: {reason}"


@dataclass(frozen=True)
class PartOfSolution(Note):
    """The solution is a part of another one, whose error was measured on the whole box."""

    text = "it was measured on the whole box, of which this solution is a part"


@dataclass(frozen=True)
class OutputError(Note):
    """The parts of the error of outputs, and the output with the largest error if it fails."""

    interpolation: float
    solution: float
    worst: str | None = None

    lead: ClassVar[str] = ": "

    def sentence(self, status: Status) -> str:
        worst = "" if self.worst is None else f"; largest for {quote(self.worst)}"
        both = f"{self.interpolation:.1e} of the interpolation, {self.solution:.1e} of the solution"
        return both + worst


@dataclass(frozen=True)
class WorstPiece(Note):
    """The piece with the largest error of a solution that was joined of several."""

    pieces: int
    worst: int
    intervals: tuple[tuple[str, float, float], ...]

    lead: ClassVar[str] = ", "

    def sentence(self, status: Status) -> str:
        where = ", ".join(f"{name} in [{a:.4g}, {b:.4g}]" for name, a, b in self.intervals)
        return f"that of piece {self.worst}, the worst of {self.pieces} ({where})"


@dataclass(frozen=True)
class FailedPieces(Note):
    """The pieces of a joined solution that are no success, and how the first of them ended."""

    failed: tuple[int, ...]
    pieces: int
    first: Verdict

    def sentence(self, status: Status) -> str:
        shown = ", ".join(map(str, self.failed[:LISTED]))
        hidden = len(self.failed) - LISTED
        more = f" and {hidden} more" if hidden > 0 else ""
        return (
            f"no success: pieces {shown}{more} of {self.pieces} (piece {self.failed[0]}: "
            f"{self.first})"
        )
