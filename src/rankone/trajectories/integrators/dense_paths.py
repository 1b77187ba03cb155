"""Trajectories that were integrated one by one, and the control of their steps."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from rankone.support.arrays import Array
from rankone.support.budget import charge
from rankone.support.costs import inverse
from rankone.trajectories.integrators.defects import Interpolant
from rankone.trajectories.integrators.integrator import EARLY_STEPS, Path, Tolerances, jacobians
from rankone.trajectories.system.system import System


@dataclass(frozen=True)
class SingleTrajectories:
    """Dense trajectories that each have their own steps. Fulfils :class:`DenseTrajectories`."""

    paths: tuple[Path, ...]
    end: float
    state: Array
    avoided: float = 0.0
    integrator: str = "single"
    method: str = "LSODA"

    @property
    def start(self) -> float:
        return float(self.paths[0].breaks[0])

    @property
    def steps(self) -> int:
        return max(path.steps for path in self.paths)

    @property
    def has_begun(self) -> bool:
        return self.end > self.start

    @cached_property
    def last(self) -> Array:
        if not self.has_begun:
            return self.state
        end = np.array([np.nextafter(self.end, self.start)])
        return np.stack([path(end)[:, 0] for path in self.paths], axis=1)

    @property
    def largest(self) -> Array:
        return np.stack([path.largest() for path in self.paths], axis=1)

    @property
    def early(self) -> Array:
        return np.stack([path.largest(EARLY_STEPS) for path in self.paths], axis=1)

    def __call__(self, times: Array) -> Array:
        """States at times (T,), after a jump at its time: shape (n, m, T)."""
        return np.stack([path(times) for path in self.paths], axis=1)

    def of(self, trajectories: slice) -> SingleTrajectories:
        """Some of the trajectories; see :meth:`DenseTrajectories.of`."""
        return replace(self, paths=self.paths[trajectories], state=self.state[:, trajectories])

    def samples(self, count: int) -> list[tuple[float, Array]]:
        """Ends of steps of the first trajectory, with all states there."""
        ends = self.paths[0].breaks[1:]
        ends = ends[ends <= self.end]
        times = ends[:: max(1, len(ends) // count)]
        return list(zip(times.tolist(), np.moveaxis(self(times), 2, 0), strict=True))


class StepsOfOne:
    """Steps of the trajectory at a point (d,), for defect control: fulfils :class:`Steps`."""

    def __init__(
        self, system: System, point: Array, path: Path, tolerances: Tolerances, end: float
    ) -> None:
        self.system, self.point, self.t_bound = system, point, end
        self.t_old, self.t = path.breaks[:-1], path.breaks[1:]
        self.coefficients = path.coefficients
        self.before, self.y = path.nodal[:, 0].T.ravel(), path.nodal[:, -1].T.ravel()
        self.rtol = tolerances.relative
        self.atol = np.broadcast_to(tolerances.absolute, (path.state.size, path.steps)).ravel()

    def interpolant(self, columns: NDArray[np.intp]) -> Interpolant:
        """The polynomials of some steps."""
        coefficients = self.coefficients[:, columns].transpose(0, 2, 1)

        def evaluate(shares: Array, slopes: bool) -> tuple[Array, Array]:
            place, (_, n, c) = 2.0 * shares - 1.0, coefficients.shape
            y = np.zeros((n, *shares.shape))
            slope = np.zeros_like(y)
            of_powers = coefficients.reshape(-1, n, *(1,) * (shares.ndim - 1), c)
            for coefficient in of_powers[::-1]:
                if slopes:
                    slope = slope * place + y
                y = y * place + coefficient
            return y, 2.0 * slope

        return evaluate

    def error_of(self, defect: Array, columns: NDArray[np.intp]) -> Array:
        """The defect divided by the matrices of an implicit Euler step."""
        n, count = len(defect), self.t.size
        blocks = jacobians(self.system, np.tile(self.point, (count, 1)), self.t, self.y)
        lengths = (self.t - self.t_old)[:, None, None]
        charge(count * inverse(n, real=True))
        try:
            inverses = np.linalg.inv(np.eye(n) - lengths * np.nan_to_num(blocks))
        except np.linalg.LinAlgError:
            return defect
        return np.asarray(np.matmul(inverses[columns], defect.T[:, :, None])[:, :, 0].T)
