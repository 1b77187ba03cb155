"""Reasons not to trust a fit, and what is odd about its residuals.

They are compared with what independent noise of the kind assumed would show by chance once in a
thousand fits.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence

import numpy as np
import scipy

from rankone.inference.estimation.experiments import Trial, failures_of
from rankone.inference.estimation.formulas import formula_of
from rankone.inference.estimation.intervals import Intervals
from rankone.support.arrays import Array
from rankone.support.errors import with_remedy
from rankone.support.wording import listing, quote

_NEGLIGIBLE = 0.1  # Residuals below this, in standard deviations, are no noise
_LEAST = 8  # Least number of data of an observable for patterns among them
_ALONE = 1e-6  # What a fit leaves of the variance of a datum that alone decides on a parameter


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
    if len(series) < 2 or together.size < _LEAST or not np.abs(together).max() > _NEGLIGIBLE:
        return
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
    if not np.isfinite(r).all() or r.size < 3 or not np.abs(r).max() > _NEGLIGIBLE:
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
    shared = spare > _ALONE
    own = np.divide(r**2, spare, out=np.zeros(r.size), where=shared)
    others = np.maximum(np.sum(r**2) - own, 1e-12 * np.sum(r**2)) / freedom
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
# Accepted shift of an estimate by the error of the solution, in its standard deviations
_MODEL_SHARE = 0.5


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
            shares = np.divide(error, noise, out=np.zeros(error.size), where=noise > 0.0)
            if math.sqrt(float(np.sum(shares**2))) > _MODEL_SHARE:
                told.add(name)
                yield with_remedy(
                    f"the error of the solution, {float(np.median(error)):.2g} in {quote(name)}, "
                    f"is not small beside the noise, {float(np.median(noise)):.2g}",
                    "solve with a smaller rtol",
                )
