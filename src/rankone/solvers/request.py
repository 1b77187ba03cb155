"""The request of a solve: domain, tolerance, check, limits, and what is observed.

The domain is the horizon and the box of parameters that a system is solved on.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence, Set
from dataclasses import dataclass, fields, replace
from functools import partial
from typing import SupportsFloat, TypeVar

import numpy as np

from rankone.support.arrays import LEAST, MANY_SAMPLES, Array
from rankone.support.budget import LEAST_EFFORT, NORMAL, operations_for
from rankone.support.errors import EvaluationError, OptionError, did_you_mean, listing, quote, shown
from rankone.support.options import (
    INTEGRATORS,
    RTOL,
    RTOLS,
    Options,
    checked_memory,
    checked_number,
)
from rankone.tensors.coordinates import (
    LINEAR,
    SCALES,
    Scale,
    check_scale,
    first_scale,
    name_of,
    split,
)
from rankone.trajectories.fields.field_system import FieldSystem
from rankone.trajectories.system.system import System

_MEMORY = 4e9  # Bytes that arrays of a solve may take at once, unless max_memory is given
USUAL_POINTS = 96
"""Interior check points: a twentieth of the box is missed with probability below 1 %."""
MOST_POINTS = 100_000  # Most interior check points, so that their trajectories fit into memory
_COVERS = ("interior", "box")
# Factor on the budget of work where functions of the user are called, which may be slow
_USER_FUNCTION_FACTOR = 10.0

EngineOptions = TypeVar("EngineOptions", bound=Options)


@dataclass(frozen=True)
class Domain:
    """A horizon in time, and an interval for each parameter.

    ``scales`` names the coordinate of each interval, a word of
    :data:`~rankone.tensors.coordinates.SCALES`; left out, all are linear.
    """

    horizon: tuple[float, float]
    box: tuple[tuple[float, float], ...]
    scales: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not self.scales:
            object.__setattr__(self, "scales", (LINEAR,) * len(self.box))

    @classmethod
    def of(cls, system: System) -> Domain:
        """The domain a generated module was written for."""
        box = tuple((float(lower), float(upper)) for lower, upper in system.box)
        return cls((float(system.horizon[0]), float(system.horizon[1])), box, system.scales)

    def edges(self, cuts: Sequence[float] = ()) -> list[float]:
        """The ends of the horizon, and cuts between them."""
        return [self.horizon[0], *cuts, self.horizon[1]]

    @property
    def bounds(self) -> Array:
        """The box as an array (d, 2)."""
        return np.array(self.box, dtype=float).reshape(-1, 2)

    @property
    def coordinates(self) -> tuple[Scale, ...]:
        """The scales of the parameters."""
        return tuple(SCALES[word] for word in self.scales)

    @property
    def first_coordinates(self) -> tuple[Scale, ...]:
        """For each parameter the coordinate in which it is looked at first.

        That is its scale if one was given, or else the logarithm over decades.
        """
        pairs = zip(self.coordinates, self.box, strict=True)
        return tuple(first_scale(*box) if scale.is_identity else scale for scale, box in pairs)

    def moved(
        self,
        names: Sequence[str],
        parameters: Mapping[object, Sequence[object]] | None = None,
        t_final: float | None = None,
    ) -> Domain:
        """The domain with other intervals of some parameters, or another end of the horizon.

        ``names`` are those of all parameters, ``parameters`` maps some of them, or their symbols,
        to new intervals, which may end with a scale. An OptionError if there is no such parameter,
        or an interval is not two finite ascending numbers.
        """
        if not isinstance(parameters, Mapping | None):
            message = f"parameters={parameters!r} is not a mapping from parameters to intervals"
            raise OptionError(message, term=parameters, remedy="give {name: (lower, upper), ...}")
        box = dict(zip(names, self.box, strict=True))
        scales = dict(zip(names, self.scales, strict=True))
        moved: set[str] = set()
        for key, interval in (parameters or {}).items():
            name = _name(key)
            if name not in box:
                raise OptionError(
                    f"there is no parameter {quote(name)}{did_you_mean(name, box)}",
                    term=key,
                    remedy=f"choose from {', '.join(box)}" if box else None,
                )
            if name in moved:
                raise OptionError(f"the parameter {quote(name)} is given twice", term=key)
            moved.add(name)
            bounds, word = split(interval)
            box[name] = _interval(f"the range of {quote(name)}", bounds)
            if word is not None:
                scales[name] = check_scale(name, box[name], word)
            elif box[name][0] <= 0.0:
                scales[name] = LINEAR
        start, end = self.horizon
        horizon = _interval("the horizon", (start, end if t_final is None else t_final))
        return Domain(horizon, tuple(box.values()), tuple(scales.values()))


def _name(key: object) -> str:
    """The name of a symbol, or the key itself."""
    return str(getattr(key, "name", key))


def _interval(subject: str, interval: object) -> tuple[float, float]:
    """Two finite numbers in ascending order, or an OptionError."""
    try:
        if not isinstance(interval, Iterable):
            raise TypeError
        lower, upper = (
            float(end)
            for end in interval
            if isinstance(end, SupportsFloat) and not isinstance(end, bool | np.bool_)
        )
    except (OverflowError, TypeError, ValueError):
        lower = upper = math.nan
    if isinstance(interval, Set):  # it has no order
        lower = math.nan
    if lower < upper and upper - lower < LEAST:
        raise OptionError(f"{subject} is {shown(interval)}, which is too narrow", term=interval)
    if not (math.isfinite(lower) and math.isfinite(upper) and lower < upper):
        raise OptionError(
            f"{subject} is {shown(interval)}, not two numbers in ascending order",
            term=interval,
            remedy="give a lower end and a higher one",
        )
    return lower, upper


@dataclass(frozen=True)
class KnownFactors:
    """The factors of one coordinate on an interval; an infinite one is an OptionError."""

    coordinate: str
    interval: tuple[float, float]
    function: Callable[[Array], Array]

    @classmethod
    def of(cls, system: System, domain: Domain) -> Iterator[KnownFactors]:
        """The factors of time, then those of each parameter."""
        yield cls("time", domain.horizon, system.time_factors)
        for j, (name, interval) in enumerate(zip(system.parameters, domain.box, strict=True)):
            yield cls(quote(name), interval, partial(system.parameter_factors, j))

    def __call__(self, points: Array) -> Array:
        """Values at points (N,): shape (factors, N)."""
        with np.errstate(all="ignore"):
            factors = self.function(points)
        if not np.isfinite(factors).all():
            raise self.not_finite()
        return factors

    def not_finite(self) -> OptionError:
        """The error for a pole."""
        lower, upper = self.interval
        return OptionError(
            f"a coefficient is not finite for {self.coordinate} in [{lower:g}, {upper:g}]",
            remedy="choose a range on which all coefficients are finite",
        )


def check_factors(system: System, domain: Domain) -> None:
    """Raise an OptionError if a known factor is not finite at a sample of a coordinate, or at 0."""
    for factors in KnownFactors.of(system, domain):
        lower, upper = factors.interval
        factors(np.append(np.linspace(lower, upper, MANY_SAMPLES + 1), min(max(lower, 0.0), upper)))


@dataclass(frozen=True)
class Check:
    """How a solution is compared with reference trajectories.

    ``points`` in the interior are checked, none with 0. ``cover`` is "interior" or "box", whether
    success covers the corners too; None: it does where there are few parameters. ``states`` are
    those that are asked for, whose error counts; None for all.
    """

    points: int = USUAL_POINTS
    cover: str | None = None
    states: tuple[int, ...] | None = None

    @classmethod
    def of(
        cls,
        system: System,
        check: int = USUAL_POINTS,
        cover: str | None = None,
        unknowns: object = None,
    ) -> Check:
        """The check for arguments of ``solve``, or an OptionError."""
        points = checked_number("check", check, 0, MOST_POINTS)
        if cover is not None and (not isinstance(cover, str) or cover not in _COVERS):
            raise OptionError(
                f"cover={cover!r} is not valid", remedy="choose 'interior' or 'box'", term=cover
            )
        states = counted_states(system, unknowns)
        every = states is None or len(states) == len(system.unknowns)
        return cls(points, cover, None if every else states)


@dataclass(frozen=True)
class Limits:
    """The budget of a solve: operations of counted work, bytes, and seconds if a user set them."""

    operations: float = math.inf
    seconds: float = math.inf
    memory: float = math.inf

    @classmethod
    def of(
        cls,
        system: System | FieldSystem,
        effort: str | float = "normal",
        max_seconds: float | None = None,
        max_memory: str | float | None = None,
    ) -> Limits:
        """The limits for arguments of ``solve``, or an OptionError."""
        factor = _USER_FUNCTION_FACTOR if system.user_functions else 1.0
        operations = operations_for(effort) * factor
        seconds, memory = math.inf, _MEMORY
        if max_seconds is not None:
            seconds = checked_number("max_seconds", max_seconds, 0.0, kind=float)
        if max_memory is not None:
            memory = checked_memory("max_memory", max_memory)
        return cls(operations, seconds, memory)

    def scaled(self, factor: float) -> Limits:
        """A fraction of these limits."""
        operations = max(factor * self.operations, LEAST_EFFORT * NORMAL)
        return replace(self, operations=operations, seconds=factor * self.seconds)


@dataclass(frozen=True)
class SolveArguments:
    """Arguments of every ``solve``, beside the options of an engine."""

    rtol: float = RTOL
    parameters: Mapping[object, Sequence[object]] | None = None
    t_final: float | None = None
    check: int = USUAL_POINTS
    cover: str | None = None
    effort: str | float = "normal"
    max_seconds: float | None = None
    max_memory: str | float | None = None
    unknowns: object = None
    integrator: str = "auto"
    markers: bool = True


SOLVE_ARGUMENTS = tuple(each.name for each in fields(SolveArguments))
"""Their names."""


@dataclass(frozen=True)
class SolveRequest:
    """The request of a solve, with all arguments checked.

    ``rtol`` is the largest measured error, relative to the size of each unknown; ``options`` has
    one group for each engine that may be tried. ``measures`` are the scales, by the names of
    parameters, that this solve gave to intervals. ``integrator`` is one of
    INTEGRATORS. With ``markers``, stretches of time may end where no event of the user is: at
    markers of oscillators, and where rates switch. What is ``observed`` is kept in place of the
    states.
    """

    rtol: float
    domain: Domain
    check: Check = Check()
    limits: Limits = Limits()
    options: tuple[Options, ...] = ()
    measures: tuple[tuple[str, str], ...] = ()
    integrator: str = "auto"
    markers: bool = True
    observed: Observation | None = None

    @classmethod
    def of(
        cls,
        system: System,
        groups: Sequence[type[Options]],
        options: Mapping[str, object],
        arguments: SolveArguments,
        further: Sequence[str] = (),
    ) -> SolveRequest:
        """Check the arguments of a ``solve``; an OptionError if one is unknown or out of its range.

        Several engines, by the ``groups`` of their options, take each the ``options`` that they
        know; a single one has to know all of them. ``further`` names what the caller's ``solve``
        takes beside the arguments.
        """
        rtol = checked_rtol(arguments.rtol)
        compared = Check.of(system, arguments.check, arguments.cover, arguments.unknowns)
        keywords = (*SOLVE_ARGUMENTS, *further)
        chosen = tuple(
            group.of(
                keywords,
                **{k: v for k, v in options.items() if len(groups) == 1 or k in group.names()},
            )
            for group in groups
        )
        parameters, t_final = arguments.parameters, arguments.t_final
        domain = Domain.of(system).moved(system.parameters, parameters, t_final)
        effort, seconds = arguments.effort, arguments.max_seconds
        limits = Limits.of(system, effort, seconds, arguments.max_memory)
        words = ((_name(key), split(interval)[1]) for key, interval in (parameters or {}).items())
        measures = tuple((name, word) for name, word in words if word is not None)
        integrator = checked_integrator(arguments.integrator)
        markers = arguments.markers
        return cls(rtol, domain, compared, limits, chosen, measures, integrator, markers)

    def options_of(self, group: type[EngineOptions]) -> EngineOptions:
        """The options of one engine, by their type."""
        return next(options for options in self.options if isinstance(options, group))

    def on_box(self, intervals: Mapping[int, tuple[float, float]], factor: float) -> SolveRequest:
        """The request with other intervals of some parameters, and a fraction of the limits."""
        box = tuple(intervals.get(j, interval) for j, interval in enumerate(self.domain.box))
        domain = replace(self.domain, box=box)
        return replace(self, domain=domain, limits=self.limits.scaled(factor))


def checked_rtol(rtol: object) -> float:
    """The option ``rtol``, or an OptionError."""
    return float(checked_number("rtol", rtol, *RTOLS, float))


def checked_integrator(integrator: object) -> str:
    """The option ``integrator``, or an OptionError."""
    if not isinstance(integrator, str) or integrator not in INTEGRATORS:
        remedy = f"choose one of {', '.join(map(repr, INTEGRATORS))}"
        raise OptionError(f"integrator={integrator!r} is unknown", term=integrator, remedy=remedy)
    return integrator


def counted_states(system: System, unknowns: object) -> tuple[int, ...] | None:
    """The states whose error counts, of names, functions of time or derivatives; None for all."""
    if unknowns is None:
        return None
    states = system.unknowns
    remedy = f"give some of {listing(states)}"
    single = isinstance(unknowns, str) or hasattr(unknowns, "free_symbols")
    listed = [unknowns] if single else unknowns
    try:
        if not isinstance(listed, Iterable):
            raise TypeError
        names = [name_of(unknown) for unknown in listed]
    except (TypeError, EvaluationError):
        raise OptionError(
            f"unknowns={unknowns!r} is not a list of unknowns", term=unknowns, remedy=remedy
        ) from None
    for name in names:
        if name not in states:
            raise OptionError(
                f"there is no unknown {quote(name)}{did_you_mean(name, states)}",
                term=name,
                remedy=f"give some of {listing(states, name)}",
            )
    if not names:
        raise OptionError("unknowns is empty", remedy=remedy)
    return tuple(sorted({states.index(name) for name in names}))


# -----------------------------------------------------------------------------
# What a solve keeps of trajectories in place of their states.


@dataclass(frozen=True, eq=False)
class Observation:
    """Quantities of states, time and parameters along trajectories.

    ``rows`` are the states that they read. ``values`` takes times (T, 1), these states (k, T, m)
    and parameters (d, m), and gives for each quantity what broadcasts to (T, m). ``texts`` are
    their definitions. They may be ``states_alone``: some of the states, as they are. ``surfaces``,
    of the same arguments, vanish in the middle of what is narrow or steep in them, and at kinks.
    """

    names: tuple[str, ...]
    texts: tuple[str, ...]
    rows: tuple[int, ...]
    values: Callable[[Array, Array, Array], Sequence[Array] | Array]
    states_alone: bool = False
    surfaces: Callable[[Array, Array, Array], Sequence[Array]] | None = None

    @classmethod
    def of_some(cls, states: Sequence[str], rows: Sequence[int]) -> Observation:
        """Some of the states, by position."""
        names = tuple(states[row] for row in rows)
        return cls(names, names, tuple(rows), lambda times, seen, points: seen, True)

    def of_states(self, times: Array, states: Array, points: Array) -> Array:
        """The quantities (q, m, T) of all states (n, m, T) at times (T,), points (m, d)."""
        return self.of_rows(times, states[list(self.rows)].swapaxes(1, 2), points).swapaxes(1, 2)

    def of_rows(self, times: Array, states: Array, points: Array) -> Array:
        """The quantities (q, T, m) of the states that they read (k, T, m).

        An EvaluationError says which is not finite somewhere.
        """
        with np.errstate(all="ignore"):
            quantities = self.values(times[:, None], states, points.T)
        shape = times.size, len(points)
        sampled = np.array([np.broadcast_to(quantity, shape) for quantity in quantities], float)
        if not np.isfinite(sampled).all():
            which = int(np.argmin(np.isfinite(sampled).all(axis=(1, 2))))
            at = times[int(np.argmin(np.isfinite(sampled[which]).all(axis=1)))]
            raise EvaluationError(
                f"`{self.texts[which]}` is not finite on a trajectory, at t = {at:.6g}",
                term=self.names[which],
                remedy="change the output, or the box, so that it is finite everywhere",
            )
        return sampled

    def surfaces_at(self, times: Array, states: Array, points: Array) -> Array:
        """The surfaces (s, m, T) of all states (n, m, T) at times (T,), points (m, d)."""
        assert self.surfaces is not None
        read = states[list(self.rows)].swapaxes(1, 2)
        with np.errstate(all="ignore"):
            surfaces = self.surfaces(times[:, None], read, points.T)
        shape = times.size, len(points)
        return np.array([np.broadcast_to(each, shape).T for each in surfaces], float)
