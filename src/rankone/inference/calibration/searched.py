"""The likelihoods that searches take: of experiments, and of problems from files."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from rankone.inference.calibration.calibration_likelihood import ACCURACY, Evaluation, Evaluator
from rankone.inference.calibration.descent import Expansion
from rankone.inference.calibration.dynamics import deciding_jumps, jumps_with_states
from rankone.inference.calibration.linearised import covariance_at, spread_of
from rankone.inference.calibration.nested import Nested
from rankone.inference.calibration.result import Comparison, compared
from rankone.inference.calibration.starts import Cube
from rankone.inference.estimation.experiments import Experiment, trials_of
from rankone.inference.estimation.fitted_models import IntegratedSolution
from rankone.inference.estimation.formulas import value_of
from rankone.inference.estimation.free_parameters import Bounds
from rankone.inference.estimation.intervals import quantile_of
from rankone.inference.estimation.likelihood import Likelihood
from rankone.inference.estimation.ranges import with_linear_ranges
from rankone.inference.estimation.search import Options, problem_of
from rankone.solution.compiled import CompiledProblem
from rankone.support.arrays import Array, spread
from rankone.support.budget import OutOfBudgetError, limited
from rankone.support.errors import ProblemError, RankoneError
from rankone.support.wording import quote
from rankone.tensors.bases.joint_distribution import LEVEL

_RESOLVED = 1e-7  # Residuals in shares of the data below which trajectories do not tell them apart
_SCREENED = 32  # Points that tell the ranges of parameters that enter observables linearly


@dataclass(frozen=True)
class OfExperiments:
    """-2 log L of experiments on one problem, each value from trajectories."""

    integrated: IntegratedSolution
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
        if jumps_with_states(compiled):
            raise ProblemError(
                "rates jump with the states: trajectories cannot be differentiated yet",
                remedy="write a smooth transition, or `max` and `min` if nothing jumps; a solution "
                "on a box can be fitted: solution.fit(...)",
            )
        integrated = IntegratedSolution(compiled.system, compiled.metadata())
        trials = trials_of([(integrated, each) for each in experiments])
        likelihood = problem_of(trials, Options(bounds=bounds, fixed=fixed))
        for name in sorted(deciding_jumps(compiled) & {*likelihood.free.names}):
            raise ProblemError(
                f"rates jump where {quote(name)} says: nothing can be differentiated by it yet",
                term=name,
                remedy=f"fix it, fixed={{{name!r}: ...}}, or fit a solution on a box: "
                "solution.fit(...)",
            )
        points = spread(_SCREENED, len(likelihood.free.names), np.random.default_rng(7))
        return cls(integrated, with_linear_ranges(likelihood, points))

    @property
    def names(self) -> tuple[str, ...]:
        """The free parameters; see :class:`~rankone.inference.calibration.descent.Expandable`."""
        return self.likelihood.free.names

    @property
    def nested(self) -> NDArray[np.bool_]:
        """None: what has a best value for given trajectories has no coordinate."""
        return np.zeros(len(self.names), dtype=bool)

    @cached_property
    def dynamic(self) -> tuple[str, ...]:
        """Those that trajectories depend on; the others belong to observables and noise."""
        return tuple(name for name in self.names if name in self.integrated.parameters)

    def expanded(self, z: Array, held: NDArray[np.bool_] | None = None) -> Expansion:
        """At z (n,); see :class:`~rankone.inference.calibration.descent.Expandable`.

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
        finite = np.isfinite(cost) and np.isfinite(residuals).all() and np.isfinite(jacobian).all()
        return Expansion(z, float(cost) if finite else np.inf, residuals, jacobian)

    def named(self, z: Array) -> dict[str, float]:
        """The parameters at z (n,), by name."""
        return self.likelihood.free.named(z)

    def places(self, values: Mapping[str, float]) -> Array:
        """The coordinates z (n,) of parameters by name."""
        return self.likelihood.free.places(np.array([values[name] for name in self.names]))

    def log_likelihood(self, at: Expansion) -> float:
        """The logarithm of the density of the data with all constants, by trajectories."""
        if not np.isfinite(at.cost):
            return -np.inf
        return self.likelihood.largest_log_likelihood(at.z, self._squares(at))

    def comparisons(self, at: Expansion) -> tuple[Comparison, ...]:
        """Measurements and predictions at z (n,); none without trajectories."""
        if not np.isfinite(at.cost):
            return ()
        variance, unit = self.variance(at), 1.0
        covariance = covariance_at(at, variance)
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
                compared(
                    (observations.names[i], trial.name),
                    (observations.times[here], observations.values[here]),
                    predicted,
                    sigma * unit,
                    spread_of(at.jacobian[rows], covariance) / math.sqrt(variance),
                    "log" if noise.distribution == "log-normal" else "lin",
                )
            )
        return tuple(comparisons)

    def variance(self, at: Expansion) -> float:
        """The variance of the residuals; one where standard deviations are known or estimated."""
        return 1.0 if self.likelihood.unit_known else self.likelihood.size / self._freedom

    def _squares(self, at: Expansion) -> float:
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
            scale = (
                np.ones(here.size) if noise.distribution == "log-normal" else here / noise.spread
            )
            squares += float(scale @ scale)
        return max(_RESOLVED**2 * squares, 1e-300)

    @property
    def _freedom(self) -> int:
        """Data less parameters, levels of noise left out."""
        return max(self.likelihood.size - len(self.names) + len(self.likelihood.levels), 1)

    @cached_property
    def quantile(self) -> float:
        """Half the length of an interval in standard deviations, with 95 %."""
        noise_given = self.likelihood.unit_known and not self.likelihood.levels
        return quantile_of(LEVEL, noise_given, self._freedom)

    def rise(self, at: Expansion) -> float:
        """By how much the cost is larger at the ends of intervals; see :meth:`.Intervals.rise`."""
        if self.likelihood.levels or not self.likelihood.unit_known:
            return self.likelihood.size * math.log1p(self.quantile**2 / self._freedom)
        return self.quantile**2 * self.variance(at)


# -----------------------------------------------------------------------------
# The likelihood of a calibration problem, as searches take it.


_SEARCH_ACCURACY = 1e-3  # Relative tolerance of searches; LSODA has a hundredth of it
_MOST_WORK = 1e9  # Operations of one evaluation: a second, far more than a good one takes


@dataclass(frozen=True, eq=False)
class OfFiles:
    """Twice the objective on the unit cube between the bounds of the estimated parameters.

    Parameters that only observables and noise have are ``nested``: they are at their best.
    """

    evaluator: Evaluator
    cube: Cube
    best: Nested
    fixed: Mapping[str, float]

    @classmethod
    def of(cls, evaluator: Evaluator, values: Mapping[str, float]) -> OfFiles:
        """Of all estimated parameters; the others have their ``values``."""
        cube = Cube.of([p for p in evaluator.records.parameters if p.estimated])
        evaluator.simulation.check_smooth(cube.names)
        return cls(evaluator, cube, Nested(evaluator, cube), values)

    @property
    def names(self) -> tuple[str, ...]:
        """The estimated parameters; see
        :class:`~rankone.inference.calibration.descent.Expandable`."""
        return self.cube.names

    @property
    def nested(self) -> NDArray[np.bool_]:
        """The coordinates (n,) that are at their best."""
        return np.array([name in self.best.names for name in self.names])

    def named(self, z: Array) -> dict[str, float]:
        """The values of the estimated parameters at z (n,)."""
        return self.cube.named(z)

    def expanded(self, z: Array) -> Expansion:
        """At z (n,), with the nested parameters at their best.

        The cost is infinite where there are no trajectories, or too much work to do.
        """
        try:
            with limited(_MOST_WORK), np.errstate(all="ignore"):
                return self._expanded(z)
        except (RankoneError, OutOfBudgetError, np.linalg.LinAlgError):
            return Expansion(z, np.inf, np.zeros(1), np.zeros((1, z.size)))

    def _expanded(self, z: Array) -> Expansion:
        values = {**self.fixed, **self.named(z)}
        simulated = self.evaluator.simulated(values, self.names, _SEARCH_ACCURACY, quick=True)
        values = self.best.best(simulated, values)
        z = np.where(self.nested, self.cube.places(values), z)
        at = self.evaluator.evaluated(simulated, values, self.names)
        _, residuals, rows = self.cube.prior_rows(values)
        jacobian = np.concatenate([at.jacobian * self.cube.width, rows])
        finite = np.isfinite(at.objective) and np.isfinite(jacobian).all()
        cost = 2.0 * at.objective if finite else np.inf
        return Expansion(z, cost, np.concatenate([at.residuals, residuals]), jacobian)

    def evaluated(self, z: Array) -> Evaluation:
        """The evaluation at z (n,), at the accuracy of searches."""
        values = {**self.fixed, **self.named(z)}
        simulated = self.evaluator.simulated(values, self.names, _SEARCH_ACCURACY, quick=True)
        return self.evaluator.evaluated(simulated, values, self.names)

    def log_likelihood(self, at: Expansion) -> float:
        """Minus the objective, at its full accuracy; minus infinity without trajectories."""
        if not np.isfinite(at.cost):
            return -np.inf
        values = {**self.fixed, **self.named(at.z)}
        try:
            simulated = self.evaluator.simulated(values, (), ACCURACY)
            return -self.evaluator.evaluated(simulated, values, ()).objective
        except RankoneError:
            return -np.inf
