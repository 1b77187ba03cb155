"""Tuning of a solve and of its check: attempts, ways, branches, points and references."""

from __future__ import annotations

from dataclasses import dataclass

from rankone.support.arrays import (
    ACCUMULATED,
    COARSE,
    COINCIDENT,
    DIFFERENCE,
    EPSILON,
    LEAST,
    LEAST_SQUARED,
    MINOR,
    NEGLIGIBLE,
    RESOLVED,
    ROUNDING,
)
from rankone.support.budget import WAITING
from rankone.support.options import RTOL


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
    train_operations: float = WAITING
    """Most operations of train if cross follows: a system that suits train needs fewer."""
    train_share: float = 0.4
    """Largest share of the budget for train if cross follows."""
    cross_share: float = 0.78
    """Share of the budget for cross if train follows: most systems need no second engine, which has
    the reference of the first."""
    least_remedy_share: float = 0.06
    """Share of the budget that remedies may take where the solve itself took less."""
    # ways
    loose_rtol: float = COARSE
    """Tolerance from which on kinks cost less as they are than stretches between them."""
    most_more_events: int = 2
    """Most events before the end that some trajectories meet, beyond those that the first ones
    met."""
    # march
    first_left_points: int = 9
    """Random left points of the first attempt; each further attempt doubles them."""
    initial_rank: int = 200
    """Largest rank: initial values and states after jumps are smooth functions."""
    initial_tolerance: float = ACCUMULATED
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
    order_pilot_rtol: float = RTOL
    """Their relative tolerance."""
    pilot_floor: float = 1e-6
    """Size of a state, over its largest, below which accuracy is absolute."""
    first_look_operations: float = 2e8
    """Operations of a reference over clock time above which pilots tell whether markers pay, since
    trajectories that are out of phase take many common steps."""
    marker_pilot_rtol: float = 1e-4
    """Relative tolerance of the pilots."""
    pilot_shares: tuple[float, ...] = (1 / 8, 1 / 2, 1)
    """Parts of the horizon after which they may be enough."""
    marked_share: float = 0.3
    """Part of the budget that a reference over stretches may take where one over clock time is
    there: its samples take several times as much."""
    late_share: float = MINOR
    """Part of the budget in which a front after the horizon is looked for."""
    path_copies: int = 3
    """Copies of the paths of trajectories while crossings are looked for: one by one, together,
    crossing."""
    # branches
    order_points: int = 256
    """Trajectories that tell the orders."""
    most_solves: int = 4
    """Solves of all branches: the check may meet further orders, or ask for accuracy."""
    branch_share: float = MINOR
    """Share of the budget for one branch: where more is asked for, it is not smooth."""
    branch_tolerances: tuple[float, ...] = (0.5, MINOR)
    """Tolerances of the branches over that of the solve."""
    branch_floor: float = COARSE
    """Size of a state, over that at the start, below which accuracy is absolute."""
    branch_inset: float = 1e-4
    """Distance of points from the faces of the box, in widths."""
    # branching
    most_branches: int = 16
    """Most orders of events that are solved, each as a branch."""
    most_grazed: float = 0.03
    """Share of the trajectories, about, with an order that cannot be continued."""
    same_time: float = MINOR
    """Difference of lengths of stretches that end at once, in horizons, over rtol."""
    same_root: float = COARSE
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
    fastest_decay: float = MINOR
    """Smallest ratio of successive modes: rounding errors hide faster decay."""
    rank_share: float = 0.5
    """Ranks over the largest possible ones for the nodes on either side."""
    element_growth: float = 2.0
    """Factor on the nodes of elements whose modes have not fallen."""
    box_digits: int = 2
    """Significant digits of the ends that are told."""
    part_step: float = 0.02
    """Of a face, outwards, over the width of the whole box."""
    part_inset: float = MINOR
    """Distance of the faces that are told from points of other orders, over the part."""
    part_points: int = 48
    """Trajectories inside of a part that have to be of one order as well."""
    part_rounds: int = 4
    """Parts that are tried: each leaves out what the check of the one before met."""
    least_units: float = 20.0
    """Units of the last digit in an interval that is told, at least."""
    part_search_share: float = MINOR
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
    shrunk_parts: tuple[float, ...] = (1, 1 / 2, 1 / 4)
    """Parts of predicted intervals, around their middles."""
    front_distances: tuple[float, ...] = (0.35, 0.65)
    """Distances from a front, over the interval beside it."""
    front_surroundings: float = 0.15
    """Distance from a front's other parameters, over their intervals, if it moves."""


SOLVE = SolveTuning()


# -----------------------------------------------------------------------------
# Tuning of the check: where a solution is measured, and against what.


@dataclass(frozen=True)
class CheckTuning:
    """Tuning of the check: where a solution is measured, and against what."""

    # points
    mixed_ratio: float = 30.0
    """Upper over lower end above which points are mixed: below it, even ones reach all decades."""
    coverage_knots: int = 513
    """Knots on each of the two scales between which shares are interpolated."""
    few_corners: int = 8
    """Corners where they do not count: all of three parameters."""
    most_corners: int = 256
    """Corners where they count: all of eight parameters."""
    cut_distance: float = 4 * NEGLIGIBLE
    """Distance from cuts, in widths of the interval: at a jump the state is ambiguous."""
    factor_samples: int = 1025
    """Samples of a factor over its interval."""
    rare_term_share: float = 0.2
    """Share of the box below which a term is rarely active."""
    most_rare_terms: int = 4
    """Rare terms that are looked at."""
    rare_points: int = 48
    """Points at which rare terms are active, for all of them together."""
    least_surface_points: int = 4
    """Points on each surface at least."""
    surface_halvings: int = 50
    """Halvings of the distance to a surface, to the last digits."""
    surface_climbers: int = 4
    """Points from which a surface that no random point crosses is approached."""
    cell_parameters: int = 2
    """Parameters with several cuts from which their cells are looked at."""
    steep_nodes: float = 3.0
    """Nodes in one of several parameters, over those of a smooth function."""
    steep_nodes_alone: float = 3 * steep_nodes
    """The same for a single parameter: its random points lie close."""
    most_elements: int = 16
    """Elements of a parameter in which the error is measured."""
    steep_points: int = 12
    """Points chosen on each slab."""
    steep_shift: float = 2 * COARSE
    """Change of parameters, in widths of their intervals, that shows steepness."""
    # worst_points
    most_candidates: int = 2560
    """Most points at which residuals are evaluated, as far as the work goes."""
    residual_work: float = 3e7
    """Multiplications that residuals and jumps may take: about a tenth of a second."""
    worst_chosen: int = 8
    """Worst points that are taken."""
    corner_interval: int = 5
    """With more than three parameters every fifth candidate is near a corner."""
    corner_power: float = 1.0 / 3.0
    """Power of the distance from the centre: draws points to corners."""
    corner_error: float = 5.0
    """Factor on the error tolerated there unless corners count: points are few."""
    negligible_error: float = COARSE
    """Smaller errors and residuals count as this part of the tolerance."""
    doubtful_error: float = 1.5
    """Expected error over the tolerance from which a point is doubtful. On smooth problems expected
    errors are too large and reach 1.4; where something was missed, 3."""
    most_compared: int = 64
    """Reference trajectories whose residuals tell what a residual amounts to."""
    jump_candidates: int = 16_384
    """Most points where a jump that is not a polynomial is checked."""
    jump_error: float = 3.0
    """Error after a jump, over the tolerance, from which a point is doubtful."""
    jump_climbers: int = 64
    """Points with the largest errors after a jump, from which larger ones are looked for."""
    # cuts
    piece_samples: int = 2**14
    """Fine samples over the interval: narrower pieces may be missed."""
    cut_nodes: int = 14
    """Nodes of an interpolant that resolves smooth pieces."""
    resolved_error: float = RESOLVED
    """Interpolation error of resolved pieces, relative to the largest value."""
    straight_error: float = ACCUMULATED
    """Error of a straight line, relative to the largest value: rounding."""
    smooth_error: float = COARSE
    """Error over that one below which both halves are smooth, with a cut between."""
    narrow_piece: float = 1 / 64
    """Width of a narrow piece, relative to the interval: its ends are cuts."""
    rare_piece_share: float = 0.25
    """Narrow pieces count if they make up less than this part of the interval."""
    most_depth: int = 13
    """Bisections of the interval: down to about a sample."""
    most_rounds: int = 4
    """Rounds of sampling, each between the cuts of those before."""
    cut_width: float = 4 * EPSILON
    """Width of a piece, relative to the size of its ends, at which a cut is located."""
    factor_size_samples: int = 224
    """Samples that tell the size of a factor."""
    most_rough_pieces: int = 1000
    """Most places at which samples show functions that are not smooth."""
    most_repeated: int = 10_000
    """Most cuts that repeat with a period."""
    most_close_pairs: int = 100
    """Most pairs of such cuts that are checked."""
    pole: float = 1 / NEGLIGIBLE
    """A factor this many times larger at a cut than at samples may have a pole there."""
    pole_distances: tuple[float, ...] = (8 * COINCIDENT, ROUNDING)
    """Widths of the interval from a cut between which a pole grows."""
    pole_growth: float = 10.0
    """Factor by which a pole grows between them; a narrow peak does not."""
    # reference
    crossing_parts: int = 32
    """Parts of an interval of which one is kept."""
    crossing_rounds: int = 6
    """How often: the interval is a billionth of itself then."""
    most_narrow_times: int = 200
    """Most times that are kept, evenly spread over those that are found."""
    reference_accuracy: float = 3e-3
    """Tolerance of the reference over the tolerance of the solve."""
    least_reference_accuracy: float = 2 * ACCUMULATED
    """Tightest tolerance of the reference: rounding errors are larger."""
    longest_step: float = MINOR
    """Longest step, in horizons, if narrow functions may hide between its stages."""
    blow_up_growth: float = 1e3
    """Growth of a state from which it blows up, and meets no pole or border."""
    numbers_of_state: int = 100
    """Numbers held for each state of each trajectory: stages of a step, and dense output of few
    steps."""
    most_integrations: int = 5
    """Most integrations: a state that starts from zero shows its size only then."""
    size_pilots: int = 3
    """Trajectories that show the sizes of such states before all are integrated."""
    many_numbers: int = 3000
    """States times trajectories from which on these pilots cost little."""
    face_rtol: float = COARSE
    """Relative tolerance of trajectories that only show whether they reach the end."""
    face_points: int = 8
    """Trajectories that begin inside of a face of the box."""
    face_halvings: int = 7
    """Halvings between a face and the early end: 1 % of the box is enough."""
    face_work: float = WAITING
    """Most operations for all faces: about two seconds."""
    face_work_share: float = 0.5
    """Most of what is left of the budget for them."""
    # reference_set
    solved_share: float = 0.9
    """Part of the way to a blow-up that is still solved."""
    loss_samples: int = 16
    """Times at which it is measured how many digits quantities lose."""
    loss_shift: float = DIFFERENCE
    """Relative change of the states by which that is measured."""
    loss_share: float = 0.03
    """Error of the reference, in quantities, over the tolerance."""
    single_share: float = 0.15
    """Most of what is left of the budget for finer trajectories by LSODA."""
    most_single_states: int = 200
    """States up to which LSODA, whose matrices are dense, samples again."""
    least_squared_size: float = LEAST_SQUARED
    """Size of a state below which its square is lost."""
    most_checked_cuts: int = 16
    """Most cuts of a parameter that are checked on either side."""
    # resolution
    lingering: float = COARSE
    """Part of its early size that resolves a negligible state that is amplified."""
    begun: float = MINOR
    """Part of the time in which a state grows by a factor e, after which it has begun to."""
    small_state: float = 10.0
    """Negligible parts of its presumed size below which a state is small."""
    pilot_margin: float = MINOR
    """Absolute tolerances of all trajectories over those that a few of them need."""
    resolution_samples: int = 8
    """Times at which rounding errors and the growth of small states are estimated."""
    dip_samples: int = 64
    """Times at which states are looked for that fall far below their size."""
    dip_floor: float = LEAST
    """Floor of a state that falls far and grows again: it is relative all the way."""
    zero_floor: float = 1e-18
    """That over its size if it starts from zero: no step leaves zero without one."""
    eigenvector_part: float = NEGLIGIBLE
    """Least part of a state in an eigenvector: others are rounding."""
    least_kept_size: float = 1e-250
    """Size below which a small state is lost: floating-point numbers end at 1e-308."""
    unseen: float = 1e-100
    """Size of a state that nobody asks for, over the largest, that is not resolved."""
    long_chain: int = 25
    """States from which a chain may amplify what is negligible: binomial coefficients."""
    most_exponent: float = 250
    """Largest exponent of e by which a floor is lowered."""
    chain_trajectories: int = 3
    """Trajectories on which the growth along a chain is measured."""
    chain_work: float = 4.0
    """Most work for these trajectories, over that for all before."""
    chain_end: float = 0.5
    """Part of the way that they have to come, to tell anything."""
    chain_share: float = MINOR
    """Most of what is left of the budget for them."""
    passed_on: float = 10.0
    """Differences from there on, in tolerances, are errors that were passed on."""
    # growth
    growth_steps: int = 32
    """Steps over the horizon by which the growth of errors is followed."""
    growth_trajectories: int = 5
    """Check points at which it is followed, the centre first."""
    beside_pole: float = 0.99
    """Factor on the Jacobian where its Cayley transform does not exist."""
    growth_columns: int = 16
    """Random columns of a propagator of many states."""
    # branch_errors
    change_candidates: int = 4096
    """Points among which those near to where orders change are chosen."""
    change_points: int = 48
    """How many of them."""
    most_surprising: int = 6
    """Points with other events than their branch that are looked at, at most."""
    event_looks: int = 17
    """Times at which other events, or undecided states, are looked for."""
    share_points: int = 2**14
    """Points that tell the share of the box that is undecided."""
    branch_points_at_once: int = 1024
    """Points, or curves of states, at which branches are evaluated together."""
    # measure
    measure_times: int = 41
    """Evenly spaced times of the horizon at which values are compared."""
    event_distance: float = 1.001
    """Distance of the nearest compared time from an event, in those left out."""
    drift_points: int = 24
    """Points at which lifted states are compared with what they stand for."""
    # finer
    finer_ratio: float = 1e-2
    """Tolerance of finer trajectories over that of the reference."""
    finer_difference: float = 0.3
    """Difference to these, over the tolerance of the solve, that matters."""
    finer_times: int = 61
    """Evenly spaced times at which they are compared."""


CHECK = CheckTuning()
