"""One ordinary trajectory of a problem, integrated by SciPy: a first check of any solution."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from rankone.problem.forms import Coordinate
from rankone.problem.integration import LEAST_RTOL, MOST_RTOL, Integration
from rankone.problem.numeric import NumericEquations
from rankone.support.arrays import Array
from rankone.support.errors import EvaluationError
from rankone.support.options import checked_number
from rankone.support.wording import count, did_you_mean, listing
from rankone.tensors.bases.coordinates import Coordinates, name_of


@dataclass(frozen=True, eq=False, repr=False)
class Trajectory:
    """One trajectory of a problem, at the times asked for.

    ``np.asarray(trajectory)`` are its values, and a loop goes through the unknowns.

    Attributes
    ----------
    t : ndarray
        The times, as they were given.
    values : ndarray (unknowns, *shape of the times)
        The unknowns, as a solution returns them.
    states : mapping of str to ndarray
        Unknowns and derivatives that are states, by name.
    events : mapping of str to ndarray
        When each event happened, by name, up to the last of the times.
    """

    t: Array
    values: Array
    states: Mapping[str, Array]
    events: Mapping[str, Array]

    def __getitem__(self, state: object) -> Array:
        """One unknown, or one derivative that is a state: ``trajectory[x.diff(t)]``."""
        name = name_of(state)
        if name not in self.states:
            raise EvaluationError(
                f"no unknown `{name}`{did_you_mean(name, self.states)}; "
                f"the trajectory has {listing(self.states, name)}",
                term=state,
            )
        return self.states[name]

    def __iter__(self) -> Iterator[Array]:
        return iter(self.values)

    def __array__(self, dtype: object = None, copy: bool | None = None) -> Array:
        return np.array(self.values, dtype=dtype, copy=copy)  # type: ignore[call-overload,no-any-return]

    def __repr__(self) -> str:
        text = f"Trajectory of {listing(self.states)} at {count(self.t.size, 'time')}"
        counts = [f"{len(times)} of {name}" for name, times in self.events.items()]
        return f"{text}, with events: {', '.join(counts)}" if counts else text


def trajectory_of(
    equations: NumericEquations,
    coordinates: Sequence[Coordinate],
    unknowns: Sequence[str],
    rtol: object,
    given: tuple[tuple[object, ...], Mapping[str, object]],
) -> Trajectory:
    """The trajectory of equations at times and values ``given`` as the arguments of a call.

    See :meth:`rankone.Problem.trajectory`.
    """
    tolerance = checked_number("rtol", rtol, LEAST_RTOL, MOST_RTOL, float)
    axes = Coordinates([c.name for c in coordinates], [(c.lower, c.upper) for c in coordinates])
    at, named = given
    times, *values = axes.arrays(axes.gather(at, dict(named)))
    for coordinate, value in zip(coordinates[1:], values, strict=True):
        if value.size != 1:
            raise EvaluationError(
                f"`{coordinate.name}` has {value.size} values; a trajectory has one for each "
                "parameter",
                term=coordinate.name,
                remedy="call it for each",
            )
    point = np.array([value.item() for value in values])
    ascending, places = np.unique(times, return_inverse=True)
    integration = Integration(equations, point, ascending, tolerance)
    states = integration.values[:, places.reshape(times.shape)]
    by_name = dict(zip(map(name_of, equations.states), states, strict=True))
    rows = np.stack([by_name[unknown] for unknown in unknowns])
    return Trajectory(times, rows, by_name, integration.events)
