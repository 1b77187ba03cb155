"""Outputs: quantities of interest of a solution, as solutions of their own.

=================  ====================================================================
module             subject
=================  ====================================================================
``quantities``     what is asked for, as functions of arrays
``over_time``      integrals, extremes and crossings of functions of time
``sampling``       values of quantities at parameter points
``check``          where quantities are compared with their interpolation
``interpolation``  from values at points to a solution, and how good it is
=================  ====================================================================
"""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from rankone.errors import RankoneError
from rankone.metadata import Role, SolutionMetadata
from rankone.options import checked_number
from rankone.outputs.interpolation import solved_quantities
from rankone.solution_core import SolutionCore
from rankone.solvers.outcome import Outcome

__all__ = ["with_outputs"]


def with_outputs(
    solution: SolutionCore, given: Mapping[str, Any], rtol: float | None, max_seconds: float
) -> tuple[Outcome, SolutionMetadata]:
    """Quantities of interest; see :meth:`rankone.Solution.output`."""
    if rtol is not None:
        rtol = checked_number("rtol", rtol, 1e-13, 0.999, float)
    max_seconds = checked_number("max_seconds", max_seconds, 0.0, 1e9, float)
    metadata = solution.metadata
    quantities = _expressions().quantities_of(given, metadata, solution.time)
    outcome, rtol = solved_quantities(solution, quantities, rtol, max_seconds)
    names = metadata.coordinates
    return outcome, replace(
        metadata,
        states=quantities.names,
        roles=(Role.UNKNOWN,) * len(quantities.names),
        horizon=solution.time,
        rtol=rtol,
        equations=quantities.texts,
        source=None,
        timeless=quantities.timeless,
        units=tuple(pair for pair in metadata.units if pair[0] in names),
    )


def _expressions() -> Any:
    """The translation of expressions: the one part of solutions that needs SymPy."""
    try:
        return importlib.import_module("rankone.expressions")
    except ImportError:
        raise RankoneError(
            "outputs are given as SymPy expressions, and SymPy is not installed",
            remedy="pip install sympy",
        ) from None
