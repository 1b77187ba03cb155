"""The information of measurements at candidate times, for designs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from rankone.discretization.coordinates import name_of
from rankone.estimation.duals import value_of
from rankone.estimation.experiments import Trial, held_parameters, trial_of
from rankone.estimation.fit import Fit
from rankone.estimation.free_parameters import Range, free_parameters
from rankone.estimation.likelihood import Likelihood
from rankone.estimation.noise import Noise
from rankone.estimation.observations import (
    Observations,
    Sigma,
    checked_times,
    observables,
    observed,
)
from rankone.estimation.ranges import vanishing_noise
from rankone.solution.core import SolutionCore
from rankone.support.arrays import Array
from rankone.support.errors import OptionError
from rankone.support.wording import did_you_mean, listing, quote


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
        clock = checked_times(self.trial.solution, times)
        return _information(_moved(self.trial, clock, 1.0), self.names, self.points, self.scale)

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


def candidates_of(
    solution: SolutionCore,
    times: Array,
    at: Mapping[Any, ArrayLike] | None,
    after: Fit | None,
    observe: object,
    sigma: Sigma,
    noise: object,
    fixed: Mapping[Any, float] | None,
) -> Candidates:
    """The information at candidate times (N,); see :func:`~.design.design` for the arguments."""
    if after is not None:
        if any(option is not None for option in (observe, sigma, noise, fixed)):
            raise OptionError(
                "after is given, and observe, sigma, noise or fixed",
                remedy="leave them out: the fit says what is measured, and how well",
            )
        first = after.trials[0]
        at, held = after.x if at is None else at, {**after.fixed, **first.fixed}
        trial = _moved(replace(first, fixed=held), times, 1.0 if after.unit_known else after.sigma)
        if first.solution is not solution:
            raise OptionError("the fit is of another solution", remedy="give one of this solution")
    else:
        names = tuple(observables(solution, observe, None))
        ones = {name: np.ones(times.size) for name in names}
        row = observed(solution, times, ones, observe, sigma=sigma, noise=noise)
        held = held_parameters(solution, fixed)
        trial = trial_of("", solution, held, row)
    points, names = _points(trial, at, held, after)
    scale = np.where(points.mean(axis=0) != 0.0, np.abs(points.mean(axis=0)), 1.0)
    base = np.zeros((len(points), len(names), len(names)))
    if after is not None:
        base = base + after.information * np.outer(scale, scale)
    each = _information(trial, names, points, scale)
    values = dict(zip(names, map(float, points.mean(axis=0)), strict=True))
    data = len(trial.observations.names)
    return Candidates(names, values, scale, base, each, data, trial, points)


def _moved(trial: Trial, times: Array, unit: float) -> Trial:
    """The same observables with the same noise times a unit, at other times."""
    before = trial.observations
    k = len(before.names)
    noises = tuple(
        Noise(
            n.distribution,
            np.full(times.size, unit * np.median(n.spread)),
            n.formula,
            n.levels,
            n.relative,
        )
        for n in before.noises
    )
    row = Observations(
        names=before.names,
        formulas=before.formulas,
        noises=noises,
        owner=np.repeat(np.arange(k), times.size),
        times=np.tile(times, k),
        values=np.ones(k * times.size),
        sigma_known=before.sigma_known,
        present=np.ones(k * times.size, dtype=bool),
        shape=(k, times.size),
    )
    return trial_of(trial.name, trial.solution, trial.fixed, row)


def _points(
    trial: Trial, at: Mapping[Any, ArrayLike] | None, held: Mapping[str, float], after: Fit | None
) -> tuple[Array, tuple[str, ...]]:
    """Values (P, p) of the parameters that are estimated, and their names."""
    order = [*trial.solution.parameters, *trial.extras] if after is None else after.parameters
    names = tuple(name for name in order if name not in held)
    given = {name_of(key): np.atleast_1d(np.asarray(x, float)) for key, x in (at or {}).items()}
    for name in given:
        if name not in (*names, *held):
            raise OptionError(
                f"at: there is no parameter {quote(name)}{did_you_mean(name, names)}",
                term=name,
                remedy=f"known are {listing(names)}",
            )
    missing = [name for name in names if name not in given]
    if missing:
        raise OptionError(
            f"at has no value of {listing(missing)}",
            term=at,
            remedy="a design is made for values of the parameters: give at={name: value}, or "
            "after=fit",
        )
    if not names:
        raise OptionError("all parameters are fixed", remedy="leave one of them free")
    columns = np.broadcast_arrays(*(given[name] for name in names))
    points = np.stack(columns, axis=1)
    for name in names:
        if name in trial.solution.parameters:
            position = trial.solution.metadata.parameters.index(name) + 1
            trial.solution._coordinates.checked(position, given[name])
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
