"""Numbers of nodes: to begin with, and more where the highest modes are not small."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rankone.discretization import LegendreBasis
from rankone.ir.domain import Domain
from rankone.ir.system import System
from rankone.solvers.greedy.options import GreedyOptions

__all__ = ["Nodes", "first_nodes"]

_MOST = 64
_FINITE_ELEMENTS = 41
_FEW_PARAMETERS = 2
"""Up to so many parameters the known functions are resolved nearly to rounding level."""


@dataclass(frozen=True)
class Nodes:
    """Numbers of nodes in time, on one slab, and in each parameter."""

    time: int
    parameters: tuple[int, ...]

    def finer(self, wanted: NDArray[np.bool_], options: GreedyOptions) -> Nodes:
        """More nodes in the dimensions wanted, time first, whose number is not given."""
        time, parameters = self.time, self.parameters
        if wanted[0] and options.time_nodes is None:
            time = _more(time)
        if options.parameter_nodes is None:
            pairs = zip(parameters, wanted[1:], strict=True)
            parameters = tuple(_more(count) if more else count for count, more in pairs)
        return Nodes(time, parameters)


def first_nodes(system: System, domain: Domain, rtol: float, options: GreedyOptions) -> Nodes:
    """Nodes to begin with: as given, 41 for finite elements, else by the tolerance.

    Legendre elements have enough nodes for the known functions of each parameter: the factors of
    the terms and of the initial values.

    Raises
    ------
    OptionError
        If the number of nodes given does not fit the parameters.
    """
    given = options.given_parameter_nodes(len(domain.box))
    digits = -math.log10(rtol)
    if options.elements != "legendre":
        return Nodes(
            options.time_nodes or _FINITE_ELEMENTS, given or (_FINITE_ELEMENTS,) * len(domain.box)
        )
    time = options.time_nodes or int(min(max(round(5.6 + 1.4 * digits), 6), 24))
    if given is not None:
        return Nodes(time, given)
    few = len(domain.box) <= _FEW_PARAMETERS
    common = max(round((4.0 if few else 2.0) + 1.2 * digits), 4)
    tolerance = 1e-13 if few else 0.01 * rtol
    return Nodes(
        time,
        tuple(
            max(common, _resolving(system, j, lower, upper, tolerance))
            for j, (lower, upper) in enumerate(domain.box)
        ),
    )


def _resolving(system: System, dimension: int, lower: float, upper: float, tolerance: float) -> int:
    """Nodes that resolve the factors of one parameter to a part of the largest of each."""
    fine = LegendreBasis(lower, upper, _MOST)
    relative = fine.relative_spectrum(system.parameter_factors(dimension, fine.nodes))
    return int(np.flatnonzero(relative > tolerance).max(initial=0)) + 2


def _more(nodes: int) -> int:
    """The next larger number of nodes; odd stays odd, as quadratic elements need."""
    return min(nodes + 2 * max(2, nodes // 6), 2 * _MOST)
