"""The likelihood of a calibration problem, as searches take it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rankone.calibration.cube import Cube
from rankone.calibration.descent import Expansion
from rankone.calibration.evaluation import ACCURACY, Evaluator
from rankone.calibration.likelihood import Evaluation
from rankone.calibration.nested import Nested
from rankone.support.arrays import Array
from rankone.support.budget import OutOfBudgetError, limited
from rankone.support.errors import RankoneError

_SEARCH_ACCURACY = 1e-3  # Relative tolerance of searches; LSODA has a hundredth of it
_MOST_WORK = 1e9  # Operations of one evaluation: a second, far more than a good one takes


@dataclass(frozen=True, eq=False)
class OfFiles:
    """Twice the objective on the unit cube between the bounds of the estimated parameters.

    Parameters that only observables and noise have are ``nested``: they are at their best.
    """

    evaluator: Evaluator
    cube: Cube
    best: Nested
    fixed: Mapping[str, float]

    @classmethod
    def of(cls, evaluator: Evaluator, values: Mapping[str, float]) -> OfFiles:
        """Of all estimated parameters; the others have their ``values``."""
        cube = Cube.of([p for p in evaluator.records.parameters if p.estimated])
        evaluator.simulation.check_smooth(cube.names)
        return cls(evaluator, cube, Nested(evaluator, cube), values)

    @property
    def names(self) -> tuple[str, ...]:
        """The estimated parameters; see :class:`~rankone.calibration.descent.Expandable`."""
        return self.cube.names

    @property
    def nested(self) -> NDArray[np.bool_]:
        """The coordinates (n,) that are at their best."""
        return np.array([name in self.best.names for name in self.names])

    def named(self, z: Array) -> dict[str, float]:
        """The values of the estimated parameters at z (n,)."""
        return self.cube.named(z)

    def expanded(self, z: Array) -> Expansion:
        """At z (n,), with the nested parameters at their best.

        The cost is infinite where there are no trajectories, or too much work to do.
        """
        try:
            with limited(_MOST_WORK), np.errstate(all="ignore"):
                return self._expanded(z)
        except (RankoneError, OutOfBudgetError, np.linalg.LinAlgError):
            return Expansion(z, np.inf, np.zeros(1), np.zeros((1, z.size)))

    def _expanded(self, z: Array) -> Expansion:
        values = {**self.fixed, **self.named(z)}
        simulated = self.evaluator.simulated(values, self.names, _SEARCH_ACCURACY, quick=True)
        values = self.best.best(simulated, values)
        z = np.where(self.nested, self.cube.places(values), z)
        at = self.evaluator.evaluated(simulated, values, self.names)
        _, residuals, rows = self.cube.prior_rows(values)
        jacobian = np.concatenate([at.jacobian * self.cube.width, rows])
        finite = np.isfinite(at.objective) and np.isfinite(jacobian).all()
        cost = 2.0 * at.objective if finite else np.inf
        return Expansion(z, cost, np.concatenate([at.residuals, residuals]), jacobian)

    def evaluated(self, z: Array) -> Evaluation:
        """The evaluation at z (n,), at the accuracy of searches."""
        values = {**self.fixed, **self.named(z)}
        simulated = self.evaluator.simulated(values, self.names, _SEARCH_ACCURACY, quick=True)
        return self.evaluator.evaluated(simulated, values, self.names)

    def log_likelihood(self, at: Expansion) -> float:
        """Minus the objective, at its full accuracy; minus infinity without trajectories."""
        if not np.isfinite(at.cost):
            return -np.inf
        values = {**self.fixed, **self.named(at.z)}
        try:
            simulated = self.evaluator.simulated(values, (), ACCURACY)
            return -self.evaluator.evaluated(simulated, values, ()).objective
        except RankoneError:
            return -np.inf
