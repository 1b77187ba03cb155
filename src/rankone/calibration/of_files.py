"""The likelihood of a calibration problem, as searches take it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from rankone.calibration.descent import Expansion
from rankone.calibration.likelihood import Evaluation
from rankone.calibration.parameters import Parameter, slope_of_scale
from rankone.support.arrays import Array
from rankone.support.budget import OutOfBudgetError, limited
from rankone.support.errors import OptionError, RankoneError
from rankone.support.wording import listing

_SEARCH_ACCURACY = 1e-4  # Relative tolerance of searches; LSODA has a hundredth of it
_MOST_WORK = 5e9  # Operations of one evaluation: five seconds, far more than a good one takes

Evaluate = Callable[[Mapping[str, float], float], Evaluation]
"""The evaluation at values of parameters, at a relative tolerance."""


@dataclass(frozen=True, eq=False)
class OfFiles:
    """Twice the objective on the unit cube between the bounds of the estimated parameters.

    ``quick`` evaluates it with derivatives, ``exact`` gives the objective.
    """

    parameters: tuple[Parameter, ...]
    lower: Array
    upper: Array
    quick: Evaluate
    exact: Callable[[Mapping[str, float]], float]

    @classmethod
    def of(
        cls,
        parameters: Sequence[Parameter],
        quick: Evaluate,
        exact: Callable[[Mapping[str, float]], float],
    ) -> OfFiles:
        """An OptionError if nothing is estimated, or bounds are not finite on their scale."""
        if not parameters:
            raise OptionError("no parameter of the table is estimated", remedy="set estimate to 1")
        ends = np.array([[p.scaled(p.lower), p.scaled(p.upper)] for p in parameters]).T
        endless = [
            p.name for p, e in zip(parameters, ends.T, strict=True) if not np.isfinite(e).all()
        ]
        if endless:
            raise OptionError(
                f"{listing(endless)} have no finite bounds on their scale",
                term=endless[0],
                remedy="give positive bounds, or the scale `lin`",
            )
        return cls(tuple(parameters), ends[0], ends[1], quick, exact)

    @property
    def names(self) -> tuple[str, ...]:
        """The estimated parameters; see :class:`~rankone.calibration.descent.Expandable`."""
        return tuple(parameter.name for parameter in self.parameters)

    def named(self, z: Array) -> dict[str, float]:
        """Their values at z (n,)."""
        coordinates = self.lower + (self.upper - self.lower) * z
        pairs = zip(self.parameters, coordinates.tolist(), strict=True)
        return {p.name: min(max(p.value(coordinate), p.lower), p.upper) for p, coordinate in pairs}

    def expanded(self, z: Array) -> Expansion:
        """At z (n,); see :class:`~rankone.calibration.descent.Expandable`."""
        nothing = Expansion(z, np.inf, np.zeros(1), np.zeros((1, z.size)))
        try:
            with limited(_MOST_WORK), np.errstate(all="ignore"):
                at = self.evaluated(z)
                residuals, rows = self._prior_rows(z, at.gradient - at.jacobian.T @ at.residuals)
                jacobian = np.concatenate([at.jacobian, rows]) * (self.upper - self.lower)
        except (RankoneError, OutOfBudgetError, np.linalg.LinAlgError):
            return nothing
        if not np.isfinite(at.objective) or not np.isfinite(jacobian).all():
            return nothing
        return Expansion(z, 2.0 * at.objective, np.concatenate([at.residuals, residuals]), jacobian)

    def evaluated(self, z: Array) -> Evaluation:
        """The evaluation at z (n,), at the accuracy of searches."""
        return self.quick(self.named(z), _SEARCH_ACCURACY)

    def _prior_rows(self, z: Array, gradient: Array) -> tuple[Array, Array]:
        """Pseudo-residuals (q,) of q priors, and their Jacobian (q, n), by their gradients (n,).

        Their curvatures are those of normal densities of the same widths.
        """
        values = self.named(z)
        residuals, rows = list[float](), list[Array]()
        for j, parameter in enumerate(self.parameters):
            prior = parameter.prior
            if prior is None or prior.shape == "uniform":
                continue
            value = values[parameter.name]
            root = parameter.slope(value) / slope_of_scale(value, prior.scale) / prior.width
            residuals.append(gradient[j] / root)
            rows.append(root * (np.arange(z.size) == j))
        return np.array(residuals), np.array(rows).reshape(-1, z.size)

    def log_likelihood(self, at: Expansion) -> float:
        """Minus the objective, at its full accuracy; minus infinity without trajectories."""
        if not np.isfinite(at.cost):
            return -np.inf
        try:
            return -self.exact(self.named(at.z))
        except RankoneError:
            return -np.inf

    def variance(self, at: Expansion) -> float:
        """One: the noise of the data is given or estimated."""
        return 1.0
