"""The system under whose conditions trajectories come to rest before another one starts."""

from __future__ import annotations

from dataclasses import dataclass

from rankone.ir.features import OfParameters, OfStates


@dataclass(frozen=True, eq=False)
class Rest:
    """The system before a start at its steady state.

    ``initial`` values at p (d, m) are where its trajectories start, (n, m); ``rhs`` and its
    ``jacobian`` are as those of a system. ``after`` resets the states at rest at the start, if it
    is not None. Trajectories are looked at from the time ``settle[0]`` on, up to ``settle[1]``.
    """

    initial: OfParameters
    rhs: OfStates
    jacobian: OfStates
    after: OfStates | None
    settle: tuple[float, float]
