"""Reference trajectories at single parameter points."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.integrate

from rankone.ir.outcome import Measured
from rankone.ir.system import System, refuse_gap
from rankone.support.arrays import Array, corners, spread
from rankone.support.budget import OutOfBudgetError, Reached, charge
from rankone.support.costs import Cost
from rankone.support.errors import ConvergenceError
from rankone.tensors.slab import SlabTrain
from rankone.trajectories.chatter import switching_state
from rankone.trajectories.integration import NUMBERS_LEFT, Stack, quickest
from rankone.trajectories.rounding import rounding_errors

__all__ = [
    "FEW",
    "Reference",
    "check_points",
    "integrate_reference",
    "measure",
    "times_within",
]

_CHECK_TIMES = np.array([0.0, 0.13, 0.31, 0.5, 0.69, 0.87, 1.0])
"""Checked times, in slab lengths."""
FEW, _FEW_CORNERS, _MOST_CORNERS = 3, 8, 256
"""Number of parameters up to which corners count like other points, and numbers of corners."""
_BESIDE = 4e-9
"""Distance from special values, in widths of the interval: at a jump itself there is no value."""
_NEGLIGIBLE = 1e-7
"""Part of a state's size at which its relative accuracy ends."""
_LONGEST = 0.1
"""Longest step, in horizons, where functions of time or of unknowns may hide between its stages."""
_GROWN = 1e3
"""Size of a state, over the initial ones, that tells a blow-up from a pole or a border."""
_COINCIDENT = 1e-14
"""Times that are closer, relative to the ends of the horizon, are the same."""
_RUNAWAY, _LATER = 1e6, 1.0001
"""Growth in a horizon, at the last rate, that tells the same, and a state a little later."""
_EARLY, _LINGERS = 4, 1e-3
"""Steps after which a state that is below what is resolved lingers there, and the part of its size
then that is resolved instead."""
_LOOKED, _AMPLIFIED = 8, 5.0
"""Times at which rates and the growth of small values are looked at, and the growth over the
horizon, as a power of e, from which it counts."""
_DENSE = Cost(50e3, 15.0)
"""Operations of an evaluation of dense output, and for each number that it gives."""
_INTEGRATIONS = 4
"""Integrations at most, where states that start from zero turn out to be small."""


def check_points(
    box: Array,
    count: int,
    seed: int = 20140,
    special: Sequence[Sequence[float]] = (),
    every_corner: bool = False,
) -> Array:
    """The centre of the box, corners, and interior points that are spread evenly, shape (m, d).

    Parameters
    ----------
    box : ndarray (d, 2)
    count : int
        Number of interior points; with it come corners, all or eight of them.
    special : sequence of sequences of float
        For each parameter values inside of its interval that are checked on either side.
    every_corner : bool
        Whether to take all corners, or 256 of more; else eight of them.
    """
    rng = np.random.default_rng(seed)
    d = len(box)
    lower, width = box[:, 0], box[:, 1] - box[:, 0]
    if d == 0 or count == 0:
        return (lower + 0.5 * width)[None, :]
    corner = corners(d, _MOST_CORNERS if every_corner else _FEW_CORNERS, rng)
    unit = np.concatenate([np.full((1, d), 0.5), corner, spread(count, d, rng)])
    points = [lower + width * unit]
    for j, values in enumerate(special):
        for side in (-_BESIDE, _BESIDE):
            more = lower + width * rng.random((len(values), d))
            more[:, j] = values + side * width[j]
            points.append(more)
    return np.concatenate(points)


@dataclass(frozen=True)
class Reference:
    """Trajectories at the check points, dense in time.

    Attributes
    ----------
    points : ndarray (m, d)
        Parameter points; the first is the centre of the box.
    end : float
        Time reached; before the horizon where a trajectory blows up.
    avoided : float
        Steps that DOP853 would still have made when it was given up for Radau; 0 if it was not.
    blown : int or None
        The point whose trajectory blows up at ``end``, or leaves where its rates are finite.
    large : bool
        Whether it has grown by then.
    floor : ndarray (n,)
        Values of each state below which its relative accuracy ends, where that is lower than usual
        since it is amplified later; else infinite.
    rounded : ndarray (n,)
        Rounding errors of states that are tiny beside the others; 0 for all others.
    zero : ndarray of bool (n,)
        The states that are numerically zero.
    switching : int or None
        The state whose rate switches to and fro at ``end``, if that is why it ends.
    batches : tuple
        Number of points and dense output of each integration, in the order of the points.
    """

    points: Array
    start: float
    end: float
    avoided: float
    blown: int | None
    batches: tuple[tuple[int, Any], ...]
    states: int
    large: bool = False
    floor: Any = np.inf
    rounded: Any = 0.0
    zero: Any = False
    switching: int | None = None

    @property
    def stiff(self) -> bool:
        """Whether the stiff integrator was used."""
        return self.avoided > 0.0

    def __call__(self, times: Array) -> Array:
        """States at the times (T,): shape (n, m, T)."""
        charge(len(self.batches) * _DENSE(times.size * self.states * len(self.points)))
        parts = [dense(times).reshape(self.states, count, -1) for count, dense in self.batches]
        return np.asarray(parts[0] if len(parts) == 1 else np.concatenate(parts, axis=1))

    def joined(self, other: Reference) -> Reference:
        """The trajectories of both, up to where the first of them blows up."""
        first, blown = self, self.blown
        if other.end < self.end and other.blown is not None:
            first, blown = other, len(self.points) + other.blown
        points = np.concatenate([self.points, other.points])
        batches, avoided = self.batches + other.batches, max(self.avoided, other.avoided)
        ends = first.end, avoided, blown, batches, self.states, first.large
        both = np.minimum(self.rounded, other.rounded) > 0.0
        return Reference(
            points,
            self.start,
            *ends,
            floor=np.minimum(self.floor, other.floor),
            rounded=np.where(both, np.maximum(self.rounded, other.rounded), 0.0),
            zero=self.zero & other.zero,
            switching=first.switching,
        )


def integrate_reference(
    system: System,
    points: Array,
    start: float,
    end: float,
    rtol: float,
    cuts: Sequence[float] = (),
) -> Reference:
    """Integrate the system from ``start`` to ``end`` at all points (m, d).

    Parameters
    ----------
    points : ndarray (m, d)
    start, end : float
    rtol : float
        Relative tolerance of the integrator.
    cuts : sequence of float
        Times, ascending, at which the integration is begun anew: where the time factors jump,
        kink or are narrow.

    Raises
    ------
    ConvergenceError
        If not a single step can be made.
    OutOfBudgetError
        With how far the integration came.
    """
    between = _with_moving(system, points, start, end, cuts)
    stack = Stack(system, points, [start, *between, end])
    initial = system.initial(np.ascontiguousarray(points.T))
    _check_start(system, start, initial, points)
    floor = np.full((len(initial), 1), np.inf)
    size = np.abs(initial).max(axis=1, keepdims=True)
    rounding = rounding_errors(stack, [(start, initial)], size, rtol)
    size = np.where(size > 0.0, size, size.max(initial=0.0) or 1.0)
    longest = math.inf if stack.polynomial else _LONGEST * (end - start)
    atol = np.maximum(rtol * _NEGLIGIBLE * size, rounding.floor)
    for _ in range(_INTEGRATIONS):
        steps = _Steps()
        try:
            state, avoided = stack.run(
                steps, rtol, atol, max_step=longest, watched=not system.separated
            )
        except OutOfBudgetError as out:
            raise type(out)(steps.so_far(system, points, end - start)) from out
        if not steps.pieces:
            break
        largest, early = (
            values.reshape(initial.shape).max(axis=1, keepdims=True)
            for values in (steps.largest, steps.early)
        )
        looks = steps.looks(len(initial))
        before, rounding = rounding, rounding_errors(stack, looks, largest, rtol)
        coarse = before.floor > np.maximum(rounding.floor, rtol * _NEGLIGIBLE * largest)
        small = ~rounding.zero & (largest > 0.0) & (largest < 10.0 * _NEGLIGIBLE * size)
        usual = _NEGLIGIBLE * np.maximum(size, largest)
        lingers = ~rounding.zero & ~small & (early > 0.0) & (early < np.minimum(usual, floor))
        if lingers.any() and not _amplifies(stack, steps, len(initial)):
            lingers[:] = False
        size = np.where(small, largest, size)
        floor = np.where(lingers, _LINGERS * early, floor)
        coarser = atol
        atol = np.maximum(rtol * np.minimum(_NEGLIGIBLE * size, floor), rounding.floor)
        if not ((small | lingers | coarse) & (atol < coarser)).any():
            break
    if not steps.pieces:
        values = points[quickest(system, start, state, points, rtol * _NEGLIGIBLE * size)]
        where = [f"{n} = {v:.6g}" for n, v in zip(system.parameters, values, strict=True)]
        raise ConvergenceError(
            f"no trajectory can be integrated from t = {start:g}"
            + (f" at {', '.join(where)}" if where else "")
            + ": the right-hand side is not finite there or varies without bound",
            remedy="check the initial values and the coefficients",
        )
    blown, large, switching = None, False, None
    size = np.maximum(size, rounding.floor)
    negligible = rtol * _NEGLIGIBLE * size
    reached = float(steps.times[-1])
    if end - reached > NUMBERS_LEFT * np.spacing(abs(end)):
        blown = quickest(system, reached, state, points, negligible)
        before = steps.pieces[-1](reached).reshape(initial.shape)
        refuse_gap(system, reached, before[:, blown], points[blown])
        large = bool((np.abs(state[:, blown]) > _GROWN * size[:, 0]).any())
        large = large or _runs_away(system, reached, state[:, blown], points[blown], end - start)
        chatter = None if large else switching_state(system, reached, state, points, end - start)
        if chatter is not None:
            switching, blown = chatter
    # At the time of a jump the states are those after it.
    dense = scipy.integrate.OdeSolution(steps.times, steps.pieces, alt_segment=True)
    batches = ((len(points), dense),)
    ends = start, reached, avoided, blown, batches, system.n_differential, large
    rounded = rounding.floor[:, 0], rounding.zero[:, 0]
    return Reference(points, *ends, floor[:, 0], *rounded, switching=switching)


def _check_start(system: System, start: float, initial: Array, points: Array) -> None:
    """Raise a ConvergenceError where the initial values, or their rates, are not finite."""
    with np.errstate(all="ignore"):
        rates = system.rhs(start, initial, np.ascontiguousarray(points.T))
    for what, values in (("initial value", initial), ("derivative at the start", rates)):
        state, index = np.nonzero(~np.isfinite(np.broadcast_to(values, initial.shape)))
        if state.size:
            refuse_gap(system, start, initial[:, index[0]], points[index[0]])
            pairs = zip(system.parameters, points[index[0]], strict=True)
            where = ", ".join(f"{name} = {x:.6g}" for name, x in pairs)
            raise ConvergenceError(
                f"the {what} of `{system.states[state[0]]}` is not finite"
                + (f" at {where}" if where else ""),
                remedy="check the initial values and the coefficients",
            )


def _with_moving(
    system: System, points: Array, start: float, end: float, cuts: Sequence[float]
) -> list[float]:
    """The cuts, and the times at which functions of time switch at some of the points."""
    if not system.features.n_moving_cuts:
        return list(cuts)
    with np.errstate(all="ignore"):
        times = system.features.moving_cuts(np.ascontiguousarray(points.T)).ravel()
    least = _COINCIDENT * max(abs(start), abs(end))
    times = np.unique(times[(times - start > least) & (end - times > least)])
    times = times[np.diff(times, prepend=start) > least]
    known = np.array(cuts)
    apart = np.abs(times[:, None] - known).min(axis=1, initial=np.inf) > least
    return sorted([*cuts, *times[apart].tolist()])


def _amplifies(stack: Stack, steps: _Steps, states: int) -> bool:
    """Whether some state may grow exponentially along the first trajectory, by a large factor."""
    growth = 0.0
    for instant, state in steps.looks(states):
        blocks = stack.jacobians(instant, state)[:1]
        if np.isfinite(blocks).all():
            growth = max(growth, float(np.linalg.eigvals(blocks).real.max()))
    return growth * (steps.times[-1] - steps.times[0]) > _AMPLIFIED


def _runs_away(system: System, time: float, state: Array, point: Array, horizon: float) -> bool:
    """Whether a state grows at an enormous rate, and would a little later as well: no pole."""
    with np.errstate(all="ignore"):
        now, later = (system.rhs(time, s * state[:, None], point[:, None]) for s in (1.0, _LATER))
    fast = now[:, 0] * np.sign(state) * horizon > _RUNAWAY * np.abs(state)
    return bool((fast & (later / now > 0.5)[:, 0] & (later / now < 2.0)[:, 0]).any())


class _Steps:
    """The steps of an integration with their dense output."""

    times: list[float]
    pieces: list[Any]
    largest: Array
    early: Array
    """Largest after so many steps."""

    def begin(self, start: float) -> None:
        """Forget what was, and start."""
        self.times, self.pieces, self.largest = [start], [], np.zeros(1)
        self.early = np.zeros(1)

    def looks(self, states: int) -> list[tuple[float, Array]]:
        """Some times, and the states (n, m) then."""
        pieces = self.pieces[:: max(1, len(self.pieces) // _LOOKED)]
        return [(piece.t, piece(piece.t).reshape(states, -1)) for piece in pieces]

    def add(self, solver: Any) -> None:
        """Keep a step."""
        self.times.append(solver.t)
        self.pieces.append(solver.dense_output())
        self.largest = np.maximum(self.largest, np.abs(solver.y))
        if len(self.pieces) <= _EARLY:
            self.early = self.largest

    def so_far(self, system: System, points: Array, horizon: float) -> Reached:
        """How far the integration came."""
        time, count = self.times[-1], len(self.pieces)
        if not count:
            return Reached(time, count, None)
        states = self.pieces[-1](time).reshape(-1, len(points))
        chatter = switching_state(system, time, states, points, horizon)
        return Reached(time, count, None if chatter is None else chatter[0])


def times_within(start: float, end: float, shares: Array) -> Array:
    """Times at shares of a slab; at its end, where states may jump, the last number before it."""
    return np.asarray(np.minimum(start + (end - start) * shares, np.nextafter(end, start)))


def measure(
    slabs: Sequence[SlabTrain],
    reference: Reference,
    scale: Array,
    corners: int,
    whole_box: bool,
    seen: int | None = None,
    states: tuple[int, ...] | None = None,
) -> Measured:
    """Errors of the slabs against the reference over their whole time span.

    Parameters
    ----------
    scale : ndarray (n,)
        Size of each state over the interior points. Errors at corners are relative to the largest
        value over the corners, where that is larger.
    corners : int
        Number of check points, after the centre, that are corners of the box.
    whole_box : bool
        Whether they count like the others.
    seen : int, optional
        So many states, the first, are measured: those after them are lifted and serve the others.
    states : tuple of int, optional
        Those of them whose error counts.
    """
    m = len(reference.points)
    errors = np.zeros((reference.states, m))
    largest = scale.copy()
    all_times = [times_within(slab.start, slab.end, _CHECK_TIMES) for slab in slabs]
    all_exact = np.split(reference(np.concatenate(all_times)), len(slabs), axis=2)
    carry, last = np.zeros((0, m)), None
    for slab, times, exact in zip(slabs, all_times, all_exact, strict=True):
        if last is None or not slab.shares_parameters(last):
            carry, last = slab.over_parameters(reference.points.T), slab
        values = slab.on_grid(times, carry)
        errors = np.maximum(errors, np.abs(values - exact).max(axis=2))
        at_corners = np.abs(exact[:, 1 : 1 + corners]).max(axis=(1, 2), initial=0.0)
        largest = np.maximum(largest, at_corners)
    errors = np.where(np.isfinite(errors), errors, np.inf)[:seen]
    largest, scale = largest[:seen], scale[:seen]
    errors[:, 1 : 1 + corners] /= largest[:, None]
    errors[:, 0] /= scale
    errors[:, 1 + corners :] /= scale[:, None]
    at_corners = errors[:, 1 : 1 + corners].max(axis=1, initial=0.0)
    counted = np.ones(m, dtype=bool)
    counted[1 : 1 + corners] = whole_box
    of_points = errors[slice(None) if states is None else list(states)][:, counted].max(axis=0)
    return Measured(
        interior=tuple(errors[:, counted].max(axis=1).tolist()),
        corners=tuple(at_corners.tolist()) if corners else (),
        points=m,
        method="Radau" if reference.stiff else "DOP853",
        cover="box" if whole_box else "interior",
        quantile=float(np.quantile(of_points, 0.95, method="higher")),
        worst=tuple(reference.points[counted][np.argmax(of_points)].tolist()),
        counted=states,
    )
