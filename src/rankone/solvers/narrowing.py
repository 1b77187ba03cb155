"""Which parameters to narrow, and to what, where a solve did not converge.

The modes of an analytic function fall geometrically, and on a part of an interval as far with
about that part of the nodes (Trefethen, Approximation Theory and Approximation Practice, 2013,
chapter 8). So the modes of the best attempt, and its measured error, tell how many nodes a
parameter needs, and on what part of its interval the nodes of the attempt suffice.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rankone.discretization import Basis1D, first_scale
from rankone.discretization.scales import Logarithm
from rankone.ir.measures import Interval, on_scale
from rankone.ir.verdict import NarrowBox
from rankone.support.arrays import Array
from rankone.tensors.slab import SlabTrain, sharing
from rankone.tensors.train import Train

_AIMED_SHARE = 0.3  # Error aimed at, over the tolerance
_SAFETY = 0.7  # Factor on a part of an interval: predictions are of one parameter at a time
_LEAST_SHARE = 0.03  # Parts below this share are not predicted: too far from what was measured
_LARGEST_SHARE = 0.8  # Largest part, before the safety, where the work of an attempt was small
_SHRINKAGE = 0.9  # Factor on the part of the costliest parameter, until the work is affordable
# Work of one attempt over the budget: a reference comes before it, and a second attempt takes twice
# as much
_AFFORDABLE_SHARE = 0.24
_SLOWEST_DECAY = 0.97  # Largest ratio of successive modes: slower decay looks like none
_FASTEST_DECAY = 0.1  # Smallest one: rounding errors hide faster decay
_RANK_SHARE = 0.5  # Ranks over the largest possible ones for the nodes on either side
_ELEMENT_GROWTH = 2.0  # Factor on the nodes of elements whose modes have not fallen
_DIGITS = 2  # Significant digits of the ends that are told


@dataclass(frozen=True)
class Resolution:
    """The nodes of one parameter: those of an attempt, and those that are needed on all of it."""

    basis: Basis1D
    needed: float
    smooth: float

    @classmethod
    def of(cls, basis: Basis1D, spectrum: Array, rtol: float) -> Resolution:
        """From the sizes of the modes, in units of the states."""
        smooth = min(4.0 - 1.4 * math.log10(rtol), basis.size)
        excess = math.log(max(basis.tail(spectrum), 1e-300) / (_AIMED_SHARE * rtol))
        if excess <= 0.0:
            return cls(basis, float(basis.size), smooth)
        if basis.elements > 1:
            return cls(basis, _ELEMENT_GROWTH * basis.size, smooth)
        return cls(basis, basis.size - excess / math.log(_decay(spectrum)), smooth)

    @property
    def suffices(self) -> float:
        """The part of the interval on which the nodes of the attempt are enough."""
        if self.needed <= self.basis.size:
            return 1.0
        return max((self.basis.size - self.smooth) / (self.needed - self.smooth), 0.0)

    def nodes(self, share: float) -> float:
        """Nodes that are needed on a part of the interval."""
        return self.smooth + max(self.needed - self.smooth, 0.0) * share


def spectra_of(slabs: Sequence[SlabTrain], sizes: Array) -> list[Array]:
    """Sizes of the modes of each parameter, the largest of all slabs, in units of the states."""
    bases = slabs[-1].bases
    largest = [np.zeros(basis.size) for basis in bases]
    for run in sharing(slabs):
        if run[0].bases != bases:
            continue
        cores = [slab.cores[0] / sizes[: len(slab.cores[0]), None, None] for slab in run]
        first = np.concatenate([core.reshape(-1, core.shape[2]) for core in cores])
        norms = Train((first, *run[0].cores[1:])).right_orthonormal(0.0).mode_norms()
        largest = [np.maximum(a, b) for a, b in zip(largest, norms, strict=True)]
    return largest


def narrowed_box(
    names: Sequence[str],
    resolutions: Sequence[Resolution],
    work: float,
    budget: float,
) -> NarrowBox | None:
    """The parameters to narrow, and to what; None where nothing can be predicted.

    ``work`` is that of an attempt with the nodes of the ``resolutions``, and ``budget`` that of the
    solve, in operations.
    """
    shares = [1.0] * len(resolutions)
    unit = work / _samples([r.basis.size for r in resolutions])

    def further() -> list[float]:
        """Nodes beyond those of a smooth function."""
        return [r.nodes(share) - r.smooth for r, share in zip(resolutions, shares, strict=True)]

    def cost() -> float:
        nodes = [r.nodes(share) for r, share in zip(resolutions, shares, strict=True)]
        return unit * _samples(nodes)

    while cost() > _AFFORDABLE_SHARE * budget and min(shares) > _LEAST_SHARE:
        shares[further().index(max(further()))] *= _SHRINKAGE
    if min(shares) == 1.0:  # work was not what it lacked
        steepest = further().index(max(further()))
        shares[steepest] = min(resolutions[steepest].suffices, _LARGEST_SHARE)
    shares = [share if share == 1.0 else _SAFETY * share for share in shares]
    if min(shares) < _LEAST_SHARE:
        return None
    return NarrowBox(
        tuple(
            (name, *_part(resolution.basis, share))
            for name, resolution, share in zip(names, resolutions, shares, strict=True)
            if share < 1.0
        )
    )


def _decay(spectrum: Array) -> float:
    """Ratio of successive modes over the second half of a spectrum."""
    levels = np.maximum.accumulate(spectrum[::-1])[::-1]
    half = len(levels) // 2
    ratio = (levels[-1] / max(levels[half], 1e-300)) ** (1.0 / max(len(levels) - 1 - half, 1))
    return float(min(max(ratio, _FASTEST_DECAY), _SLOWEST_DECAY))


def _samples(nodes: Sequence[float]) -> float:
    """About how many trajectories a cross interpolation takes: rank by nodes by rank."""
    logarithms = np.concatenate([[0.0], np.cumsum(np.log(nodes))])
    smaller = np.minimum(logarithms, logarithms[-1] - logarithms)
    ranks = np.maximum(_RANK_SHARE * np.exp(smaller), 1.0)
    return float(np.sum(ranks[:-1] * np.array(nodes) * ranks[1:]))


def _part(basis: Basis1D, share: float) -> Interval:
    """The middle part of an interval with ends of few digits, in the logarithm over decades."""
    ends = float(basis.lower), float(basis.upper)
    scale = first_scale(*ends)
    if not basis.scale.is_identity and Logarithm().allows(*ends):
        scale = Logarithm()
    lower, upper = on_scale(scale, ends, 0.5 + np.array([-0.5, 0.5]) * share).tolist()
    lengths = (upper - lower,) * 2 if scale.is_identity else (lower, upper)
    lower, upper = (
        round(end, _DIGITS - 1 - math.floor(math.log10(abs(length))))
        for end, length in zip((lower, upper), lengths, strict=True)
    )
    return max(lower, ends[0]), min(upper, ends[1])
