"""The likelihoods that searches on trajectories take, and how far they let parameters go."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rankone.inference.calibration import experiment_objective, result
from rankone.inference.estimation import least_squares
from rankone.inference.estimation.experiments import Experiment, trials_of
from rankone.inference.estimation.fitted_models import IntegratedSolution
from rankone.inference.estimation.formulas import value_of
from rankone.inference.estimation.free_parameters import Bounds, ends_at_bounds
from rankone.inference.estimation.identification import MOST_REFINEMENTS, between
from rankone.inference.estimation.intervals import quantile_of
from rankone.inference.estimation.likelihood import (
    START_ROUNDS,
    Held,
    Likelihood,
    Linearised,
    with_linear_ranges,
)
from rankone.inference.estimation.search import Options, problem_of
from rankone.solution.compiled import CompiledProblem
from rankone.support.arrays import MINOR, RESOLVED, SAME, SAMPLES, TINY, Array, spread
from rankone.support.errors import ProblemError, RankoneError, quote
from rankone.support.options import LEVEL


@dataclass(frozen=True)
class OfExperiments:
    """-2 log L of experiments on one problem, each value from trajectories.

    The trajectories depend on its ``parameters``.
    """

    parameters: tuple[str, ...]
    likelihood: Likelihood

    @classmethod
    def of(
        cls,
        compiled: CompiledProblem,
        experiments: Sequence[Experiment],
        bounds: Bounds,
        fixed: Mapping[object, float] | None,
    ) -> OfExperiments:
        """The likelihood of experiments; the bounds are those of the problem unless given."""
        if experiment_objective.jumps_with_states(compiled):
            raise ProblemError(
                "rates jump with the states: trajectories cannot be differentiated yet",
                remedy="write a smooth transition, or `max` and `min` if nothing jumps; a solution "
                "on a box can be fitted: solution.fit(...)",
            )
        integrated = IntegratedSolution(compiled.system, compiled.metadata())
        trials = trials_of([(integrated, each) for each in experiments])
        likelihood = problem_of(trials, Options(bounds=bounds, fixed=fixed))
        for name in sorted(
            experiment_objective.deciding_jumps(compiled) & {*likelihood.free.names}
        ):
            raise ProblemError(
                f"rates jump where {quote(name)} says: nothing can be differentiated by it yet",
                term=name,
                remedy=f"fix it, fixed={{{name!r}: ...}}, or fit a solution on a box: "
                "solution.fit(...)",
            )
        points = spread(SAMPLES, len(likelihood.free.names), np.random.default_rng(7))
        return cls(tuple(integrated.parameters), with_linear_ranges(likelihood, points))

    @property
    def names(self) -> tuple[str, ...]:
        """The free parameters; see :class:`.Expandable`."""
        return self.likelihood.free.names

    @property
    def nested(self) -> NDArray[np.bool_]:
        """None: what has a best value for given trajectories has no coordinate."""
        return np.zeros(len(self.names), dtype=bool)

    @cached_property
    def dynamic(self) -> tuple[str, ...]:
        """Those that trajectories depend on; the others belong to observables and noise."""
        return tuple(name for name in self.names if name in self.parameters)

    def expanded(self, z: Array, held: NDArray[np.bool_] | None = None) -> least_squares.Expansion:
        """At z (n,); see :class:`~rankone.inference.estimation.least_squares.Expandable`.

        Coordinates that are ``held`` (n,) do not move to their best values. A deviation that is
        unknown is at its best: the cost is N log S for a sum of squares S, and residuals are
        relative to the deviation, so that no unit of the data matters.
        """
        kept = None if held is None else held[None]
        with np.errstate(all="ignore"):
            every = self.likelihood.linearised(z[None], kept)
        z, cost, residuals, jacobian = (each[0] for each in every)
        if not self.likelihood.unit_known:
            squares, size = cost + self._unresolved, self.likelihood.size
            factor = math.sqrt(size / squares)
            cost = size * np.log(squares)
            residuals, jacobian = factor * residuals, factor * jacobian
        return _finite(z, cost, residuals, jacobian)

    def named(self, z: Array) -> dict[str, float]:
        """The parameters at z (n,), by name."""
        return self.likelihood.free.named(z)

    def places(self, values: Mapping[str, float]) -> Array:
        """The coordinates z (n,) of parameters by name."""
        return self.likelihood.free.places(np.array([values[name] for name in self.names]))

    def log_likelihood(self, at: least_squares.Expansion) -> float:
        """The logarithm of the density of the data with all constants, by trajectories."""
        if not np.isfinite(at.cost):
            return -np.inf
        return self.likelihood.largest_log_likelihood(at.z, self._squares(at))

    def comparisons(self, at: least_squares.Expansion) -> tuple[result.Comparison, ...]:
        """Measurements and predictions at z (n,); none without trajectories."""
        if not np.isfinite(at.cost):
            return ()
        variance, unit = self.variance(at), 1.0
        covariance = result.covariance_at(at, variance)
        if not self.likelihood.unit_known:
            unit = math.sqrt(self._squares(at) / self._freedom)
        each = self.likelihood.predictions(self.likelihood.free.values(at.z[None]))
        predictions = dict(zip(map(id, self.likelihood.trials), each, strict=True))
        comparisons = []
        for trial, i, rows in self.likelihood.blocks:
            observations = trial.observations
            own = predictions[id(trial)][i]
            here, noise = observations.of(i), observations.noises[i]
            size = observations.values[here].size
            predicted, sigma = (
                np.broadcast_to(value_of(each), (1, size))[0] for each in (own.value, own.sigma)
            )
            comparisons.append(
                result.compared(
                    (observations.names[i], trial.name),
                    (observations.times[here], observations.values[here]),
                    predicted,
                    sigma * unit,
                    result.spread_of(at.jacobian[rows], covariance) / math.sqrt(variance),
                    "log" if noise.logarithmic else "lin",
                )
            )
        return tuple(comparisons)

    def variance(self, at: least_squares.Expansion) -> float:
        """The variance of the residuals; one where standard deviations are known or estimated."""
        return 1.0 if self.likelihood.unit_known else self.likelihood.size / self._freedom

    def _squares(self, at: least_squares.Expansion) -> float:
        """The cost where standard deviations are known, else the sum of squares."""
        if self.likelihood.unit_known:
            return at.cost
        return math.exp(at.cost / self.likelihood.size) - self._unresolved

    @cached_property
    def _unresolved(self) -> float:
        """The sum of squares that accurate trajectories may leave of data without noise."""
        squares = 0.0
        for trial, i, _ in self.likelihood.blocks:
            noise, values = trial.observations.noises[i], trial.observations.values
            here = values[trial.observations.of(i)]
            scale = np.ones(here.size) if noise.logarithmic else here / noise.spread
            squares += float(scale @ scale)
        return max(RESOLVED**2 * squares, TINY)

    @property
    def _freedom(self) -> int:
        """Data less parameters, levels of noise left out."""
        return max(self.likelihood.size - len(self.names) + len(self.likelihood.levels), 1)

    @cached_property
    def quantile(self) -> float:
        """Half the length of an interval in standard deviations, with 95 %."""
        noise_given = self.likelihood.unit_known and not self.likelihood.levels
        return quantile_of(LEVEL, noise_given, self._freedom)

    def rise(self, at: least_squares.Expansion) -> float:
        """By how much the cost is larger at the ends of intervals; see :meth:`.Intervals.rise`."""
        if self.likelihood.levels or not self.likelihood.unit_known:
            return self.likelihood.size * math.log1p(self.quantile**2 / self._freedom)
        return self.quantile**2 * self.variance(at)


@dataclass(frozen=True)
class OfFiles(OfExperiments):
    """The likelihood of a problem from files, with priors of the table.

    Parameters that only observables and noise have are at their best at once. Their closed forms
    (Loos, Krause & Hasenauer, Bioinformatics 34 (2018) 4266; Schmiester & al., Bioinformatics 36
    (2020) 594) are the start of a search for given states, which takes no trajectory.
    """

    objective: experiment_objective.Objective

    @classmethod
    def of_problem(
        cls, objective: experiment_objective.Objective, values: Mapping[str, float]
    ) -> OfFiles:
        """Of all estimated parameters; the others have their ``values``."""
        likelihood = objective.likelihood(values)
        return cls(objective.settings.active, likelihood, objective)

    @property
    def nested(self) -> NDArray[np.bool_]:
        """The coordinates (n,) that are at their best."""
        return np.array([name not in self.parameters for name in self.names])

    def expanded(self, z: Array, held: NDArray[np.bool_] | None = None) -> least_squares.Expansion:
        """At z (n,); see :class:`~rankone.inference.estimation.least_squares.Expandable`."""
        problem, free = self.likelihood, self.likelihood.free
        with np.errstate(all="ignore"):
            values = free.values(z[None])
            states, slopes = problem.followed(values)
            if self.nested.any() and all(np.isfinite(each).all() for each in states):
                settled = problem.settled(values, states, None, START_ROUNDS, problem.linear)
                z, values = self._best(np.concatenate([z[None], free.places(settled)]), states)
            every = problem.expanded(z[None], values, states, slopes)
        return _finite(*(each[0] for each in every))

    def _best(self, starts: Array, states: Sequence[Array]) -> tuple[Array, Array]:
        """The best point (n,) for given states, and its values (1, n), from starts (2, n).

        At the second one closed forms are at their best.
        """
        nested, z = np.flatnonzero(self.nested), starts[1]
        inside = (z[nested] > 0.0) & (z[nested] < 1.0)
        if not (inside.all() and np.isin(nested, self.likelihood.closed).all()):
            held = np.tile(~self.nested, (2, 1))
            ends = least_squares.minima(_GivenStates(self.likelihood, states), starts, held)
            z = ends.z[int(np.argmin(ends.cost))]
        return z, self.likelihood.free.values(z[None])

    def log_likelihood(self, at: least_squares.Expansion) -> float:
        """Minus the objective, at its full accuracy; minus infinity without trajectories."""
        if not np.isfinite(at.cost):
            return -np.inf
        values = {**self.likelihood.free.fixed, **self.named(at.z)}
        try:
            return -self.objective.evaluated(values, ()).objective
        except RankoneError:
            return -np.inf


class _GivenStates(NamedTuple):
    """The likelihood for states (1, M) that are known, as :func:`.minima` takes it."""

    problem: Likelihood
    states: Sequence[Array]

    @property
    def size(self) -> int:
        return self.problem.size

    @property
    def magnitude(self) -> float:
        return self.problem.magnitude

    def linearised(self, z: Array, held: Held = None) -> Linearised:
        states = [np.repeat(each, len(z), axis=0) for each in self.states]
        still = [np.zeros((*each.shape, z.shape[1])) for each in states]
        return self.problem.expanded(z, self.problem.free.values(z), states, still)


def _finite(z: Array, cost: float, residuals: Array, jacobian: Array) -> least_squares.Expansion:
    """An expansion, of infinite cost where not all of it is finite."""
    finite = np.isfinite(cost) and np.isfinite(residuals).all() and np.isfinite(jacobian).all()
    return least_squares.Expansion(z, float(cost) if finite else np.inf, residuals, jacobian)


# -----------------------------------------------------------------------------
# How far each parameter can go from an optimum within the bounds, by trajectories.
#
# Profile likelihoods: a parameter is held away from the optimum, and the others go down from where
# they would be if the model were linear. So nothing is held that the data do not determine, and no
# box around the optimum is needed.


_CLOSE = 1e-2  # How close an end comes to the limit, in shares of half the interval: two digits
_MOST_GROWTH = 3.0  # Most growth of a distance in one step outwards


class _End(NamedTuple):
    """Where an interval ends in z: at a bound, or with another parameter newly at one.

    An ``other`` end is not told by the data alone: also one beyond which trajectories fail.
    Bounds of ``others`` make it end before the data would.
    """

    z: float
    bound: bool
    other: bool
    others: tuple[str, ...] = ()


def profile_reaches(problem: OfExperiments, at: least_squares.Expansion) -> dict[str, result.Reach]:
    """How far each parameter can go from an optimum with 95 %; levels of noise by linearisation.

    Not identified are those whose variance the data hardly reduce and that only bounds stop. An
    end from which the way of another parameter leads further, within the limit, is taken up there:
    a descent does not leave a valley that is flat and long.
    """
    variance = problem.variance(at)
    covariance = result.covariance_at(at, variance)
    wide = result.unidentified(problem.names, np.sqrt(np.diag(covariance)))
    reaches = result.linear_reaches(problem.names, at, variance)
    inside = [at]
    ways = [
        (j, sign)
        for j in range(len(problem.names))
        if j not in problem.likelihood.levels
        for sign in (-1.0, 1.0)
    ]
    ends = {way: _end(problem, at, covariance, way, at, inside) for way in ways}
    for way in ways:
        (j, sign), end = way, ends[way].z
        farthest = max(inside, key=lambda point: sign * float(point.z[j]))
        if sign * (farthest.z[j] - end) > _CLOSE * abs(end - at.z[j]):
            ends[way] = _end(problem, at, covariance, way, farthest, inside)
    for j, name in enumerate(problem.names):
        if (j, 1.0) in ends:
            low, high = ends[j, -1.0], ends[j, 1.0]
            limited = result.limited_by(low.bound, high.bound)
            boxed = (low.bound or low.other) and (high.bound or high.other)
            free = limited == "both" or (name in wide and boxed)
            others = {*low.others, *high.others}
            names = tuple(name for name in problem.names if name in others)
            reaches[name] = result.Reach(low.z, high.z, limited, free, names)
    return reaches


def _end(
    problem: OfExperiments,
    best: least_squares.Expansion,
    covariance: Array,
    way: tuple[int, float],
    point: least_squares.Expansion,
    inside: list[least_squares.Expansion],
) -> _End:
    """Where the rise of the cost reaches the limit in one direction, or the bound.

    The ``way`` is a parameter and a sign. It begins at a ``point``, and what it passes ``inside``
    the limit is added to the others.
    """
    (j, sign), limit = way, problem.rise(best)
    along = sign * covariance[j] / covariance[j, j]
    room = float(best.z[j]) if sign < 0.0 else 1.0 - float(best.z[j])
    inner = (sign * float(point.z[j] - best.z[j]), _root(point, best, limit))
    outer = (math.inf, math.inf)
    at_bound = set(ends_at_bounds(problem.names, best.z))
    last = beyond = point
    distance = inner[0] + problem.quantile * math.sqrt(covariance[j, j]) * (1.0 - inner[1])
    distance = min(max(distance, SAME), room)
    for turn in range(MOST_REFINEMENTS):
        start = np.clip(point.z + (distance - inner[0]) * along, 0.0, 1.0)
        start[j] = np.clip(best.z[j] + sign * distance, 0.0, 1.0)
        last = _settled(problem, start, j, _CLOSE * limit)
        root = _root(last, best, limit)
        if root <= 1.0:
            inner, point = (distance, root), last
            inside.append(last)
            if distance >= room:
                return _End(0.0 if sign < 0.0 else 1.0, True, False)
        else:
            outer, beyond = (distance, root), last
        if abs(root - 1.0) <= _CLOSE:
            beyond = last
            break
        if math.isinf(outer[0]):
            beyond = last
            growth = min(max(1.0 / max(root, 0.1), 1.1), _MOST_GROWTH)
            distance = min(max(growth * distance, SAME), room)
        else:
            distance = between(inner, outer, turn)
    else:  # not as close: a place beyond the limit, unless trajectories fail there
        last = beyond
    told = abs(root - 1.0) <= _CLOSE or math.isfinite(outer[1])
    names = set(ends_at_bounds(problem.names, beyond.z)) - at_bound - {problem.names[j]}
    others = _beyond_bounds(problem, beyond, j, limit)
    return _End(float(last.z[j]), False, bool(names) or not told, others)


def _root(at: least_squares.Expansion, best: least_squares.Expansion, limit: float) -> float:
    """The root of the rise of the cost over the limit."""
    return math.sqrt(max(at.cost - best.cost, 0.0) / limit)


def _beyond_bounds(
    problem: OfExperiments, at: least_squares.Expansion, j: int, limit: float
) -> tuple[str, ...]:
    """Parameters at a bound that would go beyond it with one held, and lower the cost by much.

    Much is a share of the ``limit``.
    """
    if not np.isfinite(at.cost):
        return ()
    rest = np.delete(np.arange(at.z.size), j)
    slope = (at.jacobian.T @ at.residuals)[rest]
    variance = problem.variance(at)
    covariance = np.linalg.inv(
        np.linalg.inv(result.covariance_at(at, variance))[np.ix_(rest, rest)]
    )
    step = -covariance @ slope / variance
    if -float(slope @ step) <= MINOR * limit:  # of the rise at the end they hardly make a part
        return ()
    ends = ends_at_bounds(problem.names, at.z)
    sides = {"lower": -1.0, "upper": 1.0}
    return tuple(
        name
        for name, move in zip(np.array(problem.names)[rest].tolist(), step, strict=True)
        if name in ends and move * sides[ends[name]] > 0.0
    )


def _settled(problem: OfExperiments, z: Array, j: int, enough: float) -> least_squares.Expansion:
    """The best point with one coordinate held, from z (n,)."""
    held = np.arange(z.size) == j
    at, radius = problem.expanded(z, held), least_squares.LARGEST_RADIUS
    for _ in range(MOST_REFINEMENTS):
        if not np.isfinite(at.cost):
            break
        step, promised = least_squares.bounded_step(at, np.where(held, 0.0, radius))
        if promised <= enough or radius <= RESOLVED:
            break
        trial = problem.expanded(np.clip(at.z + np.where(held, 0.0, step), 0.0, 1.0), held)
        better = trial.cost < at.cost
        radius = min(2.0 * radius, 1.0) if better else 0.25 * float(np.abs(step[~held]).max())
        at = trial if better else at
    return at
