"""One ordinary trajectory of a problem, integrated by SciPy: a first check of any solution."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from rankone.discretization.coordinates import name_of
from rankone.support.arrays import Array
from rankone.support.errors import EvaluationError
from rankone.support.wording import count, did_you_mean, listing


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
                f"the trajectory has {listing(self.states)}",
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
