"""The way down from one start, by least squares in a box of trust (Gauss–Newton).

Within the box of trust and the bounds the squares of the linearised residuals have their minimum
exactly (bounded least squares); the box grows where the promise holds and shrinks where it does not
(Conn, Gould & Toint, Trust-Region Methods, 2000, ch. 6 and 7). For estimated noise the pseudo-
residuals make the matrix the Fisher information, which has no negative directions.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

import numpy as np
import scipy.optimize
from numpy.typing import NDArray

from rankone.support.arrays import Array

FIRST_RADIUS = 0.05
"""Half the width of the first box of trust, in widths of the bounds."""
_LARGEST_RADIUS = 0.1
_LEAST_RADIUS = 1e-7  # Half a width below which nothing moves any more
_RIDGE = 1e-9  # Weight of the square of a first step, in squares of the largest column
# Shares of the promised decrease below which the box shrinks, and above which it grows
_POOR, _GOOD = 0.25, 0.75
_SHRINKING, _GROWING = 0.25, 2.0
_SETTLED = 1e-4  # Promised decrease of -2 log L below which a descent has arrived
_STALLED = 1e-2  # Decrease of -2 log L over some iterations below which it gets nowhere
_STALL_LENGTH = 20  # These iterations
_TINY_STEP = 1e-12


class Expansion(NamedTuple):
    """-2 log L at z (n,), and the residuals (r,) and their Jacobian (r, n) that stand for it.

    Half its gradient is ``jacobian.T @ residuals``, half its curvature about
    ``jacobian.T @ jacobian``. The cost is infinite where there is no trajectory.
    """

    z: Array
    cost: float
    residuals: Array
    jacobian: Array


class Expandable(Protocol):
    """-2 log L on the unit cube; its coordinates are logarithms of parameters over decades."""

    @property
    def names(self) -> tuple[str, ...]:
        """The coordinates."""

    @property
    def nested(self) -> NDArray[np.bool_]:
        """The coordinates (n,) that :meth:`expanded` puts at their best."""

    def expanded(self, z: Array) -> Expansion:
        """At z (n,), or close to it where some parameters have their best values at once."""


@dataclass
class Descent:
    """One way down from ``start`` (n,); :meth:`go` takes it further."""

    at: Expansion
    start: Array
    radius: float = FIRST_RADIUS
    largest: float = _LARGEST_RADIUS
    iterations: int = 0
    arrived: bool = False
    costs: list[float] = field(default_factory=list)

    def go(self, problem: Expandable, iterations: int) -> None:
        """Go on for some iterations at most."""
        for _ in range(iterations):
            if self.arrived:
                return
            self._step(problem)

    def continue_from(self, other: Descent) -> None:
        """Go on from where another way is."""
        self.at, self.radius = other.at, other.radius
        self.arrived, self.costs = other.arrived, other.costs

    def _step(self, problem: Expandable) -> None:
        at = self.at
        step, promised = bounded_step(at, np.where(problem.nested, 1.0, self.radius))
        self.iterations += 1
        length = float(np.abs(step[~problem.nested]).max(initial=0.0))
        if promised <= _SETTLED or length <= _TINY_STEP:
            self.arrived = True
            return
        trial = problem.expanded(np.clip(at.z + step, 0.0, 1.0))
        share = (at.cost - trial.cost) / promised if np.isfinite(trial.cost) else -np.inf
        if share < _POOR:
            self.radius = _SHRINKING * min(length, self.radius)
        elif share > _GOOD and length >= 0.99 * self.radius:
            self.radius = min(_GROWING * self.radius, self.largest)
        if share > 0.0:
            self.at = trial
        self.costs.append(self.at.cost)
        before = self.costs[-_STALL_LENGTH] if len(self.costs) >= _STALL_LENGTH else np.inf
        self.arrived = self.radius <= _LEAST_RADIUS or before - self.at.cost <= _STALLED


def bounded_step(at: Expansion, radius: float | Array) -> tuple[Array, float]:
    """The best step (n,) within the box of trust and the cube, and the decrease it promises.

    The box has half the width ``radius``, one for all coordinates or one for each (n,).
    """
    scale = float(np.linalg.norm(at.jacobian, axis=0).max(initial=0.0)) or 1.0
    n = at.z.size
    rows = np.concatenate([at.jacobian, np.sqrt(_RIDGE) * scale * np.eye(n)])
    right = np.concatenate([-at.residuals, np.zeros(n)])
    lower = np.minimum(np.maximum(-radius, -at.z), -_TINY_STEP)
    upper = np.maximum(np.minimum(radius, 1.0 - at.z), _TINY_STEP)
    step = scipy.optimize.lsq_linear(rows, right, (lower, upper), method="bvls").x
    step = np.clip(at.z + step, 0.0, 1.0) - at.z
    after = at.residuals + at.jacobian @ step
    return step, float(at.residuals @ at.residuals - after @ after)
