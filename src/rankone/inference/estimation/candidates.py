"""The information of measurements at candidate times, for designs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from rankone.inference.estimation.doses import Doses
from rankone.inference.estimation.experiments import Trial, held_parameters, trial_of
from rankone.inference.estimation.fit import Fit
from rankone.inference.estimation.formulas import Formula, value_of
from rankone.inference.estimation.free_parameters import Range, free_parameters
from rankone.inference.estimation.likelihood import Likelihood
from rankone.inference.estimation.noise import Noise
from rankone.inference.estimation.observations import (
    Observations,
    Sigma,
    check_levels,
    checked_times,
    label,
    observables,
    observed,
)
from rankone.inference.estimation.ranges import vanishing_noise
from rankone.solution.evaluation.core import SolutionCore
from rankone.support.arrays import Array
from rankone.support.errors import OptionError
from rankone.support.wording import did_you_mean, listing, quote
from rankone.tensors.bases.coordinates import name_of


@dataclass(frozen=True)
class Candidates:
    """Information of p parameters at P points, in units of the scale (p,) of each parameter.

    ``each`` (P, N, p, p) is that of all ``data`` at each candidate, ``base`` (P, p, p) what is
    known before. ``values`` are the means of the points.
    """

    names: tuple[str, ...]
    values: dict[str, float]
    scale: Array
    base: Array
    each: Array
    data: int
    trial: Trial
    points: Array

    def at_times(self, times: ArrayLike) -> Array:
        """The information of all data at other times, (P, k, p, p)."""
        row, solution = self.trial.observations, self.trial.solution
        pairs = zip(row.formulas, row.noises, strict=True)
        own = dict(zip(row.names, pairs, strict=True))
        clock, doses = checked_times(solution, times), self.trial.doses
        trial = _measured(solution, self.trial.fixed, own, clock, 1.0, doses)
        return _information(trial, self.names, self.points, self.scale)

    def curves(self) -> Array:
        """What each observable will be at the candidates, (observables, N)."""
        at = {name: np.array([x]) for name, x in self.values.items()}
        with np.errstate(all="ignore"):
            predicted = self.trial.predicted(at, self.trial.states(at))
        size = self.each.shape[1]
        return np.array([np.broadcast_to(value_of(one.value), (1, size))[0] for one in predicted])

    def scaled(self, information: Array) -> Array:
        """Information (..., p, p) in units of the scale."""
        return information * np.outer(self.scale, self.scale)

    def unscaled(self, information: Array) -> Array:
        """Information (..., p, p) in the units of the parameters."""
        return information / np.outer(self.scale, self.scale)


class Wanted(NamedTuple):
    """What is to be measured: the arguments of a design."""

    observe: object
    sigma: Sigma
    noise: object
    fixed: Mapping[Any, float] | None


def candidates_of(
    solution: SolutionCore,
    times: Array,
    at: Mapping[Any, ArrayLike] | None,
    after: Fit | None,
    wanted: Wanted,
) -> Candidates:
    """The information at candidate times (N,); see :func:`~.design.design` for the arguments."""
    if after is None:
        trial = _new_trial(solution, times, wanted)
    else:
        at = after.x if at is None else at
        trial = _trial_after(solution, after, times, wanted)
    points, names = _points(trial, at, after)
    scale = np.where(points.mean(axis=0) != 0.0, np.abs(points.mean(axis=0)), 1.0)
    base = np.zeros((len(points), len(names), len(names)))
    if after is not None:
        base = base + after.information * np.outer(scale, scale)
    each = _information(trial, names, points, scale)
    values = dict(zip(names, map(float, points.mean(axis=0)), strict=True))
    data = len(trial.observations.names)
    return Candidates(names, values, scale, base, each, data, trial, points)


def _new_trial(solution: SolutionCore, times: Array, wanted: Wanted) -> Trial:
    """Measurements at times (N,) of what nobody has measured yet."""
    observe, sigma, noise, fixed = wanted
    names = tuple(observables(solution, observe, None))
    if len(names) > 1 and sigma is None and noise is None:
        raise OptionError(
            f"the noise of {listing(names)} is not given, and it may differ between them",
            remedy="give sigma={name: standard deviation}, or observe one of them",
        )
    ones = {name: np.ones(times.size) for name in names}
    row = observed(solution, times, ones, observe, sigma=sigma, noise=noise)
    check_levels(solution, row)
    return trial_of("", solution, held_parameters(solution, fixed), row)


def _trial_after(solution: SolutionCore, after: Fit, times: Array, wanted: Wanted) -> Trial:
    """Measurements at times (N,) of what a fit has measured, under the conditions that are wanted.

    An experiment of the fit has what the wanted conditions leave open, if all of them agree.
    """
    if wanted.sigma is not None or wanted.noise is not None:
        raise OptionError(
            "after is given, and sigma or noise",
            remedy="leave them out: the fit says how well is measured",
        )
    trials = [trial for trial in after.trials if trial.solution is solution]
    if not trials:
        raise OptionError("the fit is of another solution", remedy="give one of this solution")
    doses = trials[0].doses
    if any(trial.doses is not doses for trial in trials):
        raise OptionError(
            "the experiments of the fit have doses of their own",
            remedy="fit that one alone whose next measurements are wanted",
        )
    conditions = _conditions(after, trials, held_parameters(solution, wanted.fixed))
    owners: dict[str, tuple[Formula, Noise]] = {}
    for row in (trial.observations for trial in trials):
        for name, formula, noise in zip(row.names, row.formulas, row.noises, strict=True):
            owners.setdefault(name, (formula, noise))
    names = _observed_again(wanted.observe, solution, tuple(owners))
    unit = 1.0 if after.unit_known else after.sigma
    return _measured(
        solution, conditions, {name: owners[name] for name in names}, times, unit, doses
    )


def _conditions(
    after: Fit, trials: Sequence[Trial], wanted: Mapping[str, float]
) -> dict[str, float]:
    """The parameters that are fixed in measurements after a fit."""
    conditions = [{**after.fixed, **trial.fixed} for trial in trials]
    held = dict(wanted)
    for name in wanted:
        if not any(name in each for each in conditions):
            raise OptionError(
                f"fixed: the fit estimates {quote(name)}",
                term=name,
                remedy="fix it in the fit if you know it",
            )
    for name in dict.fromkeys(name for each in conditions for name in each):
        values = sorted({each[name] for each in conditions if name in each})
        if name in held or name in after.parameters:
            continue
        if len(values) > 1:
            raise OptionError(
                f"{quote(name)} differs between the experiments of the fit: "
                f"{', '.join(f'{value:g}' for value in values)}",
                term=name,
                remedy=f"say what it will be: fixed={{{name!r}: {values[0]:g}}}",
            )
        held[name] = values[0]
    return held


def _observed_again(
    observe: object, solution: SolutionCore, names: tuple[str, ...]
) -> tuple[str, ...]:
    """The observables of a fit that are to be measured, by name."""
    if observe is None:
        return names
    keys = observe if isinstance(observe, list | tuple) else [observe]
    chosen = tuple(label(solution, key) for key in keys)
    for name in chosen:
        if name not in names:
            raise OptionError(
                f"observe: the fit has not measured {quote(name)}{did_you_mean(name, names)}",
                term=name,
                remedy=f"choose from {listing(names)}",
            )
    return chosen


def _measured(
    solution: SolutionCore,
    fixed: dict[str, float],
    observed: Mapping[str, tuple[Formula, Noise]],
    times: Array,
    unit: float,
    doses: Doses | None,
) -> Trial:
    """Observables with their noise times a unit, at times (N,)."""
    k = len(observed)
    noises = tuple(
        replace(noise, spread=np.full(times.size, unit * np.median(noise.spread)))
        for _, noise in observed.values()
    )
    row = Observations(
        names=tuple(observed),
        formulas=tuple(formula for formula, _ in observed.values()),
        noises=noises,
        owner=np.repeat(np.arange(k), times.size),
        times=np.tile(times, k),
        values=np.ones(k * times.size),
        sigma_known=True,
        present=np.ones(k * times.size, dtype=bool),
        shape=(k, times.size),
    )
    return trial_of("", solution, fixed, row, doses)


def _points(
    trial: Trial, at: Mapping[Any, ArrayLike] | None, after: Fit | None
) -> tuple[Array, tuple[str, ...]]:
    """Values (P, p) of the parameters that are estimated, and their names."""
    held = trial.fixed
    names = (*trial.parameters, *trial.extras) if after is None else after.parameters
    values = {name_of(key): np.atleast_1d(np.asarray(x, float)) for key, x in (at or {}).items()}
    for name in values:
        if name not in (*names, *held):
            raise OptionError(
                f"at: there is no parameter {quote(name)}{did_you_mean(name, names)}",
                term=name,
                remedy=f"known are {listing(names)}",
            )
    missing = [name for name in names if name not in values]
    if missing:
        raise OptionError(
            f"at has no value of {listing(missing)}",
            term=at,
            remedy="a design is made for values of the parameters: give at={name: value}, or "
            "after=fit",
        )
    if not names:
        raise OptionError("all parameters are fixed", remedy="leave one of them free")
    columns = np.broadcast_arrays(*(values[name] for name in names))
    points = np.stack(columns, axis=1)
    for name in names:
        if name in trial.solution.parameters:
            position = trial.solution.metadata.parameters.index(name) + 1
            trial.solution._coordinates.checked(position, values[name])
    return points, names


def _information(trial: Trial, names: Sequence[str], points: Array, scale: Array) -> Array:
    """The information of all data at each time of a trial, (P, N, p, p), in units of the scale."""
    box = trial.solution.parameters
    extras = {
        name: Range(float(column.min()) - 1.0, float(column.max()) + 1.0)
        for name, column in zip(names, points.T, strict=True)
        if name not in box
    }
    absent = [name for name in box if name not in names]
    free = free_parameters([trial.solution], None, extras=extras, absent=absent)
    order = [names.index(name) for name in free.names]
    z = free.places(points[:, order])
    likelihood = Likelihood((trial,), free)
    jacobian = likelihood.linearised(z, settle=False).jacobian / free.slopes(z)[:, None, :]
    back = np.argsort(order)
    jacobian = jacobian[..., back] * scale
    # Where the noise vanishes, with the prediction, nothing is measured
    jacobian = np.where(np.isfinite(jacobian), jacobian, 0.0)
    size = trial.observations.noises[0].spread.size
    each = np.zeros((len(points), size, len(names), len(names)))
    for block in np.split(jacobian, jacobian.shape[1] // size, axis=1):
        each += np.einsum("ktp,ktq->ktpq", block, block)
    (predicted,) = likelihood.predictions(free.values(z))
    for i, one in enumerate(predicted):
        each[:, vanishing_noise(trial, i, one, np.zeros(size))] = 0.0
    return each
