"""Operators of a slab on Radau nodes, and the inverse that preconditions its equations.

They do what the generated kernels of a group do. The terms are of degree two at most.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, TypeAlias

import numpy as np
import scipy.linalg
import scipy.sparse
from numpy.typing import NDArray

from rankone.solvers.engines.engine_options import TRAIN
from rankone.support.arrays import Array
from rankone.support.budget import COPIES, reserve
from rankone.support.costs import SparseFactors, product
from rankone.support.errors import OptionError
from rankone.tensors import Basis1D, RadauCollocation
from rankone.trajectories.system.features import OfStates
from rankone.trajectories.system.system import Kernel, System, pattern_of

Monomial: TypeAlias = tuple[int, ...]
"""States that a term multiplies, in order."""


@dataclass(frozen=True)
class Entry:
    """A term of a group: coefficient, state, row of its time factor, states multiplied."""

    coefficient: float
    state: int
    factor: int
    monomial: Monomial


def entries_of(system: System) -> dict[tuple[int, tuple[int, ...]], list[Entry]]:
    """Terms by degree and by the rows of their parameter factors."""
    groups: dict[tuple[int, tuple[int, ...]], list[Entry]] = {}
    for coefficient, state, (factor, *rows), monomial in system.terms:
        entry = Entry(float(coefficient), state, factor, tuple(sorted(monomial)))
        groups.setdefault((len(monomial), tuple(rows)), []).append(entry)
    return groups


class TermKernels:
    """A group of terms of one degree: ``paired`` are the second states of products of two.

    Of P points of time and parameter, time-major, ``phi`` (factors, P) has the time factors.
    """

    def __init__(self, entries: Sequence[Entry], n_states: int) -> None:
        monomials = sorted({entry.monomial for entry in entries}, key=lambda m: m[::-1])
        if len(monomials[0]) == 1:  # linear terms multiply all states, so that none are gathered
            monomials = [(state,) for state in range(n_states)]
        place = {monomial: k for k, monomial in enumerate(monomials)}
        blocks: dict[int, list[int]] = {}
        for first, second in (monomial for monomial in monomials if len(monomial) == 2):
            blocks.setdefault(second, []).append(first)
        self.paired, self._blocks = list(blocks), list(blocks.values())
        by_factor: dict[int, list[Entry]] = {}
        for entry in entries:
            by_factor.setdefault(entry.factor, []).append(entry)
        shape = n_states, len(monomials)
        self._matrices = {
            factor: scipy.sparse.csr_matrix(
                (
                    [entry.coefficient for entry in own],
                    ([entry.state for entry in own], [place[entry.monomial] for entry in own]),
                ),
                shape,
            )
            for factor, own in by_factor.items()
        }
        self._adjoints = {factor: m.T.tocsr() for factor, m in self._matrices.items()}

    def constant(self, phi: Array) -> Array:
        """Constant terms (n, P)."""
        return _sums(self._matrices, phi, np.ones((1, phi.shape[1], 1)))[:, :, 0]

    def linear(self, phi: Array, x: Array) -> Array:
        """Linear terms at x (n, P, r)."""
        return _sums(self._matrices, phi, x)

    def linear_adjoint(self, phi: Array, w: Array) -> Array:
        """Their adjoint at w (n, P, s)."""
        return _sums(self._adjoints, phi, w)

    def quadratic(self, phi: Array, x: Array, z: Array) -> Array:
        """Products of x (n, P, r) with z (paired states, P, r, s), summed over r: (n, P, s)."""
        products = [
            np.matmul(x[first].transpose(1, 0, 2), second).transpose(1, 0, 2)
            for first, second in zip(self._blocks, z, strict=True)
        ]
        return _sums(self._matrices, phi, np.concatenate(products))

    def quadratic_adjoint(self, phi: Array, x: Array, w: Array) -> Array:
        """The adjoint at w (n, P, s): (paired states, P, r, s)."""
        q, last = _sums(self._adjoints, phi, w), 0
        v = np.empty((len(self.paired), *x.shape[1:], w.shape[2]))
        for first, out in zip(self._blocks, v, strict=True):
            begin, last = last, last + len(first)
            np.matmul(x[first].transpose(1, 2, 0), q[begin:last].transpose(1, 0, 2), out=out)
        return v


def _sums(matrices: dict[int, scipy.sparse.csr_matrix], phi: Array, x: Array) -> Array:
    """Matrices times the rows of x (m, P, r), each with its time factor; row 0 of them is one."""
    total: Array | float = 0.0
    for factor, matrix in matrices.items():
        part = np.asarray(matrix @ x.reshape(len(x), -1)).reshape(-1, *x.shape[1:])
        total = total + (part * phi[factor, :, None] if factor else part)
    return np.asarray(total)


# -----------------------------------------------------------------------------
# The operators of one time slab: collocation, mean Jacobian and the preconditioned Volterra form.
#
# On the slab [s, s + h] the unknown solves, at the Radau nodes, ``M u' = f(u)``, where M is one for
# differential states and zero for the auxiliary products. With the Jacobian A(t) along the
# trajectory at the centre of the box this is rewritten as
#
#     U = E U_s + S (f(U) - A U),    S = (D M / h - A)^{-1},  E = S (d_0 M / h),
#
# a second-kind equation, near the identity, that treats the stiffness common to the box exactly.


CONSTANT, LINEAR, QUADRATIC = range(3)
"""Degrees of term groups in the states."""

Key = tuple[int, tuple[int, ...]]
"""(degree, factor rows of the remaining parameters): all terms with the same key share one
contraction over those parameters, whatever they did before."""


@dataclass(frozen=True, slots=True)
class GroupKernels:
    """All terms of one degree in the states and one signature: they share every contraction.

    The signature holds a row of the factors of each parameter. ``kernel`` evaluates the generated
    terms; a constant is its own adjoint. ``paired`` lists the second states of quadratic terms.
    """

    degree: int
    signature: tuple[int, ...]
    kernel: Kernel
    adjoint: Kernel
    paired: list[int]

    @property
    def key(self) -> Key:
        return (self.degree, self.signature)


def term_groups(system: System) -> tuple[GroupKernels, ...]:
    """The groups of a generated system, by degree and signature.

    Systems of very many states have no generated kernels: theirs are made from the table of terms.
    """
    kernels = system.kernels
    if system.terms and not kernels.signatures:
        if system.products:
            raise OptionError(
                f"method='train' does not apply: with their products there are "
                f"{len(system.states)} states, too many for terms that multiply three of them",
                remedy="leave method= out, or take cross",
            )
        return tuple(
            _tabulated(degree, signature, TermKernels(entries, len(system.states)))
            for (degree, signature), entries in entries_of(system).items()
        )
    by_degree = (
        (CONSTANT, kernels.constant, kernels.constant),
        (LINEAR, kernels.linear, kernels.linear_adjoint),
        (QUADRATIC, kernels.quadratic, kernels.quadratic_adjoint),
    )
    return tuple(
        GroupKernels(degree, signature, kernel, adjoint, list(paired))
        for degree, forward, backward in by_degree
        for signature, paired, kernel, adjoint in zip(
            kernels.signatures, kernels.paired, forward, backward, strict=True
        )
        if kernel is not None and adjoint is not None
    )


def _tabulated(degree: int, signature: tuple[int, ...], kernels: TermKernels) -> GroupKernels:
    """A group whose kernels are those of its terms."""
    by_degree: dict[int, tuple[Kernel, Kernel]] = {
        CONSTANT: (kernels.constant, kernels.constant),
        LINEAR: (kernels.linear, kernels.linear_adjoint),
        QUADRATIC: (kernels.quadratic, kernels.quadratic_adjoint),
    }
    forward, backward = by_degree[degree]
    return GroupKernels(degree, signature, forward, backward, kernels.paired)


class ParameterOperators:
    """Diagonal parameter operators: one vector per factor, dimension and degree.

    Cores hold values scaled by sqrt(weight), so that the Euclidean product is the L2 product. The
    projection of a product of ``degree`` states and a factor is then diagonal with the entries
    ``factor * weight ** ((1 - degree) / 2)``.
    """

    def __init__(self, system: System, bases: Sequence[Basis1D]) -> None:
        factors = [system.parameter_factors(j, basis.nodes) for j, basis in enumerate(bases)]
        self.bases = tuple(bases)
        self._vectors: list[list[Array]] = [
            [
                rows * basis.weights ** (0.5 * (1 - degree))
                for rows, basis in zip(factors, bases, strict=True)
            ]
            for degree in (CONSTANT, LINEAR, QUADRATIC)
        ]

    def vector(self, key: Key, dimension: int) -> Array:
        """The operator of the first remaining factor of ``key`` in ``dimension``, shape (size,)."""
        degree, rows = key
        return np.asarray(self._vectors[degree][dimension][rows[0]])


class SlabOperator:
    """Right-hand side kernels and preconditioner of one slab, on scaled states.

    Cores hold states divided by ``scale * sqrt(K)``, with the sizes ``scale`` (n,) of the states:
    the Euclidean norm of a core is a root mean square over the K nodes in units of the size.
    ``jacobian`` is that of the quadratic system along the trajectory at the box centre.
    """

    def __init__(
        self,
        system: System,
        collocation: RadauCollocation,
        start: float,
        length: float,
        scale: Array,
        jacobian: SlabJacobian,
    ) -> None:
        self.collocation = collocation
        self.start, self.length = start, length
        n, count = scale.size, collocation.count
        self.shape = (n, count)
        self.times = collocation.times(start, length)
        self.phi = system.time_factors(self.times)
        self._units = scale * np.sqrt(count)
        self._mass = np.zeros(n)
        self._mass[: system.n_differential] = 1.0 / length
        self.jacobian = jacobian.scaled(scale)
        self.inverse = inverse_of(self.jacobian, self._mass, collocation)

    # Kernels act on x (n, P, r) with P = K * repeat points, time-major.

    def tiled(self, repeat: int) -> Array:
        """Time factors at K * repeat points."""
        return self.phi if repeat == 1 else np.repeat(self.phi, repeat, axis=1)

    def constant(self, group: GroupKernels, phi: Array) -> Array:
        return np.asarray(group.kernel(phi) / self._units[:, None])

    def linear(self, group: GroupKernels, phi: Array, x: Array) -> Array:
        units = self._units[:, None, None]
        return np.asarray(group.kernel(phi, x * units) / units)

    def quadratic(self, group: GroupKernels, phi: Array, x: Array, env: Array) -> Array:
        """Right-hand side of a quadratic group, contracted with env (r, r, s)."""
        x = x * self._units[:, None, None]
        paired = x[group.paired]
        m, points, r = paired.shape
        z = (paired.reshape(m * points, r) @ env.reshape(r, -1)).reshape(m, points, r, -1)
        return np.asarray(group.kernel(phi, x, z) / self._units[:, None, None])

    def minus_jacobian(self, x: Array) -> Array:
        """-A x at x (n, K * repeat, r)."""
        return -self.inverse.jacobian(self._paired(x)).reshape(x.shape)

    def solve(self, y: Array) -> Array:
        """S y for y (n, K * repeat, r): acts on (state, time), time-major points."""
        return self.inverse.solve(self._paired(y)).reshape(y.shape)

    def _paired(self, x: Array) -> Array:
        """(n, K * repeat, r) as (n * K, repeat * r)."""
        n, count = self.shape
        return x.reshape(n * count, -1)

    # Left environments: test functions w = S^T L against the kernels on x.

    def adjoint(self, tests: Array) -> Array:
        """S^T tests for tests (n, K, s)."""
        return self.inverse.adjoint(self._paired(tests)).reshape(tests.shape)

    def left(self, group: GroupKernels, weighted: Array, x: Array) -> Array:
        """<weighted_s, group(x)>: (s,), (s, r) or (s, r, r) by the degree of the group.

        ``weighted`` is the adjoint of the test functions, (n, K, s).
        """
        if group.degree == CONSTANT:
            return np.tensordot(weighted, self.constant(group, self.phi), axes=([0, 1], [0, 1]))
        units = self._units[:, None, None]
        x, weighted = x * units, weighted / units
        n, count, r = x.shape
        s = weighted.shape[2]
        if group.degree == LINEAR:
            v = group.adjoint(self.phi, weighted)
            return np.asarray(v.reshape(n * count, s).T @ x.reshape(n * count, r))
        v = group.adjoint(self.phi, x, weighted)
        paired = x[group.paired].reshape(-1, r)
        env = (paired.T @ v.reshape(paired.shape[0], r * s)).reshape(r, r, s)
        return np.asarray(np.moveaxis(0.5 * (env + env.swapaxes(0, 1)), 2, 0))

    def left_minus_jacobian(self, weighted: Array, x: Array) -> Array:
        """<weighted_s, -A x>: (s, r)."""
        minus_jacobian = self.minus_jacobian(x)
        return np.asarray(np.tensordot(weighted, minus_jacobian, axes=([0, 1], [0, 1])))

    def initial(self, start: Array) -> Array:
        """E u_s for start values in scaled states (n_differential, r): (n, K, r)."""
        n, count = self.shape
        rates = np.zeros((n, count, start.shape[1]))
        states = self._mass[: len(start), None, None] * start[:, None]
        rates[: len(start)] = self.collocation.start[:, None] * states
        return np.asarray(self.solve(rates) / np.sqrt(count))


# -----------------------------------------------------------------------------
# The Jacobian of one slab and S = (D M / h - A)^{-1}, as one matrix or by sparse factors.
#
# Rows and columns are pairs of state and time node, the nodes of a state side by side. Of many
# pairs sparse matrices are factored instead, and no array has the square of their number as its
# size. Where the Jacobian hardly changes over the slab, they are of the states alone, one for each
# pair of rows of the Schur form of D (Bickart, SIAM J. Numer. Anal. 14 (1977), 1022, of its Jordan
# form); else one matrix over all pairs is.


MOST_DENSE = 640
"""Pairs of state and time node up to which S is one matrix."""


@dataclass(frozen=True, eq=False)
class SlabJacobian:
    """Jacobians (n, n) of a system at the K nodes of a slab.

    ``entries`` (k, K) are at ``rows`` and ``columns``, each (k,); all others are zero.
    """

    size: int
    rows: NDArray[np.intp]
    columns: NDArray[np.intp]
    entries: Array

    @staticmethod
    def along(jacobian: OfStates, times: Array, states: Array, point: Array) -> SlabJacobian:
        """The Jacobian along states (n, K) at times (K,), for one parameter point (d, 1)."""
        n, pattern = len(states), pattern_of(jacobian)
        if pattern is None:
            values = jacobian(times, states, point)
            return SlabJacobian.of(np.broadcast_to(values, (n, n, times.size)))
        entries = pattern.entries(times, states, point)
        entries = np.broadcast_to(entries, (pattern.rows.size, times.size))
        return SlabJacobian(n, pattern.rows, pattern.columns, entries)

    @staticmethod
    def of(dense: Array) -> SlabJacobian:
        """From arrays (n, n, K) with all zeros."""
        rows, columns = np.nonzero(np.any(dense != 0.0, axis=2))
        return SlabJacobian(len(dense), rows, columns, dense[rows, columns])

    def scaled(self, scale: Array) -> SlabJacobian:
        """The same for states divided by ``scale`` (n,)."""
        ratios = scale[self.columns] / scale[self.rows]
        return SlabJacobian(self.size, self.rows, self.columns, self.entries * ratios[:, None])

    @property
    def middle(self) -> Array:
        """The entries (k,) at the node in the middle."""
        return np.asarray(self.entries[:, self.entries.shape[1] // 2])

    @property
    def change(self) -> float:
        """Largest sum of the changes of a row from the middle to another node."""
        changes = np.abs(self.entries - self.middle[:, None]).max(axis=1, initial=0.0)
        return float(np.bincount(self.rows, changes, self.size).max(initial=0.0))

    def dense(self) -> Array:
        """With all zeros: (K, n, n)."""
        full = np.zeros((self.entries.shape[1], self.size, self.size))
        full[:, self.rows, self.columns] = self.entries.T
        return full


class SlabInverse(Protocol):
    """Products with the Jacobian A, with S and with its transpose; x is (n * K, m)."""

    def jacobian(self, x: Array) -> Array:
        """A x."""

    def solve(self, x: Array) -> Array:
        """S x."""

    def adjoint(self, x: Array) -> Array:
        """S^T x."""

    def cost(self, columns: int) -> float:
        """Operations of a product with A and one with S, as far as these do not count their own."""


def inverse_of(jacobian: SlabJacobian, mass: Array, collocation: RadauCollocation) -> SlabInverse:
    """The inverse for the masses (n,) of the states, divided by the length of the slab."""
    if jacobian.size * collocation.count <= MOST_DENSE:
        return DenseInverse(jacobian, mass, collocation)
    if jacobian.change <= TRAIN.largest_change * mass.max():
        return SchurInverse(jacobian, mass, collocation)
    return SparseInverse(jacobian, mass, collocation)


class DenseInverse:
    """S as one matrix."""

    def __init__(self, jacobian: SlabJacobian, mass: Array, collocation: RadauCollocation) -> None:
        n, count = self._shape = jacobian.size, collocation.count
        reserve(8 * COPIES * (n * count) ** 2)
        self._jacobian = jacobian.dense()
        matrix = np.zeros((n, count, n, count))
        index, nodes = np.arange(n), np.arange(count)
        matrix[index, :, index, :] = mass[:, None, None] * collocation.derivative
        matrix[:, nodes, :, nodes] -= self._jacobian
        factors = scipy.linalg.lu_factor(matrix.reshape(n * count, n * count), check_finite=False)
        self._matrix = scipy.linalg.lu_solve(factors, np.eye(n * count), check_finite=False)

    def jacobian(self, x: Array) -> Array:
        n, count = self._shape
        blocks = np.moveaxis(x.reshape(n, count, -1), 1, 0)
        return np.asarray(np.moveaxis(np.matmul(self._jacobian, blocks), 0, 1).reshape(x.shape))

    def solve(self, x: Array) -> Array:
        return np.asarray(self._matrix @ x)

    def adjoint(self, x: Array) -> Array:
        return np.asarray(self._matrix.T @ x)

    def cost(self, columns: int) -> float:
        pairs = len(self._matrix)
        return 2.0 * product(pairs, pairs, columns)


class SparseInverse:
    """S by sparse factors."""

    def __init__(self, jacobian: SlabJacobian, mass: Array, collocation: RadauCollocation) -> None:
        n, count = jacobian.size, collocation.count
        reserve(TRAIN.entry_bytes * count * (n * count + 2.0 * jacobian.rows.size))
        nodes, shape = np.arange(count), (n * count, n * count)
        rows = (jacobian.rows[:, None] * count + nodes).ravel()
        columns = (jacobian.columns[:, None] * count + nodes).ravel()
        self._jacobian = scipy.sparse.csr_matrix((jacobian.entries.ravel(), (rows, columns)), shape)
        derivative = scipy.sparse.kron(scipy.sparse.diags(mass), collocation.derivative)
        matrix = (derivative - self._jacobian).tocsc()
        self._factors = SparseFactors(matrix)

    def solve(self, x: Array) -> Array:
        return self._factors.solve(x)

    def adjoint(self, x: Array) -> Array:
        return self._factors.adjoint(x)

    def jacobian(self, x: Array) -> Array:
        return np.asarray(self._jacobian @ x)

    def cost(self, columns: int) -> float:
        return 2.0 * columns * float(self._jacobian.nnz)


class SchurInverse:
    """S of the Jacobian in the middle of the slab, by sparse factors for the Schur form of D.

    With D = Q T Q^T and T of diagonal blocks of one or two rows, from the last block to the first
    ``(T_kk M / h - A) y_k`` is known. A block ``[[a, b], [c, a]]`` with the eigenvalues a ± i w is
    a complex matrix of the states: ``((a + i w) M / h - A) (y_1 + i w y_2 / c)``.
    """

    def __init__(self, jacobian: SlabJacobian, mass: Array, collocation: RadauCollocation) -> None:
        n, self._mass = jacobian.size, mass
        self._shape = n, collocation.count
        place = jacobian.rows, jacobian.columns
        self._jacobian = scipy.sparse.csr_matrix((jacobian.middle, place), (n, n))
        self._triangular, self._vectors = scipy.linalg.schur(collocation.derivative)
        self._blocks = [
            _Block.of(self._triangular, rows, self._jacobian, mass)
            for rows in _diagonal_blocks(self._triangular)
        ]

    def jacobian(self, x: Array) -> Array:
        return np.asarray((self._jacobian @ x.reshape(self._shape[0], -1)).reshape(x.shape))

    def solve(self, x: Array) -> Array:
        return self._substituted(x, self._triangular, self._blocks[::-1], adjoint=False)

    def adjoint(self, x: Array) -> Array:
        return self._substituted(x, self._triangular.T, self._blocks, adjoint=True)

    def _substituted(
        self, x: Array, triangular: Array, blocks: Sequence[_Block], adjoint: bool
    ) -> Array:
        """Solutions for right-hand sides (n * K, m), block after block."""
        n, count = self._shape
        transformed = np.tensordot(self._vectors.T, x.reshape(n, count, -1), (1, 1))  # (K, n, m)
        solutions = np.zeros_like(transformed)
        mass = self._mass[:, None]
        done: list[int] = []
        for block in blocks:
            right = transformed[block.rows]
            if done:
                right = right - mass * np.tensordot(
                    triangular[np.ix_(block.rows, done)], solutions[done], 1
                )
            solutions[block.rows] = block.solve(right, adjoint)
            done += block.rows
        return np.asarray(np.tensordot(self._vectors, solutions, 1).swapaxes(0, 1).reshape(x.shape))

    def cost(self, columns: int) -> float:
        n, count = self._shape
        return 2.0 * columns * (count * float(self._jacobian.nnz) + 3.0 * n * count**2)


@dataclass(frozen=True, eq=False)
class _Block:
    """A diagonal block of the Schur form: its rows, and the factors for them.

    Of two rows the second solution is the imaginary part over ``ratio``.
    """

    rows: list[int]
    factors: SparseFactors
    ratio: float = 0.0

    @staticmethod
    def of(
        triangular: Array, rows: list[int], jacobian: scipy.sparse.csr_matrix, mass: Array
    ) -> _Block:
        shift, ratio = float(triangular[rows[0], rows[0]]), 0.0
        if len(rows) == 1:
            matrix = scipy.sparse.diags(shift * mass) - jacobian
            return _Block(rows, SparseFactors(matrix.tocsc()))
        above, below = (float(triangular[i, j]) for i, j in (rows, rows[::-1]))
        frequency = np.sqrt(-above * below)
        ratio = frequency / below
        matrix = scipy.sparse.diags((shift + 1j * frequency) * mass) - jacobian
        return _Block(rows, SparseFactors(matrix.tocsc()), ratio)

    def solve(self, right: Array, adjoint: bool) -> Array:
        """Solutions (rows, n, m) for right-hand sides, or those of the transposed matrices."""
        solve = self.factors.adjoint if adjoint else self.factors.solve
        if len(self.rows) == 1:
            return solve(right[0])[None]
        ratio = -1.0 / self.ratio if adjoint else self.ratio
        both = solve(right[0] + 1j * ratio * right[1])
        return np.stack([both.real, both.imag / ratio])


def _diagonal_blocks(triangular: Array) -> list[list[int]]:
    """The rows of each diagonal block of a real Schur form, one or two."""
    count, blocks, k = len(triangular), list[list[int]](), 0
    while k < count:
        pair = k + 1 < count and triangular[k + 1, k] != 0.0
        blocks.append([k, k + 1] if pair else [k])
        k += len(blocks[-1])
    return blocks
