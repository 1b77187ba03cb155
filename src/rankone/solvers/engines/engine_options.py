"""Options and tuning of the three engines, and what an attempt costs them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal, Self

from rankone.solvers.attempts import LEAST_COST_RATIO
from rankone.solvers.outcome import SlabRecord
from rankone.support.arrays import COARSE, COINCIDENT, MINOR, RESOLVED, SAME
from rankone.support.costs import CALL, Cost
from rankone.support.errors import OptionError
from rankone.support.options import RTOL, Options, choice, integer, integers, number
from rankone.support.tasks import ExecutorLike, checked_executor
from rankone.tensors import BASES
from rankone.tensors.adaptive import Tightening
from rankone.tensors.basis import LagrangeElements, nodes_for


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
    known_functions_share: float = MINOR
    """What an element may miss of the known functions of its parameter, or a line of its
    column, relative to the level."""
    known_node_ratios: tuple[float, ...] = (3 / 2, 5 / 2, 4)
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
    lines_fraction: float = MINOR
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
    least_error_ratio: float = MINOR
    """Errors below this part of the error allowed waste work: the tolerance grows."""
    aimed_error_ratio: float = 0.5
    """Error aimed at when the tolerance is changed, over the error allowed, and tolerance of
    stiff integrations, whose error is not measured."""
    largest_tightness_factor: float = 4.0
    """Largest factor on the tolerance from one calibration to the next."""
    smallest_tightness_factor: float = COARSE
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
    front_change: float = MINOR
    """Change of a state, in units of its size, that makes a front."""
    kept_change: float = 0.5
    """Part of the change that a narrower piece must hold to be looked at instead."""
    front_width: float = 0.01
    """Largest width of a front, relative to the interval."""
    jump_width: float = SAME
    """Largest width of a jump, relative to the interval."""
    more_nodes: int = 2
    """Nodes of a line over those that did not resolve it."""
    explaining_share: float = 0.3
    """Sum of the modes that an attempt left out, over its error, that explains the error."""
    full_rank: float = 0.5
    """Rank over the largest one for its nodes from which it is that of a front, and grows with
    them."""


CROSS = CrossTuning()
# Power below one: there are more nodes and left points as well
TIGHTENING = Tightening(settled_growth=1.2, power=0.7, smallest=MINOR, largest=0.5)


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
            grows = rank >= CROSS.full_rank * before
            factor = max(after / before, 1.0) if grows else 1.0
            ratios.append(nodes[b] / self.nodes[b] * factor)
        first = min(self.nodes[0] * behind[0] / max(self.trajectories, 1), 1.0)
        return first * ratios[0] + (1.0 - first) * min(ratios[1:], default=ratios[0])


# -----------------------------------------------------------------------------
# Options and tuning constants of the tensor-train engine.
#
# The constants were measured over the reference problems.


@dataclass(frozen=True)
class TrainTuning:
    """Tuning of the tensor-train engine, measured over the reference problems."""

    corners_tolerance_share: float = 0.06
    """First inner tolerance, relative to rtol, where corners of the box count."""
    interior_tolerance_share: float = 0.4
    """First inner tolerance, relative to rtol, where only interior points count."""
    thinning_share: float = 0.5
    """Norm of the entries dropped from an accepted slab, relative to its resolution."""
    loss_share: float = 0.05
    """Largest loss from coarser parameter nodes at the end of a slab, or from interpolating states
    after a jump, relative to the slab's tolerance."""
    recovery_factor: float = 1.15
    """Largest growth of the length per slab after a rejection."""
    reference_noise: float = RESOLVED
    """Relative size below which the dense output of the reference is not smooth."""
    retry_length_ratio: float = 0.8
    """A slab whose proper length is below this part of its own is solved again."""
    memory_halving_limit: float = COARSE
    """Shortest slab, relative to the horizon, that is halved to save memory."""
    reliable_contraction: float = 0.5
    """A smaller ratio of two residuals predicts the next residual; sweeps that contract less after
    the fourth will not converge."""
    least_contraction: float = 0.15
    """The predicted contraction is never taken below this."""
    stagnant_contraction: float = 0.3
    """Contraction above which a slab at the rank limit counts as solved."""
    first_sweep_factor: float = 30.0
    """Largest tolerance of the first sweep, relative to the final one."""
    max_probes: int = 8
    """Largest number of random sums that widen the frame."""
    unresolved_tail: float = COINCIDENT
    """Relative size of the last modes above which a function counts as unresolved."""
    probe_modes: int = 3
    """Modes of a probe; higher ones would look like a need for more nodes."""
    max_refinements: int = 24
    """Largest number of refinements of the nodes at a jump."""
    block_multiplications: float = 5e9
    """Multiplications between two looks at the budget."""
    block_count: int = 4
    """Blocks of rows in which a packed product is formed."""
    largest_change: float = 3.0
    """Change of the Jacobian over the slab, times its length, that S may leave out: it costs no
    sweeps."""
    entry_bytes: int = 16
    """An entry of a sparse matrix, with its row."""


TRAIN = TrainTuning()
# Operations of the kernel of a group: once, and for each number of its output
GROUP_COST = Cost(30 * CALL, 4.0)


@dataclass(frozen=True, kw_only=True)
class TrainOptions(Options):
    """Limits and discretisation of ``method="train"``.

    Attributes
    ----------
    basis : {"chebyshev", "legendre"}
        Nodal basis of the parameters.
    time_nodes : int or None
        Radau nodes per slab; None chooses by the tolerance.
    max_rank : int
        Largest rank of the train.
    max_degree : int
        Largest number of nodes of one parameter element; beyond it the interval is split.
    max_nodes : int
        Largest number of nodes in one parameter.
    max_slabs : int
        Largest number of accepted and rejected slabs in one attempt.
    max_sweeps : int
        Largest number of sweeps on one slab.
    max_attempts : int or None
        How often the solve may be repeated with a tighter inner tolerance;
        None: 5 times, and more while that pays.
    """

    usual_attempts: ClassVar[int] = 5

    basis: str = choice("chebyshev", BASES)
    time_nodes: int | None = integer(None, 2, 32)
    max_rank: int = integer(250)
    max_degree: int = integer(64, 4)
    max_nodes: int = integer(400, 4)
    max_slabs: int = integer(2000)
    max_sweeps: int = integer(14, 3)
    max_attempts: int | None = integer(None)

    def nodes_in_time(self, rtol: float) -> int:
        """Radau nodes per slab: more for tighter tolerances, 9 at 1e-3 and 16 at 1e-8."""
        if self.time_nodes is not None:
            return self.time_nodes
        return min(max(nodes_for(rtol, 4.6), 6), 18)


# -----------------------------------------------------------------------------
# Options and tuning constants of the classic method.
#
# The constants were measured over the reference problems.


# Modes in a row without a better residual after which enrichment ends, by what is updated
STALLED_MODES = {"all": 4, "time": 8, "amplitudes": 12}

_SLIDES: dict[str, Any] = {
    "formulation": "derivative",
    "projection": "galerkin",
    "update": "amplitudes",
    "elements": "linear",
    "time_slabs": 1,
    "max_attempts": 1,
    "max_modes": 80,
    "max_fixed_point": 50,
    "fixed_point_tolerance": RTOL,
}


@dataclass(frozen=True)
class GreedyTuning:
    """Tuning of the classic method, measured over the reference problems."""

    tolerance_share: float = 0.03
    """Tolerance of a slab relative to rtol, before errors grow."""
    tail_share: float = MINOR
    """Part of rtol that the highest modes may make up."""
    loss_share: float = 0.2
    """Largest loss from thinning the trains of a slab, rounding its end, or interpolating states
    after a jump, relative to the slab's tolerance."""
    first_slab_contraction: float = 3.0
    """Length of the first slab times the largest norm of the scaled Jacobian."""
    few_iterations: int = 10
    """Lagged iterations up to which the next slab is longer."""
    many_iterations: int = 16
    """Lagged iterations above which the next slab is shorter."""
    inner_tolerance_share: float = MINOR
    """Tolerance of an equation relative to the last change of the unknowns."""
    max_source_rank: int = 4000
    """Rank above which a source is compressed before it is solved for."""
    better_residual: float = 0.98
    """Ratio of residuals below which a mode counts as an improvement."""
    proximal_weight: float = COINCIDENT
    """Weight, relative to the largest diagonal entry, that ties an update to the modes it
    replaces."""
    max_dense_size: int = 1200
    """Largest system of coupled modes that is solved densely whatever its bandwidth."""
    fine_degree: int = 64
    """Degree of the basis on which the factors of a parameter are resolved."""
    finite_element_nodes: int = 41
    """Nodes in every dimension for finite elements, if none are given."""
    pass_operations: float = 100 * CALL
    """Operations of a pass over a dimension, besides those with large arrays."""
    sparse_operations: float = 5 * CALL
    """Operations for each unknown of a sparse system."""
    stiffness_samples: int = 101
    """Evenly spaced times at which stiffness is measured."""


GREEDY = GreedyTuning()


@dataclass(frozen=True, kw_only=True)
class GreedyOptions(Options):
    """Formulation, projection and limits of ``method="greedy"``.

    The defaults are the best choice over all reference problems: the Volterra form, whose operator
    is the identity plus the own linear terms of an equation, with all modes updated.
    :meth:`slides` is the choice of the slides.

    Attributes
    ----------
    formulation : {"volterra", "derivative"}
        ``u = u_s + integral of f``, or ``u' = f``.
    projection : {"galerkin", "minimal-residual"}
        Test functions: the shape functions, or the operator applied to them.
    update : {"all", "time", "amplitudes"}
        What each new mode updates: the functions of each dimension in turn, the time functions, or
        the amplitudes alone.
    elements : {"legendre", "linear", "quadratic"}
        One spectral element, or finite elements, in every dimension.
    time_nodes : int or None
        Nodes in time on one slab, its start included; None chooses by the tolerance (41 for
        finite elements).
    parameter_nodes : int, tuple of int or None
        Nodes in the parameters; None as for time.
    time_slabs : int or None
        Number of equal slabs; None adapts their length to the lagged iteration.
    max_modes : int
        Most modes of one unknown on one slab.
    max_fixed_point : int
        Most passes over the dimensions for one mode.
    fixed_point_tolerance : float
        Change of a mode between passes at which it is taken, relative to the mode.
    update_sweeps : int
        Passes over the dimensions for each new mode with ``update="all"``.
    max_iterations : int
        Most updates of the lagged terms on one slab.
    tolerance : float or None
        Tolerance of residuals and lagged iterations, in units of each state's size; None derives
        it from ``rtol`` and the growth of errors.
    max_slabs : int
        Most slabs tried in one attempt.
    max_attempts : int or None
        How often the solve may be repeated with a tighter tolerance or more nodes;
        None: 4 times, and more while that pays.
    """

    usual_attempts: ClassVar[int] = 4

    formulation: str = choice("volterra", ("derivative", "volterra"))
    projection: str = choice("galerkin", ("galerkin", "minimal-residual"))
    update: str = choice("all", ("amplitudes", "time", "all"))
    elements: str = choice("legendre", ("linear", "quadratic", "legendre"))
    time_nodes: int | None = integer(None, 2)
    parameter_nodes: int | tuple[int, ...] | None = integers(None, 2)
    time_slabs: int | None = integer(None)
    max_modes: int = integer(40)
    max_fixed_point: int = integer(6)
    fixed_point_tolerance: float = number(1e-2, 1e-16, 1.0)
    update_sweeps: int = integer(2)
    max_iterations: int = integer(30)
    tolerance: float | None = number(None, 1e-16, 1.0)
    max_slabs: int = integer(400)
    max_attempts: int | None = integer(None)

    def __post_init__(self) -> None:
        super().__post_init__()
        nodes = self.parameter_nodes
        self._fit("time_nodes", self.time_nodes)
        self._fit("parameter_nodes", *(nodes if isinstance(nodes, tuple) else (nodes,)))

    def _fit(self, name: str, *counts: int | None) -> None:
        """Refuse numbers of nodes that are not possible with the elements."""
        for count in counts:
            if count is not None and (count - 1) % self.order:
                raise OptionError(
                    f"{name}={count} does not fit {self.elements} elements",
                    remedy="at least 3 and odd",
                )

    @classmethod
    def slides(cls, **changes: Any) -> Self:
        """The choice of the slides: derivative form, Galerkin, amplitudes, linear elements."""
        return cls.of(preset="slides", **changes)

    @classmethod
    def names(cls) -> list[str]:
        """What :meth:`of` takes."""
        return [*super().names(), "preset"]

    @classmethod
    def of(
        cls,
        keywords: Sequence[str] = (),
        /,
        preset: Literal["slides"] | None = None,
        **changes: Any,
    ) -> Self:
        """Options from a preset and changes to it, or an OptionError."""
        if preset not in (None, "slides"):
            raise OptionError(f"preset={preset!r} is unknown", remedy="use preset='slides'")
        return super().of(keywords, **{**(_SLIDES if preset else {}), **changes})

    @property
    def order(self) -> int:
        """Polynomial order that node numbers must fit: 2 for quadratic elements, else 1."""
        return 2 if self.elements == "quadratic" else 1

    def given_parameter_nodes(self, parameters: int) -> tuple[int, ...] | None:
        """Nodes for each parameter, None if not given; OptionError if a tuple does not fit."""
        nodes = self.parameter_nodes
        if nodes is None:
            return None
        counts = nodes if isinstance(nodes, tuple) else (nodes,) * parameters
        if len(counts) != parameters:
            raise OptionError(
                f"parameter_nodes={nodes!r} has {len(counts)} entries for {parameters} parameters",
                remedy="give one number for all, or one for each",
            )
        return counts

    def shape_functions(self, lower: float, upper: float, nodes: int) -> LagrangeElements:
        """Shape functions with a number of nodes on an interval."""
        if self.elements == "legendre":
            return LagrangeElements(lower, upper, 1, nodes - 1)
        return LagrangeElements(lower, upper, (nodes - 1) // self.order, self.order)
