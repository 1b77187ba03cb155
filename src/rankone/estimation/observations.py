"""Measured data of some states at times, checked and put in a row."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rankone.discretization.coordinates import name_of
from rankone.solution.core import SolutionCore
from rankone.support.arrays import Array
from rankone.support.errors import OptionError
from rankone.support.wording import count, did_you_mean, listing, quote, shown

Measurements = ArrayLike | Mapping[Any, ArrayLike]
"""Numbers for all outputs, or for each by name or symbol."""


@dataclass(frozen=True)
class Observations:
    """Data in a row (m,), output after output.

    For each datum, ``owner`` is the position of its state among the observed ``names``, ``rows``
    that in the solution, and ``scale`` the factor of its residual: one over sigma, or the root of
    the weight. ``present`` marks which of all data are not missing. ``shape`` is that of the data
    as given, or the number of data of each output.
    """

    names: tuple[str, ...]
    owner: NDArray[np.intp]
    rows: NDArray[np.intp]
    times: Array
    values: Array
    scale: Array
    sigma_known: bool
    present: NDArray[np.bool_]
    shape: tuple[int, ...] | dict[str, int]

    @property
    def size(self) -> int:
        """Number of data."""
        return self.values.size

    def arranged(self, row: Array) -> Array | dict[str, Array]:
        """Numbers for each datum as the data were given; NaN where they are missing."""
        whole = np.full(self.present.size, np.nan)
        whole[self.present] = row
        if not isinstance(self.shape, dict):
            return whole.reshape(self.shape)
        columns = np.split(whole, np.cumsum(list(self.shape.values()))[:-1])
        return dict(zip(self.shape, columns, strict=True))


def observed(
    solution: SolutionCore,
    times: Measurements,
    data: Measurements,
    observe: object = None,
    *,
    sigma: Measurements | None = None,
    weights: Measurements | None = None,
    missing: str = "error",
) -> Observations:
    """Check the data of a fit.

    Parameters and errors are those of :meth:`~rankone.Solution.fit`.
    """
    if missing not in ("error", "drop"):
        raise OptionError(f"missing={missing!r} is unknown", remedy='choose "error" or "drop"')
    if sigma is not None and weights is not None:
        raise OptionError(
            "sigma and weights are both given",
            remedy="give sigma if the noise is known, weights if only its ratios are",
        )
    names = _names(solution, observe, data)
    if isinstance(data, Mapping):
        by_name = {name_of(key, solution.metadata.time): column for key, column in data.items()}
        columns = [_reals(f"the data of {quote(name)}", by_name[name]) for name in names]
        table_shape: tuple[int, ...] | None = None
    else:
        table = _reals("the data", data)
        table_shape, columns = table.shape, _columns(table, names)
    clocks = [_times_of(solution, times, name) for name in names]
    for name, clock, column in zip(names, clocks, columns, strict=True):
        if column.shape != clock.shape:
            raise OptionError(
                f"there are {count(column.size, 'value')} of {quote(name)} "
                f"at {count(clock.size, 'time')}",
                term=data,
                remedy="give one value for each time: data have the shape (times,), or "
                "(outputs, times) for several outputs",
            )
    sizes = {name: column.size for name, column in zip(names, columns, strict=True)}
    noise, option = (sigma, "sigma") if weights is None else (weights, "weights")
    spread = _spread(noise, option, sizes, table_shape)
    every = np.concatenate(columns)
    present = _present(every, missing)
    owner = np.repeat(np.arange(len(names)), list(sizes.values()))[present]
    rows = np.array([solution.states.index(name) for name in names], dtype=np.intp)
    scale = 1.0 / spread if option == "sigma" else np.sqrt(spread)
    return Observations(
        names=names,
        owner=owner,
        rows=rows[owner],
        times=np.concatenate(clocks)[present],
        values=every[present],
        scale=scale[present],
        sigma_known=sigma is not None,
        present=present,
        shape=sizes if table_shape is None else table_shape,
    )


def state_name(solution: SolutionCore, key: object) -> str:
    """The name of an unknown, or of a derivative that is a state; an OptionError if unknown."""
    name = name_of(key, solution.metadata.time)
    if name not in solution.states:
        raise OptionError(
            f"there is no unknown {quote(name)}{did_you_mean(name, solution.states)}",
            term=key,
            remedy=f"choose from {listing(solution.states)}; expressions of them are outputs, "
            "solution.output({...})",
        )
    return name


def checked_times(solution: SolutionCore, times: ArrayLike | None) -> Array:
    """Times (k,) inside of the horizon; one, its start, where nothing depends on time."""
    if times is None and not solution.metadata.timeless:
        raise OptionError("no times are given", remedy="give the time of each value")
    checked = solution._coordinates.checked(0, solution.time[:1] if times is None else times)
    if checked.ndim > 1:
        raise OptionError(
            f"times have the shape {checked.shape}", term=times, remedy="give a row of times"
        )
    return np.atleast_1d(checked)


def _names(solution: SolutionCore, observe: object, data: object) -> tuple[str, ...]:
    if observe is None:
        observe = list(data) if isinstance(data, Mapping) else list(solution.unknowns)
    keys = observe if isinstance(observe, list | tuple) else [observe]
    names = tuple(state_name(solution, key) for key in keys)
    if not names:
        raise OptionError("nothing is observed", remedy="name an unknown: observe=[...]")
    if len(set(names)) < len(names):
        raise OptionError(f"observe names one unknown twice: {listing(names)}", term=observe)
    if isinstance(data, Mapping):
        measured = [name_of(key, solution.metadata.time) for key in data]
        if sorted(measured) != sorted(names):
            raise OptionError(
                f"data are given for {listing(measured)}, observed are {listing(names)}",
                term=observe,
                remedy="leave observe out: the data name the unknowns",
            )
    return names


def _columns(table: Array, names: tuple[str, ...]) -> list[Array]:
    if table.ndim < 2 and len(names) == 1:
        return [np.atleast_1d(table)]
    if table.ndim == 2 and len(table) == len(names):
        return list(table)
    raise OptionError(
        f"the data have the shape {table.shape} for {count(len(names), 'output')}, "
        f"{listing(names)}",
        remedy="give (times,) for one output, (outputs, times) for several; observe=[...] says "
        "which outputs were measured",
    )


def _times_of(solution: SolutionCore, times: Measurements, name: str) -> Array:
    if not isinstance(times, Mapping):
        return checked_times(solution, times)
    by_name = {name_of(key, solution.metadata.time): clock for key, clock in times.items()}
    if name not in by_name:
        raise OptionError(
            f"there are no times of {quote(name)}",
            term=times,
            remedy="give times for each output that was observed, or the same for all",
        )
    return checked_times(solution, by_name[name])


def _reals(subject: str, given: ArrayLike) -> Array:
    """Real numbers, also NaN."""
    try:
        array = np.asarray(given)
        if array.dtype.kind in "biufO":
            return np.asarray(array, dtype=float)
    except (TypeError, ValueError, OverflowError):
        pass
    raise OptionError(f"{subject}, {shown(given)}, are not real numbers", term=given)


def _spread(
    given: Measurements | None,
    option: str,
    sizes: Mapping[str, int],
    table_shape: tuple[int, ...] | None,
) -> Array:
    """Sigma or the weight of each datum; the shape of the data is None if they are by name."""
    if given is None:
        return np.ones(sum(sizes.values()))
    if isinstance(given, Mapping):
        by_name = {name_of(key): spread for key, spread in given.items()}
        if sorted(by_name) != sorted(sizes):
            raise OptionError(
                f"{option} is given for {listing(by_name)}, observed are {listing(sizes)}",
                term=given,
            )
        arrays = [_reals(option, by_name[name]) for name in sizes]
    else:
        array = _reals(option, given)
        per_output = array.shape == (len(sizes),) and array.shape != table_shape
        if array.ndim and not per_output and array.shape != table_shape:
            raise OptionError(
                f"{option} has the shape {array.shape}",
                term=given,
                remedy=f"give a number, one for each output ({len(sizes)}), or the shape of "
                "the data",
            )
        rows = array.ndim == 2 or per_output
        arrays = [np.asarray(row) for row in array] if rows else [array] * len(sizes)
    for (name, size), array in zip(sizes.items(), arrays, strict=True):
        if array.shape not in ((), (size,)):
            raise OptionError(
                f"{option} of {quote(name)} has the shape {array.shape} for {count(size, 'value')}",
                term=given,
                remedy="give a number, or one for each value",
            )
    pairs = zip(arrays, sizes.values(), strict=True)
    spread = np.concatenate([np.broadcast_to(array, size) for array, size in pairs]).astype(float)
    positive = np.isfinite(spread) & (spread > 0.0)
    if not positive.all():
        raise OptionError(
            f"{option} = {spread[~positive][0]:g} is not a positive number", term=given
        )
    return spread


def _present(every: Array, missing: str) -> NDArray[np.bool_]:
    """Which data are present; an error for infinite ones, and for NaN unless they are dropped."""
    if np.isinf(every).any():
        raise OptionError("the data have infinite values", remedy="leave them out")
    present: NDArray[np.bool_] = ~np.isnan(every)
    if missing == "error" and not present.all():
        raise OptionError(
            f"{np.count_nonzero(~present)} of {every.size} data are NaN",
            remedy='leave them out, or give missing="drop"',
        )
    return present
