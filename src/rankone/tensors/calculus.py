"""Smaller solutions and derivatives: exact operations on the trains of slabs.

Slabs that share the cores of their parameters go on sharing them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from rankone.discretization import Basis1D
from rankone.support.arrays import Array
from rankone.tensors.slab import SlabTrain

__all__ = ["at_one_time", "differentiated", "fixed", "restricted"]

_Made = tuple[Array, Basis1D]


def at_one_time(slabs: Sequence[SlabTrain], time: float, horizon: tuple[float, float]) -> SlabTrain:
    """The states at one time as constants over a horizon."""
    starts = np.array([slab.start for slab in slabs[1:]])
    slab = slabs[int(starts.searchsorted(time, side="right"))]
    first = slab.in_time(np.array([time]))
    start, end = horizon
    return SlabTrain(start, end, (first, *slab.cores[1:]), slab.bases)


def differentiated(slabs: Sequence[SlabTrain], parameter: int) -> tuple[SlabTrain, ...]:
    """The derivatives of the states with respect to one parameter, by its position."""

    def change(core: Array, basis: Basis1D) -> _Made:
        return np.matmul(basis.derivative, core), basis

    return _changed(slabs, parameter, change)


def restricted(
    slabs: Sequence[SlabTrain], parameter: int, interval: tuple[float, float]
) -> tuple[SlabTrain, ...]:
    """The states for a smaller interval of one parameter."""

    def change(core: Array, basis: Basis1D) -> _Made:
        smaller = basis.restricted(*interval)
        at_nodes = np.sqrt(smaller.weights)[:, None] * basis.modal_values(smaller.nodes)
        return np.matmul(smaller.to_modal @ at_nodes, core), smaller

    return _changed(slabs, parameter, change)


def fixed(slabs: Sequence[SlabTrain], parameter: int, value: float) -> tuple[SlabTrain, ...]:
    """The states for one value of a parameter, which is no coordinate any more."""
    known: dict[tuple[int, int], Array] = {}
    made = []
    for slab in slabs:
        before, core = slab.cores[parameter], slab.cores[parameter + 1]
        key = id(before), id(core)
        if key not in known:
            modes = slab.bases[parameter].modal_values(np.array([value]))[0]
            known[key] = before @ np.einsum("rms,m->rs", core, modes)
        cores = (*slab.cores[:parameter], known[key], *slab.cores[parameter + 2 :])
        bases = (*slab.bases[:parameter], *slab.bases[parameter + 1 :])
        made.append(replace(slab, cores=cores, bases=bases))
    return tuple(made)


def _changed(
    slabs: Sequence[SlabTrain], parameter: int, change: Callable[[Array, Basis1D], _Made]
) -> tuple[SlabTrain, ...]:
    """Slabs with another core and basis of one parameter."""
    known: dict[tuple[int, Basis1D], _Made] = {}
    made = []
    for slab in slabs:
        core, basis = slab.cores[parameter + 1], slab.bases[parameter]
        key = id(core), basis
        if key not in known:
            known[key] = change(core, basis)
        core, basis = known[key]
        cores = (*slab.cores[: parameter + 1], core, *slab.cores[parameter + 2 :])
        bases = (*slab.bases[:parameter], basis, *slab.bases[parameter + 1 :])
        made.append(replace(slab, cores=cores, bases=bases))
    return tuple(made)
