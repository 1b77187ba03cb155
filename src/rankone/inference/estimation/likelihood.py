"""The likelihood of all measurements as a function of the free parameters."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from rankone.inference.estimation.experiments import Predicted, Seeds, Trial
from rankone.inference.estimation.formulas import linear_names, value_of, with_shape
from rankone.inference.estimation.free_parameters import BOUND_TOLERANCE, FreeParameters
from rankone.inference.estimation.noise import Terms, log_likelihood, terms
from rankone.support.arrays import Array

# Rounds of linear parameters and levels of noise in turn, where states are known
START_ROUNDS = 6  # For a start
_STEP_ROUNDS = 2  # After a step of a search, which begins close
# Step of differences of a prior, in widths of the interval: truncation near rounding
_PRIOR_STEP = 1e-4
_LEAST_CURVATURE = 1e-8  # Least curvature of a prior, in units of 1/width^2: it may be uniform
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
        variance = max(cost / self.size, 1e-300)
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
                if not self.groups or np.allclose(values, before, rtol=BOUND_TOLERANCE, atol=0.0):
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
            root = np.sqrt(np.where(np.isfinite(bend), np.maximum(bend, _LEAST_CURVATURE), 1.0))
            rho[:, q] = np.where(np.isfinite(slope), slope, 0.0) / root
            rows[:, q, j] = root
        return rho, rows


def sum_of(each: Sequence[Terms]) -> Array:
    """The sum (K,) of what all observables add, infinite where a solution has ended before."""
    whole = np.sum([one.cost for one in each], axis=0)
    return np.where(np.isnan(whole), np.inf, whole)
