"""Predictions, residuals and standard deviations of all data at one point."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from rankone.estimation.duals import value_of
from rankone.estimation.experiments import Trial
from rankone.estimation.likelihood import Likelihood
from rankone.estimation.noise import terms
from rankone.support.arrays import Array


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
    seen = singular > 1e-7 * max(float(singular.max(initial=0.0)), 1e-300)
    return np.asarray(np.sum(left[:, seen] ** 2, axis=1))


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
