"""Which states are reset at which times."""

from __future__ import annotations

from rankone.ir.system import System
from rankone.support.errors import warn

__all__ = ["jump_kind", "jump_times", "warn_of_last"]

_AT_THE_END = 1e-9
"""Distance from the end of the horizon, in horizons, from which a jump is before it."""


def jump_times(system: System, start: float, end: float) -> tuple[float, ...]:
    """The times inside of a horizon at which states are reset, ascending."""
    near = _AT_THE_END * (end - start)
    times = (time for time, _ in getattr(system, "JUMPS", ()))
    return tuple(time for time in times if start < time < end - near)


def warn_of_last(system: System, start: float, end: float) -> None:
    """Warn of a jump that is so close to the end of the horizon that it is not taken."""
    inside = [time for time, _ in getattr(system, "JUMPS", ()) if start < time < end]
    if len(inside) > len(jump_times(system, start, end)):
        warn(
            f"the jump at {inside[-1]!r} is at the end of the horizon, {end!r}, but for rounding, "
            "and is not taken; remedy: move the end"
        )


def jump_kind(system: System, time: float) -> int | None:
    """What ``system.jumped`` takes for the jump at a time; None if there is none."""
    jumps: tuple[tuple[float, int], ...] = getattr(system, "JUMPS", ())
    return next((kind for at, kind in jumps if at == time), None)
