"""Where paths cross the roots of functions: all of a stack at once."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from rankone.support.arrays import COARSE, MINOR, NEGLIGIBLE, TINY, Array
from rankone.support.budget import charge
from rankone.support.costs import CALL, function_cost
from rankone.trajectories.events.event_trajectory import (
    LOOK_COST,
    SAME_INSTANT,
    heights_of,
    roundings_of,
)
from rankone.trajectories.integrators.defects import roots_or_jumps
from rankone.trajectories.integrators.integrator import BLOCK, NODES, Path, step_coefficients
from rankone.trajectories.system.features import BOTH, SystemEvent
from rankone.trajectories.system.system import System


@dataclass(frozen=True)
class _Look:
    """Where on a step an event may hide, and what counts as rounding."""

    slope_step: float
    crossing: float
    on_surface: float
    most_divisions: int
    newton_steps: int
    at_end: float
    unresolved: float
    near: float
    grazing: float
    low: float
    stays: float


_LOOK = _Look(
    slope_step=1e-7,  # Step of a difference in time, relative to times and steps
    crossing=COARSE,  # Slope where a path begins, over the mean one, from which it crosses
    on_surface=MINOR,  # Height where a path begins, over its change to the next node: rounding
    most_divisions=12,  # Most divisions of a step in which an event may hide
    newton_steps=4,  # Iterations to where a polynomial is nearest to zero
    at_end=1e-4,  # Distance from an end of a step, as a share, that is the end
    unresolved=COARSE,  # Error of a polynomial between nodes, over its size, that may hide a root
    near=4.0,  # Distance from zero, in such errors, within which there may be one
    grazing=0.05,  # Least distance from zero inside of a step, over its size, that may hide two
    low=0.5,  # Least value on a step, over its size, above which it comes nowhere near zero
    stays=COARSE,  # Part of the horizon for which heights are rounding, from which paths stay there
)
_BETWEEN = 0.5 * (NODES[:-1] + NODES[1:])
_FINE = np.linspace(0.0, 1.0, 25)


# From values at the nodes of a step to the coefficients of the powers of shares
_TO_COEFFICIENTS = np.linalg.inv(np.vander(NODES, increasing=True))


def _interpolation(shares: Array) -> Array:
    """From values at the nodes of a step to those of the polynomial at shares, (..., nodes)."""
    powers = (2.0 * shares - 1.0)[..., None] ** np.arange(NODES.size)
    return np.asarray(powers @ step_coefficients(np.eye(NODES.size)[None])[:, 0])


def _read(weights: Array, nodal: Array) -> Array:
    """States of steps (S, nodes, n) by weights (..., nodes); those that rest keep every bit."""
    first = nodal[:, :1]
    return np.asarray(first + np.matmul(weights, nodal - first))


_TO_BETWEEN, _TO_FINE = _interpolation(_BETWEEN), _interpolation(_FINE)
_TO_START_SLOPE = _TO_COEFFICIENTS[1]


@dataclass(frozen=True)
class _Steps:
    """Steps of several paths, in order.

    They ``begin`` and ``end`` at times (S,), with states (S, nodes, n) at the nodes; ``owner`` (S,)
    is the path of each, and ``parameters`` (d, S) are its own.
    """

    begin: Array
    end: Array
    nodal: Array
    parameters: Array
    owner: NDArray[np.intp]

    @classmethod
    def of(cls, paths: Sequence[Path], points: Array) -> _Steps:
        """All steps of paths, each at its own point of points (m, d)."""
        owner = np.repeat(np.arange(len(paths)), [path.steps for path in paths])
        return cls(
            np.concatenate([path.breaks[:-1] for path in paths]),
            np.concatenate([path.breaks[1:] for path in paths]),
            np.concatenate([path.nodal for path in paths]),
            np.ascontiguousarray(points.T)[:, owner],
            owner,
        )

    def heights(self, event: SystemEvent, shares: Array, nodal: Array) -> Array:
        """What crosses zero (S, shares), from the states (S, shares, n) there."""
        if (marker := event.marker) is not None:
            charge(CALL + LOOK_COST * nodal[:, :, 0].size)
            return np.asarray(nodal[:, :, marker.state] - marker.level)
        times = (self.begin[:, None] + (self.end - self.begin)[:, None] * shares).ravel()
        parameters = np.repeat(self.parameters, shares.size, axis=1)
        states = nodal.reshape(times.size, -1).T
        return heights_of(event, times, states, parameters).reshape(-1, shares.size)

    def telling(self, event: SystemEvent) -> _Steps:
        """The first step of each path, and all others on which an event may take place.

        Not one whose state stays on one side of the level of a marker, and far enough from it: what
        is resolved there crosses nothing, and is never divided.
        """
        if (marker := event.marker) is None:
            return self
        charge(CALL + LOOK_COST * self.nodal[:, :, 0].size)
        heights = np.ascontiguousarray(self.nodal[:, :, marker.state].T) - marker.level
        lowest, highest = heights.min(axis=0), heights.max(axis=0)
        far = (lowest > 0.0) & (lowest > _LOOK.low * highest)
        far |= (highest < 0.0) & (highest < _LOOK.low * lowest)
        far &= np.diff(self.owner, prepend=-1) == 0
        return self._chosen(np.flatnonzero(~far))

    def _stays(self, event: SystemEvent, at_nodes: Array, least: float) -> NDArray[np.bool_]:
        """Steps (S,) on which paths stay on the surface, for a ``least`` time.

        Heights (S, nodes) are what rounding makes of them there. What leaves a surface smoothly is
        there for less.
        """
        stays = np.zeros(self.begin.size, dtype=bool)
        if event.marker is not None:
            return stays
        roundings = self._roundings(event, at_nodes[:, 0])
        near = np.flatnonzero(np.abs(at_nodes).max(axis=1) <= roundings)
        if not near.size:
            return stays
        some = self._chosen(near)
        between = some.heights(event, _BETWEEN, _read(_TO_BETWEEN, some.nodal))
        near = near[np.abs(between).max(axis=1) <= roundings[near]]
        apart = (np.diff(self.owner[near]) != 0) | (self.begin[near][1:] != self.end[near][:-1])
        runs = np.split(near, 1 + np.flatnonzero(apart))
        for run in runs:
            if run.size and self.end[run[-1]] - self.begin[run[0]] >= least:
                stays[run] = True
        return stays

    def _roundings(self, event: SystemEvent, heights: Array) -> Array:
        """What of heights (S,) where steps begin is rounding, (S,)."""
        sizes = np.abs(self.nodal).max(axis=1).T
        return roundings_of(event, self.begin, self.nodal[:, 0].T, self.parameters, sizes, heights)

    def resolved(self, event: SystemEvent, least: float) -> tuple[_Steps, Array]:
        """Steps divided until polynomials resolve what crosses zero, where it may do so.

        What crosses zero is given at their nodes, (S, nodes); it is zero where a path stays there
        for a ``least`` time.
        """
        steps, done, stayed = self, list[tuple[_Steps, Array]](), False
        for divisions in range(_LOOK.most_divisions + 1):
            at_nodes = steps.heights(event, NODES, steps.nodal)
            with np.errstate(all="ignore"):  # what is not a number is no crossing
                stays = steps._stays(event, at_nodes, least)
                at_nodes[stays] = 0.0
                shares = steps._shares_to_divide(event, at_nodes)
            stayed |= bool(stays.any())
            hides = np.isfinite(shares) & ~stays
            if divisions == _LOOK.most_divisions or not hides.any():
                break
            if not hides.all():
                done.append((steps._chosen(~hides), at_nodes[~hides]))
            steps = steps._chosen(hides)._divided(shares[hides])
        steps, at_nodes = _in_order([*done, (steps, at_nodes)])
        if stayed:  # short parts beside others as well
            stays = steps._stays(event, at_nodes, least)
            roundings = steps._roundings(event, at_nodes[:, 0])[:, None]
            rounded = steps._besides(stays)[:, None] & (np.abs(at_nodes) <= roundings)
            at_nodes[stays[:, None] | rounded] = 0.0
        return steps, at_nodes

    def _besides(self, some: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Steps that some of them are before or after, on the same path."""
        same = np.diff(self.owner) == 0
        besides = np.zeros_like(some)
        besides[1:] |= some[:-1] & same
        besides[:-1] |= some[1:] & same
        return besides

    def _shares_to_divide(self, event: SystemEvent, at_nodes: Array) -> Array:
        """Where to divide steps in which what crosses zero may do so unseen, (S,), NaN elsewhere.

        That is where it comes nearest to zero, or in the middle if polynomials do not resolve it.
        """
        sizes = np.abs(at_nodes)
        if event.marker is not None:  # one of the polynomials
            largest, least = sizes.max(axis=1), sizes.min(axis=1)
            unresolved = np.zeros(largest.size, dtype=bool)
        else:
            between = self.heights(event, _BETWEEN, _read(_TO_BETWEEN, self.nodal))
            missed = np.abs(between - at_nodes @ _TO_BETWEEN.T).max(axis=1)
            sizes = np.concatenate([sizes, np.abs(between)], axis=1)
            largest, least = sizes.max(axis=1), sizes.min(axis=1)
            unresolved = (missed > _LOOK.unresolved * largest) & (least <= _LOOK.near * missed)
        # a crossing soon after a start on the surface, such as that of a small bounce
        on_surface = np.abs(at_nodes[:, 0]) <= _LOOK.on_surface * np.abs(
            at_nodes[:, 1] - at_nodes[:, 0]
        )
        turned = np.sign(at_nodes @ _TO_START_SLOPE) * at_nodes[:, 1] < 0.0
        shares = np.where(unresolved | (on_surface & turned), 0.5, np.nan)
        same = (np.sign(at_nodes) == np.sign(at_nodes[:, :1])).all(axis=1)
        near = np.flatnonzero(same & (least <= _LOOK.low * largest) & np.isnan(shares))
        nearest, height = _nearest_to_zero(at_nodes[near] * np.sign(at_nodes[near, :1]))
        inside = (nearest > _LOOK.at_end) & (nearest < 1.0 - _LOOK.at_end)
        grazes = inside & (height < _LOOK.grazing * largest[near])
        shares[near[grazes]] = nearest[grazes]
        return np.asarray(shares)

    def _chosen(self, chosen: NDArray[np.bool_] | NDArray[np.intp]) -> _Steps:
        """Some of the steps."""
        begin, end, nodal = self.begin[chosen], self.end[chosen], self.nodal[chosen]
        return _Steps(begin, end, nodal, self.parameters[:, chosen], self.owner[chosen])

    def _divided(self, shares: Array) -> _Steps:
        """Both parts of all steps, divided at shares (S,) of their lengths."""
        divided = self._chosen(np.repeat(np.arange(self.begin.size), 2))
        border = self.begin + shares * (self.end - self.begin)
        divided.end[::2] = divided.begin[1::2] = border
        before, after = shares[:, None] * NODES, shares[:, None] + (1.0 - shares[:, None]) * NODES
        divided.nodal[::2] = _read(_interpolation(before), self.nodal)
        divided.nodal[1::2] = _read(_interpolation(after), self.nodal)
        return divided


def _nearest_to_zero(heights: Array) -> tuple[Array, Array]:
    """Shares of steps where polynomials of positive ``heights`` (S, nodes) are least, and how much.

    By Newton's method from the least of many values.
    """
    powers = heights @ _TO_COEFFICIENTS.T
    slopes = powers[:, 1:] * np.arange(1.0, NODES.size)
    bends = slopes[:, 1:] * np.arange(1.0, NODES.size - 1)
    share = _FINE[(heights @ _TO_FINE.T).argmin(axis=1)]
    for _ in range(_LOOK.newton_steps):
        slope, bend = (_polynomial(each, share) for each in (slopes, bends))
        step = np.divide(slope, bend, out=np.zeros_like(slope), where=bend > 0.0)
        share = np.clip(share - np.clip(step, -_FINE[1], _FINE[1]), 0.0, 1.0)
    return share, _polynomial(powers, share)


def _polynomial(coefficients: Array, share: Array) -> Array:
    """Polynomials with coefficients (S, powers) at shares (S,)."""
    return np.asarray(
        (coefficients * share[:, None] ** np.arange(coefficients.shape[1])).sum(axis=1)
    )


def _in_order(parts: Sequence[tuple[_Steps, Array]]) -> tuple[_Steps, Array]:
    """Steps, and what there is for each of them, path by path."""
    if len(parts) == 1:
        return parts[0]
    steps = [each for each, _ in parts]
    together = _Steps(
        np.concatenate([each.begin for each in steps]),
        np.concatenate([each.end for each in steps]),
        np.concatenate([each.nodal for each in steps]),
        np.concatenate([each.parameters for each in steps], axis=1),
        np.concatenate([each.owner for each in steps]),
    )
    order = np.lexsort((together.begin, together.owner))
    return together._chosen(order), np.concatenate([heights for _, heights in parts])[order]


@dataclass(frozen=True, eq=False)
class Crossings:
    """The crossings of events on paths, each at its own point (d,) of points (m, d).

    Every path has made a step. ``fired`` are for each of them the events at its very start, and
    how often they came there. ``landed`` are those on whose surface it
    was put there, each with the side that it came from, or 0 for none. Times within an ``instant``
    are the same.
    """

    system: System
    paths: Sequence[Path]
    points: Array
    fired: Sequence[Mapping[int, int]]
    instant: float
    landed: Sequence[Mapping[int, float]] = ()

    def of(self, k: int, event: SystemEvent) -> list[Array]:
        """For each path the times of event ``k``, in order; the first alone if it interrupts."""
        return [times for block in self._blocks for times in block._together(k, event)]

    @cached_property
    def _blocks(self) -> list[Crossings]:
        """Paths that are looked at together: few, since much of what is read is read once."""
        steps = np.cumsum([path.steps for path in self.paths])
        borders = np.searchsorted(steps, np.arange(0, steps[-1], BLOCK)).tolist()
        return [
            replace(
                self,
                paths=self.paths[a:b],
                points=self.points[a:b],
                fired=self.fired[a:b],
                landed=self.landed[a:b],
            )
            for a, b in itertools.pairwise([*sorted(set(borders)), len(self.paths)])
        ]

    @cached_property
    def _steps(self) -> _Steps:
        return _Steps.of(self.paths, self.points)

    def _together(self, k: int, event: SystemEvent) -> list[Array]:
        """The times of event ``k`` on all paths.

        A trajectory that begins at the event is on its surface except for rounding. It is there
        again at once if it was reset, goes on to the same side as before, and does not cross the
        surface on its way: a ball that comes to rest falls again.
        """
        horizon = self.instant / SAME_INSTANT
        steps, heights = self._steps.telling(event).resolved(event, _LOOK.stays * horizon)
        _keep_sides(steps, heights)
        instants = [steps.begin[:0]] * len(self.paths)
        firsts = np.searchsorted(steps.owner, np.arange(len(self.paths)))
        was_here = np.array([k in fired for fired in self.fired])
        for start, path, landed in zip(firsts, range(len(was_here)), self.landed, strict=False):
            side = landed.get(k)
            if side is None or (was_here[path] and (event.switch or not side)):
                continue
            was_here[path] = False
            # rates switch where they do not let it stay on the positive side
            heights[start, 0] = TINY * (1.0 if event.switch else side)
        began = firsts[was_here]
        if event.then is None:  # nothing but rounding moved it away
            since = steps.end - steps.begin[firsts][steps.owner]
            heights[was_here[steps.owner] & (since <= self.instant)] = 0.0
        # a reset may have moved the state away from the surface
        moved = np.abs(heights[began, 1] - heights[began, 0])
        on_surface = np.abs(heights[began, 0]) <= _LOOK.on_surface * moved
        on_surface |= self._settled(event, steps, heights, began)
        began = began[on_surface]
        if began.size:
            heights[began, 0] = heights[began, 1]
            sides = np.sign(heights[began, 0])
            back = began[(sides == event.direction) & (sides != 0.0)]
            if event.then is not None and back.size:
                first = np.array([self.fired[path][k] == 1 for path in steps.owner[back]])
                through = first & self._crosses(event, steps, back)
                for start in back[~through]:
                    instants[steps.owner[start]] = steps.begin[start : start + 1]
        if event.switch:  # on a side that rates have left, or do not let it stay on
            left = (heights[firsts, :2] < 0.0).all(axis=1)
            left &= ~(was_here & _arrives(steps, heights))
            for start in firsts[left]:
                instants[steps.owner[start]] = steps.begin[start : start + 1]
        before, after = np.sign(heights[:, :-1]), np.sign(heights[:, 1:])
        # not a number is no side
        crossed = (before != after) & (before != 0.0) & np.isfinite(before) & np.isfinite(after)
        if event.direction != BOTH:
            crossed &= before == -event.direction
        rows, nodes = np.nonzero(crossed)
        owners = steps.owner[rows]
        if event.interrupts:
            owners, chosen = np.unique(owners, return_index=True)
            rows, nodes = rows[chosen], nodes[chosen]
        fresh = np.array([not instants[owner].size for owner in owners], dtype=bool)
        rows, nodes, owners = rows[fresh], nodes[fresh], owners[fresh]
        if not rows.size:
            return instants
        times = _roots(event, steps, rows, nodes, heights)
        for owner in np.unique(owners):
            instants[owner] = times[owners == owner]
        return instants

    def _settled(
        self, event: SystemEvent, steps: _Steps, heights: Array, starts: NDArray[np.intp]
    ) -> NDArray[np.bool_]:
        """Whether paths begin on the surface but for rounding, where their first step was divided.

        Their heights up to the first place beyond rounding are those there then: a slip that has
        just begun does not return at once. ``starts`` are the first steps of some paths.
        """
        ends = np.array([path.breaks[1] for path in self.paths])
        settled = steps.end[starts] < ends[steps.owner[starts]]
        if not settled.any():
            return settled
        some = starts[settled]
        roundings = steps._chosen(some)._roundings(event, heights[some, 0])
        settled[settled] = np.abs(heights[some, 0]) <= roundings
        for start, rounding in zip(some.tolist(), roundings.tolist(), strict=True):
            behind = np.searchsorted(steps.owner, steps.owner[start], side="right")
            own = heights[start:behind].reshape(-1)
            beyond = np.flatnonzero(np.abs(own) > rounding)
            if abs(own[0]) <= rounding and beyond.size:
                own[: beyond[0]] = own[beyond[0]]
        return settled

    def _crosses(
        self, event: SystemEvent, steps: _Steps, starts: NDArray[np.intp]
    ) -> NDArray[np.bool_]:
        """Whether paths cross the surface in the direction of the event where they begin."""
        t, p = steps.begin[starts], steps.parameters[:, starts]
        u, next_u = (steps.nodal[starts, node].T for node in (0, 1))
        with np.errstate(all="ignore"):
            rates = np.broadcast_to(self.system.rhs(t, u, p), u.shape)
        charge(function_cost(self.system.rhs, self.system.user_functions)(starts.size))
        length = NODES[1] * (steps.end[starts] - t)
        step = _LOOK.slope_step * np.maximum(length, np.abs(t))
        rise = heights_of(event, t + step, u + step * rates, p) - heights_of(event, t, u, p)
        mean = heights_of(event, t + length, next_u, p) / length
        return np.asarray(event.direction * rise / step > _LOOK.crossing * np.abs(mean))


def _keep_sides(steps: _Steps, heights: Array) -> None:
    """Let paths be on the side they came from while they stay on a surface: heights (S, nodes).

    They cross it where they leave it for the other side. Where they begin on it they have no side.
    """
    flat = (heights == 0.0).all(axis=1)
    if not flat.any():
        return
    on_surface = (flat | steps._besides(flat))[:, None] & (heights == 0.0)
    owners = np.repeat(steps.owner, NODES.size)
    last = np.maximum.accumulate(np.where(on_surface.ravel(), -1, np.arange(owners.size)))
    came = (last >= 0) & (owners[last] == owners)
    sides = np.where(came, np.sign(heights.ravel()[last]), 0.0).reshape(heights.shape)
    heights[on_surface] = TINY * sides[on_surface]


def _arrives(steps: _Steps, heights: Array) -> NDArray[np.bool_]:
    """Which paths begin on a surface but for rounding, and go on to where heights are positive.

    So do those whose first height (S, nodes) beyond rounding is positive, or which rise from where
    the first one is rounding.
    """
    firsts = np.flatnonzero(np.diff(steps.owner, prepend=-1))
    largest = np.maximum.reduceat(np.abs(heights).max(axis=1), firsts)
    rows, nodes = np.nonzero(np.abs(heights) > NEGLIGIBLE * largest[steps.owner][:, None])
    owners, places = np.unique(steps.owner[rows], return_index=True)
    beyond = np.zeros(firsts.size)
    beyond[owners] = heights[rows[places], nodes[places]]
    first, second = heights[firsts, :2].T
    rises = (np.abs(first) <= NEGLIGIBLE * largest) & (second >= first)
    return np.asarray(rises | (beyond >= 0.0))


def _roots(
    event: SystemEvent,
    steps: _Steps,
    rows: NDArray[np.intp],
    nodes: NDArray[np.intp],
    heights: Array,
) -> Array:
    """The roots between nodes of steps and the next ones."""
    begin, length = steps.begin[rows], (steps.end - steps.begin)[rows]
    a, width = NODES[nodes], NODES[nodes + 1] - NODES[nodes]
    coefficients, parameters = step_coefficients(steps.nodal[rows]), steps.parameters[:, rows]

    def height(shares: Array) -> Array:
        places = a + width * shares
        x = (2.0 * places - 1.0)[:, None]
        states = coefficients[-1]
        for coefficient in coefficients[-2::-1]:
            states = states * x + coefficient
        return heights_of(event, begin + length * places, states.T, parameters)

    before = heights[rows, nodes]
    shares = roots_or_jumps(height, before, heights[rows, nodes + 1])
    shares[np.abs(before) == TINY] = 0.0
    return np.asarray(begin + length * (a + width * shares))
