"""A fit: best values, intervals, what the data identify, and reasons not to trust it."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy

from rankone.inference.estimation import estimates as results
from rankone.inference.estimation.experiments import Trial, failures_of
from rankone.inference.estimation.formulas import formula_of
from rankone.inference.estimation.intervals import Intervals
from rankone.support.arrays import COINCIDENT, MINOR, SAME, Array, Table, Variables
from rankone.support.errors import count, listing, quote, with_remedy
from rankone.tensors.distributions import Distribution
from rankone.tensors.joint_distribution import Known


@dataclass(frozen=True, repr=False)
class Fit(Intervals, results.Judged):
    """Parameters from data: best values, intervals, and whether to believe them.

    Attributes
    ----------
    level : float
        Default level of intervals.
    converged : bool
        Whether the search converged.
    stuck : bool
        Whether it ended where the likelihood jumps: an event passes a time of the data there.
    kinked : bool
        Whether it ended at a kink of the likelihood: rates switch at a time of the data there.
    dof : float
        Degrees of freedom: number of data less that of directions of the parameters that were
        fitted to them. Priors make it fractional: what they say is not fitted.
    others : tuple of dict of str to float
        Other minima that the data do not exclude at the level.
    jumps : tuple of Jump
        Parameters in whose intervals an event passes a time of the data, and that time.
    sizes : tuple of dict of str to float
        For each experiment the largest values of the observed states over the box.
    held : dict of str to float
        Parameters that the data do not determine and that the solution holds at a value, as around
        the optimum of a calibration: all intervals are conditional on them.
    """

    @cached_property
    def findings(self) -> tuple[str, ...]:
        """Reasons not to trust the fit, a sentence each."""
        return tuple(findings_of(self))

    @cached_property
    def odd(self) -> tuple[str, ...]:
        """What is odd about the residuals, a sentence each; see the guide to fits."""
        predicted = [row.predicted for row in self._rows]
        rows = self.trials, self.standardised, predicted, self._spare
        return tuple(residual_checks(*rows, self.unit_known))

    @cached_property
    def checks(self) -> tuple[str, ...]:
        """What is worth knowing and no reason to distrust the fit, a sentence each.

        Most are about the residuals, see :attr:`odd`.
        """
        sentences = [*self.odd]
        levels = {name for trial in self.trials for name in trial.observations.levels}
        for name in levels & set(self.fixed):
            if self.fixed[name] == 0.0:
                sentences.append(f"{quote(name)} is zero: the data show no such part of the noise")
        for time in sorted({jump.time for jump in self.jumps if self.converged}):
            names = listing(jump.parameter for jump in self.jumps if jump.time == time)
            sentences.append(
                f"an event passes the time {time:.6g} of the data inside the intervals of {names}; "
                "standard deviations and bands are rough there"
            )
        return tuple(sentences)

    @cached_property
    def known(self) -> Known:
        """The distribution of the parameters, which statistics take: ``solution.mean(under=fit)``.

        Estimates are normal in the coordinates of the search, with the covariance there.
        """
        free = self._problem.free
        root = self._identification.root
        deviations = np.linalg.norm(root, axis=1)
        distributions: dict[str, Distribution] = {}
        fixed = dict(self.fixed)
        for j, name in enumerate(self.parameters):
            x = self.x[name]
            if not deviations[j] > 0.0:
                fixed[name] = x
            elif free.logarithmic[j]:
                spread = deviations[j] * free.logarithms[j]
                distributions[name] = scipy.stats.lognorm(spread, scale=x)
            else:
                distributions[name] = scipy.stats.norm(x, deviations[j] * free.width[j])
        moving = [j for j, name in enumerate(self.parameters) if name in distributions]
        pairs = itertools.combinations(moving, 2)
        correlation = {
            (self.parameters[i], self.parameters[j]): float(
                root[i] @ root[j] / (deviations[i] * deviations[j])
            )
            for i, j in pairs
        }
        several = []
        for name in dict.fromkeys(itertools.chain(*(trial.fixed for trial in self.trials))):
            values = {trial.fixed.get(name) for trial in self.trials}
            if len(values) > 1 or any(trial.doses is not None for trial in self.trials):
                several.append(name)
            else:
                fixed[name] = self.trials[0].fixed[name]
        return Known(distributions, correlation, fixed, tuple(several))

    # --- display -------------------------------------------------------------------------------

    def _table(self) -> Table:
        """The estimates, a line each, and whether to believe them."""
        noise = f"chi2 {self.chi2:.4g}"
        if not self.unit_known:
            noise = f"sigma {self.sigma:.4g} estimated"
        elif self.noise_levels:
            noise = f"log-likelihood {self.log_likelihood:.4g}"
        of = f"{count(self.size, 'value')} of {', '.join(self.observed)}"
        if len(self.trials) > 1:
            of += f" in {len(self.trials)} experiments"
        rows = []
        for name, (low, high) in self.interval().items():
            cells = [f"{self.x[name]:.6g}", results.interval_text((low, high)), self.limits[name]]
            rows.append([name, *(cells if self.identifiable[name] else ["not identified", "", ""])])
        for name in self.combinations:
            ends = results.interval_text(self.interval_of(name))
            rows.append([name, f"{self.value_of(name):.6g}", ends, ""])
        header = ["parameter", "estimate", f"{100 * self.level:g} % interval", "limited by"]
        if not any(row[-1] for row in rows):
            header, rows = header[:-1], [row[:-1] for row in rows]
        summary = f"Fit to {of}: {noise}, {self.dof:.4g} degrees of freedom"
        return Table(summary, header, rows, self._remarks)

    def _variables(self) -> Variables:
        """Estimates with deviations and intervals, and the covariance."""
        low, high = np.array(list(self.interval().values())).T
        columns = {
            "estimate": list(self.x.values()),
            "std": list(self.std.values()),
            "lower": low,
            "upper": high,
            "identified": list(self.identifiable.values()),
            "limits": list(self.limits.values()),
        }
        return results.by_parameter(columns, self.parameters, self.covariance)


# -----------------------------------------------------------------------------
# Reasons not to trust a fit, and what is odd about its residuals.
#
# They are compared with what independent noise of the kind assumed would show by chance once in a
# thousand fits.


_LEAST = 8  # Least number of data of an observable for patterns among them


def residual_checks(
    trials: Sequence[Trial],
    standardised: Sequence[Array],
    predicted: Sequence[Array],
    spare: Sequence[Array],
    unit_known: bool,
) -> Iterator[str]:
    """Sentences about standardised residuals (m,) and predictions (m,) of each trial.

    ``spare`` (m,) is the share of the variance of each datum that the fit leaves to its residual.
    Unless the unit is known, the size of all noise is estimated.
    """
    names = dict.fromkeys(name for trial in trials for name in trial.observations.names)
    for name in names:
        series, owners, heavy, known = [], [], False, unit_known
        for trial, r, p, left in zip(trials, standardised, predicted, spare, strict=True):
            if name in trial.observations.names:
                index = trial.observations.names.index(name)
                here = trial.observations.of(index)
                heavy |= trial.observations.noises[index].distribution == "student"
                known &= not trial.observations.noises[index].estimated
                owners.append(trial.name)
                order = np.argsort(trial.observations.times[here], kind="stable")
                columns = r, p, trial.observations.times, left
                series.append(tuple(column[here][order] for column in columns))
        yield from _of_observable(name, series, heavy, known)
        yield from _aside(name, owners, [r for r, *_ in series])


def _aside(name: str, owners: Sequence[str], series: Sequence[Array]) -> Iterator[str]:
    """Experiments on different sides of the curve (Kruskal & Wallis 1952)."""
    together = np.concatenate(series)
    if len(series) < 2 or together.size < _LEAST or not np.abs(together).max() > MINOR:
        return  # few, or in standard deviations no noise
    if scipy.stats.kruskal(*series).pvalue < _UNLIKELY:
        means = [float(r.mean()) for r in series]
        low, high = owners[int(np.argmin(means))], owners[int(np.argmax(means))]
        yield with_remedy(
            f"the curve of {quote(name)} is too high for {quote(low)} and too low for "
            f"{quote(high)}",
            "fix what differs between them, such as a dose",
        )


def _of_observable(
    name: str, series: Sequence[tuple[Array, ...]], heavy: bool, known: bool
) -> Iterator[str]:
    r, p, times, spare = (np.concatenate(column) for column in zip(*series, strict=True))
    if not np.isfinite(r).all() or r.size < 3 or not np.abs(r).max() > MINOR:
        return
    if not heavy:
        yield from _outlier(name, r, times) if known else _apart(name, r, times, spare)
    if r.size < _LEAST:
        return
    yield from _runs(name, [each for each, *_ in series])
    yield from _growing(name, r, p)


def _outlier(name: str, r: Array, times: Array) -> Iterator[str]:
    worst = int(np.argmax(np.abs(r)))
    chance = 2.0 * float(scipy.stats.norm.sf(abs(r[worst]))) * r.size
    if chance < _UNLIKELY:
        yield _off(name, times[worst], "", abs(r[worst]))


def _apart(name: str, r: Array, times: Array, spare: Array) -> Iterator[str]:
    """The datum that is farthest off where the others are fitted without it, by their spread.

    To first order that takes no fit (Cook & Weisberg, Residuals and Influence in Regression, 1982,
    2.2): the outlier itself enlarges the estimate of the noise, and draws the curve.
    """
    freedom = float(spare.sum()) - 1.0
    if freedom < 1.0:
        return
    shared = spare > SAME
    own = np.divide(r**2, spare, out=np.zeros(r.size), where=shared)
    others = np.maximum(np.sum(r**2) - own, COINCIDENT * np.sum(r**2)) / freedom
    sizes = np.sqrt(own / others)
    worst = int(np.argmax(sizes))
    chance = 2.0 * float(scipy.stats.t.sf(sizes[worst], freedom)) * r.size
    if chance < _UNLIKELY:
        yield _off(name, times[worst], ", by the spread of the others,", sizes[worst])


def _off(name: str, time: float, by: str, size: float) -> str:
    return with_remedy(
        f"the measurement of {quote(name)} at {time:.4g} is{by} {size:.2g} standard deviations off",
        'look at it, or fit with noise="student"',
    )


def _runs(name: str, series: Sequence[Array]) -> Iterator[str]:
    """Neighbours in time that deviate to the same side (Wald & Wolfowitz 1940)."""
    runs = expected = variance = 0.0
    for r in series:
        above = r > 0.0
        a, b = int(above.sum()), int((~above).sum())
        if a == 0 or b == 0 or a + b < 3:
            continue
        runs += 1.0 + np.count_nonzero(above[1:] != above[:-1])
        mean = 2.0 * a * b / (a + b)
        expected += 1.0 + mean
        variance += mean * (mean - 1.0) / (a + b - 1.0)
    if variance > 0.0 and scipy.stats.norm.cdf((runs - expected) / math.sqrt(variance)) < _UNLIKELY:
        yield (
            f"residuals of {quote(name)} keep their sign for long: {runs:.0f} runs, "
            f"{expected:.0f} expected; the model may miss something"
        )


def _growing(name: str, r: Array, p: Array) -> Iterator[str]:
    """Residuals that grow with the prediction (Spearman's rank correlation)."""
    if not np.ptp(np.abs(p)) > 0.0:
        return
    test = scipy.stats.spearmanr(np.abs(r), np.abs(p))
    if test.pvalue < _UNLIKELY:
        larger, kind = ("grow", "proportional") if test.statistic > 0 else ("shrink", "constant")
        yield with_remedy(
            f"residuals of {quote(name)} {larger} with its values", f'try noise="{kind}"'
        )


# -----------------------------------------------------------------------------
# Reasons not to trust a fit, a sentence each.


_UNLIKELY = 1e-3  # Probability of residuals this large below which the model is rejected


def findings_of(fit: Intervals) -> Iterator[str]:
    """The sentences, the most important first."""
    yield from failures_of(fit.trials)
    if fit.stuck or (fit.jumps and not fit.converged):
        times = sorted({jump.time for jump in fit.jumps})
        of = f"the time {times[0]:.6g}" if len(times) == 1 else "a time"
        reason = f", because an event passes {of} of the data there" if times else ""
        elsewhere = ", or measure at times that no event can pass" if times else ""
        yield with_remedy(
            f"the search ended where the sum of squares jumps{reason}: standard deviations and "
            "bands are not valid",
            f"take the intervals, which see the jump{elsewhere}",
        )
    elif fit.kinked:
        yield with_remedy(
            "the search ended at a kink of the sum of squares: standard deviations and bands are "
            "not valid",
            "take the intervals, which see the kink",
        )
    elif not fit.converged:
        yield with_remedy("the search did not converge", "give a start, or more starts")
    yield from _not_identified(fit.identifiable, fit.combinations)
    for name, end in fit.at_bounds.items():
        if fit.identifiable[name]:
            yield _at_bound(fit, name, end)
    for name, side in fit.limited.items():
        if fit.identifiable[name] and side and name not in fit.at_bounds:
            yield one_sided(name, side)
    if fit.held:
        yield with_remedy(
            f"the solution holds {listing(fit.held)}, which the data do not determine: intervals "
            f"are conditional on {'it' if len(fit.held) == 1 else 'them'}",
            "take those of the calibration",
        )
    for minimum in fit.others:
        where = ", ".join(f"{name} = {x:.6g}" for name, x in minimum.items())
        yield with_remedy(f"other values fit as well: {where}", "set bounds, or measure more")
    if fit.p_value < _UNLIKELY:
        yield (
            f"the residuals are {fit.sigma:.3g} times as large as sigma (chi2 {fit.chi2:.4g} with "
            f"{fit.dof:.4g} degrees of freedom, p = {fit.p_value:.1g}): "
            "the model does not describe the data, or sigma is larger"
        )
    yield from _error_of_solution(fit)


def _not_identified(
    identifiable: Mapping[str, bool], combinations: tuple[str, ...]
) -> Iterator[str]:
    """What the table says of parameters and combinations, in words."""
    names = [name for name, identified in identifiable.items() if not identified]
    inside = {name for text in combinations for name in formula_of(text).names}
    joined = [name for name in names if name in inside]
    unseen = [name for name in names if name not in inside]
    if joined:
        free = len(joined) - len(combinations)
        remedy = "fix one of them" if free == 1 else f"fix {free} of them"
        subject = f"the data do not identify {listing(joined)} alone, only {listing(combinations)}"
        yield with_remedy(subject, remedy)
    if len(unseen) == 1:
        yield with_remedy(f"the data do not identify {quote(unseen[0])}", "fix it, or measure more")
    elif unseen:
        remedy = "fix some, measure more, or widen the box"
        yield with_remedy(f"the data do not identify {listing(unseen)} within their bounds", remedy)


def _at_bound(fit: Intervals, name: str, end: str) -> str:
    if name in fit.noise_levels and end == "lower":
        return with_remedy(
            f"the level of noise {quote(name)} tends to zero",
            'fix it, give sigma as a number, or share a level: sigma="s"',
        )
    return with_remedy(
        f"{quote(name)} = {fit.x[name]:.6g} is at the {end} end of its bounds, which ends its "
        "interval",
        "widen the bounds, or solve on a wider box",
    )


def one_sided(name: str, side: str) -> str:
    """That the data bound a parameter from one side alone."""
    other = "a lower" if side == "upper" else "an upper"
    return with_remedy(
        f"the data give {quote(name)} no {side} bound, only {other} one",
        "measure more, or widen its interval if that is no limit of nature",
    )


def _error_of_solution(fit: Intervals) -> Iterator[str]:
    """Where the error of the solution is not small beside the noise."""
    told: set[str] = set()
    for trial, errors, sigma in zip(fit.trials, fit.model_errors, fit.deviations, strict=True):
        for i, name in enumerate(trial.observations.names):
            here = trial.observations.of(i)
            error, noise = errors[here], sigma[here]
            if name in told or not error.size or np.isnan(error).any():
                continue
            for sentence in results.error_beside_noise(name, error, noise):
                told.add(name)
                yield sentence
