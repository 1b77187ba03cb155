"""How far lifted states leave what they stand for, along a solve."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rankone.ir.domain import Domain
from rankone.ir.system import System
from rankone.tensors.slab import SlabTrain
from rankone.verification.reference import check_points, times_within

__all__ = ["drift"]

_POINTS = 24
_SHARES = np.array([0.0, 0.31, 0.69, 1.0])
"""Times that are looked at, in slab lengths."""


def drift(system: System, domain: Domain, slabs: Sequence[SlabTrain]) -> float:
    """Largest difference between lifted states and what they stand for, relative to their sizes.

    ``s`` for ``sin(x)`` and ``c`` for ``cos(x)`` are on the circle as long as both stay sine and
    cosine of the ``x`` that is found with them.
    """
    points = check_points(domain.bounds, _POINTS).T
    count = system.n_lifted
    size, worst = np.zeros(count), np.zeros(count)
    for slab in slabs:
        times = times_within(slab.start, slab.end, _SHARES)
        values = slab.on_grid(times, slab.over_parameters(points))
        lifted, wanted = values[-count:], system.meanings(times, values, points[:, :, None])
        size = np.maximum(size, np.abs(lifted).max(axis=(1, 2)))
        worst = np.maximum(worst, np.abs(lifted - wanted).max(axis=(1, 2)))
    return float(np.nan_to_num(worst / np.where(size > 0.0, size, 1.0), nan=np.inf).max())
