"""``method="greedy"``: march, check against SciPy, more nodes or a tighter tolerance."""

from __future__ import annotations

import math
import time as clock
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rankone.discretization.finite_elements import LagrangeElements
from rankone.ir import SeparatedForm
from rankone.solvers.greedy.history import GreedySlabRecord
from rankone.solvers.greedy.march import March, MarchResult
from rankone.solvers.greedy.nodes import first_nodes
from rankone.solvers.greedy.options import GreedyOptions
from rankone.solvers.greedy.terms import source_terms
from rankone.solvers.outcome import Measured, Outcome, Status
from rankone.solvers.reference import Reference, check_points, integrate_reference, measure
from rankone.solvers.sensitivity import amplification
from rankone.system import System

__all__ = ["solve_greedy"]

Array = NDArray[np.float64]

_BLOW_UP_FRACTION = 0.9
"""Part of the way to a blow-up that is still solved."""
_SHARE = 0.03
"""Tolerance of a slab relative to the error asked for, before the growth of errors."""
_TAIL = 0.1
"""Part of the error asked for that the highest modes may make up."""


@dataclass
class _Attempt:
    result: MarchResult
    measured: Measured | None
    error: float


def solve_greedy(
    system: System,
    form: SeparatedForm,
    rtol: float,
    options: GreedyOptions | None = None,
    check: int = 24,
    report: Callable[[float, float, int, int, int], None] | None = None,
) -> Outcome:
    """Solve a generated system for the whole box by the classic method.

    Parameters
    ----------
    system : System
        The generated module.
    form : SeparatedForm
        The separated form it was generated from.
    rtol : float
        Largest measured error asked for, relative to the size of each unknown.
    options : GreedyOptions, optional
    check : int
        Number of random interior check points; 0 skips the check.
    report : callable, optional
        Called with (time, fraction of the horizon, attempt, slabs, rank) after each slab.

    Returns
    -------
    Outcome
        ``status`` is CONVERGED only if the measured error is within ``rtol``; ``history`` holds
        :class:`~rankone.solvers.greedy.history.GreedySlabRecord`. Finite elements in time give
        one slab for each element.
    """
    options = options or GreedyOptions()
    timings = {"reference": 0.0, "march": 0.0, "check": 0.0}
    began = clock.perf_counter()
    box = np.array(system.BOX, dtype=float).reshape(-1, 2)
    start, horizon = system.TIME
    points = check_points(box, check)
    corners = len(points) - 1 - check if check else 0
    reference = integrate_reference(system, points, start, horizon, max(1e-3 * rtol, 3e-13))
    end = reference.end
    if reference.blown is not None:
        end = start + _BLOW_UP_FRACTION * (end - start)
    sizes, stiffness = _sizes(system, reference, end)
    growth = amplification(system, reference, sizes, end)
    terms = source_terms(form)
    timings["reference"] = clock.perf_counter() - began

    nodes = first_nodes(system, box, rtol, options)
    share = _SHARE
    records: list[GreedySlabRecord] = []
    best: _Attempt | None = None
    for attempt in range(options.max_attempts):
        began = clock.perf_counter()
        level = share * rtol

        def tolerance(t: float, level: float = level) -> float:
            return options.tolerance or max(level / growth(t), 1e-13)

        def in_time(lower: float, upper: float, count: int = nodes.time) -> LagrangeElements:
            return options.shape_functions(lower, upper, count)

        def notify(t: float, slabs: int, rank: int, attempt: int = attempt) -> None:
            if report is not None:
                report(t, (t - start) / (end - start), attempt, slabs, rank)

        spaces = [
            options.shape_functions(float(lower), float(upper), count)
            for (lower, upper), count in zip(box, nodes.parameters, strict=True)
        ]
        march = March(
            system,
            terms,
            end,
            sizes,
            stiffness,
            tolerance,
            in_time,
            spaces,
            options,
            attempt,
            notify,
        )
        result = march.run()
        records += result.records
        timings["march"] += clock.perf_counter() - began
        began = clock.perf_counter()
        measured, error = None, math.inf
        if result.slabs and check:
            measured = measure(result.slabs, reference, sizes, corners)
            error = max(measured.interior, default=0.0)
        timings["check"] += clock.perf_counter() - began
        current = _Attempt(result, measured, error)
        stalled = best is not None and error > 0.7 * best.error
        if best is None or _better(current, best):
            best = current
        if not check or result.stopped or error <= rtol:
            break
        finer = nodes.finer(result.tails > _TAIL * rtol, options)
        stuck = stalled or result.limits or options.tolerance is not None
        if (stalled and result.limits) or (finer == nodes and stuck):
            break
        if finer == nodes:
            share *= min(max(0.5 * rtol / error, 0.05), 0.5)
        nodes = finer
    assert best is not None
    return _outcome(best, reference, rtol, records, timings, check)


def _better(new: _Attempt, old: _Attempt) -> bool:
    if (new.result.stopped is None) != (old.result.stopped is None):
        return new.result.stopped is None
    return new.error < old.error


def _sizes(system: System, reference: Reference, end: float) -> tuple[Array, float]:
    """Largest value of each state over the check points, and largest norm of the Jacobian.

    A vanishing state has the size one; the norm is the row sum norm in units of the sizes.
    """
    times = np.linspace(reference.start, end, 101)
    values = reference(times)
    sizes = np.abs(values).max(axis=(1, 2))
    sizes = np.where(sizes > 0.0, sizes, 1.0)
    n, m, count = values.shape
    jacobian = system.jacobian(times, values, reference.points.T[:, :, None])
    jacobian = np.broadcast_to(jacobian, (n, n, m, count))
    scaled = np.abs(jacobian) * (sizes[None, :] / sizes[:, None])[:, :, None, None]
    return sizes, float(scaled.sum(axis=1).max())


def _outcome(
    best: _Attempt,
    reference: Reference,
    rtol: float,
    records: Sequence[GreedySlabRecord],
    timings: dict[str, float],
    check: int,
) -> Outcome:
    result = best.result
    if reference.blown is not None:
        status = Status.BLOW_UP
    elif result.stopped is not None:
        status = result.stopped
    elif not check:
        status = Status.UNCHECKED
    elif best.error <= rtol:
        status = Status.CONVERGED
    elif Status.NO_CONVERGENCE in result.limits:
        status = Status.NO_CONVERGENCE
    else:
        status = Status.RANK_LIMIT if result.limits else Status.TOLERANCE
    blow_up = None
    if reference.blown is not None:
        blow_up = reference.end, tuple(reference.points[reference.blown].tolist())
    return Outcome(
        tuple(result.slabs),
        status,
        _message(status, best, rtol),
        best.measured,
        tuple(records),
        timings,
        blow_up,
    )


def _message(status: Status, best: _Attempt, rtol: float) -> str:
    """The sentence a user reads: how it ended, the figures, and what to do."""
    text = status.value
    if status is Status.NO_CONVERGENCE:
        worst = max(best.result.records, key=lambda record: record.residuals[-1])
        text = (
            f"the lagged terms did not settle: after {len(worst.residuals)} updates on "
            f"[{worst.start:.4g}, {worst.end:.4g}] the unknowns still change by "
            f"{worst.residuals[-1]:.1e} times their size"
        )
    if best.measured is not None:
        text += f": measured error {best.error:.1e}, asked {rtol:.1e}"
        corner = max(best.measured.corners, default=0.0)
        if corner > max(rtol, best.error):
            text += f" (up to {corner:.1e} at the corners of the box)"
    if best.result.stopped is not None:
        slabs = best.result.slabs
        where = f"at t = {slabs[-1].end:.6g}" if slabs else "before the first slab was solved"
        text += f"; stopped {where}"
    remedies = {
        Status.RANK_LIMIT: "raise max_modes, loosen rtol or use method='train'",
        Status.SLAB_LIMIT: "raise max_slabs, shorten the horizon or use method='train'",
        Status.NO_CONVERGENCE: "use more time_slabs, weak_form='volterra', update='all' or "
        "method='train'",
        Status.TOLERANCE: "use more nodes, elements='legendre', or method='train'",
    }
    return f"{text}; {remedies[status]}" if status in remedies else text
