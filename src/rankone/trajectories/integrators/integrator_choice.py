"""The choice of an integrator: by counted work, and again in mid-solve where a stack stalls."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rankone.support.arrays import Array
from rankone.support.budget import OutOfWorkError, limited, work_done
from rankone.trajectories.events.stretch_integrator import StretchIntegrator
from rankone.trajectories.integrators.integrator import (
    DenseTrajectories,
    Integrator,
    Path,
    SampledTrajectories,
    SeparateTrajectories,
    SpanIntegrator,
    Spans,
    Tolerances,
    part_by_part,
    paths_over_shares,
)
from rankone.trajectories.integrators.single import SingleIntegrator
from rankone.trajectories.integrators.workers import GroupedStacks, SinglesOnWorkers, Workers
from rankone.trajectories.stacks.newton import sparse_pattern
from rankone.trajectories.stacks.stack import StackedIntegrator, sampling_cost
from rankone.trajectories.stacks.taylor import DOP853_POWER, TaylorTerms, steps_ratio
from rankone.trajectories.system.system import Clock, System


@dataclass(frozen=True)
class _Watching:
    """When a stack is given up for single trajectories."""

    unwatched_work: float
    pilots: int
    telling: int
    patience: float
    next_look: float
    next_pilots: float


_WATCH = _Watching(
    unwatched_work=1e6,  # Operations for each trajectory up to which a stack is not looked at
    pilots=3,  # Trajectories that tell what single ones cost; as many or fewer are not watched
    telling=32,  # Fewest trajectories whose stall tells that larger stacks stall too
    patience=0.5,  # Work of a stack, over that of single trajectories, before it is given up
    # Factors on the work of a stack from one look at it to the next, and to one at which pilots
    # that came to no end begin anew
    next_look=1.25,
    next_pilots=2.0,
)
# States of a system with sparse factors up to which stacks are watched: LSODA has dense matrices
_MOST_SINGLE_STATES = 200
_LSODA_STEPS = 10.0  # Steps of LSODA at its tighter tolerances, for each one of DOP853


def span_integrator_for(
    system: System,
    integrator: str = "auto",
    *,
    stiff: bool = False,
    bearable_steps: int = 0,
    looks_anywhere: bool = False,
    workers: Workers | None = None,
) -> SpanIntegrator:
    """The integrator for a system, the one place that chooses it.

    ``integrator`` is the option of a solve. The others are those of :class:`StackedIntegrator`;
    stacks look anywhere only in systems that do not separate. ``workers`` take part in
    what does not depend on them; without them the integrator can be sent to one.
    """
    single: SingleIntegrator | SinglesOnWorkers = SingleIntegrator(looks_anywhere)
    if workers is not None:
        single = SinglesOnWorkers(SingleIntegrator(looks_anywhere), workers)
    if integrator == "single":
        return single
    stack = StackedIntegrator(stiff, bearable_steps, looks_anywhere and not system.separated)
    if sparse_pattern(system) is not None and system.n_differential > _MOST_SINGLE_STATES:
        return stack if workers is None else GroupedStacks(stack, workers)
    if integrator == "stack":
        return stack
    return WatchedStack(stack, single)


def integrator_for(
    system: System,
    integrator: str = "auto",
    *,
    stiff: bool = False,
    bearable_steps: int = 0,
    looks_anywhere: bool = False,
    workers: Workers | None = None,
) -> Integrator:
    """The integrator for a system, also for one in stretches; see :func:`span_integrator_for`."""
    clock = system.clock
    chosen = span_integrator_for(
        system if clock is None else clock.system,
        integrator,
        stiff=stiff,
        bearable_steps=bearable_steps,
        looks_anywhere=looks_anywhere,
        workers=workers,
    )
    return chosen if clock is None else StretchIntegrator(chosen, integrator)


def following(integrator: str, taken: str, trajectories: int, clock: Clock | None = None) -> str:
    """The option for what follows an integration of some trajectories by the one ``taken``.

    So a stall is met once. A few trajectories tell nothing of large stacks. A stack on the
    ``clock`` of markers, which is in phase, is not watched again.
    """
    in_phase = clock is not None and clock.foreseen_marks is not None and taken == "stack"
    told = integrator == "auto" and trajectories >= _WATCH.telling
    return taken if told and (in_phase or taken == "single") else integrator


def explicit_steps(system: System, dense: DenseTrajectories, accuracy: float) -> float:
    """Steps of DOP853 that trajectories take at a relative tolerance, by those that were made."""
    if dense.method == "Radau":
        return dense.avoided
    if dense.method == "Taylor":
        return dense.steps / steps_ratio(accuracy, TaylorTerms.of(system).affine)
    return dense.steps / _LSODA_STEPS if dense.method == "LSODA" else dense.steps


def stacked_work(
    system: System, steps: float, tolerances: tuple[float, float], m: int, times: int
) -> float:
    """Expected work of a stack of m trajectories, sampled at so many times.

    DOP853 takes so many ``steps`` at the first of two relative tolerances; the stack has the other.
    """
    known, asked = tolerances
    steps *= (known / asked) ** DOP853_POWER
    return sampling_cost(system, asked, steps, m, times)


@dataclass(frozen=True)
class WatchedStack:
    """An :class:`Integrator` that begins with a stack and goes on with single trajectories.

    They take over where the stack has had half as much work as all of them would take, and has more
    than that before it. That is expected from its work so far, and from the steps that pilots,
    integrated alone, make before and after the time that it has reached.
    """

    stack: StackedIntegrator
    single: SingleIntegrator | SinglesOnWorkers

    def run(
        self, system: System, points: Array, edges: Sequence[float], tolerances: Tolerances
    ) -> SeparateTrajectories:
        """Trajectories at all times; see :meth:`Integrator.run`."""
        work = edges, tolerances
        with limited():
            try:
                return self._watched_run(system, points, *work).run(system, points, *work)
            except _StallError:
                return self.single.run(system, points, *work)

    def sample(
        self,
        system: System,
        points: Array,
        edges: Sequence[float],
        tolerances: Tolerances,
        times: Array,
    ) -> SampledTrajectories:
        """Trajectories at ascending times; see :meth:`Integrator.sample`."""
        work = edges, tolerances
        with limited():
            try:
                return self._watched_run(system, points, *work).sample(system, points, *work, times)
            except _StallError:
                return self.single.sample(system, points, *work, times)

    def paths(
        self, system: System, points: Array, spans: Spans, tolerances: Tolerances
    ) -> Sequence[Path]:
        """Trajectories of spans of their own; see :meth:`SpanIntegrator.paths`."""

        def part(over: Spans) -> Sequence[Path]:
            def pilots(some: NDArray[np.intp]) -> Sequence[Path]:
                few = Spans(over.starts[some], over.states[:, some], over.ends[some])
                alone = self.single.paths(system, points[some], few, tolerances)
                each = zip(alone, few.starts, few.ends, strict=True)
                return [path.over_shares(*span) for path, *span in each]

            try:
                run = self._watched(points, pilots).run
                return paths_over_shares(run, system, points, over, tolerances)
            except _StallError:
                return self.single.paths(system, points, over, tolerances)

        with limited():
            return part_by_part(part, spans)

    def _watched_run(
        self, system: System, points: Array, edges: Sequence[float], tolerances: Tolerances
    ) -> StackedIntegrator:
        """The stack over edges, watched."""

        def pilots(some: NDArray[np.intp]) -> Sequence[Path]:
            return self.single.run(system, points[some], edges, tolerances).paths

        return self._watched(points, pilots)

    def _watched(
        self, points: Array, pilots: Callable[[NDArray[np.intp]], Sequence[Path]]
    ) -> StackedIntegrator:
        """The stack, watched unless pilots would be all of it."""
        if len(points) <= _WATCH.pilots:
            return self.stack
        return replace(self.stack, watch=_Watch(len(points), pilots))


class _StallError(Exception):
    """Single trajectories cost less than what is left to a stack."""


class _Watch:
    """Compares the work of a stack, after each step, with that of single trajectories."""

    def __init__(self, count: int, pilots: Callable[[NDArray[np.intp]], Sequence[Path]]) -> None:
        self.count, self.pilots = count, pilots
        self.began, self.pilot_work = work_done(), 0.0
        self.next_look = _WATCH.unwatched_work * count
        self.paths: Sequence[Path] = ()
        self.alone = math.inf

    def __call__(self, time: float) -> None:
        spent = work_done() - self.began - self.pilot_work
        if spent < self.next_look:
            return
        self.next_look = _WATCH.next_look * spent
        if not self.paths:
            self._integrate_pilots(min(_WATCH.pilots / self.count / _WATCH.patience, 1.0) * spent)
            if not self.paths:
                self.next_look = _WATCH.next_pilots * spent
        if spent > _WATCH.patience * self.alone and self._left(time) * spent > self.alone:
            raise _StallError

    def _integrate_pilots(self, most: float) -> None:
        """Integrate some trajectories alone, unless that is more work than single ones may take."""
        before = work_done()
        some = np.linspace(0, self.count - 1, _WATCH.pilots).astype(np.intp)
        try:
            with limited(most):
                self.paths = self.pilots(some)
                self.alone = (work_done() - before) * self.count / len(some)
        except OutOfWorkError:
            pass  # at the next look they may take more
        self.pilot_work += work_done() - before

    def _left(self, time: float) -> float:
        """The part of the pilots' steps that is left after a time, over the part before it."""
        steps = sum(path.steps for path in self.paths)
        before = sum(int(np.searchsorted(path.breaks, time)) for path in self.paths)
        return (steps - before) / before if before else 0.0
