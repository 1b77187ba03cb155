"""``method="greedy"``: march, check against SciPy, more nodes or a tighter tolerance."""

from __future__ import annotations

import time as clock
from collections.abc import Sequence

import numpy as np

from rankone.arrays import Array
from rankone.discretization.finite_elements import LagrangeElements
from rankone.domain import Domain
from rankone.solvers.engine import Engine, Report, Request
from rankone.solvers.greedy.history import GreedySlabRecord
from rankone.solvers.greedy.march import March
from rankone.solvers.greedy.nodes import first_nodes
from rankone.solvers.greedy.options import GreedyOptions
from rankone.solvers.greedy.terms import source_terms
from rankone.solvers.outcome import Outcome, Status
from rankone.solvers.reference import Reference
from rankone.solvers.sensitivity import amplification
from rankone.solvers.verification import Attempt, Yardstick
from rankone.system import System

__all__ = ["ENGINE", "solve_greedy"]

_SHARE = 0.03
"""Tolerance of a slab relative to the error asked for, before the growth of errors."""
_TAIL = 0.1
"""Part of the error asked for that the highest modes may make up."""
_REMEDIES = {
    Status.RANK_LIMIT: "raise max_modes, loosen rtol or use method='train'",
    Status.SLAB_LIMIT: "raise max_slabs, shorten the horizon or use method='train'",
    Status.NO_CONVERGENCE: "use more time_slabs, formulation='volterra', update='all' or "
    "method='train'",
    Status.TOLERANCE: "use more nodes, elements='legendre', or method='train'",
}


def solve_greedy(
    system: System, domain: Domain, request: Request[GreedyOptions], report: Report
) -> Outcome:
    """Solve a generated system for the whole box by the classic method.

    Parameters
    ----------
    system : System
        The generated module.
    domain : Domain
    request : Request
    report : callable
        Called with a ProgressEvent after each accepted slab.

    Returns
    -------
    Outcome
        ``status`` is CONVERGED only if the measured error is within the tolerance asked. Finite
        elements in time give one slab for each element.
    """
    rtol, options = request.rtol, request.options
    timings = {"reference": 0.0, "march": 0.0, "check": 0.0}
    began = clock.perf_counter()
    yardstick = Yardstick.of(system, domain, rtol, request.points)
    reference, end = yardstick.reference, yardstick.end
    sizes = yardstick.sizes(system)[: system.N_DIFFERENTIAL]
    stiffness = _stiffness(system, reference, sizes, end)
    growth = amplification(system, reference, sizes, end)
    terms = source_terms(system)
    timings["reference"] = clock.perf_counter() - began

    nodes = first_nodes(system, domain, rtol, options)
    share = _SHARE
    records: list[GreedySlabRecord] = []
    best: Attempt | None = None
    tried: Sequence[GreedySlabRecord] = ()
    for attempt in range(options.max_attempts):
        began = clock.perf_counter()
        level = share * rtol

        def tolerance(t: float, level: float = level) -> float:
            return options.tolerance or max(level / growth(t), 1e-13)

        def in_time(lower: float, upper: float, count: int = nodes.time) -> LagrangeElements:
            return options.shape_functions(lower, upper, count)

        spaces = [
            options.shape_functions(lower, upper, count)
            for (lower, upper), count in zip(domain.box, nodes.parameters, strict=True)
        ]
        march = March(
            system,
            terms,
            reference.start,
            end,
            sizes,
            stiffness,
            tolerance,
            in_time,
            spaces,
            options,
            attempt,
            report,
        )
        result = march.run()
        records += result.records
        timings["march"] += clock.perf_counter() - began
        began = clock.perf_counter()
        measured = yardstick.measured(result.slabs, sizes)
        current = Attempt(result.slabs, result.stopped, set(result.limits), measured)
        timings["check"] += clock.perf_counter() - began
        error = current.error
        stalled = best is not None and error > 0.7 * best.error
        if current.better_than(best):
            best, tried = current, result.records
        if not request.points or result.stopped or error <= rtol:
            break
        finer = nodes.finer(result.tails > _TAIL * rtol, options)
        stuck = stalled or result.limits or options.tolerance is not None
        if (stalled and result.limits) or (finer == nodes and stuck):
            break
        if finer == nodes:
            share *= min(max(0.5 * rtol / error, 0.05), 0.5)
        nodes = finer
    assert best is not None
    status = best.status(yardstick, rtol)
    cause = _unsettled(tried) if status is Status.NO_CONVERGENCE else None
    return Outcome(
        tuple(best.slabs),
        status,
        best.message(status, rtol, _REMEDIES, cause),
        best.measured,
        tuple(records),
        timings,
        yardstick.blow_up,
    )


def _stiffness(system: System, reference: Reference, sizes: Array, end: float) -> float:
    """Largest row sum norm of the Jacobian over the check points, in units of the sizes."""
    times = np.linspace(reference.start, end, 101)
    values = reference(times)
    n, m, count = values.shape
    jacobian = system.jacobian(times, values, reference.points.T[:, :, None])
    jacobian = np.broadcast_to(jacobian, (n, n, m, count))
    scaled = np.abs(jacobian) * (sizes[None, :] / sizes[:, None])[:, :, None, None]
    return float(scaled.sum(axis=1).max())


def _unsettled(records: Sequence[GreedySlabRecord]) -> str:
    """Where the lagged terms were furthest from settled."""
    worst = max(records, key=lambda record: record.residuals[-1])
    return (
        f"the lagged terms did not settle: after {len(worst.residuals)} updates on "
        f"[{worst.start:.4g}, {worst.end:.4g}] the unknowns still change by "
        f"{worst.residuals[-1]:.1e} times their size"
    )


ENGINE = Engine("greedy", GreedyOptions, GreedySlabRecord, solve_greedy)
