"""Enrichment of one unknown: fixed point over the dimensions, normalisation, projection.

The discrete equation ``D(U) = G`` is solved in modes ``U = sum_i alpha_i (x)_j U_i^j`` that are
found one after the other. A new mode R solves, in each dimension j in turn,

    E R_j = sum_i (prod_{k!=j} R_k^T G_k^i) G_j^i
            - sum_i sum_{k<n} alpha_k (prod_{m!=j} R_m^T D_m^i U_k^m) D_j^i U_k^j,
    E = sum_i (prod_{k!=j} R_k^T D_k^i R_k) D_j^i,

until ``||(x)R^p - (x)R^{p-1}||`` is small. Then all amplitudes are found anew from ``B alpha = H``,
or the functions of one or all dimensions (block alternating least squares).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property, reduce

import numpy as np
import scipy.linalg
import scipy.sparse
import scipy.sparse.linalg

from rankone.solvers.engines.engine_options import GREEDY, STALLED_MODES, GreedyOptions
from rankone.solvers.engines.greedy_operators import Equation, RankOneSum
from rankone.support.arrays import ACCUMULATED, EPSILON, Array
from rankone.support.budget import charge
from rankone.support.costs import CALL, product


@dataclass(frozen=True, slots=True)
class ModeRecord:
    """One enrichment.

    ``differences`` holds the change of the mode in each pass of the fixed point, relative to the
    mode. Its norm ``amplitude`` when it was found and the ``residual`` ``||D(U) - G||`` after the
    projection or update are in units of the state's size. With ``projection="minimal-residual"``
    the residual is the norm over the box, otherwise it is tested with the shape functions.
    """

    differences: tuple[float, ...]
    amplitude: float
    residual: float


@dataclass(frozen=True)
class Enriched:
    """The result of the enrichment of one unknown, with a record for each new mode.

    Modes are values at the nodes, the largest first, with their norms ``amplitudes`` (R,) in the
    first dimension.
    """

    modes: RankOneSum
    amplitudes: Array
    residual: float
    records: tuple[ModeRecord, ...]


@dataclass
class Enrichment:
    """Modes of one unknown for one tested source G, ``loads``, beginning with the modes ``start``.

    With ``functional``, the squared norm of the source over the box, the residuals recorded are
    ``||D(U) - G||`` over the box. Records have ``units`` of residuals and of amplitudes; the
    tolerance of a run is in the first.
    """

    equation: Equation
    loads: RankOneSum
    options: GreedyOptions
    start: RankOneSum | None = None
    functional: float | None = None
    units: tuple[float, float] = (1.0, 1.0)

    def __post_init__(self) -> None:
        self._whitened = self.loads.applied(self.equation.whitening)
        self._random = np.random.default_rng(20140)
        self._dimensions = range(len(self.equation.sizes))
        start = self.start or RankOneSum.zero(self.equation.sizes)
        self.factors = list(start.factors)
        self.amplitudes = np.ones(start.rank)
        nothing = [np.zeros(0)] * len(self.factors)
        self._images, self._grams, self._load_products = [*nothing], [*nothing], [*nothing]
        for j in self._dimensions:
            self._normalise(j)

    @property
    def rank(self) -> int:
        return self.amplitudes.size

    @property
    def modes(self) -> RankOneSum:
        """The modes with their amplitudes."""
        return RankOneSum(tuple(self.factors)).scaled(self.amplitudes)

    def run(self, tolerance: float) -> Enriched:
        """Enrich until the residual is at most ``tolerance * unit``, or no longer falls."""
        records: list[ModeRecord] = []
        unit, amplitude_unit = self.units
        limit = tolerance * unit
        if self.rank:
            self._update()
            self._drop(0.02 * tolerance * amplitude_unit)
        residual = self.residual()
        best = residual, self.factors.copy(), self.amplitudes
        stalled, patience = 0, STALLED_MODES[self.options.update]
        while residual > limit and self.rank < self.options.max_modes and stalled < patience:
            mode, amplitude, differences = self._fixed_point()
            if mode is None:
                break
            self.amplitudes = np.append(self.amplitudes, amplitude)
            for j, r in enumerate(mode):
                self.factors[j] = np.concatenate([self.factors[j], r[:, None]], axis=1)
                self._refresh(j)
            self._update()
            residual = self.residual()
            shown = residual if self.functional is None else self.minimal_residual()
            records.append(ModeRecord(differences, amplitude / amplitude_unit, shown / unit))
            if residual < best[0]:
                stalled = 0 if residual < GREEDY.better_residual * best[0] else stalled + 1
                best = residual, self.factors.copy(), self.amplitudes
            else:
                stalled += 1
            if not math.isfinite(residual):
                break
        residual, self.factors, self.amplitudes = best
        order = np.argsort(-np.abs(self.amplitudes), kind="stable")
        modes = RankOneSum(tuple(factor[:, order] for factor in self.modes.factors))
        return Enriched(modes, np.abs(self.amplitudes[order]), residual, tuple(records))

    # --- a new mode ----------------------------------------------------------------------------

    def _fixed_point(self) -> tuple[list[Array] | None, float, tuple[float, ...]]:
        """A new mode: unit functions, amplitude, change in each pass; None if there is none."""
        equation = self.equation
        mode = [self._random.standard_normal(size) for size in equation.sizes]
        for j, (r, metric) in enumerate(zip(mode, equation.metrics, strict=True)):
            mode[j] = r / math.sqrt(float(r @ metric @ r))
        onto_loads = [self.loads.factors[k].T @ mode[k] for k in self._dimensions]
        onto_modes = [self._against_modes(k, mode[k]) for k in self._dimensions]
        energies = [self._energies(k, mode[k]) for k in self._dimensions]
        amplitude = 0.0
        differences: list[float] = []
        for _ in range(self.options.max_fixed_point):
            before, previous = mode.copy(), amplitude
            for j in self._dimensions:
                charge(self._cost_of_pass(j))
                right = self.loads.factors[j] @ _product(onto_loads, j)
                if self.rank:
                    weights = self.amplitudes * _product(onto_modes, j)
                    for i, u in enumerate(equation.index[j]):
                        right = right - self._images[j][u] @ weights[i]
                matrix = np.tensordot(
                    _collected(_product(energies, j), equation.index[j]), equation.matrices[j], 1
                )
                solved = _solve(matrix, right, equation.bandwidth[j])
                norm = math.sqrt(max(float(solved @ equation.metrics[j] @ solved), 0.0))
                if not math.isfinite(norm) or norm == 0.0:
                    return None, 0.0, tuple(differences)
                mode[j], amplitude = solved / norm, norm
                onto_loads[j] = self.loads.factors[j].T @ mode[j]
                onto_modes[j] = self._against_modes(j, mode[j])
                energies[j] = self._energies(j, mode[j])
            differences.append(self._difference(mode, amplitude, before, previous))
            if differences[-1] < self.options.fixed_point_tolerance:
                break
        return mode, amplitude, tuple(differences)

    def _cost_of_pass(self, j: int) -> float:
        """Operations of finding the function of a dimension for one mode."""
        count, size = self.equation.matrices[j].shape[:2]
        onto = 4.0 * self.loads.factors[j].size + 2.0 * count * size * self.rank
        return float(GREEDY.pass_operations + onto + 3.0 * count * size**2 + _solving(size))

    def _against_modes(self, j: int, r: Array) -> Array:
        """``r^T D_j^i U_k`` for all terms i and modes k, (terms, rank)."""
        if not self.rank:
            return np.zeros((self.equation.terms, 0))
        return (r @ self._images[j])[list(self.equation.index[j])]

    def _energies(self, j: int, r: Array) -> Array:
        """``r^T D_j^i r`` for all terms i."""
        return ((r @ self.equation.matrices[j]) @ r)[list(self.equation.index[j])]

    def _difference(
        self, mode: list[Array], amplitude: float, before: list[Array], previous: float
    ) -> float:
        """``||(x)R^p - (x)R^{p-1}||`` relative to the mode, without cancellation.

        The cosine of two unit functions is one minus half their squared distance.
        """
        logarithm = 0.0
        for function, earlier, metric in zip(mode, before, self.equation.metrics, strict=True):
            gap = function - earlier
            logarithm += math.log1p(-min(0.5 * float(gap @ metric @ gap), 1.0 - 4.0 * EPSILON))
        square = (amplitude - previous) ** 2 - 2.0 * amplitude * previous * math.expm1(logarithm)
        return math.sqrt(max(square, 0.0)) / amplitude

    # --- projection and updates ----------------------------------------------------------------

    def _update(self) -> None:
        """Amplitudes alone, or the functions of one or all dimensions anew."""
        update = self.options.update
        if update == "time":
            self._solve_dimension(0)
        if update == "all":
            for _ in range(self.options.update_sweeps if self.rank > 1 else 1):
                for j in self._dimensions:
                    self._solve_dimension(j)
        else:
            self.amplitudes = _solve(*self._projected())

    def _projected(self) -> tuple[Array, Array]:
        """B (R, R) and H (R,) of the projection step ``B alpha = H``."""
        right = np.prod(self._load_products, axis=0).sum(axis=0)
        return self._other_grams(None).sum(axis=0), right

    def _solve_dimension(self, j: int) -> None:
        """All functions of dimension j at once, those of the others fixed."""
        equation = self.equation
        count, size = equation.matrices[j].shape[:2]
        charge(GREEDY.pass_operations + self.rank**2 * 4.0 * equation.terms * len(self._grams))
        charge(_solving(size * self.rank if count > 1 else max(size, self.rank)))
        grams = _collected(self._other_grams(j), equation.index[j])
        right = self.loads.factors[j] @ _product(self._load_products, j)
        held = GREEDY.proximal_weight * float(np.abs(np.diagonal(grams[0])).max())
        grams[0] += held * np.eye(self.rank)
        right = right + held * (self.amplitudes * self._images[j][0])
        self.factors[j] = _solve_coupled(grams, equation.matrices[j], right, equation.bandwidth[j])
        self.amplitudes = np.ones(self.rank)
        self._normalise(j)

    def _other_grams(self, j: int | None) -> Array:
        """For each term the products of ``U_k^T D_k^i U_k`` over the dimensions but j."""
        grams = np.ones((self.equation.terms, self.rank, self.rank))
        for k in self._dimensions:
            if k != j:
                grams *= self._grams[k][list(self.equation.index[k])]
        return grams

    def _normalise(self, j: int) -> None:
        """Unit functions in dimension j; the norms go to the amplitudes."""
        factor = self.factors[j]
        norms = np.sqrt(np.maximum(np.sum(factor * (self.equation.metrics[j] @ factor), 0), 0.0))
        self.factors[j] = factor / np.where(norms > 0.0, norms, 1.0)
        self.amplitudes = self.amplitudes * norms
        self._refresh(j)

    def _refresh(self, j: int) -> None:
        """Form the products with the functions of dimension j again."""
        factor, count = self.factors[j], len(self.equation.matrices[j])
        charge(2.0 * count * product(len(factor), *factor.shape))
        self._images[j] = self.equation.matrices[j] @ factor
        self._grams[j] = factor.T @ self._images[j]
        self._load_products[j] = self.loads.factors[j].T @ factor

    def _drop(self, limit: float) -> None:
        """Leave out modes with amplitudes below ``limit``."""
        keep = np.abs(self.amplitudes) > limit
        if keep.all():
            return
        self.amplitudes = self.amplitudes[keep]
        for j in self._dimensions:
            self.factors[j] = self.factors[j][:, keep]
            self._refresh(j)

    # --- residuals -----------------------------------------------------------------------------

    def residual(self) -> float:
        """Norm of ``D(U) - G`` tested with the shape functions, in the dual of the metric."""
        image = self.equation.image(self.modes).applied(self.equation.whitening)
        return self._whitened.distance(image, self._load_square)

    @cached_property
    def _load_square(self) -> float:
        return self._whitened.inner(self._whitened)

    def minimal_residual(self) -> float:
        """``||D(U) - G||`` over the box, for the minimal residual projection."""
        assert self.functional is not None
        matrix, right = self._projected()
        square = self.functional - 2.0 * self.amplitudes @ right
        square += self.amplitudes @ matrix @ self.amplitudes
        return math.sqrt(max(float(square), 4.0 * EPSILON * self.functional))


def _solving(size: int) -> float:
    """Operations of a solve with a matrix of this size, full or with few bands."""
    dense = 0.05 * size**3 + size**2
    return 10.0 * CALL + (
        dense if size <= GREEDY.max_dense_size else GREEDY.sparse_operations * size
    )


def _product(arrays: list[Array], j: int) -> Array:
    """Product of all arrays but the j-th."""
    factors = arrays[:j] + arrays[j + 1 :]
    return reduce(np.multiply, factors) if factors else np.ones_like(arrays[j])


def _collected(weights: Array, index: tuple[int, ...]) -> Array:
    """Sum the weights of the terms that share a matrix: (matrices, ...)."""
    sums = np.zeros((max(index) + 1, *weights.shape[1:]))
    for weight, u in zip(weights, index, strict=True):
        sums[u] += weight
    return sums


def _solve(matrix: Array, right: Array, bandwidth: int | None = None) -> Array:
    """Solve a small system; singular ones in the least squares sense."""
    size = len(matrix)
    try:
        if bandwidth is not None and size > 24 * (bandwidth + 1):
            bands = np.zeros((2 * bandwidth + 1, size))
            for k in range(-bandwidth, bandwidth + 1):
                diagonal = np.diagonal(matrix, k)
                bands[bandwidth - k, max(k, 0) : max(k, 0) + diagonal.size] = diagonal
            return np.asarray(scipy.linalg.solve_banded((bandwidth, bandwidth), bands, right))
        return np.asarray(np.linalg.solve(matrix, right))
    except np.linalg.LinAlgError:
        if not (np.isfinite(matrix).all() and np.isfinite(right).all()):
            return np.full_like(right, np.inf)
        return np.asarray(np.linalg.lstsq(matrix, right, rcond=ACCUMULATED)[0])


def _solve_coupled(grams: Array, matrices: Array, right: Array, bandwidth: int) -> Array:
    """Solve ``sum_u A_u X Gamma_u^T = right`` for X (N, R)."""
    size, rank = right.shape
    if len(matrices) == 1:
        return _solve(grams[0], _solve(matrices[0], right, bandwidth).T).T
    if size * rank <= GREEDY.max_dense_size or 4 * bandwidth > size:
        total = sum(np.kron(a, g) for a, g in zip(matrices, grams, strict=True))
        return _solve(np.asarray(total), right.ravel()).reshape(size, rank)
    sparse = sum(
        scipy.sparse.kron(scipy.sparse.csc_array(a), g, format="csc")
        for a, g in zip(matrices, grams, strict=True)
    )
    return np.asarray(scipy.sparse.linalg.spsolve(sparse, right.ravel())).reshape(size, rank)
