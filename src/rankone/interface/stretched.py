"""The form over stretches of a problem with events, for methods that need separated terms."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from rankone.codegen.loading import ModuleSpecification
from rankone.codegen.lowering import quadratic_system
from rankone.codegen.module import generate_source
from rankone.ir.events import Ending
from rankone.ir.forms import GeneralTerm, SeparatedForm
from rankone.ir.system import Box, Clock, System
from rankone.support.errors import SeparationError
from rankone.symbolic import FirstOrderSystem
from rankone.symbolic.stretches import KnownStretches, KnownTime, exact, over_stretches
from rankone.symbolic.surfaces import moving_cuts
from rankone.trajectories.events.stretches import fixed_times, in_stretches
from rankone.verification.points import check_points

_POINTS = 64  # Points of the box, besides corners, that show on which side switches are


@dataclass(frozen=True, eq=False)
class StretchedProblem:
    """A problem whose events are all at times that are known functions of the parameters.

    Its ``system`` separates once the order of its events is known.
    """

    first_order: FirstOrderSystem
    original: System
    separated: SeparatedForm
    source: str
    name: str

    @cached_property
    def system(self) -> System:
        """The system over clock time, which can be written over its stretches."""
        return replace(self.original, separated_stretches=self.separated_stretches)

    def separated_stretches(self, clock: Clock, box: Box) -> System:
        """The separated system over the pseudo-time of stretches.

        Raises
        ------
        SeparationError
            If the terms do not separate there either.
        """
        moved = zip(self.first_order.coordinates, (clock.horizon, *box), strict=True)
        coordinates = tuple(replace(c, lower=a, upper=b) for c, (a, b) in moved)
        first_order = replace(self.first_order, coordinates=coordinates)
        bounds = np.array(box, dtype=float).reshape(-1, 2)
        points = check_points(bounds, _POINTS, every_corner=True)
        form = over_stretches(first_order, self._stretches(clock), np.ascontiguousarray(points.T))
        if form.coupled is not None:
            raise _does_not_separate(form.coupled)
        source = generate_source(quadratic_system(form.separated), self.name, form.meanings)
        functions = self.first_order.user_functions
        name = f"{self.name or 'system'} over stretches"
        system = ModuleSpecification(source, name, functions).load()
        whole = in_stretches(clock)
        n = whole.n_differential
        return replace(
            system,
            states=(*whole.states, *system.states[n:]),
            rhs=system.rhs if form.meanings else whole.rhs,
            specification=whole.specification,
            clock=clock,
        )

    def _stretches(self, clock: Clock) -> KnownStretches:
        """The known times of a clock, in their order."""
        order, jumps = clock.order, {jump.time: jump.values for jump in self.first_order.jumps}
        coordinates = self.first_order.coordinates
        events = [KnownTime(e.at, e.then) for e in self.first_order.events if e.at is not None]
        fixed = fixed_times(self.original, clock.cuts)
        events += [KnownTime(exact(time), jumps.get(time)) for time in fixed]
        steps, others = moving_cuts(coordinates, self.first_order.rhs)
        events += [KnownTime(time) for time in (*steps, *others)]
        instants = tuple(tuple(events[k] for k in instant) for instant in order.instants)
        end = None
        if order.ending is Ending.HORIZON:
            end = exact(clock.horizon[1])
        elif order.ending is Ending.LENGTH:
            end = instants[-1][0].at + exact(order.length)
        return KnownStretches(instants, end)


def _does_not_separate(term: GeneralTerm) -> SeparationError:
    """The error for a term that couples pseudo-time and parameters, or is no polynomial."""
    return SeparationError(
        f"over the stretches between events, {term.reason}",
        equation=term.origin,
        term=term.expression,
        remedy="method='cross', the default, takes it as it is",
    )


def known_times(first_order: FirstOrderSystem, system: System) -> bool:
    """Whether all events are at known times, and there are some, or switches that move.

    Not where initial values are guesses or at rest.
    """
    events = first_order.events
    if first_order.constraints.guessed or first_order.rest is not None:
        return False
    plain = all(
        e.at is not None and e.delay is None and e.priority is None and e.persistent for e in events
    )
    return plain and bool(events or system.features.n_moving_cuts)
