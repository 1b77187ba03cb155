"""Why an interpolation does not converge: a parameter on which the solution depends steeply."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from rankone.ir.domain import Domain
from rankone.ir.verdict import SteepParameter
from rankone.solvers.cross.constants import (
    FRONT_CHANGE,
    FRONT_WIDTH,
    JUMP_WIDTH,
    KEPT_CHANGE,
    LINE_PLACES,
    MAX_ZOOMS,
    ZOOM_PLACES,
)
from rankone.support.arrays import Array
from rankone.support.budget import OutOfBudgetError

__all__ = ["Front", "steepest_front"]


@dataclass(frozen=True)
class Front:
    """A short piece of a line along one parameter over which the trajectory changes.

    Attributes
    ----------
    parameter, state : int
        The parameter, and the state that changes most.
    lower, upper : float
        The piece.
    share : float
        Its width over that of the interval.
    change : float
        Change of the state in units of its size.
    at_end : bool
        Whether the states at the end of the horizon differ as well.
    point : ndarray (d,)
        A point of the line.
    """

    parameter: int
    state: int
    lower: float
    upper: float
    share: float
    change: float
    at_end: bool
    point: Array

    def cause(self, states: Sequence[str], parameters: Sequence[str]) -> SteepParameter:
        """The front by the names of states and parameters."""
        fixed = tuple(
            (name, float(at))
            for j, (name, at) in enumerate(zip(parameters, self.point, strict=True))
            if j != self.parameter
        )
        return SteepParameter(
            parameters[self.parameter],
            states[self.state],
            float(self.lower),
            float(self.upper),
            self.change,
            bool(self.share <= JUMP_WIDTH),
            bool(self.at_end),
            fixed,
        )


def steepest_front(
    trajectories: Callable[[Array], Array], domain: Domain, points: Sequence[Array]
) -> Front | None:
    """The narrowest front on lines through points of the box; None if there is none.

    Parameters
    ----------
    trajectories : callable
        Trajectories at points (m, d) in units of the states' sizes: shape (n, T, m).
    points : sequence of ndarray (d,)
        Through each goes one line for each parameter.
    """
    fronts: list[Front] = []
    lines = ((point, j) for point in points for j in range(len(domain.box)))
    with suppress(OutOfBudgetError):  # the fronts so far say it as well
        for point, j in lines:
            for front in _on_line(trajectories, domain.box[j], point, j):
                fronts.append(front)
    return min(
        fronts, key=lambda front: (front.share, not front.at_end, -front.change), default=None
    )


def _on_line(
    trajectories: Callable[[Array], Array], interval: tuple[float, float], point: Array, j: int
) -> Iterator[Front]:
    """Fronts on the line through a point along parameter j, at the end and at any time."""
    width = interval[1] - interval[0]

    def changes(a: float, b: float, count: int) -> tuple[Array, Array]:
        """Places, and changes (n, T, count - 1) between them."""
        places = np.linspace(a, b, count)
        line = np.tile(point, (count, 1))
        line[:, j] = places
        return places, np.abs(np.diff(trajectories(line), axis=2))

    places, coarse = changes(*interval, LINE_PLACES)
    for times in (slice(-1, None), slice(None)):
        for i in np.argsort(-coarse[:, times].max(axis=(0, 1)))[:MAX_ZOOMS]:
            a, b, change = places[i], places[i + 1], coarse[:, times, i]
            if not change.max() >= FRONT_CHANGE:
                break
            while b - a > JUMP_WIDTH * width:
                closer, fine = changes(a, b, ZOOM_PLACES)
                k = int(fine[:, times].max(axis=(0, 1)).argmax())
                if not fine[:, times, k].max() >= KEPT_CHANGE * change.max():
                    break
                a, b, change = closer[k], closer[k + 1], fine[:, times, k]
            if b - a < FRONT_WIDTH * width:
                state, at_end = int(change.max(axis=1).argmax()), change.shape[1] == 1
                yield Front(j, state, a, b, (b - a) / width, float(change.max()), at_end, point)
