"""Which states are reset at which times."""

from __future__ import annotations

from rankone.system import System

__all__ = ["jump_kind", "jump_times"]


def jump_times(system: System) -> tuple[float, ...]:
    """The times at which states are reset, ascending."""
    return tuple(time for time, _ in getattr(system, "JUMPS", ()))


def jump_kind(system: System, time: float) -> int | None:
    """What ``system.jumped`` takes for the jump at a time; None if there is none."""
    return dict(getattr(system, "JUMPS", ())).get(time)
