"""Options and tuning constants of the classic method.

The constants were measured over the reference problems.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, Self

from rankone.support.costs import CALL
from rankone.support.errors import OptionError
from rankone.support.options import Options, choice, integer, integers, number
from rankone.tensors.bases.basis import LagrangeElements

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
    "fixed_point_tolerance": 1e-6,
}


@dataclass(frozen=True)
class GreedyTuning:
    """Tuning of the classic method, measured over the reference problems."""

    tolerance_share: float = 0.03
    """Tolerance of a slab relative to rtol, before errors grow."""
    tail_share: float = 0.1
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
    inner_tolerance_share: float = 0.1
    """Tolerance of an equation relative to the last change of the unknowns."""
    max_source_rank: int = 4000
    """Rank above which a source is compressed before it is solved for."""
    better_residual: float = 0.98
    """Ratio of residuals below which a mode counts as an improvement."""
    proximal_weight: float = 1e-12
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
    sparse_operations: float = 5e3
    """Operations for each unknown of a sparse system."""
    stiffness_samples: int = 101
    """Evenly spaced times at which stiffness is measured."""


TUNING = GreedyTuning()


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
