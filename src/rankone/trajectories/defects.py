"""What the stages of a step do not see: peaks and pulses of the right-hand side over the states.

An integrator evaluates the rates at its stages alone. Where its interpolant runs through something
narrow in between, its slope is another than the rates there: the defect. It is looked at where
trajectories cross the zeros of event functions, which are known, and at random places.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from rankone.ir.system import System
from rankone.support.arrays import Array
from rankone.support.budget import charge
from rankone.support.costs import Cost, function_cost

__all__ = ["DefectControl"]

_AT_CROSSINGS, _ANYWHERE = 100.0, 300.0
"""Largest defect, if it were that of the whole step, in units of the tolerance. Without anything
narrow it comes to 40."""
_DIFFERENT = 0.5
"""Defect over the rates from which the rates are others than the step knows."""
_NARROWED, _EXACT = 30, 1e-14
"""Iterations for the time of a crossing, and its accuracy, in steps."""
_LEAST, _PLACES = 2, 512
"""Random places on each trajectory at least, and on all together, in every step."""
_LOOKED = Cost(50e3, 15.0)
"""Operations of a look at an interpolant, and for each number looked at."""


class DefectControl:
    """Looks at the steps of a stack of trajectories.

    Parameters
    ----------
    system : System
    points : ndarray (m, d)
    anywhere : bool
        Whether to look at random places too.
    """

    def __init__(self, system: System, points: Array, anywhere: bool) -> None:
        self.rates, self.features = system.rhs, system.features
        self.parameters = np.ascontiguousarray(points.T)
        self.each = max(_LEAST, _PLACES // len(points)) if anywhere else 0
        self.generator = np.random.default_rng(20142)
        self.cost_of_rates, self.cost_of_events = (
            function_cost(function, system.user_functions)
            for function in (system.rhs, system.features.state_surfaces)
        )

    def missed(self, solver: Any, y_before: Array) -> bool:
        """Whether a step, of a StackedDOP853 or StackedRadau, missed something.

        Parameters
        ----------
        solver : StackedDOP853 or StackedRadau
            After the step from its ``t_old``.
        y_before : ndarray (n m,)
            The states at its start.
        """
        if self.features.n_state_surfaces and self._at_crossings(solver, y_before) > _AT_CROSSINGS:
            return True
        return self.each > 0 and self._anywhere(solver) > _ANYWHERE

    def _anywhere(self, solver: Any) -> float:
        """Largest error that a defect at random places comes to, in units of the tolerance."""
        m, h = self.parameters.shape[1], solver.t - solver.t_old
        columns = np.tile(np.arange(m), self.each)
        charge(self.cost_of_rates(columns.size) + _LOOKED(solver.y.size // m * columns.size))
        shares = self.generator.random(columns.size)
        states, slopes = solver.interpolant(columns)(shares, slopes=True)
        rates = self.rates(solver.t_old + h * shares, states, self.parameters[:, columns])
        error = np.abs(solver.error_of(slopes - h * rates, columns))
        return _largest(error / self._tolerated(solver, states))

    @staticmethod
    def _tolerated(solver: Any, states: Array) -> Array:
        """The tolerance for the largest of the values (n, c) of each state, (n, 1)."""
        absolute = solver.atol.reshape(len(states), -1).max(axis=1)
        return np.asarray(absolute + solver.rtol * np.abs(states).max(axis=1))[:, None]

    def _at_crossings(self, solver: Any, y_before: Array) -> float:
        """Largest defect at the crossings of a step, times its length, in units of the tolerance.

        It is looked at where an event function vanishes, and midway between two such places. In
        peaks and pulses, where trajectories may stay longer than the step says, a defect as large
        as the rates counts times all the time that is left. At a kink, which the estimate of the
        error sees unless it is that of a peak, no smaller one counts.
        """
        m, before, h = self.parameters.shape[1], solver.t_old, solver.t - solver.t_old
        events = self.features.state_surfaces
        charge(2.0 * self.cost_of_events(m))
        start = events(before, y_before.reshape(-1, m), self.parameters)
        end = events(solver.t, solver.y.reshape(-1, m), self.parameters)
        columns, which = np.nonzero((start * end < 0.0).T)
        if not columns.size:
            return 0.0
        interpolant, p = solver.interpolant(columns), self.parameters[:, columns]
        tolerated = self._tolerated(solver, solver.y.reshape(-1, m))
        look = _LOOKED(len(tolerated) * columns.size)

        def event(shares: Array) -> Array:
            charge(self.cost_of_events(columns.size) + look)
            values = events(before + h * shares, interpolant(shares), p)
            return np.asarray(values[which, np.arange(columns.size)])

        def largest(shares: Array, narrow: Any, kink: Any) -> float:
            charge(self.cost_of_rates(columns.size) + 2.0 * look)
            states, slopes = interpolant(shares, slopes=True)
            rates = h * self.rates(before + h * shares, states, p)
            defect = np.abs(rates - slopes)
            differs = defect > _DIFFERENT * np.maximum(np.abs(rates), np.abs(slopes))
            defect[kink & ~differs] = 0.0
            defect = np.where(narrow & differs, (solver.t_bound - before) / h * defect, defect)
            return _largest(defect / tolerated)

        shares = _zeros(event, start[which, columns], end[which, columns])
        narrow = which < self.features.n_peaks + self.features.n_kinks
        worst = largest(shares, narrow, narrow & (which >= self.features.n_peaks))
        again = np.diff(columns, prepend=-1) == 0
        if again.any():
            shares = shares[np.lexsort((shares, columns))]
            between = np.where(again, 0.5 * (shares + np.roll(shares, 1)), shares)
            worst = max(worst, largest(between, again, False))
        return worst


def _largest(errors: Array) -> float:
    return float(np.nan_to_num(errors, nan=np.inf).max())


def _zeros(function: Callable[[Array], Array], start: Array, end: Array) -> Array:
    """Zeros on [0, 1] of functions with values of two signs at its ends (Illinois algorithm)."""
    a, b, x = np.zeros_like(start), np.ones_like(end), np.full_like(start, np.nan)
    left_before: Any = None
    for _ in range(_NARROWED):
        before, x = x, np.clip((a * end - b * start) / (end - start), a, b)
        if np.all(np.abs(x - before) <= _EXACT):
            break
        value = function(x)
        left = value * start > 0.0
        again: Any = 1.0 if left_before is None else np.where(left == left_before, 0.5, 1.0)
        left_before = left
        a, b, old_start, old_end = np.where(left, x, a), np.where(left, b, x), start, end
        start = np.where(left, value, again * old_start)
        end = np.where(left, again * old_end, value)
        done = value == 0.0
        if done.any():
            a, b = np.where(done, x, a), np.where(done, x, b)
            start, end = np.where(done, -1.0, start), np.where(done, 1.0, end)
    return np.asarray(np.clip((a * end - b * start) / (end - start), a, b))
