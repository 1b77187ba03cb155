"""Newton's matrices of stacked implicit steps, dense or sparse, and their factors.

The order of the states is chosen once for the pattern. Where they can be numbered so that all
entries are close to the diagonal (Cuthill & McKee, Proc. 24th ACM National Conference, 1969), as
along a chain or a bar, LAPACK factors the band, of all matrices in one call; else SuperLU does
(Demmel et al., SIAM J. Matrix Anal. Appl. 20 (1999), 720).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import ClassVar, Protocol, TypeAlias

import numpy as np
import scipy.sparse
from numpy.typing import NDArray
from scipy.linalg import lapack
from scipy.sparse.csgraph import reverse_cuthill_mckee
from scipy.sparse.linalg import SuperLU, splu

from rankone.support import costs
from rankone.support.arrays import MANY_STATES, MINOR, Array
from rankone.support.budget import charge, reserve
from rankone.trajectories.integrators.integrator import finite_blocks, jacobians
from rankone.trajectories.system.system import PatternJacobian, System, pattern_of

Places: TypeAlias = NDArray[np.intp]
Solver: TypeAlias = Callable[[Array, Places], Array]
"""Solutions (c, n) of matrices at places (c,) for right-hand sides, in the order of elimination.

A place may come several times.
"""


@dataclass(frozen=True)
class _Elimination:
    """How Newton matrices are made and factored, and what that costs."""

    kept: int
    pivot_threshold: float
    band_factors: tuple[float, ...]
    band_solution: tuple[float, ...]
    most_filled: float
    least_stages: int
    few_stages: int
    most_stages: int
    tight: float
    step_matrices: float
    iterations: int
    cheap_iterations: float
    costly_iterations: float


_ELIMINATION = _Elimination(
    kept=8,  # Eliminations that are kept: as many as one session works with at a time
    pivot_threshold=MINOR,  # A diagonal entry above this share of its column is the pivot
    # Operations of factors and of a solution in bands: for each state, entry of the factors,
    # product
    band_factors=(35.0, 5.0, 0.1),
    band_solution=(25.0, 2.0, 0.0),
    most_filled=0.15,  # Share of the entries of a Jacobian above which it is taken for dense
    least_stages=3,
    few_stages=5,
    most_stages=7,
    tight=1e-5,  # Relative tolerance from which on least stages are enough
    step_matrices=4.0,  # Matrices of a step that are held at once, for each trajectory
    iterations=4,  # Of Newton, in a step
    # What new matrices cost, in Newton's iterations: made of cofactors, and by LAPACK or sparse
    # factors
    cheap_iterations=2.0,
    costly_iterations=10.0,
)
_ORDERS = ("MMD_AT_PLUS_A", "COLAMD")  # Orders of SuperLU that are tried


class Elimination(Protocol):
    """How matrices (n, n) of a pattern are stored and factored.

    Of the ``stored`` numbers of a matrix the entries of the pattern are at ``places`` (k,), those
    of the diagonal at ``diagonal`` (n,). ``columns`` are the states in the order of elimination.
    The costs are operations.
    """

    @property
    def stored(self) -> int: ...
    @property
    def places(self) -> Places: ...
    @property
    def diagonal(self) -> Places: ...
    @property
    def columns(self) -> Places: ...
    @property
    def factor_cost(self) -> float: ...
    @property
    def solution_cost(self) -> float: ...

    def factored(self, numbers: Array) -> Solver:
        """What solves with matrices of numbers (m, stored), which may be overwritten."""


@lru_cache(_ELIMINATION.kept)
def elimination_of(pattern: PatternJacobian) -> Elimination:
    """The cheapest way for matrices of a pattern with a diagonal."""
    band, sparse = BandElimination.of(pattern), SparseElimination.of(pattern)
    return band if band.factor_cost < sparse.factor_cost else sparse


@dataclass(frozen=True)
class BandElimination:
    """Matrices in bands, ``lower`` and ``upper`` entries beside the diagonal."""

    lower: int
    upper: int
    places: Places
    diagonal: Places
    columns: Places

    @staticmethod
    def of(pattern: PatternJacobian) -> BandElimination:
        """States in the order of Cuthill and McKee, or as they are if the band is no wider."""
        n, entries = pattern.size, np.ones(pattern.rows.size)
        graph = scipy.sparse.csr_array((entries, (pattern.rows, pattern.columns)), shape=(n, n))
        order = np.asarray(reverse_cuthill_mckee(graph + graph.T, symmetric_mode=True), np.intp)

        def width(rank: Places) -> int:
            return int(np.abs(rank[pattern.rows] - rank[pattern.columns]).max(initial=0))

        columns = min(np.arange(n), order, key=lambda some: width(np.argsort(some)))
        rank = np.argsort(columns)  # new places of the states
        rows, over = rank[pattern.rows], rank[pattern.columns]
        lower, upper = (max(int(d.max(initial=0)), 0) for d in (rows - over, over - rows))
        height = 2 * lower + upper + 1
        places = over * height + lower + upper + rows - over
        return BandElimination(
            lower, upper, places, rank * height + lower + upper, np.asarray(columns)
        )

    @property
    def _height(self) -> int:
        return 2 * self.lower + self.upper + 1

    @property
    def stored(self) -> int:
        return self._height * self.columns.size

    @property
    def factor_cost(self) -> float:
        return self._cost(*_ELIMINATION.band_factors)

    @property
    def solution_cost(self) -> float:
        return self._cost(*_ELIMINATION.band_solution)

    def _cost(self, state: float, entry: float, product: float) -> float:
        products = self.lower * (1 + self.lower + self.upper)
        return self.columns.size * (state + entry * self._height + product * products)

    def factored(self, numbers: Array) -> Solver:
        matrix = numbers.reshape(-1, self._height).T  # of all: they are blocks of one band
        kind = "z" if np.iscomplexobj(numbers) else "d"
        factor, solve = getattr(lapack, f"{kind}gbtrf"), getattr(lapack, f"{kind}gbtrs")
        factors, pivots, _ = factor(matrix, self.lower, self.upper, overwrite_ab=True)
        shape, every = (len(numbers), self.columns.size), np.arange(len(numbers))

        def solver(right: Array, some: Places) -> Array:
            if np.array_equal(some, every):
                solution, _ = solve(factors, self.lower, self.upper, right.ravel(), pivots)
                return np.asarray(solution.reshape(shape))
            turns = _turns(some)  # one right-hand side of each matrix is solved at a time
            whole = np.zeros((int(turns.max(initial=0)) + 1, *shape), dtype=right.dtype)
            whole[turns, some] = right
            together = whole.reshape(len(whole), -1).T
            solution, _ = solve(factors, self.lower, self.upper, together, pivots)
            return np.asarray(solution.T.reshape(whole.shape)[turns, some])

        return solver


@dataclass(frozen=True)
class SparseElimination:
    """Matrices in compressed columns; the factors have about ``filled`` entries."""

    indices: NDArray[np.intc]
    pointers: NDArray[np.intc]
    filled: int
    places: Places
    diagonal: Places
    columns: Places

    @staticmethod
    def of(pattern: PatternJacobian) -> SparseElimination:
        """The best order that SuperLU has for a matrix with a large diagonal."""
        n, off = pattern.size, pattern.rows != pattern.columns
        rows = np.concatenate([pattern.rows[off], np.arange(n)])
        columns = np.concatenate([pattern.columns[off], np.arange(n)])
        entries = np.concatenate([np.full(rows.size - n, -1.0), np.full(n, 2.0 * n)])
        matrix = scipy.sparse.csc_matrix((entries, (rows, columns)), (n, n))
        best = min((_factors(matrix, order) for order in _ORDERS), key=lambda f: int(f.nnz))
        rank = np.asarray(best.perm_c, dtype=np.intp)  # new places of the states
        numbered = scipy.sparse.csc_matrix(
            (np.arange(1.0, rows.size + 1.0), (rank[rows], rank[columns])), (n, n)
        )
        numbered.sort_indices()
        compressed = np.empty(rows.size, dtype=np.intp)
        compressed[numbered.data.astype(np.intp) - 1] = np.arange(rows.size)
        diagonal = compressed[rows.size - n :]
        places = np.empty(pattern.rows.size, dtype=np.intp)
        places[off] = compressed[: rows.size - n]
        places[~off] = diagonal[pattern.rows[~off]]
        return SparseElimination(
            numbered.indices, numbered.indptr, int(best.nnz), places, diagonal, np.argsort(rank)
        )

    @property
    def stored(self) -> int:
        return self.indices.size

    @property
    def factor_cost(self) -> float:
        return costs.SPARSE_FACTORS(self.filled)

    @property
    def solution_cost(self) -> float:
        return costs.SPARSE_SOLUTION(self.filled)

    def factored(self, numbers: Array) -> Solver:
        n = self.columns.size
        matrices = (
            scipy.sparse.csc_matrix((own, self.indices, self.pointers), (n, n)) for own in numbers
        )
        factors = [_factors(matrix, "NATURAL") for matrix in matrices]

        def solver(right: Array, some: Places) -> Array:
            pairs = zip(some.tolist(), right, strict=True)
            return np.stack([factors[k].solve(vector) for k, vector in pairs])

        return solver


def _turns(places: Places) -> Places:
    """How often each of the places came before: (c,)."""
    order = np.argsort(places, kind="stable")
    ascending = places[order]
    turns = np.empty_like(places)
    turns[order] = np.arange(places.size) - np.searchsorted(ascending, ascending)
    return turns


def _factors(matrix: scipy.sparse.csc_matrix, order: str) -> SuperLU:
    return splu(matrix, permc_spec=order, diag_pivot_thresh=_ELIMINATION.pivot_threshold)


# -----------------------------------------------------------------------------
# Newton's matrices of stacked implicit steps: dense inverses, or sparse factors of many states.
#
# Small matrices of a stack are inverted all at once. From some tens of states on each trajectory
# has sparse factors of its own.


COFACTOR_STATES = 3
"""States up to which inverses are made of cofactors."""
# Operations of a matrix times a vector: once, and for each entry
_PRODUCT_COST = costs.Cost(40, 0.5)


class NewtonMatrices(Protocol):
    """Inverses of matrices (n, n), one for each trajectory of a stack."""

    def solve(self, right: Array) -> Array:
        """Inverses times stacked vectors (n m,)."""

    def solve_some(self, columns: NDArray[np.intp], right: Array) -> Array:
        """Inverses of some trajectories times their vectors (n, c)."""


class PairedMatrices(Protocol):
    """Inverses of complex matrices (n, n), of one or several shifts, for each trajectory."""

    def solve(self, right: Array) -> Array:
        """Inverses times stacked vectors: for each shift the real and the imaginary part.

        They are rows (2 k, n m) of k shifts.
        """


class Jacobians(Protocol):
    """Jacobians (n, n) of m trajectories."""

    @property
    def iterations(self) -> float:
        """What Jacobians and Newton matrices cost, in Newton's iterations."""

    def newton(self, shift: complex) -> NewtonMatrices:
        """Inverses of ``shift`` minus the Jacobians; the budget is checked in between."""

    def paired(self, shifts: Sequence[complex]) -> PairedMatrices:
        """The same for several complex shifts."""


def jacobians_for(system: System, points: Array) -> Callable[[float, Array], Jacobians]:
    """What maps a time and a stacked state to the Jacobians at points (m, d).

    They are zero where they are not finite. The derivative of a root at zero is infinite, and
    Newton's corrections vanish however wrong the state is. Without a Jacobian they converge in
    short steps.
    """
    pattern = sparse_pattern(system)
    if pattern is None:
        of_blocks = SmallJacobians if system.n_differential <= COFACTOR_STATES else DenseJacobians
        return lambda t, y: of_blocks(finite_blocks(jacobians(system, points, t, y)))
    elimination = elimination_of(pattern)
    return lambda t, y: SparseJacobians(elimination, entries_at(system, pattern, points, t, y))


def sparse_pattern(system: System) -> PatternJacobian | None:
    """The pattern of the Jacobian where sparse factors pay, by the number of states and entries."""
    pattern, n = pattern_of(system.jacobian), system.n_differential
    if pattern is None or n < MANY_STATES or pattern.rows.size > _ELIMINATION.most_filled * n * n:
        return None
    return pattern


def stages_for(system: System, tolerance: float) -> int:
    """The stages of Radau: more at tight tolerances, most with sparse factors, which cost less.

    Up to three states a stage more costs little beside the calls of a step.
    """
    if tolerance >= _ELIMINATION.tight and system.n_differential > COFACTOR_STATES:
        return _ELIMINATION.least_stages
    return _ELIMINATION.few_stages if sparse_pattern(system) is None else _ELIMINATION.most_stages


def implicit_step_cost(system: System) -> float | None:
    """Operations of an implicit step of one trajectory; None where factors are not sparse."""
    pattern = sparse_pattern(system)
    if pattern is None:
        return None
    elimination = elimination_of(pattern)
    matrices = (_ELIMINATION.few_stages + 1) / 2
    return matrices * (
        elimination.factor_cost + _ELIMINATION.iterations * elimination.solution_cost
    )


def entries_at(
    system: System, pattern: PatternJacobian, points: Array, t: float, y: Array
) -> Array:
    """Entries (k, m) of the Jacobians at points (m, d) and states (n, m) or (n m,)."""
    m, n = len(points), system.n_differential
    charge(costs.function_cost(pattern.entries, system.user_functions)(m))
    entries = pattern.entries(t, y.reshape(n, m), points.T)
    entries = np.broadcast_to(entries, (pattern.rows.size, m))
    finite = np.isfinite(entries).all(axis=0)
    return entries if finite.all() else np.where(finite, entries, 0.0)


@dataclass(frozen=True)
class DenseJacobians:
    """All entries (m, n, n)."""

    blocks: Array
    iterations: ClassVar[float] = _ELIMINATION.costly_iterations

    def newton(self, shift: complex) -> NewtonMatrices:
        size = self.blocks.shape[-1]
        cost, diagonal = costs.inverse(size, isinstance(shift, float)), shift * np.eye(size)
        reserve(_ELIMINATION.step_matrices * self.blocks.size * np.dtype(type(shift)).itemsize)
        inverses = np.empty(self.blocks.shape, dtype=type(shift))
        first = 0
        for some in costs.in_pieces(self.blocks, cost):
            charge(cost * len(some))
            inverses[first : first + len(some)] = np.linalg.inv(diagonal - some)
            first += len(some)
        return Inverses(inverses)

    def paired(self, shifts: Sequence[complex]) -> PairedMatrices:
        return Pairs(tuple(map(self.newton, shifts)))


@dataclass(frozen=True)
class SmallJacobians:
    """All entries (m, n, n) of up to three states, whose inverses are made of cofactors."""

    blocks: Array
    iterations: ClassVar[float] = _ELIMINATION.cheap_iterations

    def newton(self, shift: complex) -> NewtonMatrices:
        return SmallInverses(self._inverses([shift])[:, :, 0])

    def paired(self, shifts: Sequence[complex]) -> PairedMatrices:
        inverses = self._inverses(shifts).transpose(2, 0, 1, 3)
        count, n, _, m = inverses.shape
        parts = np.empty((count, 2, n, 2, n, m))
        parts[:, 0, :, 0] = parts[:, 1, :, 1] = inverses.real
        parts[:, 1, :, 0] = inverses.imag
        np.negative(parts[:, 1, :, 0], out=parts[:, 0, :, 1])
        return SmallPairs(parts.reshape(count, 2 * n, 2 * n, m))

    def _inverses(self, shifts: Sequence[complex]) -> Array:
        """Inverses (n, n, k, m) for k shifts."""
        m, n, _ = self.blocks.shape
        charge(costs.inverse(n, isinstance(shifts[0], float)) * m * len(shifts))
        matrices = np.empty((n, n, len(shifts), m), dtype=type(shifts[0]))
        np.negative(self.blocks.transpose(1, 2, 0)[:, :, None], out=matrices)
        matrices.reshape(n * n, len(shifts), m)[:: n + 1] += np.array(shifts)[:, None]
        return by_cofactors(matrices.reshape(n, n, -1)).reshape(matrices.shape)


@dataclass(frozen=True)
class Inverses:
    """Dense inverses (m, n, n)."""

    inverses: Array

    def solve(self, right: Array) -> Array:
        m, n, _ = self.inverses.shape
        charge(5 * costs.CALL + m * _PRODUCT_COST(n * n))
        vectors = np.ascontiguousarray(right.reshape(n, m).T)  # BLAS takes no strided ones
        return np.asarray(np.matmul(self.inverses, vectors[:, :, None])[:, :, 0].T.ravel())

    def solve_some(self, columns: NDArray[np.intp], right: Array) -> Array:
        return np.asarray(np.matmul(self.inverses[columns], right.T[:, :, None])[:, :, 0].T)


@dataclass(frozen=True)
class SmallInverses:
    """Dense inverses (n, n, m) of so few states that arithmetic over all trajectories is faster."""

    inverses: Array

    def solve(self, right: Array) -> Array:
        n, _, m = self.inverses.shape
        charge(5 * costs.CALL + m * _PRODUCT_COST(n * n))
        return np.asarray(np.einsum("ijm,jm->im", self.inverses, right.reshape(n, m)).ravel())

    def solve_some(self, columns: NDArray[np.intp], right: Array) -> Array:
        return np.asarray((self.inverses[:, :, columns] * right).sum(axis=1))


@dataclass(frozen=True)
class SmallPairs:
    """The same of k complex shifts, as real matrices (k, 2 n, 2 n, m) of both parts."""

    inverses: Array

    def solve(self, right: Array) -> Array:
        count, n, _, m = self.inverses.shape
        charge(5 * costs.CALL + count * m * _PRODUCT_COST(n * n))
        parts = np.einsum("kijm,kjm->kim", self.inverses, right.reshape(count, n, m))
        return np.asarray(parts.reshape(right.shape))


@dataclass(frozen=True)
class Pairs:
    """Complex matrices of some shifts, which solve one after the other."""

    of_shifts: Sequence[NewtonMatrices]

    def solve(self, right: Array) -> Array:
        solution = np.empty(right.shape)
        for k, matrices in enumerate(self.of_shifts):
            paired = np.empty(right.shape[1], dtype=complex)
            paired.real, paired.imag = right[2 * k], right[2 * k + 1]
            paired = matrices.solve(paired)
            solution[2 * k], solution[2 * k + 1] = paired.real, paired.imag
        return solution


def by_cofactors(matrices: Array) -> Array:
    """Inverses of matrices (n, n, m) of up to three rows."""
    (n, _, m), size = matrices.shape, COFACTOR_STATES
    if n < size:
        wide = np.zeros((size, size, m), dtype=matrices.dtype)
        wide[:n, :n], wide[range(n, size), range(n, size)] = matrices, 1.0
        return by_cofactors(wide)[:n, :n]
    (a, b, c), (d, e, f), (g, h, i) = matrices
    cofactors = (
        (e * i - f * h, c * h - b * i, b * f - c * e),
        (f * g - d * i, a * i - c * g, c * d - a * f),
        (d * h - e * g, b * g - a * h, a * e - b * d),
    )
    reciprocal = 1.0 / (a * cofactors[0][0] + b * cofactors[1][0] + c * cofactors[2][0])
    inverses = np.empty_like(matrices)
    for row, entries in zip(inverses, cofactors, strict=True):
        for place, entry in zip(row, entries, strict=True):
            np.multiply(entry, reciprocal, out=place)
    return inverses


@dataclass(frozen=True)
class SparseJacobians:
    """The entries (k, m) of a pattern."""

    elimination: Elimination
    entries: Array
    iterations: ClassVar[float] = _ELIMINATION.costly_iterations

    def paired(self, shifts: Sequence[complex]) -> PairedMatrices:
        return Pairs(tuple(map(self.newton, shifts)))

    def newton(self, shift: complex) -> NewtonMatrices:
        kept, m = self.elimination, self.entries.shape[1]
        reserve(_ELIMINATION.step_matrices * m * kept.stored * np.dtype(type(shift)).itemsize)
        numbers = np.zeros((m, kept.stored), dtype=type(shift))
        numbers[:, kept.places] -= self.entries.T
        numbers[:, kept.diagonal] += shift
        charge(kept.factor_cost * m)
        return SparseFactors(kept, kept.factored(numbers), m, numbers.dtype)


@dataclass(frozen=True)
class SparseFactors:
    """What solves with sparse factors of m matrices."""

    elimination: Elimination
    solver: Solver
    m: int
    dtype: np.dtype[np.generic]

    def solve(self, right: Array) -> Array:
        n = self.elimination.columns.size
        return self.solve_some(np.arange(self.m), right.reshape(n, -1)).ravel()

    def solve_some(self, columns: NDArray[np.intp], right: Array) -> Array:
        charge(len(columns) * self.elimination.solution_cost)
        order = self.elimination.columns
        ordered = np.ascontiguousarray(right[order].T, dtype=self.dtype)
        solution = np.empty(right.shape, dtype=self.dtype)
        solution[order] = self.solver(ordered, columns).T
        return solution
