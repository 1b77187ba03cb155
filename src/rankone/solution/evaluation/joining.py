"""One solution over a box, joined of solutions on pieces that tile it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from itertools import chain

import numpy as np

from rankone.solvers.outcome import Measured, Outcome, Piece, SolutionMetadata
from rankone.support.errors import OptionError
from rankone.support.wording import quote, shown
from rankone.tensors.bases.scales import LINEAR, SCALES, measure_text, written_scale
from rankone.tensors.evaluators.branch_evaluator import Tiling
from rankone.trajectories.system.verdict import (
    FailedPieces,
    MeasuredError,
    Note,
    Status,
    UndecidedShare,
    WorstPiece,
)

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
