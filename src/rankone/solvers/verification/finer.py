"""Whether finer trajectories confirm those of a reference.

The reference and the samples choose their steps by the same estimates of errors. Where these fail,
both may be wrong alike: an error of the place at which a state nearly stops is tiny, and becomes
a large one once the state goes on later than it should. LSODA steps in another way. So it follows
a few of the trajectories, at a tighter tolerance.

Rates that are polynomials of low degree mislead no estimate. What their flow amplifies differs
between the reference and the samples, and is a part of the measured error.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rankone.solvers.verification.check_tuning import CHECK
from rankone.solvers.verification.reference import reference_accuracy
from rankone.solvers.verification.reference_set import ReferenceSet
from rankone.support.arrays import Array
from rankone.support.precision import NEGLIGIBLE
from rankone.trajectories.events.event_order import OrderError
from rankone.trajectories.stacks.stack import has_smooth_rates
from rankone.trajectories.system.timeline import CLOCK_STATES
from rankone.trajectories.system.verdict import HiddenRate

# Below this tolerance LSODA, at a hundredth of it, stays in its stiff method once it is there, with
# short steps whatever the rates: references so many times above are compared at this one
_LSODA_RETURNS, _ABOVE = 3e-10, 10.0


def confirmed(reference_set: ReferenceSet) -> tuple[ReferenceSet, HiddenRate | None]:
    """The set, or a finer one, and where finer trajectories leave the finest there is.

    The set is finer where one of a few trajectories left a coarser one by a good part of the
    tolerance. One that is as fine as rounding allows, and trajectories of a forced order, are taken
    as they are.
    """
    system, reference = reference_set.system, reference_set.reference
    finest = reference_accuracy(0.0)
    hidden: HiddenRate | None = None
    if not reference_set.checked or reference.blown is not None:
        return reference_set, None
    if system.clock is None and has_smooth_rates(system, reference.start):
        return reference_set, None
    if system.clock is not None and system.clock.forced is not None:
        return reference_set, None
    accuracy = reference_set.accuracy
    while accuracy > finest:
        accuracy = max(_finer(accuracy), finest)
        hidden = _departure(reference_set, accuracy)
        if hidden is None:
            break
        reference_set = reference_set.at_accuracy(accuracy)
        if reference_set.reference.blown is not None:
            return reference_set, None
    if hidden is not None:
        hidden = _departure(reference_set, finest)
    return reference_set, hidden


def _finer(accuracy: float) -> float:
    """The relative tolerance of trajectories that a reference is compared with."""
    finer = CHECK.finer_ratio * accuracy
    return _LSODA_RETURNS if finer < _LSODA_RETURNS <= accuracy / _ABOVE else finer


def _departure(reference_set: ReferenceSet, accuracy: float) -> HiddenRate | None:
    """Where a trajectory of this relative tolerance has left the reference first, if one has.

    None has where it meets another order of events: it is next to where the order changes.
    """
    clock, few, times = reference_set.system.clock, _compared(reference_set), _times(reference_set)
    end = reference_set.end if clock is None else clock.horizon[1]
    try:
        samples = reference_set.sampled_again(few, times, accuracy)
    except OrderError:
        return None
    times, finer = times[: samples.reached], np.moveaxis(samples.states[: samples.reached], 0, 2)
    for k, index in enumerate(few.tolist()):
        states = reference_set.reference.of(slice(index, index + 1))(times)
        now = _clock_times(reference_set, times, states)
        apart = _differences(reference_set, index, times, states, finer[:, k : k + 1])
        left = (apart > CHECK.finer_difference * reference_set.rtol) & (now <= end)
        if left.any():
            point = reference_set.reference.points[index].tolist()
            named = zip(reference_set.system.parameters, point, strict=True)
            states_left = left if clock is None else left[: clock.n_states]
            at = int(np.argmax((states_left if states_left.any() else left).any(axis=0)))
            row = int(np.argmax(apart[: len(states_left), at]))
            return HiddenRate(reference_set.names[row], float(now[at]), tuple(named))
    return None


def _times(reference_set: ReferenceSet) -> Array:
    """The times (T,) of a comparison, none of them that of a jump: states differ on either side."""
    times = np.linspace(reference_set.reference.start, reference_set.end, CHECK.finer_times)
    jumps = np.array(reference_set.system.jumps.times)
    near = NEGLIGIBLE * (times[-1] - times[0])
    apart = np.abs(times[:, None] - jumps).min(axis=1, initial=np.inf) > near
    return np.asarray(times[apart])


def _clock_times(reference_set: ReferenceSet, times: Array, states: Array) -> Array:
    """The clock times (T,) of states (n, 1, T) at times, which may be those of stretches."""
    system = reference_set.system
    return times if system.clock is None else states[len(system.unknowns) - CLOCK_STATES, 0]


def _differences(
    reference_set: ReferenceSet, index: int, times: Array, states: Array, finer: Array
) -> Array:
    """What differs between states (n, 1, T) of a trajectory, in units of the sizes: (n, T).

    What nobody asks for differs by nothing.
    """
    one = slice(index, index + 1)
    before, after = (reference_set.seen(times, each, one) for each in (states, finer))
    apart = np.abs(after - before)[:, 0] / reference_set.states[:, None]
    if reference_set.counted is not None:
        apart[np.setdiff1d(np.arange(len(apart)), reference_set.counted)] = 0.0
    return np.asarray(np.nan_to_num(apart, nan=np.inf))


def _compared(reference_set: ReferenceSet) -> NDArray[np.intp]:
    """Positions of the trajectories to compare: the centre, and the one that moves farthest."""
    reference, sizes = reference_set.reference, reference_set.of_states[:, None]
    start = reference_set.system.initial(np.ascontiguousarray(reference.points.T))
    end = np.concatenate([batch.state for batch in reference.batches], axis=1)
    moved: Array = np.nan_to_num(np.abs(end - start) / sizes).sum(axis=0)
    if not reference_set.whole_box:
        moved[1 : 1 + reference_set.corners] = 0.0
    return np.unique([0, int(np.argmax(moved))])
