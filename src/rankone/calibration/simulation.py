"""States of a calibration problem at the times of its measurements, with their derivatives."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rankone.calibration.conditions import Settings
from rankone.calibration.dynamics import Dynamics
from rankone.calibration.following import Following
from rankone.calibration.records import Assigned, Condition, Records
from rankone.calibration.resting import Resting, Started
from rankone.support.arrays import Array
from rankone.support.errors import ProblemError
from rankone.support.wording import quote


@dataclass(frozen=True)
class States:
    """States (n, m) at m measurements, and derivatives (n, m, w) by w values; none are asked for
    where w is zero."""

    states: Array
    slopes: Array


class Simulation:
    """Simulates the experiments of a calibration problem, all at once."""

    def __init__(self, records: Records, settings: Settings, dynamics: Dynamics) -> None:
        self.records, self.settings, self.dynamics = records, settings, dynamics
        self._resting, self._following = Resting(dynamics), Following(records, dynamics)

    def states(
        self,
        values: Mapping[str, float],
        by: Sequence[str],
        accuracy: float,
        *,
        quick: bool = False,
    ) -> list[States]:
        """The states at the measurements of each series, with derivatives by some parameters.

        ``values`` are those of all parameters of the table. Where it has to be ``quick``, each
        experiment has steps of its own, and only LSODA's word for its accuracy.

        Raises
        ------
        BlowUpError, ConvergenceError
            If a trajectory does not reach the last measurement, or no steady state.
        """
        self.check_smooth(by)
        started = self._started(values, by, quick)
        pairs = [(series, np.isfinite(series.times)) for series in self.records.series]
        grid = np.unique(np.concatenate([series.times[f] for series, f in pairs]))
        follow = self._following.each if quick else self._following.together
        path, slopes = follow(started, grid, accuracy)
        resting = sorted({int(e) for series, f in pairs for e in series.experiments[~f]})
        at_rest = self._resting(started, resting, quick)
        each = []
        for series, here in pairs:
            n, w = len(started.states), len(by)
            states, own = np.empty((n, here.size)), np.empty((n, w, here.size))
            which, places = series.experiments[here], np.searchsorted(grid, series.times[here])
            states[:, here], own[:, :, here] = path[:, which, places], slopes[:, :, which, places]
            last = [resting.index(int(e)) for e in series.experiments[~here]]
            states[:, ~here], own[:, :, ~here] = at_rest.states[:, last], at_rest.slopes[:, :, last]
            each.append(States(states, np.moveaxis(own, 1, 2)))
        return each

    def check_smooth(self, by: Sequence[str]) -> None:
        """Raise if a parameter that derivatives are asked for decides where rates jump."""
        if by and self.dynamics.jumps_with_states:
            raise ProblemError(
                "rates jump with the states, and cannot be differentiated yet",
                remedy="ask for the objective alone",
            )
        for condition in self.settings.conditions:
            numbers = self.settings.at[condition.name]
            for name in sorted(self.dynamics.decisive):
                if numbers[name] in by:
                    raise ProblemError(
                        f"rates jump where {quote(name)} says, and it is estimated: nothing can be "
                        "differentiated by it yet",
                        term=numbers[name],
                        remedy="fix it (estimate 0 in the parameter table)",
                    )

    def _point(self, condition: Condition, values: Mapping[str, float]) -> Array:
        numbers = self.settings.at[condition.name]

        def number(assigned: Assigned) -> float:
            return values[assigned] if isinstance(assigned, str) else assigned

        return np.array([number(numbers[name]) for name in self.dynamics.inputs], dtype=float)

    def _directions(self, condition: Condition, by: Sequence[str]) -> Array:
        """Derivatives (d, w) of the inputs by the values of parameters."""
        numbers = self.settings.at[condition.name]
        assigned = [numbers[name] for name in self.dynamics.inputs]
        return np.array([[float(a == name) for name in by] for a in assigned]).reshape(
            len(assigned), len(by)
        )

    def _initial(
        self, conditions: Sequence[Condition], values: Mapping[str, float], by: Sequence[str]
    ) -> Started:
        """Conditions at their initial values."""
        points = np.array([self._point(c, values) for c in conditions])
        directions = np.array([self._directions(c, by) for c in conditions])
        states = self.dynamics.system.initial(np.ascontiguousarray(points.T))
        slopes = np.zeros((len(states), len(by), len(points)))
        if by:
            inner = self.dynamics.initial_slopes(points)
            slopes = np.einsum("ndm,mdw->nwm", inner, directions)
        return Started(points, directions, states, slopes)

    def _started(self, values: Mapping[str, float], by: Sequence[str], quick: bool) -> Started:
        """All experiments at time 0."""
        experiments = self.records.experiments
        started = self._initial([each.condition for each in experiments], values, by)
        befores = {e.before.name: e.before for e in experiments if e.before is not None}
        if not befores:
            return started
        before = self._initial([*befores.values()], values, by)
        rested = self._resting(before, range(len(befores)), quick)
        states, slopes, names = started.states.copy(), started.slopes.copy(), [*befores]
        for e, experiment in enumerate(experiments):
            if experiment.before is None:
                continue
            k = names.index(experiment.before.name)
            kept = ~self._reset(experiment.condition)
            states[kept, e], slopes[kept, :, e] = rested.states[kept, k], rested.slopes[kept, :, k]
        return replace(started, states=states, slopes=slopes)

    def _reset(self, condition: Condition) -> NDArray[np.bool_]:
        """The states (n,) that a condition sets after a steady state."""
        assigned = {name for name, value in condition.assigned.items() if value is not None}
        return np.array([name in assigned for name in self.dynamics.system.states])
