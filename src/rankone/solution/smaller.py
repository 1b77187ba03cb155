"""Solutions made of solutions: fewer parameters, a smaller box, derivatives."""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Set
from dataclasses import replace
from typing import Any

import numpy as np

from rankone.discretization.coordinates import name_of, round_off
from rankone.ir.metadata import SolutionMetadata, of_derivatives
from rankone.ir.outcome import Outcome
from rankone.ir.verdict import DerivativeOf, MeasuredError, PartOfSolution, Status, UncertainPart
from rankone.support.errors import OptionError
from rankone.support.wording import did_you_mean, listing, quote
from rankone.tensors.slab import at_one_time, differentiated, fixed, restricted

__all__ = ["at_time", "derived", "merged", "with_fixed", "with_restricted"]

_NARROWEST = 1e-6
"""Width of the smallest interval, in widths of the one before: derivatives grow with rounding."""

_Pair = tuple[Outcome, SolutionMetadata]


def derived(outcome: Outcome, metadata: SolutionMetadata, coordinate: Any) -> _Pair:
    """The derivatives of all states with respect to a parameter or time; their error is unknown."""
    name = name_of(coordinate)
    if name == metadata.time and not metadata.timeless:
        slabs = tuple(slab.derivative() for slab in outcome.slabs)
    else:
        slabs = differentiated(outcome.slabs, _position(metadata, name))
    made = replace(
        outcome,
        slabs=slabs,
        status=Status.UNCHECKED,
        measured=None,
        history=(),
        cause=DerivativeOf(name),
        notes=(),
    )
    units = of_derivatives(metadata.units, metadata.states, name)
    return made, replace(metadata, equations=(), source=None, units=units)


def at_time(outcome: Outcome, metadata: SolutionMetadata, time: float) -> _Pair:
    """The same at one time, which is no coordinate any more."""
    slab = at_one_time(outcome.slabs, time, metadata.horizon)
    fixed = (*metadata.fixed, (metadata.time, float(time)))
    metadata = replace(metadata, source=None, timeless=True, fixed=fixed)
    return _part(replace(outcome, slabs=(slab,)), metadata.rtol), metadata


def with_fixed(outcome: Outcome, metadata: SolutionMetadata, given: Mapping[Any, Any]) -> _Pair:
    """The same for given values of some parameters, which are no coordinates any more."""
    for key, value in given.items():
        j = _position(metadata, name_of(key))
        name, (lower, upper) = metadata.parameters[j], metadata.box[j]
        number = _number(name, value, lower, upper)
        outcome = replace(outcome, slabs=fixed(outcome.slabs, j, number))
        metadata = replace(
            metadata,
            units=tuple(pair for pair in metadata.units if pair[0] != metadata.parameters[j]),
            parameters=_without(metadata.parameters, j),
            box=_without(metadata.box, j),
            distributions=tuple(pair for pair in metadata.distributions if pair[0] != name),
            correlations=tuple(c for c in metadata.correlations if name not in c[:2]),
            fixed=(*metadata.fixed, (name, number)),
        )
    return _part(outcome, metadata.rtol), replace(metadata, source=None)


def with_restricted(
    outcome: Outcome, metadata: SolutionMetadata, given: Mapping[Any, Sequence[float]]
) -> _Pair:
    """The same for smaller intervals of some parameters."""
    for key, interval in given.items():
        j = _position(metadata, name_of(key))
        name, (lower, upper) = metadata.parameters[j], metadata.box[j]
        try:
            if isinstance(interval, str | Set | Mapping):
                raise TypeError
            low, high = interval
        except (TypeError, ValueError):
            raise OptionError(
                f"the interval of {quote(name)} is {interval!r}, not a pair of numbers",
                term=interval,
                remedy=f"give ({lower:g}, {upper:g}) or a part of it",
            ) from None
        low, high = (_number(name, end, lower, upper) for end in (low, high))
        if 0.0 < high - low < _NARROWEST * (upper - lower):
            raise OptionError(
                f"the interval ({low!r}, {high!r}) of {quote(name)} is too narrow",
                term=interval,
                remedy="fix a single value instead",
            )
        if not low < high:
            raise OptionError(
                f"the interval ({low:g}, {high:g}) of {quote(name)} does not ascend",
                term=interval,
                remedy="fix a single value instead" if low == high else f"give ({high:g}, {low:g})",
            )
        box = [*metadata.box]
        box[j] = (low, high)
        outcome = replace(outcome, slabs=restricted(outcome.slabs, j, (low, high)))
        metadata = replace(metadata, box=tuple(box))
    return _part(outcome, metadata.rtol), metadata


def merged(values: Any, named: Mapping[str, Any]) -> dict[str, Any]:
    """What was given by symbols and by keywords, by name.

    Raises
    ------
    OptionError
        If it is no mapping, or a name is given twice.
    """
    if not isinstance(values, Mapping | None):
        raise OptionError(
            f"{values!r} is not a mapping from names to values",
            term=values,
            remedy="give {name: value}, or keywords",
        )
    found = dict(named)
    for key, value in (values or {}).items():
        name = name_of(key)
        if name in found:
            raise OptionError(f"{quote(name)} is given twice", term=name, remedy="give it once")
        found[name] = value
    return found


def _position(metadata: SolutionMetadata, name: str) -> int:
    """Which parameter a name is."""
    if name not in metadata.parameters:
        known = metadata.parameters
        raise OptionError(
            f"there is no parameter {quote(name)}{did_you_mean(name, known)}",
            term=name,
            remedy=f"known are {listing(known)}" if known else "the solution has none",
        )
    return metadata.parameters.index(name)


def _number(name: str, value: Any, lower: float, upper: float) -> float:
    """A value inside of an interval."""
    try:
        if isinstance(value, str | bool):
            raise TypeError
        number = float(value)
    except (TypeError, ValueError, OverflowError):
        raise OptionError(f"{quote(name)} is {value!r}, not a number", term=value) from None
    slack = round_off(lower, upper)
    if not lower - slack <= number <= upper + slack:
        raise OptionError(
            f"{quote(name)} = {number:g} is outside of its range [{lower:g}, {upper:g}]",
            term=value,
            remedy="nothing is extrapolated; choose values inside",
        )
    return float(np.clip(number, lower, upper))


def _without(values: tuple[Any, ...], position: int) -> tuple[Any, ...]:
    return (*values[:position], *values[position + 1 :])


def _part(outcome: Outcome, rtol: float) -> Outcome:
    """What was measured on the whole box, said of a part of it.

    A part may be at the corners: where they did not count, and are worse, its error is not known.
    """
    measured = outcome.measured
    if measured is None or any(isinstance(note, PartOfSolution) for note in outcome.notes):
        return outcome
    status, cause, notes = outcome.status, outcome.cause, outcome.notes
    if status is Status.CONVERGED and measured.corner_error > rtol:
        status, cause = Status.UNCHECKED, UncertainPart(measured.corner_error)
        notes = tuple(note for note in notes if not isinstance(note, MeasuredError))
    measured = replace(measured, worst=(), quantile=None)
    return replace(
        outcome,
        status=status,
        cause=cause,
        notes=(*notes, PartOfSolution()),
        measured=measured,
        history=(),
    )
