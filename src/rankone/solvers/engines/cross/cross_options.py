"""Options and constants of the cross engine, and what its next attempt costs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

from rankone.solvers.attempts import LEAST_COST_RATIO
from rankone.solvers.outcome import SlabRecord
from rankone.support.options import Options, choice, integer
from rankone.support.tasks import ExecutorLike, checked_executor
from rankone.tensors.bases import BASES
from rankone.tensors.bases.basis import nodes_for
from rankone.tensors.trains.adaptive import Tightening


@dataclass(frozen=True)
class CrossTuning:
    """Tuning of the cross engine, measured over the reference problems.

    ``tests/benchmarks/attempts.py`` shows what the shares of the error and the tightness cost or
    gain.
    """

    integration_share: float = 0.3
    """Error of the integration, over the level: interpolation needs room."""
    highest_time_modes_share: float = 0.2
    """Size of the highest modes in time, relative to the level, above which slabs are
    halved."""
    known_functions_share: float = 0.1
    """What an element may miss of the known functions of its parameter, or a line of its
    column, relative to the level."""
    known_node_ratios: tuple[float, ...] = (1.5, 2.5, 4.0)
    """Nodes of one element, over those of the lines, tried for known functions before
    elements."""
    line_node_ratio: float = 1.5
    """Nodes of lines that show what an attempt missed, or predict a narrower box, over those of
    the attempt or of smooth functions."""
    max_stalls: int = 5
    """Attempts in a row that may stall as long as attempts are cheap."""
    max_costly_stalls: int = 2
    """Attempts in a row that may stall afterwards."""
    cheap_trajectories: int = 80_000
    """Trajectories in all up to which attempts are cheap: seconds for small systems."""
    untightened_ratio: int = 3
    """Below this many times the cheap trajectories, tolerances that were never tightened are
    tightened once, even if the error did not fall."""
    fast_error_ratio: float = 0.2
    """A costly attempt with an error far from the goal must have lowered it to this part."""
    worst_points: int = 12
    """Latest worst points, near which left points are."""
    lines_budget_share: float = 0.01
    """Part of the budget that lines through worst points may take where an attempt takes
    less."""
    lines_fraction: float = 0.1
    """Part of an attempt that the lines take on which nodes are chosen."""
    reported_fraction: float = 0.005
    """Smallest change of the fraction that is reported."""
    first_tightness: float = 0.3
    """First tolerance of the integration over the error allowed."""
    first_marked_tightness: float = 0.01
    """The same over stretches between markers, whose times add up."""
    first_marked_level: float = 0.7
    """Level of the first attempt between markers, over the tolerance: a second one costs as
    much again."""
    absolute_tolerance_ratio: float = 1e-5
    """Absolute tolerance in units of each state's size, over the relative tolerance."""
    calibration_points: int = 8
    """Reference points at which the error of the integration is measured."""
    max_calibrations: int = 3
    """How often the error of the integration is measured."""
    reference_error_ratio: float = 0.5
    """An error that keeps this part with a smaller tolerance is that of the reference."""
    least_error_ratio: float = 0.1
    """Errors below this part of the error allowed waste work: the tolerance grows."""
    aimed_error_ratio: float = 0.5
    """Error aimed at when the tolerance is changed, over the error allowed, and tolerance of
    stiff integrations, whose error is not measured."""
    largest_tightness_factor: float = 4.0
    """Largest factor on the tolerance from one calibration to the next."""
    smallest_tightness_factor: float = 1e-3
    """Smallest one: an error that is not finite must not end all calibrations."""
    explicit_step_limit: int = 400
    """This many explicit steps cost less than the implicit steps that would replace them."""
    least_sample_ratio: float = 0.6
    """Work of a trajectory over that of the cheapest so far, at least: what cannot be paid is
    not begun."""
    min_stack: int = 32
    """Fewest trajectories integrated together: calls of NumPy dominate below."""
    max_stack: int = 1500
    """Most trajectories integrated together by explicit steps."""
    max_stiff_stack: int = 300
    """Most trajectories integrated together by implicit steps: each has its own Jacobian."""
    max_user_stack: int = 64
    """Most trajectories integrated together with functions of the user, which may be slow."""
    stack_states: int = 15_000
    """States of a stack that fits the cache."""
    held_numbers: int = 2**24
    """Numbers of sampled trajectories that are held before they are compressed."""
    line_places: int = 65
    """Places on a line through the box where trajectories are compared."""
    zoom_places: int = line_places // 4 + 1
    """Places between two neighbours on a line at a closer look: fewer need one look more for a
    jump, and a stack of as few costs as much."""
    max_zooms: int = 4
    """Pairs of neighbours on a line that are looked at closer."""
    front_change: float = 0.1
    """Change of a state, in units of its size, that makes a front."""
    kept_change: float = 0.5
    """Part of the change that a narrower piece must hold to be looked at instead."""
    front_width: float = 0.01
    """Largest width of a front, relative to the interval."""
    jump_width: float = 1e-6
    """Largest width of a jump, relative to the interval."""
    more_nodes: int = 2
    """Nodes of a line over those that did not resolve it."""
    explaining_share: float = 0.3
    """Sum of the modes that an attempt left out, over its error, that explains the error."""
    full_rank: float = 0.5
    """Rank over the largest one for its nodes from which it is that of a front, and grows with
    them."""


TUNING = CrossTuning()
# Power below one: there are more nodes and left points as well
TIGHTENING = Tightening(settled_growth=1.2, power=0.7, smallest=0.1, largest=0.5)


@dataclass(frozen=True, kw_only=True)
class CrossOptions(Options):
    """Limits and discretisation of ``method="cross"``.

    Attributes
    ----------
    basis : {"chebyshev", "legendre"}
        Nodal basis of each parameter.
    time_nodes : int or None
        Gauss nodes per slab; None chooses by the tolerance.
    max_rank : int
        Largest rank of the train.
    max_nodes : int
        Largest number of nodes in one parameter.
    max_slabs : int
        Largest number of slabs on which the reference is resolved.
    max_trajectories : int
        Largest number of trajectories integrated in all.
    max_attempts : int or None
        How often the interpolation may be repeated with more nodes or points;
        None: 10 times, and more while that pays.
    executor : concurrent.futures.Executor, distributed.Client, str, int or None
        Executor, or client of dask, that integrates trajectories, which is left running; the
        address of a scheduler of dask, or a number of processes. Solutions are the same to the bit.
    """

    basis: str = choice("chebyshev", BASES)
    time_nodes: int | None = integer(None, 4, 40)
    max_rank: int = integer(400)
    max_nodes: int = integer(1000, 4)
    max_slabs: int = integer(2000)
    max_trajectories: int = integer(4_000_000)
    max_attempts: int | None = integer(None)
    executor: ExecutorLike | None = field(default=None, metadata={"check": checked_executor})

    def nodes_in_time(self, rtol: float) -> int:
        """Gauss nodes per slab: more for tighter tolerances."""
        if self.time_nodes is not None:
            return self.time_nodes
        return min(max(nodes_for(rtol, 5.6), 7), 20)


@dataclass(frozen=True, slots=True)
class CrossRecord(SlabRecord):
    """One interpolation over the whole horizon.

    ``tolerance`` is that of the skeletons, ``residuals`` holds for each parameter the size of its
    two highest modes, both in units of the states' sizes.

    Attributes
    ----------
    trajectories : int
        Number of trajectories integrated so far.
    slabs : int
        Number of time slabs.
    """

    trajectories: int = 0
    slabs: int = 1


# -----------------------------------------------------------------------------
# What the next attempt costs at least, from the nodes and the ranks of the last one.


@dataclass(frozen=True)
class AttemptCost:
    """An attempt with some ``nodes`` of the parameters: its ranks, trajectories and work."""

    nodes: Sequence[int]
    ranks: Sequence[int]
    trajectories: int
    work: float

    def least(self, nodes: Sequence[int]) -> float:
        """Least work of the next attempt, which has other nodes."""
        return LEAST_COST_RATIO * self._least_ratio(nodes) * self.work

    def _least_ratio(self, nodes: Sequence[int]) -> float:
        """Trajectories of the next attempt over those of this one, at least.

        At the first bond they are as many as nodes times the rank behind it. Later bonds have left
        points as well, at least as many as before: of their ratios the least counts.
        """
        behind, ratios = [*self.ranks[1:], 1], list[float]()
        for b, rank in enumerate(behind):
            before, after = math.prod(self.nodes[b + 1 :]), math.prod(nodes[b + 1 :])
            grows = rank >= TUNING.full_rank * before
            factor = max(after / before, 1.0) if grows else 1.0
            ratios.append(nodes[b] / self.nodes[b] * factor)
        first = min(self.nodes[0] * behind[0] / max(self.trajectories, 1), 1.0)
        return first * ratios[0] + (1.0 - first) * min(ratios[1:], default=ratios[0])
