"""Measurements beside the best predictions, for plots."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from rankone.estimation.intervals import quantile_of
from rankone.statistics.replicates import LEVEL
from rankone.support.arrays import Array


class Comparison(NamedTuple):
    """The m measurements of one observable in one experiment, in order of time.

    Attributes
    ----------
    observable, experiment : str
        Their names.
    times, measured, predicted : ndarray (m,)
    bars : ndarray (2, m)
        Ends of error bars, one standard deviation of the noise below and above the measurements.
    band : ndarray (2, m)
        Where the prediction is known to be with 95 %, by linearisation; NaN without derivatives.
    standardised : ndarray (m,)
        Measurement less prediction, in standard deviations of the noise.
    """

    observable: str
    experiment: str
    times: Array
    measured: Array
    predicted: Array
    bars: Array
    band: Array
    standardised: Array


class Scale(NamedTuple):
    """The scale on which noise is normal, as functions to it and back."""

    to: Callable[[Array], Array]
    back: Callable[[Array], Array]


SCALES = {
    "lin": Scale(np.asarray, np.asarray),
    "log": Scale(np.log, np.exp),
    "log10": Scale(np.log10, lambda x: 10.0**x),
}
"""Those of observables by name."""


def compared(
    names: tuple[str, str],
    data: tuple[Array, Array],
    predicted: Array,
    noise: Array,
    root: Array,
    scale: str = "lin",
) -> Comparison:
    """What was measured of an observable in an experiment, and what is predicted.

    Parameters
    ----------
    names : (str, str)
        The observable and the experiment.
    data : pair of ndarray (m,)
        Times and measurements.
    predicted, noise : ndarray (m,)
        Predictions, and standard deviations on the scale.
    root : ndarray (m,)
        Standard deviations of the predictions, in those of the noise.
    scale : {"lin", "log", "log10"}
        The scale on which the noise is normal.
    """
    times, measured = data
    order = np.argsort(times, kind="stable")
    times, measured, predicted = times[order], measured[order], predicted[order]
    noise, root = noise[order], root[order]
    half = quantile_of(LEVEL, True, 0.0) * noise * root
    signs = np.array([[-1.0], [1.0]])
    to, back = SCALES[scale]
    with np.errstate(all="ignore"):
        at, expected = to(measured), to(predicted)
        bars, band = back(at + signs * noise), back(expected + signs * half)
    residuals = (at - expected) / noise
    return Comparison(*names, times, measured, predicted, bars, band, residuals)
