"""The problem and the request behind a solution, as plain data; units as texts."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from enum import StrEnum

from rankone.ir.observation import Observation
from rankone.support.wording import did_you_mean

_ONE_WORD = re.compile(r"[^\s/*^·⋅()+-]+")  # A unit that needs no brackets


class Role(StrEnum):
    """The role of a state."""

    UNKNOWN = "unknown"
    """The user asked for it."""
    DERIVATIVE = "derivative"
    """A time derivative of an unknown, made a state by the reduction to first order."""
    AUXILIARY = "auxiliary"
    """A product of states, defined by an algebraic equation."""
    LIFTED = "lifted"
    """A function of other states, made a state so that the system separates."""


@dataclass(frozen=True, slots=True)
class SolutionMetadata:
    """The problem and the request as plain data: a solution needs neither SymPy nor the problem.

    ``states`` are in the order of the slabs' states, with derivatives that became states as
    ``x_t``, ``x_tt``, ...; ``parameters`` in the order of the slabs' cores. ``horizon`` is what was
    asked for; a partial solution ends earlier. ``equations`` are the problem as text, a line for
    each equation and initial value; ``source`` is the text of the generated module, ``version`` the
    rankone that solved it. ``timeless`` says that no value depends on time, which then is no
    coordinate. ``units`` has names of coordinates and states. ``distributions`` are texts,
    ``norm(1.0, 0.1)``; other parameters are uniform. ``correlations`` are pairs of parameters and
    the correlation of their Gaussian copula. ``fixed`` has the coordinates that ``fix`` or ``at``
    set. ``name`` is empty if the problem has none. ``constants`` are numbers by name, and
    ``definitions`` formulas by name, of states, coordinates and numbers. ``atol`` has absolute
    tolerances of states by name: errors are relative to the largest value plus that over ``rtol``.
    ``additive`` are parameters such as the amount of a dose: all states are proportional to each,
    and the effects of several add up, each counted from its own time. ``left_out`` are the states
    of the problem that the solve was not asked for.
    """

    states: tuple[str, ...]
    roles: tuple[Role, ...]
    parameters: tuple[str, ...]
    box: tuple[tuple[float, float], ...]
    time: str
    horizon: tuple[float, float]
    rtol: float
    method: str = "train"
    equations: tuple[str, ...] = ()
    version: str = ""
    source: str | None = None
    timeless: bool = False
    units: tuple[tuple[str, str], ...] = ()
    distributions: tuple[tuple[str, str], ...] = ()
    correlations: tuple[tuple[str, str, float], ...] = ()
    fixed: tuple[tuple[str, float], ...] = ()
    name: str = ""
    constants: tuple[tuple[str, float], ...] = ()
    definitions: tuple[tuple[str, str], ...] = ()
    atol: tuple[tuple[str, float], ...] = ()
    additive: tuple[str, ...] = ()
    left_out: tuple[str, ...] = ()

    def keeping(self, names: tuple[str, ...]) -> SolutionMetadata:
        """The metadata of a solution that holds some of the states, or quantities beside them."""
        kept = {*self.coordinates, *(name for name in names if name in self.states)}
        return replace(
            self,
            states=names,
            roles=(Role.UNKNOWN,) * len(names),
            units=tuple(unit for unit in self.units if unit[0] in kept),
            atol=tuple(size for size in self.atol if size[0] in kept),
            left_out=tuple(name for name in self.states if name not in kept),
        )

    def observing(self, observed: Observation) -> SolutionMetadata:
        """The metadata of a solution that holds what is observed in place of the states."""
        return replace(
            self.keeping(observed.names),
            equations=observed.texts,
            source=None,
            definitions=(),
            atol=(),
            additive=(),
        )

    def hint(self, name: str, *others: str) -> str:
        """What to say behind a name that is no state: that it was left out, or a similar one.

        It may also have been meant for one of the ``others``.
        """
        if name in self.left_out:
            return ", which `unknowns=` left out of the solve"
        return did_you_mean(name, [*self.states, *others])

    def derivative(self, coordinate: str) -> SolutionMetadata:
        """The metadata of a solution that holds the derivatives of the states."""
        return replace(
            self,
            equations=(),
            source=None,
            units=_of_derivatives(self.units, self.states, coordinate),
            definitions=(),
            atol=(),
            additive=(),
        )

    @property
    def coordinates(self) -> tuple[str, ...]:
        """Names of all coordinates: time, unless the solution is timeless, and the parameters."""
        return self.parameters if self.timeless else (self.time, *self.parameters)

    @property
    def statements(self) -> tuple[str, ...]:
        """The equations, and the values of fixed coordinates, as texts."""
        return *self.equations, *(f"{name} = {at!r}" for name, at in self.fixed)

    @property
    def unknowns(self) -> tuple[str, ...]:
        """Names of the unknowns."""
        return tuple(self.states[row] for row in self.unknown_rows)

    @property
    def unknown_rows(self) -> tuple[int, ...]:
        """Positions of the unknowns among the states."""
        return tuple(row for row, role in enumerate(self.roles) if role == Role.UNKNOWN)


def per(unit: str, by: str, times: int = 1) -> str:
    """The unit of a derivative, as text: a unit over another, to a power.

    >>> per("m", "s"), per("m", "s", 2), per("m/s", "1/s"), per("kg", "1")
    ('m/s', 'm/s^2', '(m/s)/(1/s)', 'kg')
    """
    if by == "1":
        return unit
    power = "" if times == 1 else f"^{times}"
    return f"{_bracketed(unit)}/{_bracketed(by)}{power}"


def _of_derivatives(
    units: tuple[tuple[str, str], ...], states: tuple[str, ...], coordinate: str
) -> tuple[tuple[str, str], ...]:
    """Units after a derivative of all states with respect to a coordinate.

    A state whose unit, or that of the coordinate, is not known has none.
    """
    by = dict(units).get(coordinate)
    return tuple(
        (name, unit if name not in states or by is None else per(unit, by))
        for name, unit in units
        if name not in states or by is not None
    )


def with_unit(text: str, units: Mapping[str, str], name: str) -> str:
    """A text with the unit of a name behind it, if there is one."""
    return f"{text} {units[name]}" if name in units else text


def _bracketed(unit: str) -> str:
    return unit if _ONE_WORD.fullmatch(unit) else f"({unit})"
