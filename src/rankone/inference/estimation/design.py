"""Where to measure next: sampling times that tell the most about the parameters.

The Fisher information of measurements is the sum of those of each, by the exact derivatives of the
solution (Atkinson, Donev & Tobias, Optimum Experimental Designs, 2007). Times are chosen among
candidates by exchanges from many starts (Fedorov 1972, ch. 3).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rankone.inference.estimation import estimates as results
from rankone.inference.estimation.experiments import Trial, held_parameters, trial_of
from rankone.inference.estimation.fit import Fit
from rankone.inference.estimation.formulas import Formula, value_of
from rankone.inference.estimation.free_parameters import Range, free_parameters
from rankone.inference.estimation.intervals import checked_level, quantile_of
from rankone.inference.estimation.likelihood import Likelihood, vanishing_noise
from rankone.inference.estimation.noise import Noise
from rankone.inference.estimation.observations import (
    DataOptions,
    Observations,
    Sigma,
    check_levels,
    checked_times,
    label,
    observables,
    observed,
)
from rankone.inference.estimation.tables import Doses
from rankone.solution.evaluation.core import SolutionCore
from rankone.support.arrays import NEGLIGIBLE, SAME, TINY, Array, Labelled, Table, Variables
from rankone.support.errors import (
    OptionError,
    count,
    did_you_mean,
    listing,
    quote,
    shown,
    with_remedy,
)
from rankone.support.options import LEVEL, checked_number
from rankone.tensors.coordinates import name_of


@dataclass(frozen=True)
class DesignTuning:
    """Tuning of the search for sampling times."""

    candidates: int = 201
    """Even times over the horizon, where no candidates are given."""
    most_times: int = 200
    """Most times of a design."""
    starts: int = 24
    """Starts of exchanges."""
    most_rounds: int = 200
    """Most rounds of exchanges: each improves the criterion."""
    seed: int = 5
    """Of the starts: a call repeats itself."""


TUNING = DesignTuning()


@dataclass(frozen=True, repr=False)
class Design(Labelled):
    """Sampling times, and what they will tell.

    Attributes
    ----------
    times : ndarray (n,)
        The chosen times, ascending; one may occur more than once.
    criterion : {"D", "A", "E"}
    parameters : tuple of str
        Those that will be estimated.
    at : dict of str to float
        Their values for which the design is made; means if there are several.
    information : ndarray (p, p)
        The Fisher information of the chosen times, and of what was measured before.
    candidates : ndarray (N,)
    gain : ndarray (N,)
        By how much one more measurement at each candidate would raise the logarithm of the
        criterion, of its root 1/p for D; NaN if the times do not identify all parameters.
    success : bool
        Whether the times identify all parameters.
    message : str
    sigma_known : bool
        Whether the size of the noise is known, by sigma, by levels in ``at`` or by a fit.
    noise_given : bool
        Whether the data will be fitted with this size: it is not estimated from them.
    dof : float
        Degrees of freedom of that fit, those of a fit before among them.
    """

    times: Array
    criterion: str
    parameters: tuple[str, ...]
    at: dict[str, float]
    information: Array
    candidates: Array
    gain: Array
    success: bool
    message: str
    level: float
    sigma_known: bool
    noise_given: bool
    dof: float
    _blocks: Candidates = field(repr=False)
    _score: Criterion = field(repr=False)

    @property
    def covariance(self) -> Array:
        """The expected covariance of the estimates (p, p); infinite where not identified."""
        if not self.success:
            return np.full(self.information.shape, np.inf)
        return np.asarray(np.linalg.inv(self.information))

    @property
    def std(self) -> dict[str, float]:
        """The expected standard deviation of each estimate; in sigma if it was not given."""
        roots = np.sqrt(np.diag(self.covariance))
        return dict(zip(self.parameters, map(float, roots), strict=True))

    def interval(self, level: float | None = None) -> dict[str, tuple[float, float]]:
        """The interval that is expected for each parameter, if its value is that of ``at``.

        By Student's quantiles if the noise is estimated with the parameters.

        Raises
        ------
        OptionError
            If the size of the noise is not known, or the level is not between 0 and 1.
        """
        if not self.sigma_known:
            raise OptionError(
                "the design knows no sigma, so no interval can be expected",
                remedy="give design(..., sigma=...)",
            )
        level = self.level if level is None else checked_level(level)
        q = quantile_of(level, self.noise_given, self.dof)
        return {
            name: (self.at[name] - q * s, self.at[name] + q * s) for name, s in self.std.items()
        }

    def efficiency(self, times: ArrayLike) -> float:
        """What other times tell, in shares of what the chosen ones do.

        For criterion D the ratio of the determinants to the power 1/p, as if from so many times
        fewer measurements; for A and E the ratio of the criteria.
        """
        other = self._blocks.at_times(times)
        base, best = self._blocks.base, self._score(self._blocks.scaled(self.information[None]))
        share = float(self._score(base + other.sum(axis=1))[0] - best[0])
        return math.exp(share) if math.isfinite(share) else 0.0

    def _table(self) -> Table:
        intervals = self.interval() if self.sigma_known else {}
        rows = []
        for name, deviation in self.std.items():
            expected = [f"{deviation:.4g} sigma", ""]
            if not self.success:
                expected = ["not identified", ""]
            elif name in intervals:
                expected = [f"{deviation:.4g}", results.interval_text(intervals[name])]
            rows.append([name, *expected])
        listed = ", ".join(f"{time:.6g}" for time in self.times)
        return Table(
            f"{self.criterion}-optimal design: {count(len(self.times), 'time')}, {listed}",
            ["parameter", "expected std", f"{100 * self.level:g} % interval"],
            rows,
            [results.verdict(self)],
        )

    def _variables(self) -> Variables:
        """Expected deviations and covariance; the gain at the candidates."""
        columns = {"std": list(self.std.values())}
        arrays, labels = results.by_parameter(columns, self.parameters, self.covariance)
        gain = {"gain": (("time",), self.gain)}
        return Variables({**arrays, **gain}, {**labels, "time": self.candidates})


def design(
    self: SolutionCore,
    times: int,
    candidates: ArrayLike | None = None,
    *,
    at: Mapping[Any, ArrayLike] | None = None,
    after: Fit | None = None,
    observe: object = None,
    sigma: Sigma = None,
    noise: object = None,
    fixed: Mapping[Any, float] | None = None,
    interest: object = None,
    criterion: str = "D",
    level: float = LEVEL,
) -> Design:
    """Choose the sampling times that tell the most about the parameters.

    Parameters
    ----------
    times : int
        How many times; at each one all observables are measured. A time may be chosen more than
        once.
    candidates : array_like, optional
        Times to choose from; by default 201 over the horizon.
    at : mapping
        Values of all parameters that are not fixed, also of those of observables and noise, for
        which the design is made: what derivatives say depends on them. Several values of each,
        ``posterior.sample(100)``, give the design that is best on average.
    after : Fit, optional
        A fit: its estimates are taken for ``at``, its observables, noise and fixed values for new
        measurements, and its information is added.
    observe, sigma, noise
        What is to be measured, as for :meth:`fit`; after a fit perhaps the names of some of its
        observables.
    fixed : mapping, optional
        Values of parameters that are known. After a fit the conditions of the new measurements: a
        dose that differs between the experiments of the fit has to be given, others may be.
    interest : name, symbol or list of them, optional
        Parameters that matter, the others being estimated as well; by default all.
    criterion : {"D", "A", "E"}
        "D" makes the determinant of the information largest, so that the joint confidence region
        is smallest; "A" makes the mean relative variance of the estimates smallest, "E" the
        variance of the worst combination.
    level : float
        Level of expected intervals.

    Returns
    -------
    Design
        With ``times``, ``information``, ``std``, ``interval()``, ``gain`` and ``efficiency``.

    Raises
    ------
    OptionError
        If values of parameters are missing, there are too few times, or a name is unknown.
    EvaluationError
        If a candidate is outside the horizon, or a value outside the box.
    """
    self._evaluator  # noqa: B018 - raises if nothing was solved
    times = checked_number("times", times, 1, TUNING.most_times)
    if criterion not in ("D", "A", "E"):
        raise OptionError(f"criterion={shown(criterion)} is unknown", remedy='choose "D"')
    clock = np.linspace(*self.time, TUNING.candidates) if candidates is None else candidates
    clock = np.unique(checked_times(self, clock))
    if after is not None and not isinstance(after, Fit):
        raise OptionError(f"{shown(after)} is not a Fit", term=after)
    blocks = candidates_of(self, clock, at, after, Wanted(observe, sigma, noise, fixed))
    level = checked_level(level)
    wanted = _interest(interest, blocks.names)
    rows = tuple(blocks.names.index(name) for name in wanted)
    _check_enough(times, blocks)
    score = Criterion(criterion, rows)
    indices, agreeing = _chosen(blocks, times, score)
    whole = blocks.base + blocks.each[:, indices].sum(axis=1)
    best = float(score(whole).mean())
    more = score(whole[:, None] + blocks.each).mean(axis=0)
    gain = more - best if math.isfinite(best) else np.full(more.shape, np.nan)
    success = bool(_identified(whole).all())
    message = f"{agreeing} of {TUNING.starts} searches among {count(len(clock), 'candidate')} agree"
    if not success:
        message = with_remedy(
            "these measurements cannot identify all parameters, whatever the times",
            "fix some, or observe more",
        )
    sigma_known, noise_given, dof = _noise(blocks, times, after)
    return Design(
        times=clock[np.sort(indices)],
        criterion=criterion,
        parameters=blocks.names,
        at=blocks.values,
        information=blocks.unscaled(whole).mean(axis=0),
        candidates=clock,
        gain=gain,
        success=success,
        message=message,
        level=level,
        sigma_known=sigma_known,
        noise_given=noise_given,
        dof=dof,
        _blocks=blocks,
        _score=score,
    )


def _check_enough(times: int, blocks: Candidates) -> None:
    """Raise an OptionError if so few times cannot identify all parameters."""
    needed = math.ceil((len(blocks.names) - np.linalg.matrix_rank(blocks.base[0])) / blocks.data)
    if times < needed:
        raise OptionError(
            f"{count(times, 'time')} cannot identify {count(len(blocks.names), 'parameter')}, "
            f"{listing(blocks.names)}",
            term=times,
            remedy=f"measure at {needed} times or more, or fix parameters",
        )


def _noise(blocks: Candidates, times: int, after: Fit | None) -> tuple[bool, bool, float]:
    """Whether the size of noise is known, whether it is given, and degrees of freedom."""
    row, data = blocks.trial.observations, times * blocks.data
    if after is not None:
        return True, after.noise_given, after.dof + data
    dof = data - len(blocks.names) + len(row.levels)
    return row.sigma_known, row.sigma_known and not row.levels, float(dof)


def _interest(interest: object, names: tuple[str, ...]) -> list[str]:
    if interest is None:
        return list(names)
    keys = interest if isinstance(interest, list | tuple) else [interest]
    wanted = []
    for key in keys:
        name = name_of(key)
        if name not in names:
            raise OptionError(
                f"interest: {quote(name)} is not estimated{did_you_mean(name, names)}",
                term=key,
                remedy=f"choose from {listing(names)}",
            )
        wanted.append(name)
    if not wanted:
        raise OptionError("interest names no parameter", term=interest)
    return wanted


def _identified(information: Array) -> Array:
    """Whether all directions of information matrices (..., p, p) are seen."""
    eigenvalues = np.linalg.eigvalsh(information)
    largest = np.maximum(eigenvalues[..., -1], TINY)
    return np.asarray(eigenvalues[..., 0] > NEGLIGIBLE * largest)


@dataclass(frozen=True)
class Criterion:
    """A criterion of some parameters, by their positions, in logarithms: the larger the better."""

    name: str
    rows: tuple[int, ...]

    def __call__(self, information: Array) -> Array:
        """Values (...) for information (..., p, p); minus infinity where not all is seen."""
        identified = _identified(information)
        safe = np.where(identified[..., None, None], information, np.eye(information.shape[-1]))
        covariance = np.linalg.inv(safe)[..., self.rows, :][..., self.rows]
        if self.name == "D":
            criterion = -np.linalg.slogdet(covariance)[1] / len(self.rows)
        elif self.name == "A":
            criterion = -np.log(np.trace(covariance, axis1=-2, axis2=-1))
        else:
            criterion = -np.log(np.linalg.eigvalsh(covariance)[..., -1])
        return np.where(identified, criterion, -np.inf)


def _chosen(blocks: Candidates, times: int, criterion: Criterion) -> tuple[NDArray[np.intp], int]:
    """The best positions of candidates (n,), and how many searches end equally good."""
    generator = np.random.default_rng(TUNING.seed)
    starts = generator.integers(0, blocks.each.shape[1], (TUNING.starts, times))
    ends = [_exchanged(blocks, start, criterion) for start in starts]
    top = max(score for score, _ in ends)
    agreeing = sum(score >= top - SAME for score, _ in ends)
    return max(ends, key=lambda end: end[0])[1], agreeing


def _exchanged(
    blocks: Candidates, start: NDArray[np.intp], criterion: Criterion
) -> tuple[float, NDArray[np.intp]]:
    """The criterion and positions (n,) that no exchange of one time improves."""
    indices, best = start.copy(), -math.inf
    for _ in range(TUNING.most_rounds):
        before = best
        for i in range(indices.size):
            rest = blocks.base + blocks.each[:, np.delete(indices, i)].sum(axis=1)
            scores = criterion(_ridged(rest[:, None] + blocks.each)).mean(axis=0)
            k = int(np.argmax(scores))
            if scores[k] > best + NEGLIGIBLE:
                indices[i], best = k, float(scores[k])
        if best <= before + NEGLIGIBLE:
            break
    return best, indices


def _ridged(information: Array) -> Array:
    """The information with a ridge just above what counts as identified: searches have a way."""
    size = information.shape[-1]
    trace = np.trace(information, axis1=-2, axis2=-1)[..., None, None]
    return np.asarray(information + 2.0 * NEGLIGIBLE * trace * np.eye(size))


# -----------------------------------------------------------------------------
# The information of measurements at candidate times, for designs.


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
    row = observed(solution, times, ones, observe, DataOptions(sigma, noise))
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
