"""Tuning of a solve: attempts, ways, branches, markers, and what explains a failure."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class SolveTuning:
    """Tuning of a solve: attempts, ways, branches, markers, and what explains a failure."""

    # attempts
    paid_reference_share: float = 0.5
    """Part of the work of the reference that does not count against patience."""
    unexplained_error: float = 1e4
    """Error over the highest modes from which the modes do not explain it."""
    unfinished_work_share: float = 0.5
    """Work of an attempt that came to no end, over what was spent on it."""
    # selection
    train_parameters: int = 1
    """Most parameters for which train comes first: it is as fast as cross there, and more exact.
    Where trajectories have sparse factors, cross takes a quarter to three quarters of its time."""
    train_operations: float = 2e9
    """Most operations of train if cross follows: a system that suits train needs fewer."""
    train_share: float = 0.4
    """Largest share of the budget for train if cross follows."""
    cross_share: float = 0.78
    """Share of the budget for cross if train follows: most systems need no second engine, which has
    the reference of the first."""
    least_remedy_share: float = 0.06
    """Share of the budget that remedies may take where the solve itself took less."""
    # ways
    loose_rtol: float = 1e-3
    """Tolerance from which on kinks cost less as they are than stretches between them."""
    most_more_events: int = 2
    """Most events before the end that some trajectories meet, beyond those that the first ones
    met."""
    # march
    first_left_points: int = 9
    """Random left points of the first attempt; each further attempt doubles them."""
    initial_rank: int = 200
    """Largest rank: initial values and states after jumps are smooth functions."""
    initial_tolerance: float = 1e-13
    """Error of initial values, in their sizes: far below that of any solve."""
    trial_nodes: int = 256
    """Random nodes at which the interpolation is compared with exact values."""
    trial_factor: float = 30.0
    """An error at a trial node above this many tolerances needs more left points."""
    worst_trial_nodes: int = 16
    """Trial nodes with the largest errors that become left points."""
    initial_attempts: int = 5
    """Most attempts: the last one has 144 random left points."""
    # stretches_by_markers
    order_pilots: int = 16
    """Trajectories, besides corners, that tell the order of events."""
    order_pilot_rtol: float = 1e-6
    """Their relative tolerance."""
    pilot_floor: float = 1e-6
    """Size of a state, over its largest, below which accuracy is absolute."""
    first_look_operations: float = 2e8
    """Operations of a reference over clock time above which pilots tell whether markers pay, since
    trajectories that are out of phase take many common steps."""
    marker_pilot_rtol: float = 1e-4
    """Relative tolerance of the pilots."""
    pilot_shares: tuple[float, ...] = (0.15, 0.4, 1.0)
    """Parts of the horizon after which they may be enough."""
    marked_share: float = 0.3
    """Part of the budget that a reference over stretches may take where one over clock time is
    there: its samples take several times as much."""
    late_share: float = 0.1
    """Part of the budget in which a front after the horizon is looked for."""
    path_copies: int = 3
    """Copies of the paths of trajectories while crossings are looked for: one by one, together,
    crossing."""
    # branches
    order_points: int = 256
    """Trajectories that tell the orders."""
    most_solves: int = 4
    """Solves of all branches: the check may meet further orders, or ask for accuracy."""
    branch_share: float = 0.08
    """Share of the budget for one branch: where more is asked for, it is not smooth."""
    branch_tolerances: tuple[float, ...] = (0.4, 0.1)
    """Tolerances of the branches over that of the solve."""
    branch_floor: float = 1e-3
    """Size of a state, over that at the start, below which accuracy is absolute."""
    branch_inset: float = 1e-4
    """Distance of points from the faces of the box, in widths."""
    # branching
    most_branches: int = 16
    """Most orders of events that are solved, each as a branch."""
    most_grazed: float = 0.03
    """Share of the trajectories, about, with an order that cannot be continued."""
    same_time: float = 0.1
    """Difference of lengths of stretches that end at once, in horizons, over rtol."""
    same_root: float = 1e-3
    """Most that stretches differ which end at one root, in horizons."""
    # remedies
    narrowing_aim: float = 0.3
    """Error aimed at, over the tolerance."""
    narrowing_safety: float = 0.7
    """Factor on a part of an interval: predictions are of one parameter at a time."""
    least_part: float = 0.05
    """Width of a part with one order, over that of the box, below which it is of no use."""
    least_narrowing: float = 0.03
    """Parts of an interval below this share are of no use: too far from the whole."""
    largest_narrowing: float = 0.8
    """Largest part, before the safety, where the work of an attempt was small."""
    narrowing_step: float = 0.9
    """Factor on the part of the costliest parameter, until the work is affordable."""
    affordable_share: float = 0.24
    """Work of one attempt over the budget: a reference comes before it, and a second attempt takes
    twice as much."""
    slowest_decay: float = 0.97
    """Largest ratio of successive modes: slower decay looks like none."""
    fastest_decay: float = 0.1
    """Smallest ratio of successive modes: rounding errors hide faster decay."""
    rank_share: float = 0.5
    """Ranks over the largest possible ones for the nodes on either side."""
    element_growth: float = 2.0
    """Factor on the nodes of elements whose modes have not fallen."""
    box_digits: int = 2
    """Significant digits of the ends that are told."""
    part_step: float = 0.02
    """Of a face, outwards, over the width of the whole box."""
    part_inset: float = 0.1
    """Distance of the faces that are told from points of other orders, over the part."""
    part_points: int = 48
    """Trajectories inside of a part that have to be of one order as well."""
    part_rounds: int = 4
    """Parts that are tried: each leaves out what the check of the one before met."""
    least_units: float = 20.0
    """Units of the last digit in an interval that is told, at least."""
    part_search_share: float = 0.1
    """Of what is left of the budget, for the search for a part."""
    worst_offered: float = 0.02
    """Largest error of a solution that is offered."""
    offered_margin: float = 1.5
    """A looser tolerance over the error that was measured, at least."""
    looser_rtol: float = 1e-2
    """Tolerance that is tried where no attempt meets a tighter one."""
    remedy_share: float = 0.5
    """Part of what is left that goes into one kind of remedy if others follow."""
    box_trial_share: float = 0.25
    """Part of that which one box may take."""
    first_ends: tuple[float, ...] = (1 / 64, 1 / 512)
    """Parts of the horizon, in turn up to a success."""
    later_ends: tuple[float, ...] = (2, 4, 8, 16, 32, 48)
    """Times this part, in turn up to a failure."""
    end_digits: int = 3
    """Significant digits of an end."""
    shrunk_parts: tuple[float, ...] = (1.0, 0.5, 0.25)
    """Parts of predicted intervals, around their middles."""
    front_distances: tuple[float, ...] = (0.35, 0.65)
    """Distances from a front, over the interval beside it."""
    front_surroundings: float = 0.15
    """Distance from a front's other parameters, over their intervals, if it moves."""


SOLVE = SolveTuning()
