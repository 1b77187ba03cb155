"""Functions of a whole function of time: extremes, durations, the first crossing of a level."""

from __future__ import annotations

from typing import Any

import sympy as sp

__all__ = ["duration", "first_crossing", "maximum", "minimum"]


class maximum(sp.Function):  # type: ignore[misc]
    """The largest value over time of an expression, in :meth:`rankone.Solution.output`.

    Examples
    --------
    >>> import sympy as sp
    >>> t = sp.Symbol("t")
    >>> maximum(sp.Function("x")(t))
    maximum(x(t))
    """

    nargs = 1


class minimum(sp.Function):  # type: ignore[misc]
    """The smallest value over time of an expression, in :meth:`rankone.Solution.output`."""

    nargs = 1


class duration(sp.Function):  # type: ignore[misc]
    """For how long an expression is positive, in :meth:`rankone.Solution.output`.

    ``duration(x - level)`` is the time that x is above a level.
    """

    nargs = 1


class first_crossing(sp.Function):  # type: ignore[misc]
    """The first time at which an expression crosses a level.

    ``first_crossing(x, level, direction)`` in :meth:`rankone.Solution.output`: the level is 0
    unless it is given, a number or an expression of parameters and time; the direction is 1
    (upwards), -1 (downwards) or 0, either. Where the expression only begins at the level, or
    exceeds it by less than ten times the tolerance of its largest distance from it, that is no
    crossing.
    """

    nargs = (1, 2, 3)

    @property
    def parts(self) -> tuple[sp.Expr, Any]:
        """What crosses zero, and the direction."""
        expression, level, direction = (*self.args, sp.S.Zero, sp.S.Zero)[:3]
        return expression - level, direction
