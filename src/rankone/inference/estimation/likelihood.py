"""The likelihood of all measurements as a function of the free parameters, and their ranges."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from rankone.inference.estimation.experiments import Predicted, Seeds, Trial, failures_of
from rankone.inference.estimation.formulas import linear_names, value_of, with_shape
from rankone.inference.estimation.free_parameters import FreeParameters, Range
from rankone.inference.estimation.noise import Terms, log_likelihood, terms
from rankone.inference.estimation.observations import check_levels
from rankone.support.arrays import NEGLIGIBLE, SAME, TINY, Array
from rankone.support.errors import SIMILAR, OptionError, did_you_mean, listing, quote
from rankone.tensors.distributions import Measure

# Rounds of linear parameters and levels of noise in turn, where states are known
# Step of second differences of a prior, in widths of the interval: truncation near rounding
_PRIOR_STEP = float(np.finfo(float).eps ** 0.25)
START_ROUNDS = 6  # For a start
_STEP_ROUNDS = 2  # After a step of a search, which begins close
Held = NDArray[np.bool_] | None
"""Coordinates (K, n) that keep their values."""


class Density(Protocol):
    """A distribution as a prior takes it."""

    def logpdf(self, values: Array) -> Array:
        """The logarithm of the density, up to a constant."""


class Prior(Protocol):
    """What was known of a parameter before."""

    @property
    def name(self) -> str: ...
    @property
    def distribution(self) -> Density | None: ...


class Linearised(NamedTuple):
    """At K points z (K, n): -2 log L (K,), pseudo-residuals (K, r), their Jacobian (K, r, n)."""

    z: Array
    cost: Array
    residuals: Array
    jacobian: Array


@dataclass(frozen=True)
class Likelihood:
    """-2 log L of all trials, with priors, as a function of z in the unit cube.

    Constants are left out. Where no standard deviation is known (``unit_known`` is False), the
    data have unit standard deviation up to a common factor.
    """

    trials: tuple[Trial, ...]
    free: FreeParameters
    priors: tuple[Prior, ...] = ()

    @cached_property
    def unit_known(self) -> bool:
        """Whether the standard deviations are known, or parameters, not given up to a factor."""
        return any(trial.observations.sigma_known for trial in self.trials)

    @cached_property
    def size(self) -> int:
        """Number of data."""
        return sum(trial.observations.size for trial in self.trials)

    @cached_property
    def magnitude(self) -> float:
        """Sum of squares of all data over their standard deviations, as far as these are known."""
        pairs = ((t.observations, i) for t in self.trials for i in range(len(t.observations.names)))
        ratios = (o.values[o.of(i)] / o.noises[i].spread for o, i in pairs)
        return float(sum(np.sum(ratio**2) for ratio in ratios))

    @cached_property
    def levels(self) -> tuple[int, ...]:
        """Positions of the free levels of noise."""
        names = {name for trial in self.trials for name in trial.observations.levels}
        return tuple(j for j, name in enumerate(self.free.names) if name in names)

    @cached_property
    def linear(self) -> tuple[int, ...]:
        """Positions of parameters that enter all observables linearly, and nothing else."""
        own = {name for trial in self.trials for name in trial.extras}
        own -= {name for trial in self.trials for name in trial.observations.levels}
        formulas = [formula for trial in self.trials for formula in trial.observations.formulas]
        names = linear_names(formulas, [name for name in self.free.names if name in own])
        return tuple(self.free.names.index(name) for name in names)

    @cached_property
    def _settled(self) -> tuple[int, ...]:
        """The linear parameters, where their best values follow from the states in one step."""
        moved = {self.free.names[j] for j in self.linear}
        for trial in self.trials:
            of = zip(trial.observations.names, trial.observations.noises, strict=True)
            for name, noise in of:
                names = set() if noise.formula is None else set(noise.formula.names)
                if noise.distribution != "normal" or names & {name, *moved}:
                    return ()
        return () if self.priors else self.linear

    @cached_property
    def closed(self) -> tuple[int, ...]:
        """Parameters whose best values for given states have closed forms, unless bounds stop them.

        Scales and levels of noise depend on each other, and have one in turn alone.
        """
        levels = tuple(j for group in self.groups for j in group)
        exact = all(n.distribution != "student" for t in self.trials for n in t.observations.noises)
        return () if levels and (self._settled or not exact) else (*levels, *self._settled)

    @cached_property
    def groups(self) -> tuple[tuple[int, ...], ...]:
        """Levels of noise that scale standard deviations together, by position.

        Levels that are held at zero scale nothing.
        """
        groups: list[set[str]] = []
        names = set(self.free.names) - {measure.name for measure in self.priors}
        for trial in self.trials:
            for noise in trial.observations.noises:
                if noise.levels:
                    joined = set(noise.levels) if noise.scales else {*noise.levels, ""}
                    joined |= set().union(*(g for g in groups if g & joined))
                    groups = [g for g in groups if not g & joined] + [joined]
        zero = {name for name, level in self.free.fixed.items() if level == 0.0}
        order = [sorted(g - zero) for g in groups if g - zero and g - zero <= names]
        return tuple(tuple(self.free.names.index(name) for name in g) for g in order)

    @property
    def blocks(self) -> list[tuple[Trial, int, slice]]:
        """For each observable its trial, its position there, and its rows among the residuals.

        The rows are those of its deviations; rows of the standard deviation may follow them.
        """
        blocks, begin = [], 0
        for trial in self.trials:
            for i, noise in enumerate(trial.observations.noises):
                size = noise.spread.size
                blocks.append((trial, i, slice(begin, begin + size)))
                begin += 2 * size if noise.estimated else size
        return blocks

    # --- values --------------------------------------------------------------------------------

    def at(self, values: Array) -> dict[str, Array]:
        """All parameters by name, (K,) each, for values (K, n) of the free ones."""
        held = {name: np.full(len(values), x) for name, x in self.free.fixed.items()}
        return {**held, **dict(zip(self.free.names, values.T, strict=True))}

    def costs(self, z: Array, *, start: bool = False) -> tuple[Array, Array]:
        """Points z (K, n) with linear parameters and levels at their best, and costs (K,)."""
        values = self.free.values(z)
        states = [trial.states(self.at(values)) for trial in self.trials]
        if start:
            values = self.settled(values, states, None, START_ROUNDS, self.linear)
        places = self.free.places(values) if start else z
        return places, self.costs_of(values, states)

    def costs_of(self, values: Array, states: Sequence[Array]) -> Array:
        """Costs (K,) at values (K, n), for the states there."""
        return sum_of(self.terms(values, states)) + self._prior_cost(values)

    def linearised(self, z: Array, held: Held = None, *, settle: bool = True) -> Linearised:
        """The cost, pseudo-residuals and Jacobian with respect to z, at points (K, n).

        Linear parameters and levels of noise move to their best values for the states there,
        unless they are held.
        """
        values = self.free.values(z)
        states, slopes = self.followed(values)
        if settle and (self._settled or self.groups):
            values = self.settled(values, states, held, _STEP_ROUNDS, self._settled)
            z = self.free.places(values)
        return self.expanded(z, values, states, slopes)

    @property
    def seeds(self) -> Seeds:
        """Derivatives by all free parameters."""
        return Seeds({name: j for j, name in enumerate(self.free.names)}, len(self.free.names))

    def followed(self, values: Array) -> tuple[list[Array], list[Array]]:
        """States (K, M) of each trial at values (K, n), with derivatives (K, M, n).

        Once no point has states in one trial, those of the others are NaN.
        """
        at, seeds, reached = self.at(values), self.seeds, True
        states, slopes = list[Array](), list[Array]()
        for trial in self.trials:
            if reached:
                own, moved = trial.linearised(at, seeds)
                reached = bool(np.isfinite(own).all(axis=1).any())
            else:
                own = np.full((len(values), trial.size), np.nan)
                moved = np.zeros((*own.shape, seeds.width))
            states.append(own)
            slopes.append(moved)
        return states, slopes

    def expanded(
        self, z: Array, values: Array, states: Sequence[Array], slopes: Sequence[Array]
    ) -> Linearised:
        """The same for states that are known, with their derivatives."""
        each = self.terms(values, states, slopes)
        residuals = np.concatenate([one.residuals for one in each], axis=1)
        widths = self.free.slopes(z)[:, None, :]
        jacobian = np.concatenate([one.jacobian for one in each], axis=1) * widths
        rho, rows = self._prior_terms(z)
        residuals = np.concatenate([residuals, rho], axis=1)
        jacobian = np.concatenate([jacobian, rows], axis=1)
        return Linearised(z, sum_of(each) + self._prior_cost(values), residuals, jacobian)

    def predictions(
        self, values: Array, states: Sequence[Array] | None = None
    ) -> list[list[Predicted]]:
        """For each trial what the model says of each observable, at values (K, n)."""
        at = self.at(values)
        if states is None:
            states = [trial.states(at) for trial in self.trials]
        with np.errstate(all="ignore"):
            pairs = zip(self.trials, states, strict=True)
            return [trial.predicted(at, rows) for trial, rows in pairs]

    def standardised(self, z: Array) -> Array:
        """Deviations (K, m) of all data at z (K, n), in standard deviations."""
        values = self.free.values(z)
        states = [trial.states(self.at(values)) for trial in self.trials]
        return np.concatenate([one.standardised for one in self.terms(values, states)], axis=1)

    def log_likelihood(self, values: Array, states: Sequence[Array] | None = None) -> float:
        """The logarithm of the density of all data at values (n,), with its constants."""
        whole = 0.0
        every = self.predictions(values[None], states)
        for trial, predicted in zip(self.trials, every, strict=True):
            for i, one in enumerate(predicted):
                noise = trial.observations.noises[i]
                data = trial.observations.values[trial.observations.of(i)]
                r = terms(noise, data, one.value, one.sigma, None).standardised[0]
                sigma = np.broadcast_to(value_of(one.sigma), (1, data.size))[0]
                whole += log_likelihood(noise, data, r, sigma)
        return whole

    def largest_log_likelihood(self, z: Array, cost: float) -> float:
        """The log-likelihood at z (n,) with its cost; unknown deviations get their best factor."""
        values = self.free.values(z)
        if self.unit_known:
            return self.log_likelihood(values)
        variance = max(cost / self.size, TINY)
        unit = self.log_likelihood(values) + 0.5 * cost
        return unit - 0.5 * self.size * (math.log(variance) + 1.0)

    def terms(
        self,
        values: Array,
        states: Sequence[Array],
        slopes: Sequence[Array] | None = None,
        seeds: Seeds | None = None,
    ) -> list[Terms]:
        """What each observable of each trial adds; derivatives are by all free parameters."""
        at = self.at(values)
        if slopes is not None and seeds is None:
            seeds = self.seeds
        every = []
        with np.errstate(all="ignore"):
            for k, trial in enumerate(self.trials):
                moved = None if slopes is None else slopes[k]
                for i, one in enumerate(trial.predicted(at, states[k], moved, seeds)):
                    data = trial.observations.values[trial.observations.of(i)]
                    shape = (len(values), data.size)
                    noise = trial.observations.noises[i]
                    if seeds is None:
                        value = np.broadcast_to(value_of(one.value), shape)
                        sigma = np.broadcast_to(value_of(one.sigma), shape)
                        every.append(terms(noise, data, value, sigma, None))
                        continue
                    full = with_shape(one.value, shape, seeds.width)
                    spread = with_shape(one.sigma, shape, seeds.width)
                    every.append(terms(noise, data, full, spread, seeds.width))
        return every

    # --- parameters whose best values follow from the states -----------------------------------

    def settled(
        self, values: Array, states: Sequence[Array], held: Held, rounds: int, linear: Sequence[int]
    ) -> Array:
        """Values (K, n) with linear parameters and levels of noise at their best for states."""
        values = values.copy()
        kept = np.zeros(values.shape, dtype=bool) if held is None else held
        with np.errstate(all="ignore"):
            for _ in range(rounds):
                before = values.copy()
                if linear:
                    self._move_linear(values, states, kept, linear)
                if self.groups:
                    self._move_levels(values, states, kept)
                if not self.groups or np.allclose(values, before, rtol=NEGLIGIBLE, atol=0.0):
                    break
        return values

    def _move_linear(
        self, values: Array, states: Sequence[Array], kept: NDArray[np.bool_], linear: Sequence[int]
    ) -> None:
        """Move linear parameters to the minimum of the squares."""
        names = [self.free.names[j] for j in linear]
        seeds = Seeds({name: j for j, name in enumerate(names)}, len(names))
        still = [np.zeros((*rows.shape, len(names))) for rows in states]
        each = self.terms(values, states, still, seeds)
        sizes = [one.standardised.shape[1] for one in each]
        rows = [one.jacobian[:, :m] for one, m in zip(each, sizes, strict=True)]
        jacobian = np.concatenate(rows, axis=1)
        r = np.concatenate([one.residuals[:, :m] for one, m in zip(each, sizes, strict=True)], 1)
        jacobian = np.where(kept[:, None, list(linear)], 0.0, jacobian)
        usable = np.isfinite(jacobian).all(axis=(1, 2)) & np.isfinite(r).all(axis=1)
        if not usable.any():
            return
        step = -np.einsum("klm,km->kl", np.linalg.pinv(jacobian[usable]), r[usable])
        moved = values[np.ix_(usable, list(linear))] + step
        lower, upper = self.free.lower[list(linear)], self.free.upper[list(linear)]
        values[np.ix_(usable, list(linear))] = np.clip(moved, lower, upper)

    def _move_levels(self, values: Array, states: Sequence[Array], kept: NDArray[np.bool_]) -> None:
        """Scale levels of noise such that the squares have the mean one."""
        each = self.terms(values, states)
        noises = [noise for trial in self.trials for noise in trial.observations.noises]
        owners = [set(noise.levels) for noise in noises]
        for group in self.groups:
            names = {self.free.names[j] for j in group}
            pairs = zip(each, owners, strict=True)
            here = [one for one, levels in pairs if levels & names]
            squares = sum(np.sum(one.weights * one.standardised**2, axis=1) for one in here)
            count = sum(one.standardised.shape[1] for one in here)
            factor = squares / count
            if not all(noise.of_laplace for noise in noises if set(noise.levels) & names):
                factor = np.sqrt(factor)
            usable = np.isfinite(factor) & (factor > 0.0) & ~kept[:, list(group)].any(axis=1)
            for j in group:
                moved = values[usable, j] * factor[usable]
                values[usable, j] = np.clip(moved, self.free.lower[j], self.free.upper[j])

    # --- priors --------------------------------------------------------------------------------

    def _prior_cost(self, values: Array) -> Array:
        """-2 log of the priors (K,)."""
        cost = np.zeros(len(values))
        for measure in self.priors:
            assert measure.distribution is not None
            column = values[:, self.free.names.index(measure.name)]
            cost -= 2.0 * measure.distribution.logpdf(column)
        return cost

    def _prior_terms(self, z: Array) -> tuple[Array, Array]:
        """Pseudo-residuals (K, q) of q priors and their Jacobian (K, q, n)."""
        size, n = z.shape
        rho, rows = np.zeros((size, len(self.priors))), np.zeros((size, len(self.priors), n))
        for q, measure in enumerate(self.priors):
            assert measure.distribution is not None
            j = self.free.names.index(measure.name)
            inside = np.clip(z, _PRIOR_STEP, 1.0 - _PRIOR_STEP)
            ends = np.stack(
                [inside + step * _PRIOR_STEP * (np.arange(n) == j) for step in (-1.0, 0.0, 1.0)]
            )
            logs = measure.distribution.logpdf(self.free.unclipped(ends)[..., j])
            slope = -(logs[2] - logs[0]) / (2.0 * _PRIOR_STEP)
            bend = -(logs[2] - 2.0 * logs[1] + logs[0]) / _PRIOR_STEP**2
            root = np.sqrt(np.where(np.isfinite(bend), np.maximum(bend, NEGLIGIBLE), 1.0))
            rho[:, q] = np.where(np.isfinite(slope), slope, 0.0) / root
            rows[:, q, j] = root
        return rho, rows


def sum_of(each: Sequence[Terms]) -> Array:
    """The sum (K,) of what all observables add, infinite where a solution has ended before."""
    whole = np.sum([one.cost for one in each], axis=0)
    return np.where(np.isnan(whole), np.inf, whole)


# -----------------------------------------------------------------------------
# Intervals of parameters that belong to no solution, and what levels of noise add.
#
# Weights that are estimated from few data are uncertain. The covariance of the other parameters
# grows with that, and the degrees of freedom of a quantity are those of the levels that decide on
# its variance (Kenward & Roger, "Small sample inference for fixed effects from restricted maximum
# likelihood", 1997; Satterthwaite 1946).


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
_LARGEST_LEVEL = 10.0
# Share of the screened points, the best, whose linear parameters say how large these are
_GOOD_SHARE = 0.25
UNNOTICED = 0.02
"""Change of -2 log L that says nothing against it."""
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
    return Range(SAME * min(sizes), _LARGEST_LEVEL * max(sizes), True)


def _check_spelling(name: str, trial: Trial) -> None:
    own = [*trial.solution.states, *trial.solution.parameters, trial.solution.metadata.time]
    near = did_you_mean(name, own, SIMILAR)
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
        return np.asarray(shares.max(axis=0) <= max(NEGLIGIBLE, error))

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
            if problem.costs(lowest[None])[1][0] <= cost + UNNOTICED:
                idle[free.names[j]] = 0.0
                break
    return idle
