"""The box around the end of a search: few parameters that the data tell apart, and how wide it is.

All others are held where the search ended. The parameters that only observables and noise have stay
free, so that what is left of the Jacobian beside their columns says what the data tell of the rest.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import scipy.linalg

from rankone.calibration.conditioned import Interval
from rankone.calibration.cube import Cube
from rankone.calibration.likelihood import Evaluation
from rankone.calibration.uncertainty import covariance_of
from rankone.support.arrays import Array
from rankone.support.errors import OptionError

MOST_AROUND = 4
"""Most parameters of a box around the end of a search, unless they are named."""
_STANDARD_DEVIATIONS = 4.0  # Half the width of the box
_LARGEST_FACTOR = 3.0  # From the middle to an end, on logarithmic scales
_LARGEST_SHARE = 0.1  # The same in widths of the bounds, on linear ones
_LEAST_SHARE = 1e-4  # Least half width, in widths of the bounds
_INSENSITIVE = 1e-3  # Share of the largest sensitivity below which a parameter is left out


def box_around(
    cube: Cube,
    at: Evaluation,
    values: Mapping[str, float],
    active: Sequence[str],
    names: Sequence[str] | None = None,
) -> dict[str, Interval]:
    """Intervals around values, for some of the ``active`` parameters, or those of the names.

    The parameters are chosen by pivoted columns of the Jacobian: each adds most to those before
    (Golub & Van Loan, Matrix Computations, 5.4).
    """
    listed = [name for name in cube.names if name in active] if names is None else [*names]
    if not listed:
        raise OptionError("no estimated parameter is in a rate or an initial value")
    rest = _beside_others(cube, at, active)[:, [cube.names.index(name) for name in listed]]
    order, count = np.arange(len(listed)), len(listed)
    if names is None:
        _, r, order = scipy.linalg.qr(rest, mode="economic", pivoting=True)
        sizes = np.abs(np.diag(r))[:MOST_AROUND]
        count = max(int(np.sum(sizes > _INSENSITIVE * sizes[0])), 1)
    chosen = order[:count]
    spreads = np.sqrt(np.diag(covariance_of(rest[:, chosen])))
    deviations = dict(zip(chosen.tolist(), spreads.tolist(), strict=True))
    return {
        name: _interval(cube, name, values, deviations[j])
        for j, name in enumerate(listed)
        if j in deviations
    }


def _beside_others(cube: Cube, at: Evaluation, active: Sequence[str]) -> Array:
    """The Jacobian by z, without what parameters of observables and noise can do as well."""
    jacobian = at.jacobian * cube.width
    outer = [j for j, name in enumerate(cube.names) if name not in active]
    if not outer:
        return jacobian
    span = scipy.linalg.orth(jacobian[:, outer])
    return np.asarray(jacobian - span @ (span.T @ jacobian))


def _interval(cube: Cube, name: str, values: Mapping[str, float], deviation: float) -> Interval:
    """Some standard deviations (in z) to both sides, within the bounds."""
    j = cube.names.index(name)
    parameter, place = cube.parameters[j], cube.places(values)[j]
    largest = _LARGEST_SHARE
    if parameter.scale != "lin":
        largest = parameter.scaled(_LARGEST_FACTOR) / float(cube.width[j])
    half = min(max(_STANDARD_DEVIATIONS * deviation, _LEAST_SHARE), largest)
    ends = np.clip([place - half, place + half], 0.0, 1.0)
    own = Cube((parameter,), cube.lower[[j]], cube.upper[[j]])
    lower, upper = (own.named(np.array([end]))[name] for end in ends)
    return lower, upper
