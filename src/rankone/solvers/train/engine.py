"""The tensor-train engine: march, check against SciPy, tighten until the measured error fits."""

from __future__ import annotations

import math
import time as clock
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from rankone.discretization import RadauCollocation
from rankone.solvers.outcome import Measured, Outcome, SlabRecord, Status
from rankone.solvers.reference import Reference, check_points, integrate_reference, measure
from rankone.solvers.sensitivity import amplification
from rankone.solvers.train.march import Guess, March, MarchResult
from rankone.solvers.train.nodes import first_bases
from rankone.solvers.train.options import TrainOptions
from rankone.system import Array, System
from rankone.tensors.slab import SlabTrain

__all__ = ["solve_train"]

_LARGEST_DENSE_PARAMETERS = 3
"""Up to so many parameters the corners of the box count for success like interior points."""
_BLOW_UP_FRACTION = 0.9
"""Part of the way to a blow-up that is still solved."""


@dataclass
class _Attempt:
    result: MarchResult
    measured: Measured | None
    error: float


def solve_train(
    system: System,
    rtol: float,
    options: TrainOptions | None = None,
    check: int = 24,
    report: Callable[[float, float, int, int, int], None] | None = None,
) -> Outcome:
    """Solve a generated system for the whole box.

    Parameters
    ----------
    system : System
        The generated module.
    rtol : float
        Largest measured error asked for, relative to the size of each unknown.
    options : TrainOptions, optional
    check : int
        Number of random interior check points; 0 skips the check.
    report : callable, optional
        Called with (time, fraction of the horizon, attempt, slabs, rank) after each slab.

    Returns
    -------
    Outcome
        ``status`` is CONVERGED only if the measured error is within ``rtol``.
    """
    options = options or TrainOptions()
    timings = {"reference": 0.0, "march": 0.0, "check": 0.0}
    began = clock.perf_counter()
    box = np.array(system.BOX, dtype=float).reshape(-1, 2)
    start, horizon = system.TIME
    points = check_points(box, check)
    reference = integrate_reference(system, points, start, horizon, max(1e-3 * rtol, 3e-13))
    end = reference.end
    if reference.blown is not None:
        end = start + _BLOW_UP_FRACTION * (end - start)
    sizes = _sizes(system, reference, end)
    growth = amplification(system, reference, sizes[: system.N_DIFFERENTIAL], end)
    timings["reference"] = clock.perf_counter() - began

    corners = _corner_count(len(box), check)
    collocation = RadauCollocation.of(options.nodes_in_time(rtol))
    bases, floors = first_bases(system, box, rtol, options)
    inner = rtol * (0.06 if len(box) <= _LARGEST_DENSE_PARAMETERS else 0.4)
    records: list[SlabRecord] = []
    guesses: Sequence[Guess] = ()
    best: _Attempt | None = None
    for attempt in range(options.max_attempts):
        began = clock.perf_counter()
        level = inner

        def tolerance(t: float, level: float = level) -> float:
            return max(level / growth(t), 1e-14)

        def notify(t: float, slabs: int, rank: int, attempt: int = attempt) -> None:
            if report is not None:
                report(t, (t - start) / (end - start), attempt, slabs, rank)

        march = March(
            system,
            reference,
            sizes,
            bases,
            floors,
            tolerance,
            0.1 * inner,
            options,
            collocation,
            attempt,
            guesses,
            notify,
        )
        result = march.run(end)
        records += result.records
        timings["march"] += clock.perf_counter() - began
        began = clock.perf_counter()
        measured, error = None, math.inf
        if result.slabs and check:
            states = sizes[: system.N_DIFFERENTIAL]
            measured = measure(result.slabs, reference, states, corners)
            error = max(measured.interior, default=0.0)
        timings["check"] += clock.perf_counter() - began
        current = _Attempt(result, measured, error)
        stalled = best is not None and error > 0.7 * best.error
        if best is None or _better(current, best):
            best = current
        if not check or result.stopped or error <= rtol or result.limits or stalled:
            break
        inner *= min(max(0.4 * rtol / error, 1e-3), 0.4)
        guesses, bases = result.guesses, result.guesses[0].bases
    assert best is not None
    return _outcome(best, reference, rtol, records, timings, check)


def _better(new: _Attempt, old: _Attempt) -> bool:
    if (new.result.stopped is None) != (old.result.stopped is None):
        return new.result.stopped is None
    return new.error < old.error


def _corner_count(dimensions: int, check: int) -> int:
    """How many of the check points after the centre are corners."""
    if not check or not dimensions:
        return 0
    return 2**dimensions if dimensions <= _LARGEST_DENSE_PARAMETERS else 8


def _sizes(system: System, reference: Reference, end: float) -> Array:
    """Largest absolute value of each state over the check points; one for a vanishing state."""
    values = system.lift(reference(np.linspace(reference.start, end, 201)))
    sizes = np.abs(values).max(axis=(1, 2))
    return np.where(sizes > 0.0, sizes, 1.0)


def _outcome(
    best: _Attempt,
    reference: Reference,
    rtol: float,
    records: list[SlabRecord],
    timings: dict[str, float],
    check: int,
) -> Outcome:
    result, measured = best.result, best.measured
    limits = [status for status in Status if status in result.limits]
    if reference.blown is not None:
        status = Status.BLOW_UP
    elif result.stopped is not None:
        gave_up = result.stopped is Status.NO_CONVERGENCE
        status = limits[0] if gave_up and limits else result.stopped
    elif not check:
        status = Status.UNCHECKED
    elif best.error <= rtol:
        status = Status.CONVERGED
    else:
        status = limits[0] if limits else Status.TOLERANCE
    blow_up = None
    if reference.blown is not None:
        blow_up = reference.end, tuple(reference.points[reference.blown].tolist())
    return Outcome(
        tuple(result.slabs),
        status,
        _message(status, best, rtol, result.slabs),
        measured,
        tuple(records),
        timings,
        blow_up,
    )


def _message(status: Status, best: _Attempt, rtol: float, slabs: Sequence[SlabTrain]) -> str:
    """The sentence a user reads: how it ended, the figures, and what to do."""
    text = status.value
    if best.measured is not None and status is Status.CONVERGED:
        text += f": {best.error:.1e} of {rtol:.1e}"
    elif best.measured is not None:
        text += f": measured error {best.error:.1e}, asked {rtol:.1e}"
    if best.measured is not None:
        corner = max(best.measured.corners, default=0.0)
        if corner > max(rtol, best.error):
            text += f" (up to {corner:.1e} at the corners of the box)"
    reached = slabs[-1].end if slabs else None
    remedies = {
        Status.RANK_LIMIT: "raise max_rank, narrow the box or loosen rtol",
        Status.NODE_LIMIT: "raise max_nodes, narrow the box or loosen rtol",
        Status.SLAB_LIMIT: "raise max_slabs or shorten the horizon",
        Status.MEMORY_LIMIT: "raise max_memory, narrow the box or loosen rtol",
        Status.NO_CONVERGENCE: "narrow the box or shorten the horizon",
        Status.TOLERANCE: "loosen rtol, narrow the box or shorten the horizon",
    }
    if best.result.stopped is not None:
        where = "before the first slab was solved" if reached is None else f"at t = {reached:.6g}"
        text += f"; stopped {where}"
    if status in remedies:
        text += f"; {remedies[status]}"
    return text
