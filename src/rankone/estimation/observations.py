"""What was measured: data of some states at times, checked and put in a row."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rankone.discretization.coordinates import name_of
from rankone.solution.core import SolutionCore
from rankone.support.arrays import Array
from rankone.support.errors import OptionError
from rankone.support.wording import count, did_you_mean, listing, quote, shown

__all__ = ["Observations", "checked_times", "observed", "state_name"]


@dataclass(frozen=True)
class Observations:
    """Data in a row, output after output.

    Attributes
    ----------
    names : tuple of str
        The states observed.
    owner : ndarray of int (m,)
        Which of them each datum is of.
    rows : ndarray of int (m,)
        Its position among the states of the solution.
    times, values : ndarray (m,)
    scale : ndarray (m,)
        What residuals are multiplied with: one over sigma, or the root of the weight.
    known : bool
        Whether sigma is known.
    present : ndarray of bool (all data)
        Data that are not missing.
    shape : tuple of int, or tuple of (str, int)
        Shape of the data as given, or name and number of each.
    """

    names: tuple[str, ...]
    owner: NDArray[np.intp]
    rows: NDArray[np.intp]
    times: Array
    values: Array
    scale: Array
    known: bool
    present: NDArray[np.bool_]
    shape: tuple[Any, ...]

    @property
    def size(self) -> int:
        """Number of data."""
        return self.values.size

    def arranged(self, row: Array) -> Any:
        """Numbers for each datum as the data were given; NaN where they are missing."""
        whole = np.full(self.present.size, np.nan)
        whole[self.present] = row
        if not self.shape or not isinstance(self.shape[0], tuple):
            return whole.reshape(self.shape)
        ends = np.cumsum([number for _, number in self.shape])[:-1]
        parts = np.split(whole, ends)
        return {name: part for (name, _), part in zip(self.shape, parts, strict=True)}


def observed(
    solution: SolutionCore,
    times: Any,
    data: Any,
    observe: Any = None,
    *,
    sigma: Any = None,
    weights: Any = None,
    missing: str = "error",
) -> Observations:
    """Check what was measured.

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
    by_name = isinstance(data, Mapping)
    if by_name:
        shape: tuple[Any, ...] = ()
        each = {name_of(key, solution.metadata.time): value for key, value in data.items()}
        columns = [_numbers(f"the data of {quote(name)}", each[name]) for name in names]
    else:
        table = _numbers("the data", data)
        shape = table.shape
        columns = _columns(table, names)
    clocks = [_times_of(solution, times, name, len(names)) for name in names]
    for name, clock, column in zip(names, clocks, columns, strict=True):
        if column.shape != clock.shape:
            raise OptionError(
                f"there are {count(column.size, 'value')} of {quote(name)} "
                f"at {count(clock.size, 'time')}",
                term=data,
                remedy="give one value for each time: data have the shape (times,), or "
                "(outputs, times) for several outputs",
            )
    if by_name:
        shape = tuple((name, column.size) for name, column in zip(names, columns, strict=True))
    sizes = [column.size for column in columns]
    given, what = (sigma, "sigma") if weights is None else (weights, "weights")
    spread = _spread(given, what, names, sizes, shape)
    values = np.concatenate(columns)
    present = _present(values, missing)
    owner = np.repeat(np.arange(len(names)), sizes)[present]
    rows = np.array([solution.states.index(name) for name in names], dtype=np.intp)
    scale = 1.0 / spread if what == "sigma" else np.sqrt(spread)
    return Observations(
        names=names,
        owner=owner,
        rows=rows[owner],
        times=np.concatenate(clocks)[present],
        values=values[present],
        scale=scale[present],
        known=sigma is not None,
        present=present,
        shape=shape,
    )


def state_name(solution: SolutionCore, key: Any) -> str:
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


def checked_times(solution: SolutionCore, times: Any) -> Array:
    """Times (k,) inside of the horizon; one, its start, where nothing depends on time.

    Raises
    ------
    EvaluationError
        If a time is outside of the horizon or no number.
    OptionError
        If there are none, or they are no one-dimensional row.
    """
    if times is None and not solution.metadata.timeless:
        raise OptionError("no times are given", remedy="give the time of each value")
    checked = solution._coordinates.checked(0, solution.time[:1] if times is None else times)
    if checked.ndim > 1:
        raise OptionError(
            f"times have the shape {checked.shape}", term=times, remedy="give a row of times"
        )
    return np.atleast_1d(checked)


def _names(solution: SolutionCore, observe: Any, data: Any) -> tuple[str, ...]:
    """The states observed."""
    if observe is None:
        observe = list(data) if isinstance(data, Mapping) else list(solution.unknowns)
    keys = observe if isinstance(observe, list | tuple) else [observe]
    names = tuple(state_name(solution, key) for key in keys)
    if not names:
        raise OptionError("nothing is observed", remedy="name an unknown: observe=[...]")
    if len(set(names)) < len(names):
        raise OptionError(f"observe names one unknown twice: {listing(names)}", term=observe)
    if isinstance(data, Mapping):
        there = [name_of(key, solution.metadata.time) for key in data]
        if sorted(there) != sorted(names):
            raise OptionError(
                f"data are given for {listing(there)}, observed are {listing(names)}",
                term=observe,
                remedy="leave observe out: the data say it",
            )
    return names


def _columns(table: Array, names: tuple[str, ...]) -> list[Array]:
    """The data of each output."""
    if table.ndim == 1 and len(names) == 1:
        return [table]
    if table.ndim == 0 and len(names) == 1:
        return [table.reshape(1)]
    if table.ndim == 2 and len(table) == len(names):
        return list(table)
    raise OptionError(
        f"the data have the shape {table.shape} for {count(len(names), 'output')}, "
        f"{listing(names)}",
        remedy="give (times,) for one output, (outputs, times) for several; observe=[...] says "
        "which outputs were measured",
    )


def _times_of(solution: SolutionCore, times: Any, name: str, outputs: int) -> Array:
    """Times of one output."""
    if not isinstance(times, Mapping):
        return checked_times(solution, times)
    by_name = {name_of(key, solution.metadata.time): value for key, value in times.items()}
    if name not in by_name:
        raise OptionError(
            f"there are no times of {quote(name)}",
            term=times,
            remedy="give times for each output that was observed, or the same for all",
        )
    return checked_times(solution, by_name[name])


def _numbers(what: str, given: Any) -> Array:
    """Real numbers, also NaN."""
    try:
        array = np.asarray(given)
        if array.dtype.kind in "biufO":
            return np.asarray(array, dtype=float)
    except (TypeError, ValueError, OverflowError):
        pass
    raise OptionError(f"{what}, {shown(given)}, are not real numbers", term=given)


def _spread(
    given: Any, what: str, names: tuple[str, ...], sizes: list[int], shape: tuple[Any, ...]
) -> Array:
    """Sigma or the weight of each datum."""
    total = sum(sizes)
    if given is None:
        return np.ones(total)
    if isinstance(given, Mapping):
        by_name = {name_of(key): value for key, value in given.items()}
        if sorted(by_name) != sorted(names):
            raise OptionError(
                f"{what} is given for {listing(by_name)}, observed are {listing(names)}",
                term=given,
            )
        parts: Iterable[Any] = [by_name[name] for name in names]
        arrays = [_numbers(what, part) for part in parts]
    else:
        array = _numbers(what, given)
        per_output = array.shape == (len(names),) and array.shape != shape
        if array.ndim and not per_output and array.shape != shape:
            raise OptionError(
                f"{what} has the shape {array.shape}",
                term=given,
                remedy=f"give a number, one for each output ({len(names)}), or the shape of "
                "the data",
            )
        if array.ndim == 2:
            arrays = list(array)
        elif per_output:
            arrays = [np.asarray(value) for value in array]
        else:
            arrays = [array] * len(names)
    for name, part, size in zip(names, arrays, sizes, strict=True):
        if part.shape not in ((), (size,)):
            raise OptionError(
                f"{what} of {quote(name)} has the shape {part.shape} for {count(size, 'value')}",
                term=given,
                remedy="give a number, or one for each value",
            )
    found = np.concatenate(
        [np.broadcast_to(part, size) for part, size in zip(arrays, sizes, strict=True)]
    ).astype(float)
    if not (np.isfinite(found) & (found > 0.0)).all():
        worst = found[~(np.isfinite(found) & (found > 0.0))][0]
        raise OptionError(f"{what} = {worst:g} is not a positive number", term=given)
    return found


def _present(values: Array, missing: str) -> NDArray[np.bool_]:
    """Which data are there; an error for those that are no numbers, unless they may miss."""
    if np.isinf(values).any():
        raise OptionError("the data have infinite values", remedy="leave them out")
    present: NDArray[np.bool_] = ~np.isnan(values)
    if missing == "error" and not present.all():
        raise OptionError(
            f"{np.count_nonzero(~present)} of {values.size} data are NaN",
            remedy='leave them out, or give missing="drop"',
        )
    return present
