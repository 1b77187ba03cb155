"""A solution in plain data, as ``--json`` prints it."""

from __future__ import annotations

import math
from typing import Any

from rankone.interface.solution import Solution

__all__ = ["number", "summary"]


def summary(solution: Solution) -> dict[str, Any]:
    """How good a solution is and how it was found; numbers that are not known are null."""
    return {
        "success": solution.success,
        "status": solution.status.name.lower(),
        "message": solution.message,
        "method": solution.method,
        "rtol": solution.rtol,
        "error": number(solution.error),
        "errors": {name: number(error) for name, error in solution.errors.items()},
        "corner_error": number(solution.corner_error),
        "checked": _checked(solution),
        "unknowns": list(solution.unknowns),
        "time": None if solution.metadata.timeless else list(solution.time),
        "parameters": {name: list(interval) for name, interval in solution.parameters.items()},
        "slabs": len(solution.ranks),
        "rank": solution.rank,
        "nodes": list(solution.nodes),
        "timings": solution.timings,
        "version": solution.metadata.version,
        "units": dict(solution.metadata.units),
    }


def _checked(solution: Solution) -> dict[str, Any] | None:
    """On what the error was measured, and what success covers."""
    measured = solution.outcome.measured
    if measured is None:
        return None
    return {
        "trajectories": measured.points,
        "cover": measured.cover,
        "unknowns": [solution.states[i] for i in measured.counted or range(len(solution.states))],
        "quantile95": measured.quantile,
        "worst": dict(zip(solution.parameters, measured.worst, strict=False)),
    }


def number(value: float) -> float | None:
    """A number that JSON has, or None."""
    return float(value) if math.isfinite(value) else None
