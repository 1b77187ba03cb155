"""Measured data at times, checked and put in a row, and what was measured."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rankone.inference.estimation.formulas import Formula, formula_of
from rankone.inference.estimation.noise import Noise, noise_of, usual_levels
from rankone.solution.evaluation.core import SolutionCore
from rankone.support.arrays import Array
from rankone.support.errors import (
    SIMILAR,
    EvaluationError,
    OptionError,
    count,
    did_you_mean,
    listing,
    quote,
    shown,
)
from rankone.tensors.coordinates import name_of

Measurements = ArrayLike | Mapping[Any, ArrayLike]
"""Numbers for all observables, or for each by name or symbol."""
Sigma = Measurements | str | Mapping[Any, Any] | None
"""Standard deviations: numbers, or expressions as text or symbols; perhaps by observable."""


@dataclass(frozen=True)
class Observations:
    """Data in a row (m,), observable after observable.

    ``formulas`` has what each of the observables ``names`` is, ``noises`` the noise of each. For
    each datum, ``owner`` is the position of its observable. ``present`` marks which of all data are
    not missing. ``shape`` is that of the data as given, or the number of data of each observable.
    ``sigma_known`` is False if the standard deviations are known up to a factor, ``weighted`` True
    if weights say so.
    """

    names: tuple[str, ...]
    formulas: tuple[Formula, ...]
    noises: tuple[Noise, ...]
    owner: NDArray[np.intp]
    times: Array
    values: Array
    sigma_known: bool
    present: NDArray[np.bool_]
    shape: tuple[int, ...] | dict[str, int]
    weighted: bool = False

    @property
    def size(self) -> int:
        """Number of data."""
        return self.values.size

    @property
    def levels(self) -> tuple[str, ...]:
        """Parameters of the noise alone."""
        return tuple(dict.fromkeys(name for noise in self.noises for name in noise.levels))

    def of(self, index: int) -> slice:
        """The data of one observable among the row."""
        begin, end = np.searchsorted(self.owner, [index, index + 1])
        return slice(int(begin), int(end))

    def arranged(self, row: Array) -> Array | dict[str, Array]:
        """Numbers for each datum as the data were given; NaN where they are missing."""
        whole = np.full(self.present.size, np.nan)
        whole[self.present] = row
        if not isinstance(self.shape, dict):
            return whole.reshape(self.shape)
        columns = np.split(whole, np.cumsum(list(self.shape.values()))[:-1])
        return dict(zip(self.shape, columns, strict=True))


class DataOptions(NamedTuple):
    """What a user says of the noise of data, and of those that are missing."""

    sigma: Sigma = None
    noise: object = None
    weights: Measurements | None = None
    missing: str = "error"


def observed(
    solution: SolutionCore,
    times: Measurements,
    data: Measurements,
    observe: object = None,
    options: DataOptions | None = None,
) -> Observations:
    """Check the data of a fit.

    Parameters and errors are those of :meth:`~rankone.Solution.fit`.
    """
    options = options or DataOptions()
    _check_options(options)
    formulas = observables(solution, observe, data)
    names = tuple(formulas)
    columns, table_shape = _rows_of(data, names, solution.metadata.time)
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
    every = np.concatenate(columns)
    present = _present(every, options.missing)
    noises = _noises(solution, sizes, table_shape, options, present)
    owner = np.repeat(np.arange(len(names)), list(sizes.values()))[present]
    observations = Observations(
        names=names,
        formulas=tuple(formulas.values()),
        noises=noises,
        owner=owner,
        times=np.concatenate(clocks)[present],
        values=every[present],
        sigma_known=options.sigma is not None or options.noise is not None,
        present=present,
        shape=sizes if table_shape is None else table_shape,
        weighted=options.weights is not None,
    )
    _check_logarithms(observations)
    return observations


def _check_options(options: DataOptions) -> None:
    """Raise if options of a fit are unknown, or contradict each other."""
    sigma, noise, weights, missing = options
    if missing not in ("error", "drop"):
        raise OptionError(f"missing={missing!r} is unknown", remedy='choose "error" or "drop"')
    if weights is not None and not (sigma is None and noise is None):
        option = "noise" if sigma is None else "sigma"
        raise OptionError(
            f"{option} and weights are both given",
            remedy="give sigma if the noise is known, weights if only its ratios are",
        )


def state_name(solution: SolutionCore, key: object) -> str:
    """The name of an unknown, or of a derivative that is a state; an OptionError if unknown."""
    name = name_of(key, solution.metadata.time)
    if name not in solution.states:
        raise OptionError(
            f"there is no unknown {quote(name)}{solution.metadata.hint(name)}",
            term=key,
            remedy=f"choose from {listing(solution.states, name)}",
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


# --- what was measured ---------------------------------------------------------------------------


def observables(solution: SolutionCore, observe: object, data: object) -> dict[str, Formula]:
    """What was measured, by name: unknowns, or expressions of them."""
    if observe is None:
        observe = list(data) if isinstance(data, Mapping) else list(solution.unknowns)
    if isinstance(observe, Mapping):
        pairs = [(label(solution, key), entry) for key, entry in observe.items()]
    else:
        keys = observe if isinstance(observe, list | tuple) else [observe]
        pairs = [(label(solution, key), key) for key in keys]
    if not pairs:
        raise OptionError("nothing is observed", remedy="name an unknown: observe=[...]")
    names = [name for name, _ in pairs]
    if len(set(names)) < len(names):
        raise OptionError(f"observe names one unknown twice: {listing(names)}", term=observe)
    formulas = {name: _observable(solution, entry) for name, entry in pairs}
    if isinstance(data, Mapping):
        measured = [label(solution, key) for key in data]
        if sorted(measured) != sorted(names):
            raise OptionError(
                f"data are given for {listing(measured)}, observed are {listing(names)}",
                term=observe,
                remedy="leave observe out: the data name the unknowns",
            )
    return formulas


def label(solution: SolutionCore, key: object) -> str:
    """The name of an observable: of an unknown, or the text of an expression."""
    try:
        return name_of(key, solution.metadata.time)
    except EvaluationError:
        return str(key)


def _observable(solution: SolutionCore, entry: object) -> Formula:
    formula = formula_of(entry, solution.metadata.time)
    if formula.is_name:
        state_name(solution, formula.names[0])
    elif not set(formula.names) & set(solution.states):
        near = [solution.metadata.hint(name) for name in formula.names]
        raise OptionError(
            f"{quote(entry)} depends on no unknown{next(filter(None, near), '')}",
            term=entry,
            remedy=f"write it by {listing(solution.states)}",
        )
    return formula


def _rows_of(
    data: Measurements, names: tuple[str, ...], time: str
) -> tuple[list[Array], tuple[int, ...] | None]:
    """The data of each observable, and the shape of an array of all of them."""
    if isinstance(data, Mapping):
        named = {_key(key, time): column for key, column in data.items()}
        return [_reals(f"the data of {quote(name)}", named[name]) for name in names], None
    table = _reals("the data", data)
    if table.ndim < 2 and len(names) == 1:
        return [np.atleast_1d(table)], table.shape
    if table.ndim == 2 and len(table) == len(names):
        return list(table), table.shape
    raise OptionError(
        f"the data have the shape {table.shape} for {count(len(names), 'output')}, "
        f"{listing(names)}",
        remedy="give (times,) for one output, (outputs, times) for several; observe=[...] says "
        "which outputs were measured",
    )


def _key(key: object, time: str) -> str:
    try:
        return name_of(key, time)
    except EvaluationError:
        return str(key)


def _times_of(solution: SolutionCore, times: Measurements, name: str) -> Array:
    if not isinstance(times, Mapping):
        return checked_times(solution, times)
    by_name = {label(solution, key): clock for key, clock in times.items()}
    if name not in by_name:
        raise OptionError(
            f"there are no times of {quote(name)}",
            term=times,
            remedy="give times for each output that was observed, or the same for all",
        )
    return checked_times(solution, by_name[name])


def _reals(subject: str, given: Any) -> Array:
    """Real numbers, also NaN."""
    try:
        array = np.asarray(given)
        if array.dtype.kind in "biufO":
            return np.asarray(array, dtype=float)
    except (TypeError, ValueError, OverflowError):
        pass
    raise OptionError(f"{subject}, {shown(given)}, are not real numbers", term=given)


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


# --- noise ---------------------------------------------------------------------------------------


def _noises(
    solution: SolutionCore,
    sizes: Mapping[str, int],
    table_shape: tuple[int, ...] | None,
    options: DataOptions,
    present: NDArray[np.bool_],
) -> tuple[Noise, ...]:
    """The noise of each observable, for the data that are present."""
    sigma, noise, weights, _ = options
    option = "sigma" if weights is None else "weights"
    kinds = _by_observable(solution, "noise", noise, sizes)
    spreads = _by_observable(solution, "sigma", sigma, sizes)
    texts = {name: entry for name, entry in spreads.items() if _is_expression(entry)}
    numbers: Any = sigma if weights is None else weights
    if isinstance(weights, Mapping):
        numbers = _by_observable(solution, option, weights, sizes)
    elif texts or isinstance(sigma, Mapping):
        plain = {name: entry for name, entry in spreads.items() if name not in texts}
        numbers = {name: plain.get(name, 1.0) for name in sizes}
    rows = _spread(numbers, option, sizes, table_shape)
    noises = []
    ends = np.cumsum(list(sizes.values()))[:-1]
    for name, row, here in zip(sizes, rows, np.split(present, ends), strict=True):
        kind = kinds.get(name)
        own = name in spreads if isinstance(sigma, Mapping) else sigma is not None
        if name in texts:
            distribution = _expressed(solution, name, texts[name], kind, row)
        elif kind is None and (own or (sigma is None and noise is None)):
            distribution = Noise("normal", 1.0 / np.sqrt(row) if option == "weights" else row)
        else:
            distribution = noise_of(kind or "constant", name, row, given=own)
        noises.append(distribution.selected(here))
    return tuple(noises)


def _is_expression(entry: object) -> bool:
    return isinstance(entry, str) or hasattr(entry, "free_symbols")


def _by_observable(
    solution: SolutionCore, option: str, given: object, sizes: Mapping[str, int]
) -> dict[str, Any]:
    """What is given for each observable: for all of them, or by name; nothing for arrays.

    Weights have to be given for all, since only their ratios count.
    """
    if isinstance(given, Mapping):
        named = {label(solution, key): entry for key, entry in given.items()}
        if not set(named) <= set(sizes) or (option == "weights" and len(named) < len(sizes)):
            raise OptionError(
                f"{option} is given for {listing(named)}, observed are {listing(sizes)}",
                term=given,
            )
        return named
    return dict.fromkeys(sizes, given) if _is_expression(given) or option == "noise" else {}


def _expressed(
    solution: SolutionCore, observable: str, given: object, kind: object, row: Array
) -> Noise:
    """Noise whose standard deviation is an expression; new names in it are its levels."""
    if kind not in (None, "constant", "log-normal", "student"):
        raise OptionError(
            f"noise={kind!r} has a standard deviation of its own, and sigma is an expression",
            term=given,
            remedy='leave noise out, or choose "log-normal" or "student"',
        )
    formula = formula_of(given, solution.metadata.time)
    names = {*solution.states, *solution.parameters, solution.metadata.time, observable}
    levels = tuple(name for name in formula.names if name not in names)
    distribution = str(kind) if kind in ("log-normal", "student") else "normal"
    return Noise(distribution, row, formula, levels, levels)


def check_levels(
    solution: SolutionCore, observations: Observations, declared: Collection[str] = ()
) -> None:
    """Raise an OptionError for levels of noise that look like misspelt names.

    Those that are ``declared`` by bounds or a value do not, nor those with the usual names.
    """
    for observable, noise in zip(observations.names, observations.noises, strict=True):
        names = {*solution.states, *solution.parameters, solution.metadata.time, observable}
        for name in noise.levels:
            if name in declared or name in usual_levels(observable):
                continue
            near = did_you_mean(name, names, SIMILAR)
            if near:
                raise OptionError(
                    f"sigma of {quote(observable)}: {quote(name)} is unknown{near}",
                    term=name,
                    remedy="choose a name for a level of noise that is less like it, upper and "
                    "lower case aside; in a fit it may also have bounds",
                )


def _spread(
    given: Any,
    option: str,
    sizes: Mapping[str, int],
    table_shape: tuple[int, ...] | None,
) -> list[Array]:
    """Sigma or the weight of each datum; the shape of the data is None if they are by name."""
    if given is None:
        return [np.ones(size) for size in sizes.values()]
    if isinstance(given, Mapping):
        arrays = [_reals(option, given[name]) for name in sizes]
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
    spreads = [np.broadcast_to(array, size).astype(float) for array, size in pairs]
    for spread in spreads:
        positive = np.isfinite(spread) & (spread > 0.0)
        if not positive.all():
            raise OptionError(
                f"{option} = {spread[~positive][0]:g} is not a positive number", term=given
            )
    return spreads


def _check_logarithms(observations: Observations) -> None:
    """Raise an OptionError for data without a logarithm under log-normal noise."""
    for i, (name, noise) in enumerate(zip(observations.names, observations.noises, strict=True)):
        data = observations.values[observations.of(i)]
        if noise.distribution == "log-normal" and not (data > 0.0).all():
            raise OptionError(
                f"{data[data <= 0.0][0]:g} of {quote(name)} is not positive, as log-normal noise "
                "wants it",
                remedy='leave it out, or choose noise="combined"',
            )
