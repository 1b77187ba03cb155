"""Why solves of fields end."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from rankone.trajectories.system.verdict import Cause, Status


@dataclass(frozen=True)
class SlowModes(Cause):
    """Too many modes would be needed: those of fronts that travel, and of noise, do not decay."""

    unknown: str
    count: int
    left_out: float
    allowed: float
    needed: int
    trajectories: int
    text: ClassVar[str] = (
        "the modes of {unknown} decay too slowly: {count} of them leave out {left_out:.1e} of "
        "{trajectories} trajectories; for {allowed:.1e} they would need at least {needed}"
    )


@dataclass(frozen=True)
class FieldsEnd(Cause):
    """A trajectory of fields that does not reach the end of the horizon."""

    time: float
    at: tuple[tuple[str, float], ...]

    def sentence(self, status: Status) -> str:
        place = ", ".join(f"{name} = {value:.6g}" for name, value in self.at)
        place = f" with {place}" if place else ""
        remedy = "end the horizon before, or take a box without it"
        text = status.value
        if status is Status.BLOW_UP:
            text = "a trajectory leaves all bounds inside the horizon"
        if status is Status.SWITCHES:
            text = "events of a trajectory follow each other too closely to be told apart"
        return f"{text}, at t = {self.time:.6g}{place}; {remedy}"


@dataclass(frozen=True)
class TooFewTrajectories(Cause):
    """The full trajectories that were allowed did not suffice."""

    most: int
    modes: int
    error: float | None

    def sentence(self, status: Status) -> str:
        text = f"{status.value}: at most {self.most} were to be integrated"
        if self.error is not None:
            missed = f"{self.error:.1e} of the largest value"
            text += f"; {self.modes} modes missed the last ones by {missed}"
        return f"{text}; raise max_trajectories or rtol, or take a smaller box"


@dataclass(frozen=True)
class FieldError(Cause):
    """How far the solution is from full trajectories at new points.

    With events ``time_error`` is the largest error of their times, over the horizon.
    """

    error: float
    unknown: str
    points: int
    trajectories: int
    time_error: float | None = None
    text: ClassVar[str] = (
        "{status}: {error:.1e} of the largest value of {unknown}, against {points} trajectories "
        "that no mode was made of, {trajectories} in all"
    )

    def sentence(self, status: Status) -> str:
        text = super().sentence(status)
        if self.time_error is not None:
            text += f"; times of events within {self.time_error:.1e} of the horizon"
        return text


@dataclass(frozen=True)
class ReducedEnds(Cause):
    """How the solve of the reduced system ended."""

    message: str
    modes: int
    text: ClassVar[str] = "the system of {modes} coefficients is not solved: {message}"
