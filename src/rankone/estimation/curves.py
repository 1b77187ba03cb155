"""Fitted curves of observables, with their derivatives."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from rankone.estimation.duals import with_shape
from rankone.estimation.experiments import Seeds, Trial, trial_of
from rankone.estimation.likelihood import Likelihood
from rankone.estimation.noise import Noise
from rankone.estimation.observations import checked_times
from rankone.support.arrays import Array
from rankone.support.errors import OptionError
from rankone.support.wording import did_you_mean, listing, quote


class Curve(NamedTuple):
    """Values of an observable (times,), and half the width of the band in which it is known."""

    values: Array
    half_width: Array


def curve_of(
    problem: Likelihood, trial: Trial, observable: str, times: ArrayLike, z: Array
) -> tuple[Array, Array]:
    """Values of an observable at times (k,), and derivatives (k, n) with respect to z (n,)."""
    names = trial.observations.names
    if observable not in names:
        raise OptionError(
            f"{quote(observable)} was not measured{did_you_mean(observable, names)}",
            term=observable,
            remedy=f"choose from {listing(names)}",
        )
    clock = checked_times(trial.solution, times)
    i = names.index(observable)
    observations = replace(
        trial.observations,
        names=(observable,),
        formulas=(trial.observations.formulas[i],),
        noises=(Noise("normal", np.ones(clock.size)),),
        owner=np.zeros(clock.size, dtype=np.intp),
        times=clock,
        values=np.zeros(clock.size),
    )
    there = trial_of(trial.name, trial.solution, trial.fixed, observations, trial.doses)
    free = problem.free
    seeds = Seeds({name: j for j, name in enumerate(free.names)}, len(free.names))
    at = problem.at(free.values(z)[None])
    states, slopes = there.linearised(at, seeds)
    with np.errstate(all="ignore"):
        predicted = there.predicted(at, states, slopes, seeds)[0].value
    curve = with_shape(predicted, (1, clock.size), seeds.width)
    return curve.value[0], curve.slope[0] * free.slopes(z)
