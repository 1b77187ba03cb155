"""Options and tuning constants of the tensor-train engine.

The constants were measured over the reference problems.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from rankone.support.costs import CALL, Cost
from rankone.support.options import Options, choice, integer
from rankone.tensors.bases import BASES
from rankone.tensors.bases.basis import nodes_for


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
    reference_noise: float = 1e-7
    """Relative size below which the dense output of the reference is not smooth."""
    retry_length_ratio: float = 0.8
    """A slab whose proper length is below this part of its own is solved again."""
    memory_halving_limit: float = 1e-3
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
    unresolved_tail: float = 1e-12
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
    entry_bytes: float = 16.0
    """An entry of a sparse matrix, with its row."""


TUNING = TrainTuning()
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
