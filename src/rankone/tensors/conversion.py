"""From sums of products of nodal functions to tensor trains that solutions evaluate."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rankone.discretization.finite_elements import LagrangeElements
from rankone.support.arrays import Array
from rankone.tensors.rank_one_sums import RankOneSum
from rankone.tensors.slab import SlabTrain
from rankone.tensors.train import right_orthonormal, truncated

__all__ = ["element_trains"]


def element_trains(
    bases: Sequence[LagrangeElements],
    start: Sequence[RankOneSum],
    modes: Sequence[RankOneSum],
    tolerance: Array,
) -> tuple[list[SlabTrain], Array]:
    """One train for each element in time, all states together.

    The products of all states form a train with diagonal cores. It is orthogonalised once for the
    slab; on one element in time the polynomials span few directions, and singular values below
    the tolerance are left out.

    Parameters
    ----------
    bases : sequence of LagrangeElements
        Time, then the parameters.
    start : sequence of RankOneSum
        For each state its value at the start, nodal in the parameters, with one row of time.
    modes : sequence of RankOneSum
        For each state what is added to it, nodal, without the first node in time.
    tolerance : ndarray (n,)
        Root mean square, for each state, of what may be left out on an element.

    Returns
    -------
    trains : list of SlabTrain
    tails : ndarray (n, 1 + d)
        For each state and dimension the root mean square of the two highest modes.
    """
    time, *parameters = bases
    sums = [
        RankOneSum((np.repeat(value.factors[0], time.size, axis=0), *value.factors[1:]))
        + RankOneSum((np.vstack([np.zeros((1, mode.rank)), mode.factors[0]]), *mode.factors[1:]))
        for value, mode in zip(start, modes, strict=True)
    ]
    if not any(total.rank for total in sums):
        sums[0] = RankOneSum(tuple(np.zeros((len(factor), 1)) for factor in sums[0].factors))
    n, rank = len(sums), sum(total.rank for total in sums)
    first = np.zeros((n, time.elements, time.order + 1, rank))
    begin = 0
    for state, total in enumerate(sums):
        first[state, :, :, begin : begin + total.rank] = time.to_modes(total.factors[0])
        begin += total.rank
    first /= tolerance[:, None, None, None]
    cores: list[Array] = [first.reshape(-1, rank)]
    for j, basis in enumerate(parameters, start=1):
        nodal = np.concatenate([total.factors[j] for total in sums], axis=1)
        coefficients = basis.to_modes(nodal).reshape(-1, rank) / np.sqrt(basis.elements)
        core = np.zeros((rank, len(coefficients), rank))
        index = np.arange(rank)
        core[index, :, index] = coefficients.T
        cores.append(core)
    if parameters:
        cores[-1] = cores[-1].sum(axis=2, keepdims=True)
        cores = right_orthonormal(truncated(right_orthonormal(cores), 1.0)[0])
    else:
        cores = [cores[0].sum(axis=1, keepdims=True)]
    first = cores[0].reshape(n, time.elements, time.order + 1, -1)
    tails = _tails(first, cores[1:], bases) * tolerance[:, None]
    trains = []
    for e in range(time.elements):
        local = first[:, e].reshape(n * (time.order + 1), -1)
        rest = cores[1:]
        if rest and local.shape[1] > len(local):
            # no more directions than coefficients in time: rotate them into the next core
            q, r = np.linalg.qr(local.T)
            local = r.T
            rest = [np.tensordot(q.T, rest[0], 1), *rest[1:]]
        block = local.reshape(n, time.order + 1, -1) * tolerance[:, None, None]
        lower = time.lower + e * time.width
        upper = time.upper if e == time.elements - 1 else time.lower + (e + 1) * time.width
        trains.append(
            SlabTrain(lower, upper, (block, *rest), tuple(basis.modes for basis in parameters))
        )
    return trains, tails


def _tails(first: Array, rest: Sequence[Array], bases: Sequence[LagrangeElements]) -> Array:
    """Norms of the two highest modes of each element, by state and dimension.

    ``first`` is (n, elements, order + 1, r) and the other cores are right-orthonormal.
    """
    n, elements = first.shape[:2]
    result = np.zeros((n, len(bases)))
    result[:, 0] = np.sqrt(np.sum(first[:, :, -2:] ** 2, axis=(1, 2, 3)) / elements)
    gram = np.einsum("nepr,neps->nrs", first, first, optimize=True) / elements
    for j, (core, basis) in enumerate(zip(rest, bases[1:], strict=True), start=1):
        split = core.reshape(len(core), basis.elements, basis.order + 1, -1)[:, :, -2:]
        flat = split.reshape(len(core), -1)
        result[:, j] = np.sqrt(np.maximum(np.einsum("nrs,rs->n", gram, flat @ flat.T), 0.0))
        gram = np.stack([_carried(g, core) for g in gram])
    return result


def _carried(gram: Array, core: Array) -> Array:
    """Gram matrix of the next bond, (s, s)."""
    r, size, s = core.shape
    half = (gram @ core.reshape(r, size * s)).reshape(r * size, s)
    return half.T @ core.reshape(r * size, s)
