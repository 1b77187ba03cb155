"""Two-site alternating sweeps for the fixed point U = E U_s + S (f(U) - A U) on one slab.

The unknown is one tensor train over [(state, time)] | p_1 | ... | p_d. All cores but one (the
centre) are orthonormal; the orthonormal cores to the left and right of a pair of neighbours form a
frame. One step contracts the right-hand side with that frame, which gives a new value for the
pair, and splits it by a truncated SVD: the rank adapts itself (this is the enrichment).

A contraction is stored per *key* (degree, remaining factor rows): ``left[b][key]`` collects all
terms that agree from parameter b on, ``right[b][key]`` holds the parameters b, ..., d.
Bond b lies between core b - 1 and core b; core 0 is (state, time), core j is parameter j.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from rankone.solvers.engines.engine_options import GROUP_COST, TRAIN
from rankone.solvers.engines.train_operators import (
    CONSTANT,
    LINEAR,
    QUADRATIC,
    GroupKernels,
    Key,
    ParameterOperators,
    SlabOperator,
)
from rankone.support.arrays import COARSE, Array
from rankone.support.budget import charge, memory_left, reserve
from rankone.support.costs import CALL, product
from rankone.tensors.train import Train, independent, truncated_svd

_COPIES = 1.5  # Numbers of a contraction while it is made, over those of its products


@lru_cache(maxsize=512)
def _indices(rank: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Rows and columns of the packed pairs."""
    return np.triu_indices(rank)


@lru_cache(maxsize=512)
def multiplicity(rank: int) -> Array:
    """Copies of a packed pair in the full square: 1 on the diagonal, else 2."""
    i, j = _indices(rank)
    return np.where(i == j, 1.0, 2.0)


def unpack(packed: Array, rank: int) -> Array:
    """Symmetric squares (..., rank, rank) from packed pairs (..., rank (rank + 1) / 2)."""
    i, j = _indices(rank)
    full = np.empty((*packed.shape[:-1], rank, rank))
    full[..., i, j] = packed
    full[..., j, i] = packed
    return full


def _blocks(rank: int, work: float) -> list[tuple[int, int]]:
    """Blocks of rows for one matrix product; ``work`` counts the multiplications of a row."""
    step = -(-rank // TRAIN.block_count) if rank > 2 * TRAIN.block_count else rank
    step = max(min(step, int(TRAIN.block_multiplications / max(work, 1.0))), 1)
    return [(first, min(first + step, rank)) for first in range(0, rank, step)]


def right_products(env: Array, core: Array, vector: Array) -> Array:
    """Two trial cores (r, size, s) against a fully symmetric environment (s, s, s) on their right.

    With the diagonal operator ``vector`` (size,) of the parameter, (packed pairs of r, size * s):
    ``sum_ab vector[n] core[i, n, a] core[j, n, b] env[c, a, b]`` at (ij, (n, c)).
    """
    r, size, s = core.shape
    nodes = np.ascontiguousarray(core.transpose(1, 0, 2))
    weighted = nodes * vector[:, None, None]
    square = env.reshape(s, s * s)
    packed = np.empty((r * (r + 1) // 2, size, s))
    row = 0
    for first, last in _blocks(r, size * s**3):
        charge(product((last - first) * size, s, s * s))
        charge(size * product((last - first) * s, s, r - first))
        block = np.ascontiguousarray(weighted[:, first:last]).reshape(-1, s)
        once = (block @ square).reshape(size, (last - first) * s, s)
        twice = np.matmul(once, nodes[:, first:].swapaxes(1, 2))
        twice = twice.reshape(size, last - first, s, r - first)
        for i in range(last - first):
            count = r - first - i
            packed[row : row + count] = twice[:, i, :, i:].transpose(2, 0, 1)
            row += count
    return packed.reshape(-1, size * s)


def left_products(env: Array, core: Array, vector: Array) -> Array:
    """Two trial cores (r, size, s) against an environment (tests, r, r) on their left.

    It is symmetric in the trial indices. With the diagonal operator ``vector`` (size,) of the
    parameter, (tests * size, packed pairs of s): ``sum_ab vector[n] env[c, a, b] core[a, n, i]
    core[b, n, j]`` at ((c, n), ij), times the multiplicity of the pair.
    """
    tests = env.shape[0]
    r, size, s = core.shape
    nodes = np.ascontiguousarray(core.transpose(1, 0, 2))
    charge(product(tests * r, r, size * s))
    once = (env.reshape(tests * r, r) @ core.reshape(r, size * s)).reshape(tests, r, size, s)
    once = once * vector[:, None]
    packed = np.empty((s * (s + 1) // 2, tests, size))
    row = 0
    for first, last in _blocks(s, size * tests * r**2):
        width = last - first
        charge(size * product(tests * width, r, s - first))
        rows = np.ascontiguousarray(once[..., first:last].transpose(2, 0, 3, 1))
        twice = np.matmul(rows.reshape(size, tests * width, r), nodes[:, :, first:])
        twice = twice.reshape(size, tests, width, s - first)
        for i in range(width):
            count = s - first - i
            packed[row : row + count] = twice[:, :, i, i:].transpose(2, 1, 0)
            row += count
    packed *= multiplicity(s)[:, None, None]
    return np.ascontiguousarray(packed.reshape(row, tests * size).T)


@dataclass
class Sweeper:
    """The state of the sweeps on one slab.

    Core 0 (n, K, r_1) is the centre, the cores j >= 1 (r_j, n_j, r_{j+1}) are right-orthonormal.
    The train ``source`` is U_s at the start of the slab, with core 0 (n_differential, r). Splits
    keep ranks up to ``max_rank``.
    """

    operator: SlabOperator
    groups: tuple[GroupKernels, ...]
    parameters: ParameterOperators
    cores: list[Array]
    source: Train
    max_rank: int

    def __post_init__(self) -> None:
        d = self.dimensions = len(self.cores) - 1
        self._keys: list[list[Key]] = [[] for _ in range(d + 2)]
        for b in range(1, d + 2):
            keys = [(g.degree, g.signature[b - 1 :]) for g in self.groups]
            self._keys[b] = list(dict.fromkeys([*keys, (LINEAR, (0,) * (d + 1 - b))]))
        # a linear key without an entry stands for the identity
        self._right: list[dict[Key, Array]] = [{} for _ in range(d + 2)]
        self._left: list[dict[Key, Array]] = [{} for _ in range(d + 2)]
        self._right_halves: list[dict[Key, Array]] = [{} for _ in range(d + 2)]
        self._left_halves: list[dict[Key, Array]] = [{} for _ in range(d + 2)]
        self._source_right: list[Array] = [np.ones((1, 1)) for _ in range(d + 2)]
        self._source_left: list[Array] = [np.ones((1, 1)) for _ in range(d + 2)]
        for key in self._keys[d + 1]:
            if key[0] != LINEAR:
                self._right[d + 1][key] = np.ones((1,) * (key[0] + 1))
        self.initial = self.operator.initial(self.source.first)
        for b in range(d, 0, -1):
            self._contract_right(b)

    @property
    def train(self) -> Train:
        """The present cores."""
        return Train(tuple(self.cores))

    @property
    def ranks(self) -> tuple[int, ...]:
        return tuple(core.shape[0] for core in self.cores[1:])

    @property
    def memory(self) -> float:
        """Estimated bytes that the contractions need."""
        total = 0.0
        ranks, bases = (*self.ranks, 1), self.parameters.bases
        for left, basis, right in zip(ranks[:-1], bases, ranks[1:], strict=True):
            total += basis.size * (left * left * right + left * right * right) + left**3
        n, count = self.operator.shape
        first = bases[0].size * count * n * ranks[1] ** 2 if bases else 0.0
        return 8 * (2.0 * total + 2.0 * first)

    def _reserve(self, numbers: float) -> None:
        """Raise an OutOfMemoryError if so many numbers do not fit beside the contractions."""
        if memory_left() < math.inf:
            kept = (self._left, self._right, self._left_halves, self._right_halves)
            held = sum(x.nbytes for by_bond in kept for by_key in by_bond for x in by_key.values())
            reserve(held + 8 * _COPIES * numbers)

    def source_in_frame(self) -> Array:
        """Scaled states at the start of the slab in the present frame, (n_differential, r_1)."""
        return self.source.first @ self._source_right[1]

    # -- the first core alone: cheap fixed-point steps in a frozen parameter frame ---------------

    def settle(self, tolerance: float, steps: int) -> float:
        """Iterate the first core in the present frame; return the last change."""
        change = np.inf
        for _ in range(steps):
            with np.errstate(over="ignore", invalid="ignore"):
                core = self._first_block(self.cores[0], 1)
            previous, change = change, float(np.linalg.norm(core - self.cores[0]))
            self.cores[0] = core
            if change <= tolerance or not np.isfinite(change) or change > 2.0 * previous:
                break
        return change

    def _first_block(self, x: Array, bond: int) -> Array:
        """Right-hand side of the fixed point on core 0 (bond 1) or on cores 0 and 1 (bond 2).

        ``x`` is (n, K, r_1), or (n, K, n_1, r_2).
        """
        n, count = self.operator.shape
        repeat = 1 if bond == 1 else x.shape[2]
        flat = x.reshape(n, count * repeat, -1)
        rank = flat.shape[2]
        charge(self._cost_of_first(count * repeat, x.shape[-1]))
        phi = self.operator.tiled(repeat)
        total = self.operator.minus_jacobian(flat)
        for group in self.groups:
            right, key = self._right[bond], (group.degree, group.signature[bond - 1 :])
            if group.degree == CONSTANT:
                y = self.operator.constant(group, phi)[:, :, None] * right[key]
            elif group.degree == LINEAR:
                y = self.operator.linear(group, phi, flat)
                if key in right:
                    y = (y.reshape(-1, rank) @ right[key]).reshape(n, -1, rank)
            else:
                self._reserve(len(group.paired) * flat.shape[1] * rank * (rank + 2.0))
                y = self.operator.quadratic(group, phi, flat, right[key])
            if bond == 2:
                vector = self.parameters.vector(group.key, 0)
                y = (y.reshape(n, count, repeat, rank) * vector[:, None]).reshape(n, -1, rank)
            total += y
        total = self.operator.solve(total)
        if bond == 1:
            start = self.initial @ self._source_right[1]
        else:
            start = self.initial.reshape(n * count, -1) @ self._source_right_half(1)
        return np.asarray(total.reshape(x.shape) + start.reshape(x.shape))

    def _cost_of_first(self, points: int, rank: int) -> float:
        """Operations of the right-hand side on the first core, at points of time and parameter."""
        n, count = self.operator.shape
        size = n * points * rank
        total = self.operator.inverse.cost(points // count * rank)
        total += GROUP_COST.once + 4.0 * size
        for group in self.groups:
            total += GROUP_COST(size) + product(n * points, rank, rank)
            if group.degree == QUADRATIC:
                total += product(len(group.paired) * points, rank, rank * rank)
                total += 0.5 * len(group.paired) * points * rank * rank
        return total

    # -- contractions from the right: parameters b, ..., d --------------------------------------

    def _contract_right(self, b: int) -> None:
        """``right[b]`` from ``right[b + 1]`` and the orthonormal core b."""
        r = self.cores[b].shape[0]
        flat = self.cores[b].reshape(r, -1)
        self._right[b] = {}
        for key in self._keys[b]:
            degree, rows = key
            if degree == LINEAR and rows[0] == 0 and (degree, rows[1:]) not in self._right[b + 1]:
                continue
            half = self._right_half(b, key)
            charge(5 * CALL + product(len(half), half.shape[1], r))
            env = half @ flat.T
            if degree == CONSTANT:
                env = env[0]
            elif degree == QUADRATIC:
                env = unpack(env.T, r)
            self._right[b][key] = env
        self._source_right[b] = self._source_right_half(b) @ flat.T
        if b > 1:
            self._right_halves[b - 1] = {}

    def _right_half(self, b: int, key: Key) -> Array:
        """``right[b + 1]`` extended by the trial core b: (trial, size * right rank).

        The trial index is 1, r, or the packed pairs of r.
        """
        cached = self._right_halves[b].get(key)
        if cached is not None:
            return cached
        degree, rows = key
        core = self.cores[b]
        r, size, s = core.shape
        right, next_key = self._right[b + 1], (degree, rows[1:])
        vector = self.parameters.vector(key, b - 1)
        if degree == CONSTANT:
            half: Array = np.outer(vector, right[next_key])
        elif degree == LINEAR:
            half = core
            if next_key in right:
                half = (core.reshape(-1, s) @ right[next_key]).reshape(r, size, s)
            half = half if rows[0] == 0 else half * vector[:, None]
        else:
            self._reserve(size * (r * s * s + r * (r + 1) * s))
            half = right_products(right[next_key], core, vector)
        half = half.reshape(-1, size * s)
        self._right_halves[b][key] = half
        return half

    def _source_right_half(self, b: int) -> Array:
        """Overlap of the source train with the frame, extended by the source core b."""
        core = self.source.cores[b]
        flat = core.reshape(-1, core.shape[2]) @ self._source_right[b + 1]
        return flat.reshape(core.shape[0], -1)

    # -- contractions from the left: (state, time) and the parameters 1, ..., b - 1 --------------

    def _left_half(self, b: int) -> dict[Key, Array]:
        """``left[b]`` extended by the trial core b, by the keys of bond b + 1.

        Each is (left rank * size, trial): the trial index is 1, s, or the packed pairs of s.
        """
        halves = self._left_halves[b]
        if halves:
            return halves
        core = self.cores[b]
        for key, env in self._left[b].items():
            degree, rows = key
            vector = self.parameters.vector(key, b - 1)
            size, s = core.shape[1:]
            if degree == CONSTANT:
                half = np.outer(env, vector).reshape(-1, 1)
            elif degree == LINEAR:
                half = env @ core.reshape(core.shape[0], -1)
                if rows[0] != 0:
                    half = half.reshape(-1, size, s) * vector[:, None]
                half = half.reshape(-1, s)
            else:
                self._reserve(len(env) * size * (len(core) * s + s * (s + 1)))
                half = left_products(env, core, vector)
            remaining = (degree, rows[1:])
            halves[remaining] = halves[remaining] + half if remaining in halves else half
        return halves

    def _contract_left(self, b: int) -> None:
        """``left[b]`` from ``left[b - 1]`` and the left-orthonormal core b - 1."""
        core = self.cores[b - 1]
        self._left[b] = {}
        self._left_halves[b] = {}
        if b == 1:
            charge(self._cost_of_first(core.shape[1], core.shape[2]))
            weighted = self.operator.adjoint(core)
            for group in self.groups:
                self._left[1][group.key] = self.operator.left(group, weighted, core)
            trivial = (LINEAR, (0,) * self.dimensions)
            jacobian = self.operator.left_minus_jacobian(weighted, core)
            self._left[1][trivial] = self._left[1].get(trivial, 0.0) + jacobian
            self._source_left[1] = np.tensordot(core, self.initial, axes=([0, 1], [0, 1]))
            return
        s = core.shape[2]
        flat = core.reshape(-1, s)
        for key, half in self._left_half(b - 1).items():
            charge(5 * CALL + product(s, flat.shape[0], half.size / flat.shape[0]))
            env = flat.T @ half.reshape(flat.shape[0], -1)
            if key[0] == CONSTANT:
                env = env[:, 0]
            elif key[0] == QUADRATIC:
                env = unpack(env / multiplicity(s), s)
            self._left[b][key] = env
        self._source_left[b] = flat.T @ self._source_left_half(b - 1)

    def _source_left_half(self, b: int) -> Array:
        core = self.source.cores[b]
        half = self._source_left[b] @ core.reshape(core.shape[0], -1)
        return half.reshape(-1, core.shape[2])

    # -- pairs ----------------------------------------------------------------------------------

    def _pair_block(self, b: int) -> tuple[Array, Array]:
        """New and present value of the cores (b, b + 1) as matrices (left * size, size * right)."""
        core, neighbour = self.cores[b], self.cores[b + 1]
        width = neighbour.shape[1] * neighbour.shape[2]
        if b == 0:
            n, count, r = core.shape
            present = core.reshape(n * count, r) @ neighbour.reshape(r, width)
            block = present.reshape(n, count, *neighbour.shape[1:])
            return self._first_block(block, 2).reshape(n * count, width), present
        r, size, s = core.shape
        present = core.reshape(r * size, s) @ neighbour.reshape(s, width)
        block = self._source_left_half(b) @ self._source_right_half(b + 1)
        for key, half in self._left_half(b).items():
            other_half = self._right_half(b + 1, key)
            charge(5 * CALL + product(len(half), half.shape[1], other_half.shape[1]))
            block += half @ other_half
        return block, present

    def iterate(self, tolerance: float) -> tuple[float, list[Array]]:
        """One sweep; the centre starts and ends at core 0.

        On the way right the cores are only orthogonalised; on the way left every pair is solved.
        Solving pairs in both directions converges no faster per unit of work.

        Returns the residual (largest change of a pair) and, for each parameter, the norms of its
        modes, shape (nodes,). The residual is infinite where the iteration overflowed.
        """
        largest = 0.0
        spectra = [np.zeros(0)] * self.dimensions
        for b in range(self.dimensions - 1):
            self._shift_right(b, COARSE * tolerance)
            self._contract_left(b + 1)
        for b in range(self.dimensions - 1, -1, -1):
            with np.errstate(over="ignore", invalid="ignore"):
                block, present = self._pair_block(b)
                change = float(np.linalg.norm(block - present))
            if not np.isfinite(change):
                return np.inf, spectra
            largest = max(largest, change)
            spectra[b] = self._split(b, block, tolerance)
            self._contract_right(b + 1)
        return largest, spectra

    def _shift_right(self, b: int, negligible: float) -> None:
        """Move the centre from core b to core b + 1 with no more than a negligible change."""
        core, neighbour = self.cores[b], self.cores[b + 1]
        q, r = independent(core.reshape(-1, core.shape[-1]), negligible)
        self.cores[b] = q.reshape(*core.shape[:-1], q.shape[1])
        self.cores[b + 1] = (r @ neighbour.reshape(neighbour.shape[0], -1)).reshape(
            q.shape[1], *neighbour.shape[1:]
        )
        self._changed(b)

    def _split(self, b: int, block: Array, tolerance: float) -> Array:
        """Replace the cores (b, b + 1) by truncated factors of ``block``; the centre moves to b.

        Returns the norms of the parameter modes of core b + 1, weighted.
        """
        shape = self.cores[b + 1].shape
        expected = self.cores[b + 1].reshape(shape[0], -1)
        left, weights, right = truncated_svd(block, tolerance, self.max_rank, expected)
        rank = weights.size
        weighted = (weights[:, None] * right).reshape(rank, *shape[1:])
        modes = np.matmul(self.parameters.bases[b].to_modal, weighted)
        self.cores[b] = (left * weights).reshape(*self.cores[b].shape[:-1], rank)
        self.cores[b + 1] = right.reshape(rank, *shape[1:])
        self._changed(b)
        return np.asarray(np.sqrt(np.einsum("anb,anb->n", modes, modes)))

    def _changed(self, b: int) -> None:
        """Drop the contractions with the cores b and b + 1."""
        for halves in (self._left_halves, self._right_halves):
            halves[b] = {}
            halves[b + 1] = {}
