"""Scales of parameters as expressions of C and JavaScript, which share their operators."""

from __future__ import annotations

from rankone.discretization import Logarithm, Reciprocal, Scale
from rankone.support.errors import ExportError


def scale_expressions(scale: Scale, library: str = "") -> tuple[str, str]:
    """The coordinate s and its slope ds/dx as functions of ``x``.

    ``library`` stands before the names of functions.
    """
    if scale.is_identity:
        return "x", "1"
    if isinstance(scale, Logarithm):
        return f"{library}log(x)", "1 / x"
    if isinstance(scale, Reciprocal):
        return "-1 / x", "1 / (x * x)"
    raise ExportError(f"the scale {scale} has no expression in other languages", term=scale)
