"""Intervals of parameters that belong to no solution, and what levels of noise add.

Weights that are estimated from few data are uncertain. The covariance of the other parameters grows
with that, and the degrees of freedom of a quantity are those of the levels that decide on its
variance (Kenward & Roger, "Small sample inference for fixed effects from restricted maximum
likelihood", 1997; Satterthwaite 1946).
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rankone.inference.estimation.experiments import Predicted, Trial, failures_of
from rankone.inference.estimation.formulas import linear_names, value_of
from rankone.inference.estimation.free_parameters import FreeParameters, Range
from rankone.inference.estimation.likelihood import START_ROUNDS, Likelihood
from rankone.inference.estimation.observations import MISSPELT, check_levels
from rankone.support.arrays import Array
from rankone.support.errors import OptionError
from rankone.support.wording import did_you_mean, listing, quote
from rankone.tensors.bases.distributions import Measure


@dataclass(frozen=True)
class LevelUncertainty:
    """What k levels of noise are worth for n parameters.

    ``information`` (k, n, n) is that of all data, times the derivative of the logarithm of their
    standard deviations with respect to each level; ``squares`` (k, k, n, n) times those with
    respect to two. ``covariance`` (k, k) is that of the levels, ``root`` (n, r) one of the
    covariance of all parameters if the levels were known.
    """

    information: Array
    squares: Array
    covariance: Array
    root: Array

    def enlarged(self, root: Array) -> Array:
        """A root (n, r) of the covariance of all parameters; the weights add theirs."""
        inside = root.T @ self.information @ root
        more = np.einsum("kl,klab->ab", self.covariance, root.T @ self.squares @ root)
        less = np.einsum("kl,kab,lbc->ac", self.covariance, inside, inside)
        growth = 8.0 * (more - less)
        values, vectors = np.linalg.eigh(0.5 * (growth + growth.T))
        return np.asarray(root @ (vectors * np.sqrt(1.0 + np.maximum(values, 0.0))))

    def dof(self, slope: Array) -> float:
        """Degrees of freedom of the variance of a quantity with derivatives (n,)."""
        along = self.root @ (self.root.T @ slope)
        change = 2.0 * np.einsum("a,kab,b->k", along, self.information, along)
        variance = float(change @ self.covariance @ change)
        return 2.0 * float(slope @ along) ** 2 / variance if variance > 0.0 else math.inf


def level_uncertainty(
    problem: Likelihood, jacobian: Array, root: Array, shares: Mapping[int, float]
) -> LevelUncertainty:
    """That of the free levels of noise, at a point with Jacobian (r, n).

    Of the data, ``shares`` are left to estimate each level.
    """
    levels = list(problem.levels)
    location, moved = [], []
    for trial, i, here in problem.blocks:
        rows = jacobian[here]
        location.append(rows)
        if trial.observations.noises[i].estimated:
            size = here.stop - here.start
            scaled = jacobian[here.stop : here.stop + size][:, levels]
            moved.append(scaled / trial.observations.noises[i].scale_root)
        else:
            moved.append(np.zeros((len(rows), len(levels))))
    x, d = np.concatenate(location), np.concatenate(moved)
    left = np.sqrt([shares.get(j, 1.0) for j in levels])
    covariance = (root @ root.T)[np.ix_(levels, levels)] / np.outer(left, left)
    return LevelUncertainty(
        np.einsum("mk,ma,mb->kab", d, x, x),
        np.einsum("mk,ml,ma,mb->klab", d, d, x, x),
        covariance,
        root,
    )


# -----------------------------------------------------------------------------
# Intervals of parameters that belong to no solution: of observables, and levels of noise.


# Levels of noise that are looked for, in shares of the size of the data
_LEAST_LEVEL, _LARGEST_LEVEL = 1e-6, 10.0
# Share of the screened points, the best, whose linear parameters say how large these are
_GOOD_SHARE = 0.25
# Rise of -2 log L without a level of noise below which the data do not need it
_IDLE_RISE = 0.02
_NOTHING = 1e-9  # Predictions and noise below this share of the largest ones are none
_MARGIN = 2.0  # Margin of their interval to both sides, in lengths of what those points have


def ranges_of(trials: Sequence[Trial], declared: Sequence[str]) -> dict[str, Range]:
    """The ranges of parameters that observables and noise have of their own.

    Linear ones have an infinite range, which :func:`with_linear_ranges` makes finite. Others are
    ``declared`` by bounds or a value; an OptionError if they are not, or look like a misspelt name.
    """
    for trial in trials:
        check_levels(trial.solution, trial.observations, declared)
    levels = {name for trial in trials for name in trial.observations.levels}
    extras = dict.fromkeys(name for trial in trials for name in trial.extras)
    formulas = [formula for trial in trials for formula in trial.observations.formulas]
    linear = linear_names(formulas, [name for name in extras if name not in levels])
    ranges = {}
    for name in extras:
        owners = [trial for trial in trials if name in trial.extras]
        if any(name in trial.solution.parameters for trial in trials):
            continue
        if name in levels:
            ranges[name] = _level_range(name, owners)
            continue
        if name not in declared:
            _check_spelling(name, owners[0])
            if name not in linear:
                raise OptionError(
                    f"the parameter {quote(name)} of an observable enters it nonlinearly, and has "
                    "no bounds",
                    term=name,
                    remedy=f"give bounds={{{name!r}: (lower, upper)}}",
                )
        ranges[name] = Range(-math.inf, math.inf)
    return ranges


def with_linear_ranges(problem: Likelihood, points: Array) -> Likelihood:
    """The problem with finite ranges of linear parameters, from points (N, n) all over the cube."""
    free = problem.free
    endless = np.flatnonzero(~np.isfinite(free.width))
    if not endless.size:
        return problem
    lower, upper = free.lower.copy(), free.upper.copy()
    lower[endless], upper[endless] = 0.0, 1.0
    start = replace(free, lower=lower, upper=upper)
    values = start.values(points)
    states = [trial.states(problem.at(values)) for trial in problem.trials]
    values = problem.settled(values, states, None, START_ROUNDS, problem.linear)
    costs = problem.costs_of(values, states)
    usable = np.isfinite(costs) & np.isfinite(values[:, endless]).all(axis=1)
    order = np.argsort(np.where(usable, costs, np.inf))[: max(int(usable.sum() * _GOOD_SHARE), 1)]
    for j in endless:
        column = values[order, j]
        low, high = float(column.min()), float(column.max())
        margin = _MARGIN * (high - low) + max(abs(low), abs(high))
        margin = margin if np.isfinite(margin) and margin > 0.0 else 1.0
        lower[j], upper[j] = low - margin, high + margin
    free = replace(free, lower=lower, upper=upper, endless=tuple(endless.tolist()))
    return replace(problem, free=free)


def _level_range(name: str, trials: Sequence[Trial]) -> Range:
    """From far below the data to above them; of one for levels that are relative."""
    size = 0.0
    relative = absolute = False
    for trial in trials:
        for i, noise in enumerate(trial.observations.noises):
            if name in noise.levels:
                data = trial.observations.values[trial.observations.of(i)]
                size = max(size, math.sqrt(float(np.mean(data**2))) if data.size else 0.0)
                relative |= name in noise.relative
                absolute |= name not in noise.relative or len(noise.relative) == len(noise.levels)
    sizes = [1.0] * relative + [size or 1.0] * absolute
    return Range(_LEAST_LEVEL * min(sizes), _LARGEST_LEVEL * max(sizes), True)


def _check_spelling(name: str, trial: Trial) -> None:
    own = [*trial.solution.states, *trial.solution.parameters, trial.solution.metadata.time]
    near = did_you_mean(name, own, MISSPELT)
    if near:
        raise OptionError(
            f"an observable has {quote(name)}, which the solution has not{near}",
            term=name,
            remedy=f"it has {listing(own)}; a parameter of the observable with such a name needs "
            "bounds",
        )


def within_support(free: FreeParameters, priors: Sequence[Measure]) -> FreeParameters:
    """The parameters with bounds inside of the supports of priors."""
    lower, upper = free.lower.copy(), free.upper.copy()
    for measure in priors:
        assert measure.distribution is not None
        j = free.names.index(measure.name)
        low, high = measure.distribution.support()
        lower[j], upper[j] = max(lower[j], float(low)), min(upper[j], float(high))
    return replace(free, lower=lower, upper=upper)


def check_certain(problem: Likelihood, points: Array) -> None:
    """Raise an OptionError for data without noise: their likelihood has no bound.

    They are where the prediction is zero for all parameters, and the noise with it.
    """
    values = problem.free.values(points)
    for trial, predicted in zip(problem.trials, problem.predictions(values), strict=True):
        observations = trial.observations
        for i, one in enumerate(predicted):
            here = observations.of(i)
            data, times = observations.values[here], observations.times[here]
            vanishing = vanishing_noise(trial, i, one, data)
            if vanishing.any():
                k, time = int(np.argmax(vanishing)), trial.solution.metadata.time
                zero = (
                    f"{quote(observations.names[i])} at {time} = {times[k]:g} is zero for all "
                    "parameters, and noise that is relative to it vanishes there"
                )
                raise OptionError(
                    "; ".join([*failures_of([trial]), zero]),
                    term=float(data[k]),
                    remedy="leave this measurement out",
                )


def vanishing_noise(trial: Trial, i: int, one: Predicted, data: Array) -> NDArray[np.bool_]:
    """Which data (m,) of an observable have no noise, wherever it was predicted."""
    noise, name = trial.observations.noises[i], trial.observations.names[i]
    own = {name, *trial.solution.states}
    if noise.formula is None or not own & set(noise.formula.names) or not data.size:
        return np.zeros(data.size, dtype=bool)

    # Where a solution is no success, nothing is known of its error
    error = np.nan_to_num(trial.solution.error) if trial.solution.success else 0.0

    def none(rows: Array) -> NDArray[np.bool_]:
        sizes = np.abs(np.broadcast_to(rows, (len(rows), data.size)))
        largest = sizes.max(axis=1, keepdims=True)
        shares = np.divide(sizes, largest, out=np.zeros(sizes.shape), where=largest > 0.0)
        return np.asarray(shares.max(axis=0) <= max(_NOTHING, error))

    silent = none(value_of(one.sigma)) | none(data[None])
    return none(value_of(one.value)) & silent


def idle_levels(
    problem: Likelihood, z: Array, cost: float, bounded: Collection[str]
) -> dict[str, float]:
    """Levels of combined noise that the data do not need: they may as well be zero.

    Those that somebody has ``bounded`` stay.
    """
    free = problem.free
    idle: dict[str, float] = {}
    for group in problem.groups:
        if len(group) < 2:
            continue
        for j in group:
            if free.names[j] in bounded:
                continue
            lowest = z.copy()
            lowest[j] = 0.0
            if problem.costs(lowest[None])[1][0] <= cost + _IDLE_RISE:
                idle[free.names[j]] = 0.0
                break
    return idle
