"""What to do about a solve that is refused: a remedy is tried before it is offered.

The modes of an analytic function fall geometrically, and on a part of an interval as far with
about that part of the nodes (Trefethen, Approximation Theory and Approximation Practice, 2013,
chapter 8). So the modes of the best attempt, and its measured error, tell how many nodes a
parameter needs, and on what part of its interval the nodes of the attempt suffice.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rankone.solvers.outcome import Outcome
from rankone.solvers.request import SolveRequest
from rankone.solvers.tuning import SOLVE
from rankone.solvers.verification.points import check_points, smooth_nodes
from rankone.support.arrays import NEGLIGIBLE, TINY, Array
from rankone.support.budget import OutOfBudgetError, budget_left, limited, persisting
from rankone.support.errors import ConvergenceError, quote
from rankone.tensors import Basis1D, first_scale
from rankone.tensors.coordinates import Interval, Logarithm, on_scale
from rankone.tensors.slab import SlabTrain, sharing
from rankone.tensors.train import Train
from rankone.trajectories.events.orders import OrderSearch
from rankone.trajectories.events.sides import REMEDY, OrderError, TrajectoryEndError
from rankone.trajectories.system.verdict import (
    NarrowBox,
    Note,
    NothingInterpolated,
    Remedy,
    Status,
    SteepParameter,
)


@dataclass(frozen=True)
class Resolution:
    """The nodes of one parameter: those of an attempt, and those that are needed on all of it."""

    basis: Basis1D
    needed: float
    smooth: float

    @classmethod
    def of(cls, basis: Basis1D, spectrum: Array, rtol: float) -> Resolution:
        """From the sizes of the modes, in units of the states."""
        smooth = min(smooth_nodes(rtol), basis.size)
        excess = math.log(max(basis.tail(spectrum), TINY) / (SOLVE.narrowing_aim * rtol))
        if excess <= 0.0:
            return cls(basis, float(basis.size), smooth)
        if basis.elements > 1:
            return cls(basis, SOLVE.element_growth * basis.size, smooth)
        return cls(basis, basis.size - excess / math.log(_decay(spectrum)), smooth)

    @property
    def suffices(self) -> float:
        """The part of the interval on which the nodes of the attempt are enough."""
        if self.needed <= self.basis.size:
            return 1.0
        return max((self.basis.size - self.smooth) / (self.needed - self.smooth), 0.0)

    def nodes(self, share: float) -> float:
        """Nodes that are needed on a part of the interval."""
        return self.smooth + max(self.needed - self.smooth, 0.0) * share


def spectra_of(slabs: Sequence[SlabTrain], sizes: Array) -> list[Array]:
    """Sizes of the modes of each parameter, the largest of all slabs, in units of the states."""
    bases = slabs[-1].bases
    largest = [np.zeros(basis.size) for basis in bases]
    for run in sharing(slabs):
        if run[0].bases != bases:
            continue
        cores = [slab.cores[0] / sizes[: len(slab.cores[0]), None, None] for slab in run]
        first = np.concatenate([core.reshape(-1, core.shape[2]) for core in cores])
        norms = Train((first, *run[0].cores[1:])).right_orthonormal(0.0).mode_norms()
        largest = [np.maximum(a, b) for a, b in zip(largest, norms, strict=True)]
    return largest


def narrowed_box(
    names: Sequence[str],
    resolutions: Sequence[Resolution],
    work: float,
    budget: float,
) -> NarrowBox | None:
    """The parameters to narrow, and to what; None where nothing can be predicted.

    ``work`` is that of an attempt with the nodes of the ``resolutions``, and ``budget`` that of the
    solve, in operations.
    """
    shares = [1.0] * len(resolutions)
    unit = work / _samples([r.basis.size for r in resolutions])

    def further() -> list[float]:
        """Nodes beyond those of a smooth function."""
        return [r.nodes(share) - r.smooth for r, share in zip(resolutions, shares, strict=True)]

    def cost() -> float:
        nodes = [r.nodes(share) for r, share in zip(resolutions, shares, strict=True)]
        return unit * _samples(nodes)

    while cost() > SOLVE.affordable_share * budget and min(shares) > SOLVE.least_narrowing:
        shares[further().index(max(further()))] *= SOLVE.narrowing_step
    if min(shares) == 1.0:  # work was not what it lacked
        steepest = further().index(max(further()))
        shares[steepest] = min(resolutions[steepest].suffices, SOLVE.largest_narrowing)
    shares = [share if share == 1.0 else SOLVE.narrowing_safety * share for share in shares]
    if min(shares) < SOLVE.least_narrowing:
        return None
    return NarrowBox(
        tuple(
            (name, *_part(resolution.basis, share))
            for name, resolution, share in zip(names, resolutions, shares, strict=True)
            if share < 1.0
        )
    )


def _decay(spectrum: Array) -> float:
    """Ratio of successive modes over the second half of a spectrum."""
    levels = np.maximum.accumulate(spectrum[::-1])[::-1]
    half = len(levels) // 2
    ratio = (levels[-1] / max(levels[half], TINY)) ** (1.0 / max(len(levels) - 1 - half, 1))
    return float(min(max(ratio, SOLVE.fastest_decay), SOLVE.slowest_decay))


def _samples(nodes: Sequence[float]) -> float:
    """About how many trajectories a cross interpolation takes: rank by nodes by rank."""
    logarithms = np.concatenate([[0.0], np.cumsum(np.log(nodes))])
    smaller = np.minimum(logarithms, logarithms[-1] - logarithms)
    ranks = np.maximum(SOLVE.rank_share * np.exp(smaller), 1.0)
    return float(np.sum(ranks[:-1] * np.array(nodes) * ranks[1:]))


def _part(basis: Basis1D, share: float) -> Interval:
    """The middle part of an interval with ends of few digits, in the logarithm over decades."""
    ends = float(basis.lower), float(basis.upper)
    scale = first_scale(*ends)
    if not basis.scale.is_identity and Logarithm().allows(*ends):
        scale = Logarithm()
    lower, upper = on_scale(scale, ends, 0.5 + np.array([-0.5, 0.5]) * share).tolist()
    lengths = (upper - lower,) * 2 if scale.is_identity else (lower, upper)
    lower, upper = (
        round(end, SOLVE.box_digits - 1 - math.floor(math.log10(abs(length))))
        for end, length in zip((lower, upper), lengths, strict=True)
    )
    return max(lower, ends[0]), min(upper, ends[1])


# -----------------------------------------------------------------------------
# A part of a box in which events come in one order, for the message of a refused solve.


def one_order(search: OrderSearch) -> tuple[Interval, ...] | None:
    """The intervals of a part in which all trajectories meet the same events in the same order.

    None where there is none of some size. Further trajectories inside of it are followed.
    """
    for _ in range(SOLVE.part_rounds):
        part = _largest_part(search)
        if part is None:
            return None
        points = check_points(part, SOLVE.part_points, every_corner=True)
        try:
            inside = search.at(points)
        except OrderError:
            return None
        if len(inside.groups()) == 1:
            return tuple((float(lower), float(upper)) for lower, upper in part)
        search = search.joined_with(inside)
    return None


def remedy_of(search: OrderSearch) -> tuple[str, tuple[Interval, ...] | None]:
    """What to do about orders that cannot be continued: a part of the box, if there is one."""
    try:
        with persisting(SOLVE.part_search_share * budget_left()):
            part = one_order(search)
    except OutOfBudgetError:
        part = None
    if part is None:
        return REMEDY, None
    narrowed = narrowing_text(search.system.parameters, search.bounds, part)
    return f"narrow {narrowed}: events come in one order there", part


def box_of_one_order(names: Sequence[str], bounds: Array, part: Sequence[Interval]) -> NarrowBox:
    """Which parameters to narrow, and to what, for one order of events."""
    return NarrowBox(
        tuple(
            (name, *inside(ends))
            for name, whole, ends in zip(names, bounds.tolist(), part, strict=True)
            if list(ends) != whole
        ),
        one_order=True,
    )


def narrowing_text(names: Sequence[str], bounds: Array, part: Sequence[Interval]) -> str:
    """Which parameters to narrow, and to what."""
    narrowed = [
        "{} to [{:.12g}, {:.12g}]".format(quote(name), *inside(ends))
        for name, whole, ends in zip(names, bounds.tolist(), part, strict=True)
        if list(ends) != whole
    ]
    return " and ".join(narrowed)


def inside(ends: Interval) -> Interval:
    """An interval inside another one, with ends of few digits."""
    lower, upper = ends
    unit = 10.0 ** math.floor(math.log10((upper - lower) / SOLVE.least_units))
    low = math.ceil(lower / unit - NEGLIGIBLE) * unit
    high = math.floor(upper / unit + NEGLIGIBLE) * unit
    return float(f"{low:.12g}"), float(f"{high:.12g}")


def _largest_part(search: OrderSearch) -> Array | None:
    """The largest part (d, 2) that is found around a point, without points of other orders."""
    lower, width = search.bounds[:, 0], np.ptp(search.bounds, axis=1)
    unit = (search.points - lower) / width
    best, largest = None, 0.0
    for places in search.groups().values():
        others = np.delete(unit, places, axis=0)
        part = _grown(_inmost(unit[places], others), others)
        volume = float(np.ptp(part, axis=1).prod())
        if volume > largest:
            best, largest = part, volume
    if best is None:
        return None
    at_faces = np.stack([best[:, 0] <= 0.0, best[:, 1] >= 1.0], axis=1)
    inner = best + SOLVE.part_inset * np.ptp(best, axis=1)[:, None] * np.array([1.0, -1.0])
    part = np.where(at_faces, [0.0, 1.0], inner)
    if np.ptp(part, axis=1).min() < SOLVE.least_part:
        return None
    return np.asarray(np.where(at_faces, search.bounds, lower[:, None] + width[:, None] * part))


def _inmost(points: Array, others: Array) -> Array:
    """Of points (m, d) the one that is farthest from all others, which may be none."""
    if not len(others):
        return np.asarray(points[0])
    distances = np.abs(points[:, None] - others).max(axis=2).min(axis=1)
    return np.asarray(points[int(np.argmax(distances))])


def _grown(start: Array, others: Array) -> Array:
    """The part (d, 2) of the unit cube around a point, each face as far out as no other point is.

    All faces go outwards in turns.
    """
    part = np.stack([start, start], axis=1)
    open_faces = [(j, side) for j in range(len(start)) for side in (0, 1)]
    while open_faces:
        for j, side in [*open_faces]:
            grown = part.copy()
            grown[j, side] = np.clip(part[j, side] + (2 * side - 1) * SOLVE.part_step, 0.0, 1.0)
            if grown[j, side] == part[j, side] or _holds(grown, others):
                open_faces.remove((j, side))
            else:
                part = grown
    return part


def _holds(part: Array, points: Array) -> bool:
    """Whether a part has some of the points (m, d)."""
    inside: NDArray[np.bool_] = (points >= part[:, 0]) & (points <= part[:, 1])
    return bool(inside.all(axis=1).any())


# -----------------------------------------------------------------------------
# What to do about a solve that is refused: a remedy is tried before it is offered.
#
# The same solve is tried at a looser tolerance, on smaller boxes, and up to earlier ends, each with
# a part of what is left. A box that is predicted, and not tried for lack of work, comes last.


_NO_REMEDY = (
    Status.CONVERGED,
    Status.UNCHECKED,
    Status.NARROW,
    Status.TIME_LIMIT,
    *(s for s in Status if s.ends_early),
)

# Limits that a user may raise as well
_RAISED = (
    Status.WORK_LIMIT,
    Status.MEMORY_LIMIT,
    Status.RANK_LIMIT,
    Status.NODE_LIMIT,
    Status.SLAB_LIMIT,
    Status.TRAJECTORY_LIMIT,
)

TriedSolve = Callable[[SolveRequest], Outcome | None]
"""The outcome of another request; None if that ends in an error."""
Intervals = Mapping[int, Interval]


def remedied(outcome: Outcome, request: SolveRequest, trials: Trials) -> Outcome:
    """The outcome of a request with a remedy that holds, if one is found.

    With the slabs of a looser solve that succeeds where no attempt came as close. A box that is
    predicted stays unless the solve fails there too.
    """
    if outcome.status in _NO_REMEDY:
        return outcome
    for rtol in _looser_ones(outcome, request.rtol):
        if (solved := trials.looser(rtol)) is None:
            continue
        advice = f"try rtol={rtol:.0e}: it was solved to {solved.error:.1e}"
        if outcome.slabs and outcome.error <= solved.error:
            return _with_notes(outcome, Remedy(advice))
        outcome = _with_notes(outcome, Remedy(advice), NothingInterpolated)
        return replace(
            outcome,
            slabs=solved.slabs,
            measured=solved.measured,
            timeline=solved.timeline,
            observed=solved.observed,
        )
    box, fails = trials.smaller(outcome)
    if box is not None:
        return _with_notes(outcome, box, NarrowBox)
    outcome = _without_notes(outcome, NarrowBox) if fails else outcome
    end = trials.end()
    return outcome if end is None else _with_notes(outcome, Remedy(_end_text(end)))


def remedied_error(error: ConvergenceError, trials: Trials) -> ConvergenceError:
    """An error that was raised in place of an outcome, with a remedy that holds if one is found."""
    if isinstance(error, OrderError) and not isinstance(error, TrajectoryEndError):
        domain, whole = trials.request.domain, error.part is None
        # the middle of a whole box has fewer orders, if not one alone
        intervals = dict(enumerate(error.part or domain.box))
        box, _ = trials.first_box(trials.shrunk(intervals, SOLVE.shrunk_parts[whole:]))
        if box is not None:
            error.part = tuple(box.get(j, ends) for j, ends in enumerate(domain.box))
            narrowed = narrowing_text(trials.names, domain.bounds, error.part)
            error.remedy = f"narrow {narrowed}: it was solved there"
            return error
    if (end := trials.end()) is not None:
        error.remedy = _end_text(end)
    return error


@dataclass(frozen=True)
class Trials:
    """Solves of a request with changes; ``trial`` makes them, ``names`` are of the parameters."""

    request: SolveRequest
    names: Sequence[str]
    trial: TriedSolve

    def looser(self, rtol: float) -> Outcome | None:
        """The outcome at a looser tolerance; None without success."""
        with limited(SOLVE.remedy_share * budget_left()):
            outcome = self.trial(replace(self.request, rtol=rtol))
        return outcome if _succeeds(outcome) else None

    def smaller(self, outcome: Outcome) -> tuple[NarrowBox | None, bool]:
        """A smaller box: beside a front, or a part of the one that is predicted.

        Without success whether it fails in the first one, and not for lack of work.
        """
        cause, predicted = outcome.cause, outcome.verdict.narrower
        boxes: Iterator[Intervals] = iter(())
        if isinstance(cause, SteepParameter):
            boxes = self._beside(cause)
        elif predicted:
            boxes = self.shrunk({self.names.index(name): predicted[name] for name in predicted})
        with limited(SOLVE.remedy_share * budget_left()):
            box, fails = self.first_box(boxes)
        if box is None:
            return None, fails
        intervals = tuple((self.names[j], *ends) for j, ends in sorted(box.items()))
        return NarrowBox(intervals, tried=True), False

    def first_box(self, boxes: Iterator[Intervals]) -> tuple[Intervals | None, bool]:
        """The first box with a success; or whether the first one fails, not for lack of work."""
        most, fails = SOLVE.box_trial_share * budget_left(), list[bool]()
        for box in boxes:
            with limited(most):
                outcome = self.trial(self.request.on_box(box, 1.0))
            if _succeeds(outcome):
                return box, False
            fails.append(outcome is not None and outcome.status is not Status.WORK_LIMIT)
        return None, any(fails[:1])

    def end(self) -> float | None:
        """The latest end of the horizon with a success, of some."""
        start, end = self.request.domain.horizon
        length = end - start

        def solved(share: float) -> float | None:
            digits = SOLVE.end_digits - 1 - math.floor(math.log10(max(abs(start), share * length)))
            earlier = round(start + share * length, digits)
            domain = replace(self.request.domain, horizon=(start, earlier))
            later = (earlier > start and self.trial(replace(self.request, domain=domain))) or None
            return earlier if _succeeds(later) else None

        for first in SOLVE.first_ends:
            with limited(SOLVE.remedy_share * budget_left()):
                latest = solved(first)
            if latest is None:
                continue
            for times in SOLVE.later_ends:
                later = solved(times * first)
                if later is None:
                    break
                latest = later
            return latest
        return None

    def shrunk(
        self, intervals: Intervals, parts: Sequence[float] = SOLVE.shrunk_parts
    ) -> Iterator[Intervals]:
        """Intervals, and parts around their middles."""
        for part in parts:
            shares = 0.5 + np.array([-0.5, 0.5]) * part
            yield {j: self._part(j, ends, shares) for j, ends in intervals.items()}

    def _beside(self, front: SteepParameter) -> Iterator[Intervals]:
        """Intervals on both sides of a front, also where it moves with other parameters."""
        j = self.names.index(front.parameter)
        whole = self.request.domain.box[j]
        below, above = (whole[0], front.lower), (front.upper, whole[1])
        others: dict[int, Interval] = {}
        for name, value in front.others:
            i = self.names.index(name)
            lower, upper = self.request.domain.box[i]
            width = SOLVE.front_surroundings * (upper - lower)
            around = max(lower, value - width), min(upper, value + width)
            others[i] = self._part(i, around, np.array([0.0, 1.0]))
        for distance in SOLVE.front_distances:
            for beside in (dict[int, Interval](), others) if others else ({},):
                sides = (below, (0.0, 1.0 - distance)), (above, (distance, 1.0))
                for ends, shares in sorted(sides, key=lambda side: side[0][0] - side[0][1]):
                    if ends[0] < ends[1]:
                        yield {j: self._part(j, ends, np.array(shares)), **beside}

    def _part(self, j: int, ends: Interval, shares: np.ndarray) -> Interval:
        """A part of an interval of a parameter with ends of few digits, which are those told."""
        scale, whole = self.request.domain.first_coordinates[j], self.request.domain.box[j]
        lower, upper = on_scale(scale, ends, shares).tolist()
        low, high = inside((lower, upper))
        return (lower if lower == whole[0] else low), (upper if upper == whole[1] else high)


def _succeeds(outcome: Outcome | None) -> bool:
    return outcome is not None and outcome.status is Status.CONVERGED


def _looser_ones(outcome: Outcome, rtol: float) -> list[float]:
    """Looser tolerances to try: of one digit that the measured error meets with some margin."""
    front, error = outcome.cause, outcome.error
    tolerances = (
        [SOLVE.looser_rtol]
        if rtol < SOLVE.looser_rtol and not isinstance(front, SteepParameter)
        else []
    )
    jumps = isinstance(front, SteepParameter) and front.jump
    if jumps or not outcome.slabs or not 0.0 < error <= SOLVE.worst_offered:
        return tolerances
    unit = 10.0 ** math.floor(math.log10(SOLVE.offered_margin * error))
    met = float(f"{math.ceil(SOLVE.offered_margin * error / unit) * unit:.0e}")
    return [met, *(each for each in tolerances if each > met)] if met > rtol else tolerances


def _end_text(end: float) -> str:
    return f"end the horizon before t = {end:g}: it was solved up to there"


def _with_notes(outcome: Outcome, told: Note, *instead: type[Note]) -> Outcome:
    """The outcome with a remedy in place of others, and of those that say less than it."""
    vague = () if outcome.status in _RAISED else (Remedy,)
    kept = _without_notes(outcome, *vague, *instead).notes
    predicted = tuple(note for note in kept if isinstance(note, NarrowBox))
    others = tuple(note for note in kept if not isinstance(note, NarrowBox))
    return replace(outcome, notes=(*others, told, *predicted))


def _without_notes(outcome: Outcome, *kinds: type[Note]) -> Outcome:
    """The outcome without notes of some kinds."""
    return replace(outcome, notes=tuple(n for n in outcome.notes if not isinstance(n, kinds)))
