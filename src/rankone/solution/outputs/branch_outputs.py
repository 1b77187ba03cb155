"""Quantities of a solution in branches: those of each branch, continued over the whole box."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from rankone.compiler.codegen.layout import Quantities, Source
from rankone.solution.evaluation.core import SolutionCore
from rankone.solution.outputs.interpolation import Asked, OutputInterpolation
from rankone.solution.outputs.output_check import spread_over
from rankone.solvers.branches import (
    box_of_branch,
    branch_evaluator,
    one_after_the_other,
    slabs_of_branches,
    slabs_over,
)
from rankone.solvers.outcome import Measured, Outcome, Role
from rankone.solvers.request import Domain
from rankone.solvers.verification.measure import MOST_UNDECIDED, undecided_share
from rankone.solvers.verification.points import Coverage
from rankone.support.arrays import SAMPLES, Array
from rankone.support.budget import Report, quiet
from rankone.support.errors import EvaluationError, OptionError, listing, quote
from rankone.support.tasks import Pool
from rankone.tensors.branch_evaluator import BranchEvaluator, ContinuedBranch
from rankone.tensors.slab import SlabTrain
from rankone.trajectories.system.timeline import BranchedTimeline, Timeline
from rankone.trajectories.system.verdict import OutputError, Remedy, Status, UndecidedShare

OfBranch = Callable[[SolutionCore, Timeline | None], Quantities]
"""The quantities of one branch, or of a solution without, whose timeline places their events."""

_ROOT_POINTS = 1024  # Points that tell errors of roots of heights
_HELD_POINTS = 2**14  # Points that tell whether a branch holds anywhere


class BranchPart(SolutionCore):
    """One branch of a solution over its own box, whose guards are states behind the others.

    The roots of heights of its opened events are parameters behind the others.
    """

    def __init__(self, solution: SolutionCore, branch: int) -> None:
        self._whole, self._branch = solution, branch
        timeline, metadata = solution.outcome.timeline, solution.metadata
        assert isinstance(timeline, BranchedTimeline)
        guards = tuple(f"guard {k}" for k in range(timeline.guards[branch]))
        measured = solution.outcome.measured
        if measured is not None:
            measured = replace(measured, interior=(*measured.interior, *(0.0 for _ in guards)))
        box = box_of_branch(timeline, branch, metadata.box)
        outcome = replace(
            solution.outcome,
            slabs=slabs_over(slabs_of_branches(solution.outcome.slabs, timeline)[branch], box),
            timeline=timeline.branches[branch],
            measured=measured,
        )
        roots = timeline.roots_of(branch)
        turns = (f"turn {k} past an event" for k in range(1, 1 + len(roots)))
        metadata = replace(
            metadata,
            states=(*metadata.states, *guards),
            roles=(*metadata.roles, *(Role.LIFTED for _ in guards)),
            parameters=(*metadata.parameters, *turns),
            box=(*box, *roots),
        )
        super().__init__(outcome, metadata)

    @property
    def _evaluator(self) -> ContinuedBranch:
        evaluator = self._whole._evaluator
        assert isinstance(evaluator, BranchEvaluator)
        return ContinuedBranch(evaluator, self._branch)


def over_branches(
    solution: SolutionCore,
    of_branch: OfBranch,
    asked: Asked,
    sizes: Sequence[float] = (),
    pool: Pool | None = None,
    report: Report = quiet,
) -> tuple[Outcome, float, Quantities]:
    """Quantities as an outcome in branches, the tolerance, and those of the first branch.

    Each branch is interpolated over its own box, and measured where it holds. Errors are relative
    to the largest values there, or to larger ``sizes``. Workers of a ``pool`` take part.
    """
    timeline = solution.outcome.timeline
    assert isinstance(timeline, BranchedTimeline)
    outcomes, tolerances = list[Outcome](), list[float]()
    branches = [BranchPart(solution, k) for k in range(len(timeline.branches))]
    every = _of_all(branches, timeline, of_branch)
    for k, (part, quantities) in enumerate(zip(branches, every, strict=True)):
        require_states(quantities)
        further = len(part.parameters) - len(solution.parameters)
        guarded = _with_guards(quantities, len(solution.states), timeline.guards[k], further)
        interpolation = OutputInterpolation(
            part, guarded, least_sizes=tuple(sizes), pool=pool, report=report
        )
        outcome, tolerance = interpolation.solve(asked.share(len(branches)))
        outcomes.append(replace(outcome, slabs=slabs_over(outcome.slabs, solution.metadata.box)))
        tolerances.append(tolerance)
    rtol, quantities = max(tolerances), every[0]
    least = np.zeros(len(quantities.names))
    least[: len(sizes)] = sizes
    return _joined(solution, outcomes, rtol, least), rtol, quantities


def _of_all(
    branches: Sequence[BranchPart], timeline: BranchedTimeline, of_branch: OfBranch
) -> list[Quantities]:
    """The quantities over each branch.

    An OptionError says in which orders of events they are not defined, if they are in others, and
    what holds in each order if they are in none.
    """
    every, refused = list[Quantities](), dict[int, OptionError]()
    for k, (part, branch) in enumerate(zip(branches, timeline.branches, strict=True)):
        try:
            every.append(of_branch(part, branch))
        except OptionError as error:
            refused[k] = error
    if not refused:
        return every
    first = next(iter(refused.values()))
    if not every:
        if len({error.remedy for error in refused.values()}) == 1:
            raise first
        in_each = [f"in order {k}: {error.remedy}" for k, error in refused.items()]
        raise OptionError(first.message, term=first.term, remedy="; ".join(in_each)) from first
    orders = listing([f"order {k}" for k in refused])
    raise OptionError(
        f"{first.message} in {orders} of the {len(branches)} orders of events in the box",
        term=first.term,
        remedy="ask for what is there in all orders (print solution.timeline), or solve on a box "
        "in which one order holds",
    ) from first


def require_states(quantities: Quantities) -> None:
    """Raise an EvaluationError if quantities need derivatives of states, over lengths that vanish.

    Where the order of events changes, a stretch has no length, and the states as functions of its
    shares, known to the tolerance, no derivative by time.
    """
    if not all(source.is_state for source in quantities.sources):
        raise EvaluationError(
            f"{quote(quantities.texts[0])} needs derivatives of states, which are not resolved "
            "where the order of events changes inside the box",
            remedy="write rates instead of derivatives by time, take `solution.gradient(...)` at "
            "points, or solve on a box in which one order holds (print solution.timeline)",
        )


def _with_guards(quantities: Quantities, first: int, count: int, further: int) -> Quantities:
    """The quantities over stretches, and behind them the guards, which are sources.

    Behind their parameters come so many ``further`` coordinates.
    """
    cuts = (*quantities.cuts, *((),) * further)
    names = tuple(f"guard {k}" for k in range(count))
    return replace(
        quantities,
        names=(*quantities.names, *names),
        texts=(*quantities.texts, *names),
        timeless=False,
        cuts=cuts,
        sources=(*quantities.sources, *(Source(first + k) for k in range(count))),
        values=_ValuesAndGuards(
            quantities.values, len(quantities.sources), len(quantities.cuts) - 1
        ),
    )


@dataclass(frozen=True)
class _ValuesAndGuards:
    """Quantities of the first sources and parameters, and behind them the other sources."""

    values: Callable[[Array, Array, Array, Sequence[Array]], Sequence[Array]]
    count: int
    d: int

    def __call__(self, t: Array, s: Array, p: Array, r: Sequence[Array]) -> list[Array]:
        return [*self.values(t, s[: self.count], p[: self.d], r), *s[self.count :]]


def _joined(
    solution: SolutionCore, outcomes: Sequence[Outcome], rtol: float, least: Array
) -> Outcome:
    """The outcome in branches of those of the branches, with the ``least`` sizes of quantities."""
    timeline = solution.outcome.timeline
    assert isinstance(timeline, BranchedTimeline)
    domain = Domain(solution.time, solution.metadata.box)
    slabs = one_after_the_other(outcomes, timeline)
    timeline = replace(timeline, width=max(timeline.width, rtol))
    sizes = np.maximum(_sizes(slabs, timeline, domain, least.size), least)
    timeline = replace(timeline, tolerances=tuple((rtol * sizes).tolist()))
    evaluator = branch_evaluator(slabs, timeline)
    timeline = replace(timeline, undecided=undecided_share(evaluator, Coverage.of_domain(domain)))
    measured = [_of_quantities(outcome.measured, least.size) for outcome in outcomes]
    held = _held_somewhere(evaluator, domain)
    if timeline.openings:
        missed = _errors_of_roots(solution, evaluator, domain, sizes)
        measured = [each and _with_errors(each, missed) for each in measured]
    outcomes, measured = [outcomes[k] for k in held], [measured[k] for k in held]
    joined = _over_all(outcomes, measured, rtol, timeline.undecided)
    return replace(joined, slabs=slabs, timeline=timeline)


def _held_somewhere(evaluator: BranchEvaluator, domain: Domain) -> list[int]:
    """The branches that hold at some of evenly spread points: others only lead to further ones."""
    points = np.ascontiguousarray(spread_over(domain, _HELD_POINTS).T)
    held: list[int] = np.unique(evaluator.decided(points).chosen).tolist()
    return held


def _over_all(
    outcomes: Sequence[Outcome],
    measured: Sequence[Measured | None],
    rtol: float,
    undecided: float,
) -> Outcome:
    """The outcome of the worst branch with the errors of all, or that of one without any."""
    checked = [each for each in measured if each is not None]
    if len(checked) < len(measured):
        return outcomes[measured.index(None)]
    errors = [each.error for each in checked]
    worst = int(np.argmax(errors))
    status = Status.CONVERGED if errors[worst] <= rtol else Status.TOLERANCE
    notes = outcomes[worst].notes
    if status is Status.CONVERGED:
        notes = tuple(n for n in notes if not isinstance(n, Remedy))
        notes = tuple(replace(n, worst=None) if isinstance(n, OutputError) else n for n in notes)
    if undecided:
        notes = (*notes, UndecidedShare(undecided))
        status = status if undecided <= MOST_UNDECIDED else Status.TOLERANCE
    return replace(outcomes[worst], status=status, measured=_largest(checked), notes=notes)


def _errors_of_roots(
    solution: SolutionCore, evaluator: BranchEvaluator, domain: Domain, sizes: Array
) -> Array:
    """The largest errors (count,), over sizes, that those of roots of heights make."""
    exact = solution._evaluator
    assert isinstance(exact, BranchEvaluator)
    points = np.ascontiguousarray(spread_over(domain, _ROOT_POINTS).T)
    decision, rows = exact.decided(points), slice(0, sizes.size)
    largest = np.zeros(sizes.size)
    for k, branch in enumerate(evaluator.branches):
        here = points[:, (decision.chosen == k) & ~decision.undecided]
        if not branch.roots or not here.size:
            continue
        end = branch.slabs[-1].end
        pseudo = np.linspace(0.0, np.nextafter(end, 0.0), SAMPLES)[:, None]
        ours, theirs = (
            branch.trains.curves(pseudo, each.own(here), rows)
            for each in (branch, exact.branches[k])
        )
        largest = np.maximum(largest, np.abs(ours - theirs).max(axis=(1, 2)))
    return np.asarray(largest / np.where(sizes > 0.0, sizes, 1.0))


def _with_errors(measured: Measured, errors: Array) -> Measured:
    """What was measured, with further errors (count,) of the same quantities."""
    interior = np.maximum(measured.interior, errors)
    return replace(measured, interior=tuple(interior.tolist()))


def _sizes(
    slabs: Sequence[SlabTrain], timeline: BranchedTimeline, domain: Domain, count: int
) -> Array:
    """The largest values (count,) of quantities in the branches that hold."""
    everything = replace(timeline, tolerances=(np.inf,) * count)
    evaluator = branch_evaluator(slabs, everything).likeliest()
    points = np.ascontiguousarray(spread_over(domain, SAMPLES).T)
    times = np.linspace(*domain.horizon, SAMPLES)[:, None]
    states = np.abs(evaluator.curves(times, points, slice(0, count)))
    return np.asarray(np.nan_to_num(states).max(axis=(1, 2)))


def _of_quantities(measured: Measured | None, count: int) -> Measured | None:
    """What was measured of the quantities, without guards."""
    if measured is None:
        return None
    return replace(measured, interior=measured.interior[:count], corners=measured.corners[:count])


def _largest(measured: Sequence[Measured]) -> Measured:
    """The largest errors of all branches."""
    interior = tuple(map(max, zip(*(each.interior for each in measured), strict=True)))
    of_corners = [each.corners for each in measured if each.corners]
    return replace(
        measured[0],
        interior=interior,
        corners=tuple(map(max, zip(*of_corners, strict=True))),
        points=sum(each.points for each in measured),
        time_error=max(each.time_error or 0.0 for each in measured),
    )
