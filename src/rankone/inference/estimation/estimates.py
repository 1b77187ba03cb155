"""Results with tables and a verdict; best values of a fit, and its residuals."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, ClassVar, NamedTuple, Protocol

import numpy as np
import scipy

from rankone.inference.estimation.experiments import Trial
from rankone.inference.estimation.formulas import value_of
from rankone.inference.estimation.identification import Best, Identification, Jump
from rankone.inference.estimation.likelihood import LevelUncertainty, Likelihood
from rankone.inference.estimation.noise import normal_scores, terms
from rankone.inference.estimation.observations import Observations
from rankone.solution.evaluation.core import SolutionCore
from rankone.support.arrays import RESOLVED, TINY, Array, Labelled, Variables
from rankone.support.errors import OptionError, did_you_mean, listing, quote, with_remedy

MODEL_SHARE = 0.5
"""Accepted shift of an estimate by the error of the solution, in its standard deviations."""


class WithVerdict(Protocol):
    """A result that says whether it is a success, and why."""

    @property
    def success(self) -> bool: ...
    @property
    def message(self) -> str: ...


def verdict(result: WithVerdict) -> str:
    """Whether to believe a result, in a line."""
    return f"{'success' if result.success else 'no success'}: {result.message}"


class Judged(Labelled):
    """A result with reasons not to trust it, and notes on what is worth knowing."""

    _done: ClassVar[str] = "the fit converged"
    _itself: ClassVar[str] = "it"

    @property
    @abstractmethod
    def findings(self) -> tuple[str, ...]:
        """Reasons not to trust it, a sentence each."""

    @property
    def odd(self) -> tuple[str, ...]:
        """Those of the :attr:`checks` about what would not happen by chance."""
        return ()

    @property
    def checks(self) -> tuple[str, ...]:
        """What is worth knowing and no reason to distrust it, a sentence each."""
        return ()

    @property
    def success(self) -> bool:
        """Whether there are no :attr:`findings`."""
        return not self.findings

    @property
    def message(self) -> str:
        """The findings in one text, or that there are none."""
        against = "the notes say what is odd"
        if not self.odd:
            against = f"nothing speaks against {self._itself}"
        return "; ".join(self.findings) or f"{self._done}, and {against}"

    @property
    def _remarks(self) -> list[str]:
        """What stands below a table."""
        return [verdict(self), *(f"note: {check}" for check in self.checks)]


def interval_text(ends: tuple[float, float]) -> str:
    """An interval in a cell."""
    return f"[{ends[0]:.6g}, {ends[1]:.6g}]"


def by_parameter(
    columns: Mapping[str, Sequence[Any] | Array],
    names: Sequence[str],
    covariance: Array | None = None,
) -> Variables:
    """Columns with an entry for each parameter, and perhaps their covariance."""
    listed = list(names)
    arrays: dict[str, tuple[tuple[str, ...], Any]] = {}
    for name, column in columns.items():
        texts = any(isinstance(each, str) for each in column)
        arrays[name] = ("parameter",), np.array(column, dtype=object if texts else None)
    if covariance is None:
        return Variables(arrays, {"parameter": listed})
    arrays["covariance"] = ("parameter", "other"), covariance
    return Variables(arrays, {"parameter": listed, "other": listed})


def error_beside_noise(name: str, error: Array, noise: Array) -> Iterator[str]:
    """A sentence where the error of a solution (m,) is not small beside the noise of data (m,)."""
    shares = np.divide(error, noise, out=np.zeros(error.size), where=noise > 0.0)
    if math.sqrt(float(np.sum(shares**2))) > MODEL_SHARE:
        yield with_remedy(
            f"the error of the solution, {float(np.median(error)):.2g} in {quote(name)}, is not "
            f"small beside the noise, {float(np.median(noise)):.2g}",
            "solve with a smaller rtol",
        )


# -----------------------------------------------------------------------------
# Best values of a fit, its residuals, and how well the model describes the data.


class Rows(NamedTuple):
    """The data of a trial in a row (m,) each.

    ``scaled`` are data less predictions over sigma; of logarithms for log-normal noise.
    ``deviations`` are standard deviations in the unit of the data, for log-normal noise to first
    order.
    """

    predicted: Array
    scaled: Array
    deviations: Array


def rows_of(problem: Likelihood, z: Array) -> list[Rows]:
    """The rows of each trial at z (n,)."""
    at = problem.at(problem.free.values(z)[None])
    return [_rows(trial, at) for trial in problem.trials]


def _rows(trial: Trial, at: Mapping[str, Array]) -> Rows:
    observations = trial.observations
    predicted, sigma = _predicted(trial, at, trial.states(at))
    scaled = np.empty(observations.size)
    for i, noise in enumerate(observations.noises):
        here = observations.of(i)
        data, spread = observations.values[here], sigma[here][None]
        with np.errstate(all="ignore"):
            one = terms(noise, data, predicted[here][None], spread, None)
        scaled[here] = -one.standardised[0]
        if noise.distribution == "log-normal":
            sigma[here] *= np.abs(predicted[here])
    return Rows(predicted, scaled, sigma)


def leverages_of(problem: Likelihood, jacobian: Array) -> Array:
    """What share of each pseudo-residual (r,) the fit takes up, by their Jacobian (r, n).

    Levels of noise take up nothing, and nothing is taken up of priors.
    """
    others = [j for j in range(jacobian.shape[1]) if j not in problem.levels]
    rows = np.zeros(len(jacobian), dtype=bool)
    for _, _, here in problem.blocks:
        rows[here] = True
    location = np.where(rows[:, None], jacobian, 0.0)[:, others]
    left, singular, _ = np.linalg.svd(location, full_matrices=False)
    visible = singular > RESOLVED * max(float(singular.max(initial=0.0)), TINY)
    return np.asarray(np.sum(left[:, visible] ** 2, axis=1))


def model_errors(
    problem: Likelihood, z: Array, sizes: Sequence[Mapping[str, float]]
) -> list[Array]:
    """For each trial how far the error of its solution moves the predictions (m,) at z (n,).

    ``sizes`` are those of the states of each trial, to which errors are relative.
    """
    at = problem.at(problem.free.values(z)[None])
    errors = []
    for trial, size_of in zip(problem.trials, sizes, strict=True):
        states = trial.states(at)
        moved, begin = states.copy(), 0
        for noise, rows in zip(trial.observations.noises, trial.rows, strict=True):
            for row in rows:
                end = begin + noise.spread.size
                moved[:, begin:end] += trial.solution.errors[row] * size_of[row]
                begin = end
        change = _predicted(trial, at, moved)[0] - _predicted(trial, at, states)[0]
        errors.append(np.abs(change))
    return errors


def _predicted(trial: Trial, at: Mapping[str, Array], states: Array) -> tuple[Array, Array]:
    """Predictions and standard deviations of all data of a trial (m,), for states (1, M)."""
    with np.errstate(all="ignore"):
        predicted = trial.predicted(at, states)
    sizes = [noise.spread.size for noise in trial.observations.noises]
    columns = [
        [np.broadcast_to(value_of(operand), (1, m))[0] for operand in one]
        for one, m in zip(predicted, sizes, strict=True)
    ]
    prediction, sigma = (np.concatenate(each) for each in zip(*columns, strict=True))
    return prediction, sigma


# -----------------------------------------------------------------------------
# Best values of a fit, its residuals, and how well the model describes the data.


@dataclass(frozen=True, repr=False)
class Estimates:
    """The best values of parameters, and what they leave of the data; see :class:`.Fit`."""

    level: float
    converged: bool
    stuck: bool
    kinked: bool
    dof: float
    _problem: Likelihood
    _best: Best
    _centre: Best
    _z: Array
    _identification: Identification
    _freedom: dict[int, float] = field(default_factory=dict)
    _levels: LevelUncertainty | None = None
    others: tuple[dict[str, float], ...] = ()
    jumps: tuple[Jump, ...] = ()
    sizes: tuple[dict[str, float], ...] = ()
    held: Mapping[str, float] = field(default_factory=dict)

    # --- what was fitted -----------------------------------------------------------------------

    @property
    def trials(self) -> tuple[Trial, ...]:
        """The experiments, each with its solution and its data in a row."""
        return self._problem.trials

    @property
    def solution(self) -> SolutionCore:
        """The solution; with several experiments, the first one's."""
        return self.trials[0].solution

    @property
    def observations(self) -> Observations:
        """What was measured, in a row; in the first experiment if there are several."""
        return self.trials[0].observations

    @property
    def size(self) -> int:
        """Number of data."""
        return self._problem.size

    @property
    def observed(self) -> tuple[str, ...]:
        """Names of what was measured."""
        return tuple(dict.fromkeys(n for trial in self.trials for n in trial.observations.names))

    # --- best values ---------------------------------------------------------------------------

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the free parameters, in the order of the covariance."""
        return self._problem.free.names

    @property
    def noise_levels(self) -> tuple[str, ...]:
        """Those of the free parameters that are levels of noise."""
        return tuple(self.parameters[j] for j in self._problem.levels)

    @property
    def fixed(self) -> dict[str, float]:
        """Parameters that were fixed in all experiments, and their values."""
        return dict(self._problem.free.fixed)

    @cached_property
    def x(self) -> dict[str, float]:
        """The estimate of each free parameter."""
        return self._problem.free.named(self._z)

    @property
    def most_likely(self) -> dict[str, float]:
        """The free parameters where the likelihood is largest.

        They differ from ``x`` in levels of noise, which are there corrected for what was fitted.
        """
        return self._problem.free.named(self._best.z)

    @property
    def values(self) -> dict[str, float]:
        """All parameters of the solution: ``solution(times, fit.values)`` is the curve.

        Those of the first experiment if there are several; see :meth:`values_in`. With ``doses=``
        each dose has an amount of its own, which is left out; :meth:`curve` is that of all.
        """
        return self.values_in(0)

    def values_in(self, experiment: int | str) -> dict[str, float]:
        """All parameters of the solution in one experiment, by its name or its position."""
        trial = self.trial(experiment)
        every = {**self._problem.free.complete(self.x), **trial.fixed}
        dose = None if trial.doses is None else trial.doses.parameter
        return {name: every[name] for name in trial.solution.parameters if name != dose}

    def trial(self, experiment: int | str) -> Trial:
        """One experiment, by its name or its position."""
        names = [trial.name for trial in self.trials]
        if isinstance(experiment, str) and experiment in names:
            return self.trials[names.index(experiment)]
        if isinstance(experiment, int) and -len(names) <= experiment < len(names):
            return self.trials[experiment]
        raise OptionError(
            f"there is no experiment {quote(experiment)}{did_you_mean(str(experiment), names)}",
            term=experiment,
            remedy=f"choose from {listing(names)}" if any(names) else f"give 0 to {len(names) - 1}",
        )

    @cached_property
    def residuals(self) -> Array | dict[str, Array] | dict[str, Array | dict[str, Array]]:
        """Data minus model, in the shape of the data.

        By name if the data were so; by experiment if there are several.
        """
        rows = [
            trial.observations.arranged(trial.observations.values - row.predicted)
            for trial, row in zip(self.trials, self._rows, strict=True)
        ]
        return rows[0] if len(rows) == 1 else dict(zip(self._names, rows, strict=True))

    @property
    def standardised(self) -> tuple[Array, ...]:
        """For each experiment the residuals in standard deviations, in a row."""
        unit = self._unit if self._unit > 0.0 else 1.0
        return tuple(row.scaled / unit for row in self._rows)

    @property
    def _names(self) -> tuple[str, ...]:
        """Names of the experiments."""
        return tuple(trial.name for trial in self.trials)

    @cached_property
    def _rows(self) -> list[Rows]:
        return rows_of(self._problem, self._z)

    @property
    def _spare(self) -> list[Array]:
        """For each experiment the share of the variance of each datum (m,) left to its residual."""
        jacobian = self._problem.linearised(self._z[None], settle=False).jacobian[0]
        leverages = leverages_of(self._problem, jacobian)
        each = np.concatenate([1.0 - leverages[here] for _, _, here in self._problem.blocks])
        ends = np.cumsum([trial.observations.size for trial in self.trials])
        return np.split(each, ends[:-1])

    @property
    def deviations(self) -> list[Array]:
        """For each experiment the standard deviations of the data (m,), as given or estimated.

        Those of log-normal noise are in the unit of the data, to first order.
        """
        return [row.deviations * self._unit for row in self._rows]

    @property
    def model_errors(self) -> list[Array]:
        """For each experiment how far the error of the solution moves the predictions (m,)."""
        return model_errors(self._problem, self._z, self.sizes)

    @property
    def chi2(self) -> float:
        """Sum of squared residuals over sigma; of weighted residuals if sigma is not known."""
        return float(sum(np.sum(row.scaled**2) for row in self._rows))

    @property
    def unit_known(self) -> bool:
        """Whether standard deviations are given or have levels, not one that all data share."""
        return self._problem.unit_known

    @property
    def noise_given(self) -> bool:
        """Whether the standard deviations of all data were given."""
        return self._problem.unit_known and not self._problem.levels

    @cached_property
    def sigma(self) -> float:
        """Standard deviation of the residuals, in units of sigma where sigma was given.

        Where none was given it is the estimate of sigma; with weights, for a datum of weight one.
        """
        return math.sqrt(self.chi2 / self.dof) if self.dof > 0 else math.nan

    @property
    def p_value(self) -> float:
        """Probability of residuals as large as these or larger; NaN where sigma is not given.

        Those of Student's noise count as normal ones that are as improbable.
        """
        if not self.noise_given or not self.dof > 0:
            return math.nan
        squares = 0.0
        for trial, row in zip(self.trials, self._rows, strict=True):
            for i, noise in enumerate(trial.observations.noises):
                own = normal_scores(noise, row.scaled[trial.observations.of(i)])
                squares += float(np.sum(own**2))
        return float(scipy.stats.chi2.sf(squares, self.dof))

    # --- how well the model describes the data -------------------------------------------------

    @cached_property
    def log_likelihood(self) -> float:
        """The largest logarithm of the probability density of the data, with all constants."""
        return self._problem.largest_log_likelihood(self._best.z, self._best.cost)

    @property
    def _estimated(self) -> int:
        """Number of estimates, an unknown sigma among them."""
        return len(self.parameters) + (not self._problem.unit_known)

    @property
    def aic(self) -> float:
        """Akaike's information criterion: the smaller, the better the model predicts."""
        return 2.0 * self._estimated - 2.0 * self.log_likelihood

    @property
    def bic(self) -> float:
        """The Bayesian information criterion (Schwarz 1978), smaller for better models."""
        return math.log(self.size) * self._estimated - 2.0 * self.log_likelihood

    @property
    def _unit(self) -> float:
        """Standard deviation of scaled residuals: one, or its estimate."""
        return 1.0 if self._problem.unit_known else self.sigma
