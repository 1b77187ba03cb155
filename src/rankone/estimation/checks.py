"""What is odd about the residuals of a fit, in words.

They are compared with what independent noise of the kind assumed would show by chance once in a
thousand fits.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np
import scipy

from rankone.estimation.experiments import Trial
from rankone.support.arrays import Array
from rankone.support.errors import with_remedy
from rankone.support.wording import quote

_UNLIKELY = 1e-3  # Probability by chance below which something is said
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
