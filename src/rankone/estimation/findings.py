"""Reasons not to trust a fit, a sentence each."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping

import numpy as np

from rankone.estimation.experiments import failures_of
from rankone.estimation.formulas import formula_of
from rankone.estimation.intervals import Intervals
from rankone.support.errors import with_remedy
from rankone.support.wording import listing, quote

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
