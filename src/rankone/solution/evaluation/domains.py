"""Solutions on smaller domains, and those joined of pieces: nothing is sampled."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence, Set
from dataclasses import replace
from itertools import chain
from typing import Any

import numpy as np

from rankone.solvers.branches import branch_evaluator
from rankone.solvers.outcome import Measured, Outcome, Piece, SolutionMetadata
from rankone.solvers.verification.measure import MOST_UNDECIDED, undecided_share
from rankone.solvers.verification.points import Coverage
from rankone.support.errors import OptionError, did_you_mean, listing, quote, shown
from rankone.tensors.branch_evaluator import Tiling
from rankone.tensors.coordinates import (
    LINEAR,
    SCALES,
    measure_text,
    name_of,
    round_off,
    written_scale,
)
from rankone.tensors.slab import SlabTrain, at_one_time, differentiated, restricted
from rankone.tensors.train import Train
from rankone.trajectories.system.timeline import BranchedTimeline
from rankone.trajectories.system.verdict import (
    DerivativeOf,
    FailedPieces,
    MeasuredError,
    Note,
    PartOfSolution,
    Status,
    UncertainPart,
    UndecidedOrder,
    UndecidedShare,
    WorstPiece,
)

# Smallest interval over the one before: rounding errors of derivatives grow with its inverse
_LEAST_SHARE = 1e-6

_Pair = tuple[Outcome, SolutionMetadata]
_MEASURED = (Status.CONVERGED, Status.TOLERANCE)  # What the measured error alone decides


def derived(outcome: Outcome, metadata: SolutionMetadata, coordinate: object) -> _Pair:
    """The derivatives of all states with respect to a parameter or time; their error is unknown."""
    name = name_of(coordinate)
    slabs = outcome.slabs_over_clock_time("diff")
    if name == metadata.time and not metadata.timeless:
        slabs = tuple(slab.derivative() for slab in slabs)
    else:
        slabs = differentiated(slabs, position(metadata, name))
    derivative = replace(
        outcome,
        slabs=slabs,
        status=Status.UNCHECKED,
        measured=None,
        history=(),
        cause=DerivativeOf(name),
        notes=(),
    )
    return derivative, metadata.derivative(name)


def at_time(outcome: Outcome, metadata: SolutionMetadata, time: float) -> _Pair:
    """An outcome and its metadata at one time, which is no longer a coordinate."""
    slab = at_one_time(outcome.slabs_over_clock_time("at"), time, metadata.horizon)
    fixed = (*metadata.fixed, (metadata.time, float(time)))
    metadata = replace(metadata, source=None, timeless=True, fixed=fixed)
    return _part(replace(outcome, slabs=(slab,)), metadata.rtol), metadata


def with_fixed(
    outcome: Outcome, metadata: SolutionMetadata, parameters: Mapping[str, object]
) -> _Pair:
    """An outcome and its metadata with some parameters fixed, which are no longer coordinates."""
    for key, at in parameters.items():
        j = position(metadata, key)
        name, (lower, upper) = metadata.parameters[j], metadata.box[j]
        point = _inside(name, at, lower, upper)
        if outcome.pieces:
            outcome, metadata = _fixed_in_pieces(outcome, metadata, j, point)
            continue
        outcome = outcome.fixed(j, point)
        metadata = replace(
            metadata,
            units=tuple(pair for pair in metadata.units if pair[0] != metadata.parameters[j]),
            parameters=(*metadata.parameters[:j], *metadata.parameters[j + 1 :]),
            box=(*metadata.box[:j], *metadata.box[j + 1 :]),
            distributions=tuple(pair for pair in metadata.distributions if pair[0] != name),
            correlations=tuple(c for c in metadata.correlations if name not in c[:2]),
            fixed=(*metadata.fixed, (name, point)),
            additive=tuple(each for each in metadata.additive if each != name),
        )
    return _decided(_part(outcome, metadata.rtol), metadata), replace(metadata, source=None)


def with_restricted(
    outcome: Outcome, metadata: SolutionMetadata, intervals: Mapping[str, Sequence[float]]
) -> _Pair:
    """An outcome and its metadata on smaller intervals of some parameters."""
    for key, interval in intervals.items():
        j = position(metadata, key)
        ends = _part_of(metadata.box[j], interval, metadata.parameters[j])
        if outcome.pieces:
            outcome, metadata = _restricted_in_pieces(outcome, j, ends)
            continue
        box = [*metadata.box]
        box[j] = ends
        outcome = replace(outcome, slabs=restricted(outcome.slabs, j, ends))
        metadata = replace(metadata, box=tuple(box))
    return _decided(_part(outcome, metadata.rtol), metadata), metadata


def state_rows(states: Sequence[str], chosen: Sequence[object]) -> list[int]:
    """The rows of the states chosen by name, each once, or an OptionError."""
    names = dict.fromkeys(map(name_of, chosen))
    for name in names:
        if name not in states:
            raise OptionError(
                f"no unknown {quote(name)}{did_you_mean(name, states)}",
                term=name,
                remedy=f"choose from {listing(states)}",
            )
    if not names:
        raise OptionError("no unknown is chosen", remedy=f"choose from {listing(states)}")
    return [states.index(name) for name in names]


def with_states(outcome: Outcome, metadata: SolutionMetadata, rows: Sequence[int]) -> _Pair:
    """An outcome and its metadata with some of the states alone; nothing is sampled."""
    n, names = len(metadata.states), tuple(metadata.states[row] for row in rows)
    smaller = metadata.keeping(names)
    smaller = replace(smaller, roles=tuple(metadata.roles[row] for row in rows))
    if outcome.pieces:
        pieces = (with_states(p.outcome, p.metadata, rows) for p in outcome.pieces)
        return joined([Piece(*piece) for piece in pieces])

    def own(numbers: tuple[float, ...]) -> tuple[float, ...]:
        return tuple(numbers[row] for row in rows if row < len(numbers))

    def kept(slab: SlabTrain) -> SlabTrain:
        first, *others = slab.cores
        beside = range(n, len(first))  # clock, lengths and guards
        return replace(slab, train=Train((first[[*rows, *beside]], *others)))

    timeline, measured = outcome.timeline, outcome.measured
    if isinstance(timeline, BranchedTimeline):
        timeline = replace(timeline, tolerances=own(timeline.tolerances))
    part = replace(
        outcome,
        slabs=tuple(map(kept, outcome.slabs)),
        timeline=timeline,
        history=(),
        switching=None,
    )
    if measured is None:
        return part, smaller
    counted = [rows.index(row) for row in measured.counted or () if row in rows]
    interior, corners = own(measured.interior), own(measured.corners)
    measured = replace(
        measured, interior=interior, corners=corners, counted=tuple(counted) or None, quantile=None
    )
    part = replace(part, measured=measured)
    within = measured.error <= metadata.rtol
    if within is (outcome.status is Status.CONVERGED) or outcome.status not in _MEASURED:
        return part, smaller
    worst = names[measured.worst_first[0]] if len(names) > 1 else None
    note = MeasuredError(measured.error, metadata.rtol, worst, None)
    status = Status.CONVERGED if within else Status.TOLERANCE
    return replace(part, status=status, cause=None, notes=(note,)), smaller


def _part_of(whole: tuple[float, float], interval: Any, name: str) -> tuple[float, float]:
    """The ends of an interval, or an OptionError if it is no part of the whole one."""
    lower, upper = whole
    try:
        if isinstance(interval, str | Set | Mapping):
            raise TypeError
        low, high = interval
    except (TypeError, ValueError):
        raise OptionError(
            f"the interval of {quote(name)} is {interval!r}, not a pair of numbers",
            term=interval,
            remedy=f"give ({lower:g}, {upper:g}) or a part of it",
        ) from None
    low, high = (_inside(name, end, lower, upper) for end in (low, high))
    if 0.0 < high - low < _LEAST_SHARE * (upper - lower):
        raise OptionError(
            f"the interval ({low!r}, {high!r}) of {quote(name)} is too narrow",
            term=interval,
            remedy="fix a single value instead",
        )
    if not low < high:
        raise OptionError(
            f"the interval ({low:g}, {high:g}) of {quote(name)} does not ascend",
            term=interval,
            remedy="fix a single value instead" if low == high else f"give ({high:g}, {low:g})",
        )
    return low, high


def _fixed_in_pieces(outcome: Outcome, metadata: SolutionMetadata, j: int, at: float) -> _Pair:
    """The pieces that hold a value of the parameter at a position, with it fixed there."""
    boxes = [piece.metadata.box for piece in outcome.pieces]
    positions = Tiling.of(boxes, metadata.parameters).at(j, at)
    smaller = []
    for piece in (outcome.pieces[position] for position in positions):
        held = {metadata.parameters[j]: float(np.clip(at, *piece.metadata.box[j]))}
        smaller.append(Piece(*with_fixed(piece.outcome, piece.metadata, held)))
    return joined(smaller)


def _restricted_in_pieces(outcome: Outcome, j: int, interval: tuple[float, float]) -> _Pair:
    """The pieces that have a part of an interval of the parameter at a position, and their part."""
    smaller = []
    for piece in outcome.pieces:
        (lower, upper), name = piece.metadata.box[j], piece.metadata.parameters[j]
        low, high = max(lower, interval[0]), min(upper, interval[1])
        if high - low > round_off(lower, upper):
            part = {name: (low, high)}
            smaller.append(Piece(*with_restricted(piece.outcome, piece.metadata, part)))
    return joined(smaller)


def merged(by_symbol: object, named: Mapping[str, object]) -> dict[str, Any]:
    """Arguments by symbols and by keywords, all by name; an OptionError if one is given twice."""
    if not isinstance(by_symbol, Mapping | None):
        raise OptionError(
            f"{by_symbol!r} is not a mapping from names to values",
            term=by_symbol,
            remedy="give {name: value}, or keywords",
        )
    by_name: dict[str, Any] = dict(named)
    for key, argument in (by_symbol or {}).items():
        name = name_of(key)
        if name in by_name:
            raise OptionError(f"{quote(name)} is given twice", term=name, remedy="give it once")
        by_name[name] = argument
    return by_name


def position(metadata: SolutionMetadata, name: str) -> int:
    """The position of a parameter."""
    names = metadata.parameters
    if name not in names:
        raise OptionError(
            f"there is no parameter {quote(name)}{did_you_mean(name, names)}",
            term=name,
            remedy=f"choose from {listing(names)}" if names else "the solution has none",
        )
    return names.index(name)


def _inside(name: str, at: Any, lower: float, upper: float) -> float:
    """A number inside an interval, or an OptionError."""
    try:
        if isinstance(at, str | bool):
            raise TypeError
        point = float(at)
    except (TypeError, ValueError, OverflowError):
        raise OptionError(f"{quote(name)} is {at!r}, not a number", term=at) from None
    slack = round_off(lower, upper)
    if not lower - slack <= point <= upper + slack:
        raise OptionError(
            f"{quote(name)} = {point:g} is outside its range [{lower:g}, {upper:g}]",
            term=at,
            remedy="nothing is extrapolated; choose values inside",
        )
    return float(np.clip(point, lower, upper))


def _decided(outcome: Outcome, metadata: SolutionMetadata) -> Outcome:
    """The outcome on a part of the box, with the share of it in which the order is undecided."""
    timeline = outcome.timeline
    if not isinstance(timeline, BranchedTimeline):
        return outcome
    coverage = Coverage.of_box(np.reshape(metadata.box, (-1, 2)))
    share = undecided_share(branch_evaluator(outcome.slabs, timeline), coverage)
    outcome = replace(outcome, timeline=replace(timeline, undecided=share))
    if outcome.status not in (Status.CONVERGED, Status.UNCHECKED):
        return outcome
    notes = [note for note in outcome.notes if not isinstance(note, UndecidedShare)]
    if share > MOST_UNDECIDED:
        notes = [note for note in notes if not isinstance(note, MeasuredError)]
        cause = UndecidedOrder(share)
        return replace(outcome, status=Status.TOLERANCE, cause=cause, notes=tuple(notes))
    notes += [UndecidedShare(share)] if share else []
    return replace(outcome, notes=tuple(notes))


def _part(outcome: Outcome, rtol: float) -> Outcome:
    """The outcome on a part of the box, of which the error on the whole box is known.

    The error of a part at corners that did not count, and are less accurate, is not known.
    """
    measured = outcome.measured
    if outcome.pieces:  # each of them knows that it is a part
        return outcome
    if measured is None or any(isinstance(note, PartOfSolution) for note in outcome.notes):
        return outcome
    status, cause, notes = outcome.status, outcome.cause, outcome.notes
    if status is Status.CONVERGED and measured.corner_error > rtol:
        status, cause = Status.UNCHECKED, UncertainPart(measured.corner_error)
        notes = tuple(note for note in notes if not isinstance(note, MeasuredError))
    measured = replace(measured, worst=(), quantile=None)
    return replace(
        outcome,
        status=status,
        cause=cause,
        notes=(*notes, PartOfSolution()),
        measured=measured,
        history=(),
    )


# -----------------------------------------------------------------------------
# One solution over a box, joined of solutions on pieces that tile it.


_SHARED = ("problem", "compile", "outputs")  # Stages that pieces have in common
_SOLVED = (Status.CONVERGED, Status.UNCHECKED)
# What pieces of one problem have in common, and how messages call it
_COMMON: dict[str, Callable[[SolutionMetadata], object]] = {
    "unknowns": lambda metadata: metadata.unknowns,
    "states": lambda metadata: (metadata.states, metadata.roles),
    "parameters": lambda metadata: metadata.parameters,
    "time": lambda metadata: (metadata.time, metadata.timeless),
    "horizons": lambda metadata: metadata.horizon,
    "fixed coordinates": lambda metadata: metadata.fixed,
    "constants": lambda metadata: metadata.constants,
    "equations": lambda metadata: (metadata.equations, metadata.definitions),
    "correlations": lambda metadata: metadata.correlations,
    "absolute tolerances": lambda metadata: metadata.atol,
    "units": lambda metadata: metadata.units,
}


def joined(pieces: Sequence[Piece]) -> tuple[Outcome, SolutionMetadata]:
    """The outcome and the metadata of one solution over the box that pieces tile.

    Its error is that of the worst piece, and it is a success if all pieces are. An OptionError if
    pieces belong to different problems, overlap or leave gaps, or one has nothing to evaluate.
    """
    pieces = tuple(chain.from_iterable(piece.outcome.pieces or (piece,) for piece in pieces))
    if not pieces:
        raise OptionError("there are no pieces to join", remedy="give solutions that tile a box")
    if len(pieces) == 1:
        return pieces[0].outcome, pieces[0].metadata
    first = pieces[0].metadata
    for position, piece in enumerate(pieces):
        _check_alike(first, piece, position)
    tiling = Tiling.of([piece.metadata.box for piece in pieces], first.parameters)
    outcomes = [piece.outcome for piece in pieces]
    methods = dict.fromkeys(piece.metadata.method for piece in pieces)
    metadata = replace(
        first,
        box=tiling.box,
        distributions=_distributions(pieces, tiling.box),
        rtol=max(piece.metadata.rtol for piece in pieces),
        method=next(iter(methods)) if len(methods) == 1 else ", ".join(methods),
        source=None,
    )
    status, measured = _status(outcomes), _measured(outcomes)
    outcome = Outcome(
        slabs=(),
        status=status,
        measured=measured,
        history=tuple(chain.from_iterable(outcome.history for outcome in outcomes)),
        timings=_timings(outcomes),
        work=_sums(outcome.work for outcome in outcomes),
        notes=_notes(pieces, measured, metadata),
        pieces=pieces,
    )
    return outcome, metadata


def _check_alike(first: SolutionMetadata, piece: Piece, position: int) -> None:
    """Raise an OptionError unless a piece is of the same problem as the first one, and solved."""
    if not piece.outcome.is_solved:
        raise OptionError(
            f"piece {position} has nothing to evaluate: {piece.outcome.message}",
            remedy="solve it again with a larger effort, or on smaller pieces",
        )
    for what, of in _COMMON.items():
        one, other = of(first), of(piece.metadata)
        if one != other:
            raise OptionError(
                f"pieces 0 and {position} differ in their {what}: {shown(one)} and {shown(other)}",
                remedy="join pieces of one problem, solved on parts of one box",
            )


def _distributions(
    pieces: Sequence[Piece], box: Sequence[tuple[float, float]]
) -> tuple[tuple[str, str], ...]:
    """The distributions over the whole box: scales go on over it, others have to be the same."""
    names = pieces[0].metadata.parameters
    whole: list[tuple[str, str]] = []
    for name, interval in zip(names, box, strict=True):
        texts = {dict(piece.metadata.distributions).get(name) for piece in pieces}
        words = {written_scale(text) for text in texts}
        text = texts.pop() if len(texts) == 1 else None
        if len(words) == 1 and None not in words:
            text = measure_text(str(words.pop()), interval)
        elif texts:
            raise OptionError(
                f"pieces have different distributions of {quote(name)}",
                remedy="solve them with the same one",
            )
        if text is not None:
            whole.append((name, text))
    return tuple(whole)


def _status(outcomes: Sequence[Outcome]) -> Status:
    """CONVERGED if all are, else the status of the worst of them."""
    failed = [outcome for outcome in outcomes if outcome.status not in _SOLVED]
    if failed:
        return max(failed, key=lambda outcome: outcome.error).status
    if any(outcome.status is Status.UNCHECKED for outcome in outcomes):
        return Status.UNCHECKED
    return Status.CONVERGED


def _measured(outcomes: Sequence[Outcome]) -> Measured | None:
    """The largest errors over all pieces; None if one was not measured."""
    every = [outcome.measured for outcome in outcomes if outcome.measured is not None]
    if len(every) < len(outcomes):
        return None
    worst = max(every, key=lambda measured: measured.error)
    counted: set[int] | None = set()
    for measured in every:
        states = None if measured.counted is None else {*measured.counted}
        counted = None if counted is None or states is None else counted | states
    return Measured(
        interior=_largest(measured.interior for measured in every),
        corners=_largest(measured.corners for measured in every),
        points=sum(measured.points for measured in every),
        method=_names(measured.method for measured in every),
        cover="box" if all(measured.cover == "box" for measured in every) else "interior",
        worst=worst.worst,
        counted=None if counted is None else tuple(sorted(counted)),
        drift=_most(measured.drift for measured in every),
        integrator=_names(measured.integrator for measured in every),
        time_error=_most(measured.time_error for measured in every),
        share_error=_most(measured.share_error for measured in every),
        constraint_drift=_most(measured.constraint_drift for measured in every),
    )


def _notes(
    pieces: Sequence[Piece], measured: Measured | None, metadata: SolutionMetadata
) -> tuple[Note, ...]:
    """What the message says: the worst piece, those that failed, and what is undecided."""
    notes: list[Note] = []
    if measured is not None:
        errors = [piece.outcome.error for piece in pieces]
        order = measured.worst_first
        unknown = metadata.states[order[0]] if len(order) > 1 else None
        corners = measured.corner_error if measured.cover == "interior" else 0.0
        above = corners if corners > metadata.rtol else None
        notes.append(MeasuredError(measured.error, metadata.rtol, unknown, above))
        worst = max(range(len(pieces)), key=errors.__getitem__)
        notes.append(WorstPiece(len(pieces), worst, _intervals(pieces[worst])))
    failed = [k for k, piece in enumerate(pieces) if piece.outcome.status not in _SOLVED]
    if failed:
        verdict = pieces[failed[0]].outcome.verdict
        notes.append(FailedPieces(tuple(failed), len(pieces), verdict))
    share = _undecided(pieces)
    return (*notes, UndecidedShare(share)) if share else tuple(notes)


def _undecided(pieces: Sequence[Piece]) -> float:
    """The share of the whole box in which it is undecided in which order events come."""
    shares = [piece.outcome.verdict.undecided for piece in pieces]
    return float(np.average(shares, weights=[_volume(piece.metadata) for piece in pieces]))


def _volume(metadata: SolutionMetadata) -> float:
    """The volume of a box on the scales of its parameters."""
    texts, volume = dict(metadata.distributions), 1.0
    for name, interval in zip(metadata.parameters, metadata.box, strict=True):
        scale = SCALES[written_scale(texts.get(name)) or LINEAR]
        volume *= abs(float(np.diff(scale.to_scale(np.array(interval)))[0]))
    return volume


def _intervals(piece: Piece) -> tuple[tuple[str, float, float], ...]:
    names, box = piece.metadata.parameters, piece.metadata.box
    return tuple((name, *ends) for name, ends in zip(names, box, strict=True))


def _largest(errors: Iterable[tuple[float, ...]]) -> tuple[float, ...]:
    """The largest error of each state; empty where a piece has none."""
    table = list(errors)
    return tuple(map(max, zip(*table, strict=True))) if all(table) else ()


def _most(errors: Iterable[float | None]) -> float | None:
    return max((error for error in errors if error is not None), default=None)


def _names(words: Iterable[str]) -> str:
    """Different words in one text, the most frequent first."""
    return " and ".join(word for word, _ in Counter(words).most_common())


def _timings(outcomes: Sequence[Outcome]) -> dict[str, float]:
    """Seconds by stage in all; what was compiled served all pieces."""
    seconds = _sums(outcome.timings for outcome in outcomes)
    shared = {
        stage: max(outcome.timings.get(stage, 0.0) for outcome in outcomes)
        for stage in _SHARED
        if stage in seconds
    }
    return seconds | shared


def _sums(by_stage: Iterable[dict[str, float]]) -> dict[str, float]:
    totals: Counter[str] = Counter()
    for amounts in by_stage:
        totals.update(amounts)
    return dict(totals)
