"""Functions of which enclosures are made by samples: those of the user, tables and the unlisted.

Functions of ``scipy.special`` have a scale of about one, and poles at integers, if any. Of
functions of the user and of tables nothing is known: they show what their samples show.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rankone.support.arrays import Array
from rankone.trajectories.paths import NODES
from rankone.verification.enclosures.enclosure import Enclosure
from rankone.verification.enclosures.ranges import (
    BETWEEN,
    Function,
    around,
    away_from,
    share_in_doubt,
    times,
    width_of,
    within,
    without_nan,
)

_MIDDLE = NODES.size // 2  # The sample in the middle of a piece
# Shares of ranges of several arguments at which functions are sampled, with all corners of three
_SHARES = np.concatenate(
    [np.indices((2, 2, 2)).reshape(3, -1), np.random.default_rng(7).random((3, 89))], axis=1
)


def by_samples(function: Function) -> Function:
    """A function of which nothing is known besides its values."""

    def of(*arguments: Any) -> Any:
        if not any(isinstance(argument, Enclosure) for argument in arguments):
            return function(*arguments)
        sampled = np.broadcast_arrays(*(Enclosure.of(a).values for a in arguments))
        values = function(*sampled)
        if isinstance(values, tuple):
            return tuple(Enclosure.of_samples(np.real(each)) for each in values)
        return Enclosure.of_samples(np.real(values))

    return of


def of_scale_one(function: Function) -> Function:
    """A function of scale one that may be singular at integers: its range is told by samples."""

    def of(*arguments: Any) -> Any:
        if not any(isinstance(argument, Enclosure) for argument in arguments):
            return function(*arguments)
        enclosures = [Enclosure.of(argument) for argument in arguments]
        sampled = function(*np.broadcast_arrays(*(each.values for each in enclosures)))
        if not isinstance(sampled, tuple):
            return _over_ranges(function, enclosures, sampled)
        return tuple(
            _over_ranges(lambda *a, k=k: function(*a)[k], enclosures, values)
            for k, values in enumerate(sampled)
        )

    return of


def _over_ranges(function: Function, arguments: Sequence[Enclosure], sampled: Array) -> Enclosure:
    """In doubt by its range where an argument varies by more than its scale, or is in doubt."""
    values = np.real(sampled)
    varying = [each for each in arguments if each.values.ndim > 1]
    clear = all(each.doubt is None and _of_one_scale(*each.hull()).all() for each in varying)
    if values.ndim < 2:
        return Enclosure.of_samples(values)
    poles = _poles(function, arguments)
    if clear and not poles.any():
        return Enclosure.of_samples(values)
    shares = iter(_SHARES[: len(varying)] if len(varying) > 1 else [np.linspace(0.0, 1.0, 49)])
    inside = [
        each.values if each.values.ndim < 2 else _inside_range(*each.range(), next(shares))
        for each in arguments
    ]
    beside = np.real(function(*np.broadcast_arrays(*inside)))
    low, high = without_nan(*around(np.concatenate([values, beside]), BETWEEN))
    low, high = np.where(poles, -np.inf, low), np.where(poles, np.inf, high)
    in_doubt = np.where(poles, 1.0, 0.0)
    for each in varying:
        below, above = each.range()
        in_doubt = np.where(_of_one_scale(below, above), in_doubt, 1.0)
        if each.doubt is not None:
            in_doubt = np.maximum(in_doubt, share_in_doubt(each.doubt, below, above))
    return Enclosure(values, (low, high), times(width_of(low, high), in_doubt))


def _poles(function: Function, arguments: Sequence[Enclosure]) -> NDArray[np.bool_]:
    """Whether a function is infinite, or no number, at an integer in the range of an argument.

    There are the poles of gamma, digamma and zeta functions, of elliptic and of hypergeometric
    ones. A range within one scale holds three integers at most.
    """
    middles = [each.values[_MIDDLE] if each.values.ndim > 1 else each.values for each in arguments]
    poles = np.zeros(1, dtype=bool)
    for k, each in enumerate(arguments):
        if each.values.ndim < 2:
            continue
        low, high = each.hull()
        integers = np.stack([np.ceil(low), np.rint(0.5 * (low + high)), np.floor(high)])
        places = [*middles[:k], np.clip(integers, low, high), *middles[k + 1 :]]
        poles = poles | ~np.isfinite(function(*np.broadcast_arrays(*places))).all(axis=0)
    return poles


def _of_one_scale(low: Array, high: Array) -> NDArray[np.bool_]:
    return np.asarray(within(1.0)(low, high) & away_from(0.0)(low, high))


def _inside_range(low: Array, high: Array, shares: Array) -> Array:
    """Places at shares (M,) of ranges, evenly spaced near zero and by their logarithms afar."""
    begin, end = (np.arcsinh(10.0 * np.clip(each, -1e100, 1e100)) for each in (low, high))
    places = np.sinh(begin + (end - begin) * shares[:, None]) / 10.0
    return np.asarray(np.clip(places, low, high))
