"""Problems that are integrated at each point instead of solved over a box, as fits read them."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from rankone.ir.metadata import SolutionMetadata
from rankone.ir.outcome import Outcome
from rankone.ir.system import System
from rankone.ir.verdict import Status
from rankone.solution.core import SolutionCore
from rankone.support.arrays import Array
from rankone.support.budget import OutOfBudgetError, limited
from rankone.support.errors import OptionError
from rankone.trajectories.integrator import Tolerances
from rankone.trajectories.sensitive_paths import sensitive_to_parameters

_ABSOLUTE = 1e-6  # Absolute tolerance, in sizes of each state: those of the initial values or data
_MOST_WORK = 2e9  # Operations of one trajectory: two seconds, a hundred times what one costs


class IntegratedSolution(SolutionCore):
    """A problem as a fit reads a solution: its values come from trajectories, point by point.

    Parameters
    ----------
    system : System
        What is integrated; events that depend on the states are not differentiated.
    metadata : SolutionMetadata
        The problem; its box may be as wide as one likes.
    rtol : float
        Relative tolerance of the trajectories.
    """

    def __init__(self, system: System, metadata: SolutionMetadata, rtol: float = 1e-5) -> None:
        if system.events:
            raise OptionError(
                "trajectories with events have no sensitivities here",
                remedy="solve the problem on a box and fit in it: solution.fit(...)",
            )
        self.system, self.tolerance = system, rtol
        outcome = Outcome((), Status.UNCHECKED, None, ())
        super().__init__(outcome, metadata)

    @property
    def time(self) -> tuple[float, float]:
        """Start and end of the horizon."""
        return self.metadata.horizon

    @cached_property
    def edges(self) -> tuple[float, ...]:
        """The start, times at which the system jumps or switches, and the end."""
        start, end = self.metadata.horizon
        cuts = [t for t in self.system.features.cuts[0] if start < t < end]
        return (start, *sorted({*self.system.jumps.inside(start, end), *cuts}), end)

    def tolerances(self, point: Array) -> Tolerances:
        """Those at a point (d,); a state that starts at zero has the largest initial value."""
        start = np.abs(self.system.initial(point[:, None])[:, 0])
        sizes = np.where(start > 0.0, start, start.max(initial=0.0) or 1.0)
        return Tolerances(self.tolerance, _ABSOLUTE * sizes[:, None])

    def __reduce__(self) -> tuple[object, ...]:
        specification = self.system.specification  # the functions of a module do not pickle
        assert specification is not None
        return specification.call, (type(self), self.metadata, self.tolerance)

    @cached_property
    def _evaluator(self) -> None:  # type: ignore[override]
        return None


class TrajectoryModel:
    """A :class:`~rankone.estimation.models.Model` whose values are trajectories.

    Values are NaN where a trajectory ends before the last of the data, or takes too much work.
    """

    def __init__(self, solution: IntegratedSolution, rows: NDArray[np.intp], times: Array) -> None:
        self.solution, self.rows = solution, rows
        self.times, self.places = np.unique(times, return_inverse=True)

    def thinned(self, scale: Array, tolerance: float) -> TrajectoryModel:
        """The same: there is nothing to be made smaller."""
        return self

    def values(self, points: Array) -> Array:
        """Values (N, m); see :meth:`Model.values`."""
        return self.linearised(points, ())[0]

    def linearised(self, points: Array, free: Sequence[int]) -> tuple[Array, Array]:
        """Values (N, m) and derivatives (N, m, k); see :meth:`Model.linearised`."""
        count = points.shape[1]
        values = np.full((count, self.rows.size), np.nan)
        slopes = np.full((count, self.rows.size, len(free)), np.nan)
        for j, point in enumerate(points.T):
            try:
                with limited(_MOST_WORK):
                    at = sensitive_to_parameters(
                        self.solution.system,
                        point,
                        self.solution.edges,
                        self.solution.tolerances(point),
                        self.times,
                        free,
                    )
            except (OutOfBudgetError, np.linalg.LinAlgError):
                continue
            values[j] = at.states[self.places, self.rows]
            slopes[j] = at.slopes[self.places, self.rows]
        return values, slopes
