"""Functionals of fields as a solution of their own: nothing is sampled or interpolated.

They are sums of coefficients, so the first core of each train is multiplied by their weights.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from rankone.solution.evaluation.domains import joined
from rankone.solution.solution import Solution
from rankone.solvers.outcome import Measured, Outcome, Piece, Role, SolutionMetadata
from rankone.solvers.reduced.functionals import Functional
from rankone.solvers.verification.points import check_points
from rankone.support.arrays import SAMPLES, Array
from rankone.tensors.slab import SlabTrain
from rankone.tensors.train import Train
from rankone.trajectories.system.timeline import BranchedTimeline
from rankone.trajectories.system.verdict import LessAccurateOutput, OutputError, Status

_MEASURED = (Status.CONVERGED, Status.TOLERANCE)  # What the measured error alone decides


def functional_solution(
    coefficients: Solution, functionals: Mapping[str, Functional], status: Status
) -> Solution:
    """The states that outputs are made of.

    Errors are relative to the largest value that a functional could have, not to the one it has:
    absolute tolerances add the difference. ``status`` is that of the fields.
    """
    rtol, listed = coefficients.rtol, [*functionals.values()]
    missing = np.maximum([f.size for f in listed] - largest_values(coefficients, listed), 0.0)
    errors = [functional.error for functional in listed]
    metadata = replace(
        _metadata(coefficients.metadata, functionals),
        atol=tuple(zip(functionals, (rtol * missing).tolist(), strict=True)),
    )
    return _mapped(coefficients, listed, metadata, errors, status)


def linear_outputs(
    coefficients: Solution,
    outputs: Mapping[str, Functional],
    texts: Mapping[str, str],
    rtol: float,
    status: Status,
) -> Solution:
    """Functionals as outputs, whose errors are relative to their own largest values."""
    listed = [*outputs.values()]
    sizes = largest_values(coefficients, listed)
    errors = relative_errors(listed, sizes)
    metadata = replace(
        _metadata(coefficients.metadata, outputs),
        equations=tuple(texts.get(name, name) for name in outputs),
        rtol=rtol,
    )
    solution = _mapped(coefficients, listed, metadata, errors, status)
    if solution.outcome.measured is None or solution.status not in _MEASURED:
        return solution
    worst = [*outputs][int(np.argmax(errors))] if not solution.success else None
    note = OutputError(0.0, max(errors), worst)
    return Solution(replace(solution.outcome, notes=(note,)), solution.metadata)


def compared_with_solve(outputs: Solution, asked: float) -> Solution:
    """Outputs whose message begins with it if they miss the tolerance that the solve asked for."""
    outcome = outputs.outcome
    if outcome.cause is not None or outcome.measured is None or outputs.error <= asked:
        return outputs
    cause = LessAccurateOutput(outputs.error, asked)
    return Solution(replace(outcome, cause=cause), outputs.metadata)


def relative_errors(functionals: list[Functional], sizes: Array) -> list[float]:
    """What the errors of the fields may change functionals by, relative to their sizes."""
    return [
        float(each.error * each.size / size) if size else 0.0 if each.error == 0.0 else np.inf
        for each, size in zip(functionals, sizes, strict=True)
    ]


def largest_values(coefficients: Solution, functionals: list[Functional]) -> Array:
    """The largest absolute value of each functional over the horizon and points of the box."""
    box = np.array(coefficients.metadata.box, dtype=float).reshape(-1, 2)
    points = check_points(box, SAMPLES, every_corner=True)
    at: dict[str, object] = dict(zip(coefficients.metadata.parameters, points.T, strict=True))
    if not coefficients.metadata.timeless:
        at[coefficients.metadata.time] = np.linspace(*coefficients.time, SAMPLES)[:, None]
    sampled = coefficients(at).reshape(len(coefficients.unknowns), -1)
    weights = np.array([functional.weights for functional in functionals])
    values = np.abs(weights @ sampled)
    return np.asarray(np.fmax.reduce(values, axis=1))


def _metadata(metadata: SolutionMetadata, names: Mapping[str, Functional]) -> SolutionMetadata:
    """The metadata of a solution of functionals."""
    coordinates = {*metadata.coordinates}
    return replace(
        metadata,
        states=tuple(names),
        roles=(Role.UNKNOWN,) * len(names),
        units=tuple(unit for unit in metadata.units if unit[0] in coordinates),
        source=None,
        definitions=(),
        atol=(),
        additive=(),
        left_out=(),
    )


def _mapped(
    coefficients: Solution,
    functionals: list[Functional],
    metadata: SolutionMetadata,
    errors: list[float],
    status: Status,
) -> Solution:
    """The solution of functionals, with errors of each."""
    weights = np.zeros((len(functionals), len(coefficients.states)))
    weights[:, coefficients.metadata.unknown_rows] = [each.weights for each in functionals]
    measured = Measured(tuple(errors), (), points=0, method="solution", cover="box")
    if np.isnan(errors).any():
        status, own = Status.UNCHECKED, None
    else:
        own = measured
        if status in _MEASURED:
            within = measured.error <= metadata.rtol
            status = Status.CONVERGED if within else Status.TOLERANCE

    def of(outcome: Outcome) -> Outcome:
        timeline = outcome.timeline
        if isinstance(timeline, BranchedTimeline):
            tolerances = np.abs(weights) @ timeline.tolerances
            timeline = replace(timeline, tolerances=tuple(tolerances.tolist()))
        return replace(
            outcome,
            slabs=tuple(_with_rows(slab, weights) for slab in outcome.slabs),
            timeline=timeline,
            measured=own,
            status=status,
            cause=None,
            notes=(),
            history=(),
            switching=None,
        )

    if coefficients.outcome.pieces:
        pieces = coefficients.outcome.pieces
        return Solution(
            *joined([Piece(of(p.outcome), replace(metadata, box=p.metadata.box)) for p in pieces])
        )
    return Solution(of(coefficients.outcome), metadata)


def _with_rows(slab: SlabTrain, weights: Array) -> SlabTrain:
    """A slab whose states are sums of those it has; clock, lengths and guards stay behind them."""
    first, *others = slab.cores
    states = np.tensordot(weights, first[: weights.shape[1]], axes=1)
    rows = np.concatenate([states, first[weights.shape[1] :]])
    return replace(slab, train=Train((rows, *others)))
