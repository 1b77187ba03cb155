"""The tensor-train engine: march, check against SciPy, tighten until the measured error fits."""

from __future__ import annotations

import time as clock
from collections.abc import Sequence

from rankone.discretization import RadauCollocation
from rankone.domain import Domain
from rankone.solvers.engine import Engine, Report, Request
from rankone.solvers.outcome import Outcome, SlabRecord, Status
from rankone.solvers.sensitivity import amplification
from rankone.solvers.train.march import Guess, March
from rankone.solvers.train.nodes import first_bases
from rankone.solvers.train.options import TrainOptions
from rankone.solvers.verification import Attempt, Yardstick
from rankone.system import System

__all__ = ["ENGINE", "solve_train"]

_SHARE_FEW, _SHARE_MANY = 0.06, 0.4
"""Inner tolerance / rtol if corners count (d <= 3), if not."""
_STALLED = 0.7
"""An attempt that leaves more of the error has stalled; two in a row are the last."""
_REMEDIES = {
    Status.RANK_LIMIT: "raise max_rank, narrow the box or loosen rtol",
    Status.NODE_LIMIT: "raise max_nodes, narrow the box or loosen rtol",
    Status.SLAB_LIMIT: "raise max_slabs or shorten the horizon",
    Status.MEMORY_LIMIT: "raise max_memory, narrow the box or loosen rtol",
    Status.NO_CONVERGENCE: "narrow the box or shorten the horizon",
    Status.TOLERANCE: "loosen rtol, narrow the box or shorten the horizon",
}


def solve_train(
    system: System, domain: Domain, request: Request[TrainOptions], report: Report
) -> Outcome:
    """Solve a generated system for the whole box.

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
        ``status`` is CONVERGED only if the measured error is within the tolerance asked.
    """
    rtol, options = request.rtol, request.options
    timings = {"reference": 0.0, "march": 0.0, "check": 0.0}
    began = clock.perf_counter()
    yardstick = Yardstick.of(system, domain, rtol, request.points)
    reference, end = yardstick.reference, yardstick.end
    sizes = yardstick.sizes(system)
    states = sizes[: system.N_DIFFERENTIAL]
    growth = amplification(system, reference, states, end)
    timings["reference"] = clock.perf_counter() - began

    collocation = RadauCollocation.of(options.nodes_in_time(rtol))
    bases, floors = first_bases(system, domain, rtol, options)
    inner = rtol * (_SHARE_FEW if len(domain.box) <= 3 else _SHARE_MANY)
    records: list[SlabRecord] = []
    guesses: Sequence[Guess] = ()
    best: Attempt | None = None
    stalls = 0
    for number in range(options.max_attempts):
        began = clock.perf_counter()

        def tolerance(t: float, level: float = inner) -> float:
            return max(level / growth(t), 1e-14)

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
            yardstick.cuts,
            number,
            guesses,
            report,
        )
        result = march.run(end)
        records += result.records
        timings["march"] += clock.perf_counter() - began
        began = clock.perf_counter()
        measured = yardstick.measured(result.slabs, states)
        attempt = Attempt(result.slabs, result.stopped, result.limits, measured)
        timings["check"] += clock.perf_counter() - began
        stalls = stalls + 1 if best and attempt.error > _STALLED * best.error else 0
        if attempt.better_than(best):
            best = attempt
        if (
            not request.points
            or attempt.stopped
            or attempt.error <= rtol
            or attempt.limits
            or stalls == 2
        ):
            break
        inner *= min(max(0.4 * rtol / attempt.error, 1e-3), 0.03 if stalls else 0.4)
        guesses, bases = result.guesses, result.guesses[0].bases
    assert best is not None
    status = best.status(yardstick, rtol)
    message, slabs = best.message(status, rtol, _REMEDIES), tuple(best.slabs)
    history, blow_up = tuple(records), yardstick.blow_up
    return Outcome(slabs, status, message, best.measured, history, timings, blow_up)


ENGINE = Engine("train", TrainOptions, SlabRecord, solve_train)
