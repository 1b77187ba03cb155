"""From values of quantities at parameter points to a solution, and how good it is.

By cross interpolation, as the cross engine does it with trajectories; its error is that of the
interpolation, measured at further points, and what the errors of the solution make of it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import numpy as np

from rankone.discretization import Basis1D
from rankone.ir.domain import Domain
from rankone.ir.outcome import Measured, Outcome
from rankone.ir.verdict import Note, OutputError, Remedy, Status, UnknownOutputError, WorstOutput
from rankone.outputs.check import Check, CheckPoints, critical_points, split, spread_over
from rankone.outputs.quantities import Quantities
from rankone.outputs.sampling import Sampler
from rankone.solution.core import SolutionCore
from rankone.solvers.cross.nodes import divided, more_nodes, resolving_bases
from rankone.solvers.cross.options import CrossOptions
from rankone.solvers.cross.time_grid import TimeGrid, resolving_breaks
from rankone.support.arrays import Array
from rankone.support.budget import (
    OutOfBudgetError,
    OutOfTimeError,
    limited,
    seconds_left,
    work_left,
)
from rankone.support.errors import ConvergenceError
from rankone.tensors.cross import interpolate, left_points, with_points
from rankone.tensors.samples import GrowingBasis, Samples
from rankone.tensors.slab import SlabTrain
from rankone.tensors.train import Train

__all__ = ["solved_quantities"]

_OF_SOLUTION = Remedy("solve with a smaller rtol, or loosen that of the output")
_OF_INTERPOLATION = Remedy(
    "raise effort, loosen rtol or restrict the solution; what jumps or kinks as parameters change "
    "is hardly resolved"
)

_AIM = 0.1
"""Error of the interpolation that is aimed at, over the tolerance."""
_DEFAULT = 1.5
"""The tolerance where none is given, over what errors of the solution's tolerance bring."""
_SHARE = 0.1
"""Share of a part of the interpolation in that."""
_LEFT_POINTS = 7
_ATTEMPTS = 8
_PROBES = 12
"""Points whose functions of time are resolved, besides the corners."""
_GRIDS, _ROUGHEST, _ROUGH = 4, 8, 3.0
"""Most grids in time, points that each has to resolve besides those before it, and the highest
modes there, over what is aimed at, that suffice."""
_SLABS = 500
"""Most slabs of a grid, or twice those that the solution has."""
_FOR_TRAINS = 0.7
"""Share of the budget for the interpolation; its error is measured whatever is left then."""
_LARGEST = 0.1
"""Largest tolerance where none is given."""


def solved_quantities(
    solution: SolutionCore,
    quantities: Quantities,
    rtol: float | None,
    operations: float,
    max_seconds: float,
) -> tuple[Outcome, float]:
    """Quantities as an outcome over the box and the time that the solution holds.

    Returns
    -------
    outcome : Outcome
    rtol : float
        The tolerance; if it is not given, what errors of the solution's tolerance would bring.

    Raises
    ------
    EvaluationError
        If a quantity is not finite somewhere.
    ConvergenceError
        If the time limit is reached before there is anything.
    """
    domain, options = Domain(solution.time, solution.metadata.box), CrossOptions()
    slabs, names = solution.outcome.slabs, solution.metadata.parameters
    points = CheckPoints.of(domain, quantities)
    with _limited(operations, max_seconds):
        level = _AIM * (rtol or solution.rtol)
        grid = _resolving_grid(solution, quantities, domain, options, level, points)
        sampler = Sampler(slabs, names, quantities, grid, solution.rtol)
        finer = Sampler(slabs, names, quantities, split(grid), solution.rtol)
        critical = critical_points(sampler, domain)
        check = Check.at(finer, np.concatenate([points.further, critical]))
        amplified = check.amplified(finer, solution.rtol)
        if rtol is None:
            most = float(amplified.sum(axis=0).max(initial=0.0))
            rtol = min(_DEFAULT * max(solution.rtol, most), max(_LARGEST, solution.rtol))
        target = Check.at(sampler, np.concatenate([points.aimed, critical]))
        with limited(_FOR_TRAINS * work_left(), _FOR_TRAINS * seconds_left()):
            found = _interpolated(sampler, target, domain, options, _AIM * rtol)
    errors = list(solution.errors.values())
    shares = [
        np.nan if source.order else errors[source.row] / solution.rtol
        for source in quantities.sources
    ]
    brought = np.tensordot(np.array(shares), amplified, 1)
    missed = check.missed(found, finer) + sampler.narrow(check.points)
    if domain.box:
        climbed = check.climbed(found, finer, domain).missed(found, finer)
        missed[:, -1] = np.maximum(missed[:, -1], climbed.max(axis=1))
    return _outcome(quantities, found, missed, brought, points.corners, rtol), rtol


@contextmanager
def _limited(operations: float, seconds: float) -> Iterator[None]:
    """Limit what is done inside, with an error of ours."""
    try:
        with limited(operations, seconds):
            yield
    except OutOfBudgetError as out:
        more = (
            "give more time by max_seconds" if isinstance(out, OutOfTimeError) else "raise effort"
        )
        raise ConvergenceError(
            f"{Status.of_limit(out).value} before anything was interpolated",
            remedy=f"{more}, or restrict the solution",
        ) from None


def _resolving_grid(
    solution: SolutionCore,
    quantities: Quantities,
    domain: Domain,
    options: CrossOptions,
    level: float,
    points: CheckPoints,
) -> TimeGrid:
    """A grid that resolves the functions of time at corners, and where they are roughest."""
    probes = np.concatenate([points.aimed[: points.corners], spread_over(domain, _PROBES)])
    slabs, names = solution.outcome.slabs, solution.metadata.parameters
    for _ in range(_GRIDS):
        grid = _grid(solution, quantities, domain, options, level, probes)
        sampler = Sampler(slabs, names, quantities, grid, solution.rtol)
        if solution.metadata.timeless:
            break
        rough = sampler.roughness(points.aimed)
        worst = np.argsort(-rough)[:_ROUGHEST]
        if rough[worst[0]] <= _ROUGH * level:
            break
        probes = np.concatenate([probes, points.aimed[worst]])
    return grid


def _grid(
    solution: SolutionCore,
    quantities: Quantities,
    domain: Domain,
    options: CrossOptions,
    level: float,
    points: Array,
) -> TimeGrid:
    """Slabs that resolve the integrands, and what is no reduction, at some points."""
    slabs, names = solution.outcome.slabs, solution.metadata.parameters
    start, end = domain.horizon
    if solution.metadata.timeless:
        return TimeGrid((start, end), 1)
    limits = [x for r in quantities.reductions for x in (r.start, r.end) if start < x < end]
    cuts = {*(slab.start for slab in slabs[1:]), *limits, *quantities.breaks[0]}
    edges = [start, *sorted(cuts), end]
    count = options.nodes_in_time(level)
    first = Sampler(slabs, names, quantities, TimeGrid(tuple(edges), count), solution.rtol)
    found = np.abs(first.at(first.grid.times, points))
    sizes = np.maximum(found.max(axis=(1, 2), where=np.isfinite(found), initial=0.0), 1e-300)

    def values(times: Array) -> Array:
        exact = first.at(times, points) / sizes[:, None, None]
        return np.asarray(np.nan_to_num(exact.swapaxes(1, 2), posinf=0.0, neginf=0.0))

    breaks = resolving_breaks(values, edges, count, level, max(_SLABS, 2 * len(edges)))
    return TimeGrid(tuple(edges) if breaks is None else breaks, count)


def _interpolated(
    sampler: Sampler,
    check: Check,
    domain: Domain,
    options: CrossOptions,
    level: float,
) -> tuple[SlabTrain, ...]:
    """The best trains by a check."""
    function = _Columns(sampler, check.sizes, _SHARE * level)
    bases: tuple[Basis1D, ...] = ()
    best: tuple[float, tuple[SlabTrain, ...]] | None = None
    left_count, inner, worst = _LEFT_POINTS, level, None
    for attempt in range(_ATTEMPTS):
        try:
            if not attempt:
                known = [(borders, 0) for borders in sampler.quantities.breaks[1:]]
                if domain.box:
                    bases = resolving_bases(function, domain, inner, options, known)
            else:
                bases = divided(bases, function, domain, inner, options, worst)
            slabs, spectra = _one(function, bases, left_count, inner, options, worst)
        except OutOfBudgetError:
            if best is None:
                raise
            break
        missed = check.missed(slabs, sampler)
        error = float(missed.max())
        if error <= level and domain.box:
            check = check.with_points(sampler, check.climbed(slabs, sampler, domain).points)
            missed = check.missed(slabs, sampler)
            error = float(missed.max())
        if best is None or error < best[0]:
            best = error, slabs
        if error <= level or not domain.box:
            break
        worst = check.points[np.argsort(-missed.max(axis=0))[:_LEFT_POINTS]]
        left_count = -(-3 * left_count // 2)
        finer = more_nodes(bases, spectra, _SHARE * inner, options.max_nodes)
        if finer == bases:
            inner *= max(min(0.5, level / error), 0.05)
            finer = more_nodes(bases, spectra, _SHARE * inner, options.max_nodes)
        bases = finer
    assert best is not None
    return best[1]


class _Columns:
    """Quantities at points as coefficients in a growing basis, in units of their sizes."""

    def __init__(self, sampler: Sampler, sizes: Array, lost: float) -> None:
        self.sampler, self.lost = sampler, lost
        self.units = sizes * np.sqrt(sampler.rows)
        self.basis = GrowingBasis(sizes.size * sampler.rows)

    def __call__(self, points: Array) -> Array:
        values = self.sampler(points) / self.units[:, None, None]
        return self.basis.coefficients(values.reshape(-1, len(points)), self.lost)

    def values(self, coefficients: Array) -> Array:
        """Quantities (quantities, rows, m) from coefficients (rank, m)."""
        columns = self.basis.columns(coefficients)
        shape = self.units.size, self.sampler.rows, coefficients.shape[1]
        return np.asarray(columns.reshape(shape) * self.units[:, None, None])


def _one(
    function: _Columns,
    bases: Sequence[Basis1D],
    left_count: int,
    level: float,
    options: CrossOptions,
    doubtful: Array | None,
) -> tuple[tuple[SlabTrain, ...], list[Array]]:
    """One interpolation: slabs, and the norms of the modes of each parameter."""
    if bases:
        left = left_points([basis.size for basis in bases], left_count, 20140)
        if doubtful is not None:
            left = with_points(left, [basis.nodes for basis in bases], doubtful)
        tolerance = _SHARE * level / np.sqrt(len(bases))
        samples = Samples(function, bases)
        train, _ = interpolate(samples, bases, left, tolerance, options.max_rank)
        train = train.rounded(_SHARE * level)
    else:
        train = Train((function(np.zeros((1, 0))),))
    modal = train.apply_to_modes([basis.to_modal for basis in bases])
    first, grid = function.values(train.first), function.sampler.grid
    if function.sampler.quantities.timeless:
        grid = TimeGrid((grid.breaks[0], grid.breaks[-1]), 1)
    return tuple(grid.trains(modal.with_first(first), bases)), modal.mode_norms()


def _outcome(
    quantities: Quantities,
    slabs: tuple[SlabTrain, ...],
    missed: Array,
    brought: Array,
    corners: int,
    rtol: float,
) -> Outcome:
    """What was found and how good it is; the first points are corners."""
    if np.isnan(brought).any():
        cause = UnknownOutputError(float(missed.max()))
        return Outcome(slabs, Status.UNCHECKED, None, (), cause=cause)
    total = missed + brought
    measured = Measured(
        interior=tuple(map(float, total.max(axis=1))),
        corners=tuple(map(float, total[:, :corners].max(axis=1))) if corners else (),
        points=total.shape[1],
        method="solution",
        cover="box",
    )
    status = Status.CONVERGED if measured.error <= rtol else Status.TOLERANCE
    notes: list[Note] = [OutputError(float(missed.max()), float(brought.max()))]
    if status is Status.TOLERANCE:
        notes.append(WorstOutput(quantities.names[int(total.max(axis=1).argmax())]))
        notes.append(_OF_SOLUTION if brought.max() > missed.max() else _OF_INTERPOLATION)
    return Outcome(slabs, status, measured, (), notes=tuple(notes))
