"""Sums of products and their arithmetic, and the operators of a slab on shape functions.

    X[n_0, ..., n_d] = sum_r F_0[n_0, r] F_1[n_1, r] ... F_d[n_d, r]

Addition joins columns, a pointwise product pairs them; both raise the rank, and the classic method
lowers it again by solving with the identity. A solved sum becomes tensor trains, which solutions
evaluate.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rankone.solvers.engines.engine_options import GREEDY, GreedyOptions
from rankone.solvers.march import FEW_PARAMETERS
from rankone.solvers.request import Domain
from rankone.support.arrays import ACCUMULATED, AT_ONCE, EPSILON, Array
from rankone.support.budget import COPIES, charge, reserve
from rankone.support.costs import product, qr
from rankone.tensors import LegendreBasis
from rankone.tensors.basis import LagrangeElements, nodes_for
from rankone.tensors.slab import SlabTrain
from rankone.tensors.train import Integers, Train
from rankone.trajectories.system.system import System

# Largest rank whose norm in three dimensions or more is found by orthogonalisation, in cubic time
_ORTHOGONALISED_RANK = 120


@dataclass(frozen=True)
class RankOneSum:
    """A sum of R products, by a matrix (N_j, R) for each dimension that holds amplitudes too."""

    factors: tuple[Array, ...]

    @property
    def rank(self) -> int:
        return int(self.factors[0].shape[1])

    def __add__(self, other: RankOneSum) -> RankOneSum:
        pairs = zip(self.factors, other.factors, strict=True)
        return RankOneSum(tuple(np.concatenate(pair, axis=1) for pair in pairs))

    def __neg__(self) -> RankOneSum:
        return self.scaled(-1.0)

    def __sub__(self, other: RankOneSum) -> RankOneSum:
        return self + -other

    def scaled(self, amplitudes: float | Array) -> RankOneSum:
        """Multiply by a number, or every product by its own."""
        return RankOneSum((self.factors[0] * amplitudes, *self.factors[1:]))

    def times(self, other: RankOneSum) -> RankOneSum:
        """The pointwise product; a square keeps each pair of products once."""
        if other is self:
            i, j = np.triu_indices(self.rank)
            square = RankOneSum(tuple(f[:, i] * f[:, j] for f in self.factors))
            return square.scaled(np.where(i == j, 1.0, 2.0))
        pairs = zip(self.factors, other.factors, strict=True)
        return RankOneSum(
            tuple((a[:, :, None] * b[:, None, :]).reshape(len(a), -1) for a, b in pairs)
        )

    def weighted(self, rows: Sequence[Array | None]) -> RankOneSum:
        """Multiply pointwise by a function of each coordinate; None is one."""
        pairs = zip(self.factors, rows, strict=True)
        return RankOneSum(tuple(f if row is None else f * row[:, None] for f, row in pairs))

    def applied(self, matrices: Sequence[Array]) -> RankOneSum:
        """Apply one matrix to each dimension."""
        pairs = zip(matrices, self.factors, strict=True)
        return RankOneSum(tuple(matrix @ f for matrix, f in pairs))

    def inner(self, other: RankOneSum) -> float:
        return sum(float(gram.sum()) for gram in self._grams(other))

    def distance(self, other: RankOneSum, square: float | None = None) -> float:
        """Euclidean norm of the difference, as careful as :meth:`norm`.

        ``square`` is the squared norm of this tensor, if it is known.
        """
        if self.rank + other.rank <= _ORTHOGONALISED_RANK or len(self.factors) <= 2:
            return (self - other).norm()
        square = self.inner(self) if square is None else square
        difference = square - 2.0 * self.inner(other) + other.inner(other)
        return math.sqrt(max(difference, 4.0 * EPSILON * square))

    def _grams(self, other: RankOneSum) -> Iterator[Array]:
        """Inner products of the products, (R, R of the other), a block of columns at a time."""
        step = max(AT_ONCE // max(self.rank, 1), 1)
        for first in range(0, other.rank, step):
            gram = np.ones((self.rank, min(step, other.rank - first)))
            charge(sum(product(len(gram), len(f), gram.shape[1]) for f in self.factors))
            for a, b in zip(self.factors, other.factors, strict=True):
                gram *= a.T @ b[:, first : first + step]
            yield gram

    def norm(self) -> float:
        """Euclidean norm.

        The norm of a difference keeps all digits up to rank 120, and in one and two dimensions at
        any rank; otherwise it is at least what rounding may have cancelled.
        """
        if self.rank == 0:
            return 0.0
        if self.rank > _ORTHOGONALISED_RANK and len(self.factors) > 2:
            square = size = 0.0
            for gram in self._grams(self):
                square, size = square + float(gram.sum()), size + float(np.abs(gram).sum())
            return math.sqrt(max(square, 4.0 * EPSILON * size))
        products = np.ones((1, self.rank))
        for factor in self.factors[:-1]:
            block = (products[:, None, :] * factor).reshape(-1, self.rank)
            charge(qr(*block.shape))
            if len(block) > self.rank:
                block = np.asarray(np.linalg.qr(block, mode="r"))
            products = block
        return float(np.linalg.norm(products @ self.factors[-1].T))

    def at(self, indices: Integers) -> Array:
        """Entries of a tensor with one row in its first dimension, at indices (m, d): (m,)."""
        products = np.broadcast_to(self.factors[0], (len(indices), self.rank))
        for factor, rows in zip(self.factors[1:], indices.T, strict=True):
            products = products * factor[rows]
        return np.asarray(products.sum(axis=1))

    @classmethod
    def of_train(cls, row: Array, cores: Sequence[Array]) -> RankOneSum:
        """The products of a train: a row (r_1,) of its first core, then (r_j, N_j, r_{j+1})."""
        factors = [np.tensordot(row, cores[0], 1)]  # (N_1, products)
        for core in cores[1:]:
            products, size, rank = core.shape
            repeated = factors[-1].shape[1] // products
            factors = [np.repeat(factor, rank, axis=1) for factor in factors]
            columns = np.moveaxis(core, 1, 0).reshape(size, -1)
            factors.append(np.tile(columns, (1, repeated)))
        return cls(tuple(factors))

    def merged(self) -> RankOneSum:
        """The same tensor without repeated work: one column if there is one dimension only."""
        if len(self.factors) > 1:
            return self
        return RankOneSum((self.factors[0].sum(axis=1, keepdims=True),))

    @staticmethod
    def zero(sizes: Sequence[int]) -> RankOneSum:
        return RankOneSum(tuple(np.zeros((size, 0)) for size in sizes))

    @staticmethod
    def joined(tensors: Sequence[RankOneSum], sizes: Sequence[int]) -> RankOneSum:
        """The sum of any number of tensors of the given sizes."""
        if not tensors:
            return RankOneSum.zero(sizes)
        columns = zip(*(tensor.factors for tensor in tensors), strict=True)
        return RankOneSum(tuple(np.concatenate(factors, axis=1) for factors in columns))


def element_trains(
    bases: Sequence[LagrangeElements],
    start: Sequence[RankOneSum],
    modes: Sequence[RankOneSum],
    tolerance: Array,
) -> tuple[list[SlabTrain], Array]:
    """One train for each element in time, all states together, and their highest modes.

    For each state ``start`` is its value at the start, nodal in the parameters, with one row of
    time, and ``modes`` the change from it, nodal, without the first node in time. The products of
    all states form a train with diagonal cores. It is orthogonalised once for the slab; on one
    element in time the polynomials span few directions, and singular values below the tolerance,
    the root mean square error (n,) of each state, are left out. The second array (n, 1 + d) is the
    root mean square of the two highest modes.
    """
    time, *parameters = bases
    sums = [
        RankOneSum((np.repeat(initial.factors[0], time.size, axis=0), *initial.factors[1:]))
        + RankOneSum((np.vstack([np.zeros((1, mode.rank)), mode.factors[0]]), *mode.factors[1:]))
        for initial, mode in zip(start, modes, strict=True)
    ]
    if not any(total.rank for total in sums):
        sums[0] = RankOneSum(tuple(np.zeros((len(factor), 1)) for factor in sums[0].factors))
    n, rank = len(sums), sum(total.rank for total in sums)
    entries = n * time.size + rank * sum(basis.size for basis in parameters)
    reserve(8 * COPIES * rank * entries)
    first = np.zeros((n, time.elements, time.order + 1, rank))
    begin = 0
    for state, total in enumerate(sums):
        first[state, :, :, begin : begin + total.rank] = time.to_modes(total.factors[0])
        begin += total.rank
    first /= tolerance[:, None, None, None]
    cores: list[Array] = [first.reshape(-1, rank)]
    diagonal = np.arange(rank)
    for j, basis in enumerate(parameters, start=1):
        nodal = np.concatenate([total.factors[j] for total in sums], axis=1)
        coefficients = basis.to_modes(nodal).reshape(-1, rank) / np.sqrt(basis.elements)
        core = np.zeros((rank, len(coefficients), rank))
        core[diagonal, :, diagonal] = coefficients.T
        cores.append(core)
    if parameters:
        cores[-1] = cores[-1].sum(axis=2, keepdims=True)
    else:
        cores = [cores[0].sum(axis=1, keepdims=True)]
    train = Train(tuple(cores)).rounded(1.0)
    first = train.first.reshape(n, time.elements, time.order + 1, -1)
    tails = _tails(first, train.cores[1:], bases) * tolerance[:, None]
    trains, parameter_bases = [], tuple(basis.modes for basis in parameters)
    for e in range(time.elements):
        local = first[:, e].reshape(n * (time.order + 1), -1)
        following = train.cores[1:]
        if following and local.shape[1] > len(local):
            # no more directions than coefficients in time: rotate them into the next core
            q, r = np.linalg.qr(local.T)
            local = r.T
            following = (np.tensordot(q.T, following[0], 1), *following[1:])
        block = local.reshape(n, time.order + 1, -1) * tolerance[:, None, None]
        lower = time.lower + e * time.width
        upper = time.upper if e == time.elements - 1 else time.lower + (e + 1) * time.width
        trains.append(SlabTrain(lower, upper, Train((block, *following)), parameter_bases))
    return trains, tails


def _tails(first: Array, cores: Sequence[Array], bases: Sequence[LagrangeElements]) -> Array:
    """Norms of the two highest modes of each element, by state and dimension.

    ``first`` is (n, elements, order + 1, r) and the other cores are right-orthonormal.
    """
    n, elements = first.shape[:2]
    tails = np.zeros((n, len(bases)))
    tails[:, 0] = np.sqrt(np.sum(first[:, :, -2:] ** 2, axis=(1, 2, 3)) / elements)
    gram = np.einsum("nepr,neps->nrs", first, first, optimize=True) / elements
    for j, (core, basis) in enumerate(zip(cores, bases[1:], strict=True), start=1):
        split = core.reshape(len(core), basis.elements, basis.order + 1, -1)
        flat = split[:, :, -2:].reshape(len(core), -1)
        tails[:, j] = np.sqrt(np.maximum(np.einsum("nrs,rs->n", gram, flat @ flat.T), 0.0))
        gram = np.stack([_carried(g, core) for g in gram])
    return tails


def _carried(gram: Array, core: Array) -> Array:
    r, size, s = core.shape
    half = (gram @ core.reshape(r, size * s)).reshape(r * size, s)
    return half.T @ core.reshape(r * size, s)


# -----------------------------------------------------------------------------
# Operators and sources on shape functions: D = sum_i (x)_j D_j^i and G = sum_i (x)_j G_j^i.
#
# The slides' discrete equation ``D(U) = G`` of one unknown. With the shape functions phi of time
# and psi of a parameter k, the equation ``u' + k u = 0`` has
#
#     D = P (x) M_k + M_t (x) N,
#     P = int phi phi'^T dt,   M_t = int phi phi^T dt,   N = int k psi psi^T dk.
#
# The unknown is the state minus its initial value, so that its time functions vanish at the start
# of the slab: the first shape function in time is left out, of the unknown and of the test
# function.


class SourceTerm(NamedTuple):
    """One term of f in ``u' = f``: a row of ``TERMS``.

    ``rows`` are a row of ``time_factors``, then one of ``parameter_factors`` for each parameter; 0
    is one. ``monomial`` lists the states multiplied, of any degree.
    """

    coefficient: float
    equation: int
    rows: tuple[int, ...]
    monomial: tuple[int, ...]

    @property
    def own(self) -> bool:
        """Whether the term is linear in the unknown of its equation: part of its operator."""
        return self.monomial == (self.equation,)


def source_terms(system: System) -> tuple[SourceTerm, ...]:
    """The terms of f in ``u' = f``."""
    return tuple(SourceTerm(*row) for row in system.terms)


def evaluation_order(terms: Sequence[SourceTerm], states: int) -> tuple[tuple[int, ...], ...]:
    """Blocks of states to be solved one after the other; only within a block terms are lagged.

    The strongly connected components of the graph of dependence. A state that needs another reaches
    all that the other reaches, and more: the blocks come in the order of how many states they
    reach. A block of one state whose terms do not lag it takes a single solve.
    """
    reached = np.eye(states, dtype=bool)
    for term in terms:
        reached[term.equation, list(term.monomial)] = True
    for middle in range(states):  # Warshall, J. ACM 9 (1962) 11
        reached |= np.outer(reached[:, middle], reached[middle])
    blocks = dict.fromkeys(tuple(np.flatnonzero(row).tolist()) for row in reached & reached.T)
    return tuple(sorted(blocks, key=lambda block: np.count_nonzero(reached[block[0]])))


class ShapeSpace:
    """Shape functions on a slab and in every parameter, and the known factors at their points."""

    def __init__(
        self, system: System, time: LagrangeElements, parameters: Sequence[LagrangeElements]
    ) -> None:
        self.time = time
        self.parameters = tuple(parameters)
        self.bases = (time, *self.parameters)
        self.tables = (time.values[:, 1:], *(basis.values for basis in self.parameters))
        self.weights = tuple(basis.weights for basis in self.bases)
        self.rows = (
            system.time_factors(time.points),
            *(system.parameter_factors(j, b.points) for j, b in enumerate(self.parameters)),
        )

    @property
    def sizes(self) -> tuple[int, ...]:
        """Number of unknown nodal values in each dimension."""
        return tuple(table.shape[1] for table in self.tables)

    @property
    def counts(self) -> tuple[int, ...]:
        """Number of quadrature points in each dimension."""
        return tuple(weights.size for weights in self.weights)

    @property
    def volume(self) -> float:
        """Volume of the slab times the box."""
        return float(np.prod([basis.upper - basis.lower for basis in self.bases]))

    @cached_property
    def masses(self) -> tuple[Array, ...]:
        """Mass matrices of the shape functions, those of time without the first."""
        return tuple(v.T @ (w[:, None] * v) for v, w in zip(self.tables, self.weights, strict=True))

    def at_points(self, nodal: RankOneSum) -> RankOneSum:
        """Values at the quadrature points from values at the nodes."""
        return nodal.applied(self.tables)

    def constant_in_time(self, start: RankOneSum) -> RankOneSum:
        """Values at the quadrature points of a function of the parameters, given at the nodes."""
        pairs = zip(self.tables[1:], start.factors[1:], strict=True)
        ones = np.ones((self.weights[0].size, start.rank))
        return RankOneSum((ones * start.factors[0], *(table @ f for table, f in pairs)))

    def product(self, term: SourceTerm, states: Sequence[RankOneSum]) -> RankOneSum:
        """One term at the quadrature points, the states given there."""
        if term.monomial:
            monomial = states[term.monomial[0]]
            for state in term.monomial[1:]:
                monomial = monomial.times(states[state])
        else:
            monomial = RankOneSum(tuple(np.ones((count, 1)) for count in self.counts))
        pairs = zip(self.rows, term.rows, strict=True)
        factors = [None if row == 0 else rows[row] for rows, row in pairs]
        return monomial.weighted(factors).scaled(term.coefficient)


@dataclass(frozen=True)
class Equation:
    """The discrete operator D of one unknown, by dimension.

    ``matrices`` (U_j, N_j, N_j) are distinct; ``index`` says which one each term of D takes, and
    ``bandwidth`` how far their entries are from the diagonal. ``tests`` (Q_j, N_j) are the test
    functions at the quadrature points times the weights: one for Galerkin, one for each term of D
    for the minimal residual. ``metrics`` (N_j, N_j) are the inner products in which residuals are
    measured and modes normalised.
    """

    matrices: tuple[Array, ...]
    index: tuple[tuple[int, ...], ...]
    tests: tuple[tuple[Array, ...], ...]
    metrics: tuple[Array, ...]
    bandwidth: tuple[int, ...]

    @property
    def terms(self) -> int:
        return len(self.index[0])

    @property
    def sizes(self) -> tuple[int, ...]:
        """Number of unknowns in each dimension."""
        return tuple(metric.shape[0] for metric in self.metrics)

    @cached_property
    def whitening(self) -> tuple[Array, ...]:
        """For each dimension L^{-1} of the metric L L^T: residuals become Euclidean."""
        return tuple(np.linalg.inv(np.linalg.cholesky(metric)) for metric in self.metrics)

    def loads(self, source: RankOneSum) -> RankOneSum:
        """The source G tested: from values at the quadrature points."""
        terms = zip(*self.tests, strict=True)
        tested = [source.applied([test.T for test in term]) for term in terms]
        return RankOneSum.joined(tested, self.sizes)

    def image(self, nodal: RankOneSum) -> RankOneSum:
        """D(U), of rank terms * rank."""
        factors = []
        for matrices, index, factor in zip(self.matrices, self.index, nodal.factors, strict=True):
            products = matrices @ factor
            factors.append(np.concatenate([products[u] for u in index], axis=1))
        return RankOneSum(tuple(factors))


def assemble(space: ShapeSpace, own: Sequence[SourceTerm], options: GreedyOptions) -> Equation:
    """The operator of one equation.

    ``D(u) = u' - f_own(u)``, or in the Volterra form ``D(u) = u - int f_own(u) dt``, where f_own
    holds the terms of f that are linear in the unknown; those that share their parameter factors
    share one term of D. The options say formulation and projection.
    """
    table = space.tables[0]
    derivative = options.formulation == "derivative"
    one = (0,) * len(space.parameters)
    in_time = {one: space.time.derivatives[:, 1:] if derivative else table}
    for term in own:
        image = term.coefficient * space.rows[0][term.rows[0]][:, None] * table
        image = image if derivative else space.time.integrated(image)
        in_time[term.rows[1:]] = in_time.get(term.rows[1:], 0.0) - image
    applied = [list(in_time.values())]  # for each dimension and term D on the shape functions
    for j, (v, rows) in enumerate(zip(space.tables[1:], space.rows[1:], strict=True)):
        applied.append([rows[key[j]][:, None] * v for key in in_time])
    labels = [list(range(len(in_time))), *([key[j] for key in in_time] for j in range(len(one)))]
    tests: list[tuple[Array, ...]] = []
    matrices: list[Array] = []
    index: list[tuple[int, ...]] = []
    for j, (v, w) in enumerate(zip(space.tables, space.weights, strict=True)):
        if options.projection == "galerkin":
            tests.append((w[:, None] * v,))
            pairs = [(0, i) for i in range(len(in_time))]
            names = [(0, labels[j][i]) for _, i in pairs]
        else:
            tests.append(tuple(w[:, None] * a for a in applied[j]))
            pairs = [(k, i) for k in range(len(in_time)) for i in range(len(in_time))]
            names = [(labels[j][k], labels[j][i]) for k, i in pairs]
        first = dict(zip(reversed(names), reversed(pairs), strict=True))
        distinct = list(dict.fromkeys(names))
        stack = [tests[j][first[name][0]].T @ applied[j][first[name][1]] for name in distinct]
        matrices.append(np.stack(stack))
        index.append(tuple(distinct.index(name) for name in names))
    metrics = list(space.masses)
    if options.projection == "minimal-residual":
        metrics[0] = matrices[0][0]
    bandwidth = tuple(map(_bandwidth, matrices))
    return Equation(tuple(matrices), tuple(index), tuple(tests), tuple(metrics), bandwidth)


def named_matrices(system: System, space: ShapeSpace) -> dict[str, Array]:
    """The slides' matrices on all shape functions, boundary included.

    ``P`` for d/dt, ``M_t`` and ``M_k`` for mass, ``N_k`` (``N_k1``, ``N_k2``, ...) for the known
    factors of the parameter k; with one parameter and one factor it is plain ``N``.
    """
    v, w = space.time.values, space.time.weights[:, None]
    matrices = {"P": v.T @ (w * space.time.derivatives), "M_t": v.T @ (w * v)}
    for i, row in enumerate(space.rows[0][1:], start=1):
        matrices[f"N_t{i}"] = v.T @ (w * row[:, None] * v)
    plain = len(system.parameters) == 1 and len(space.rows[1]) == 2
    for name, table, weights, rows in zip(
        system.parameters, space.tables[1:], space.weights[1:], space.rows[1:], strict=True
    ):
        matrices[f"M_{name}"] = table.T @ (weights[:, None] * table)
        for i, row in enumerate(rows[1:], start=1):
            label = "N" if plain else f"N_{name}" if len(rows) == 2 else f"N_{name}{i}"
            matrices[label] = table.T @ ((weights * row)[:, None] * table)
    return matrices


def _bandwidth(stack: Array) -> int:
    rows, columns = np.nonzero(np.abs(stack).max(axis=0))
    return int(np.abs(rows - columns).max(initial=0))


@dataclass(frozen=True)
class Nodes:
    """Numbers of nodes in time, on one slab, and in each parameter."""

    time: int
    parameters: tuple[int, ...]

    def finer(self, wanted: NDArray[np.bool_], options: GreedyOptions) -> Nodes:
        """More nodes in the dimensions wanted, time first, whose number is not given."""
        time, parameters = self.time, self.parameters
        if wanted[0] and options.time_nodes is None:
            time = _more(time)
        if options.parameter_nodes is None:
            pairs = zip(parameters, wanted[1:], strict=True)
            parameters = tuple(_more(count) if steep else count for count, steep in pairs)
        return Nodes(time, parameters)


def first_nodes(system: System, domain: Domain, rtol: float, options: GreedyOptions) -> Nodes:
    """Nodes to begin with: as given, 41 for finite elements, else by the tolerance.

    Legendre elements have enough nodes for the known functions of each parameter: the factors of
    the terms and of the initial values. Raises OptionError as ``given_parameter_nodes`` does.
    """
    counts = options.given_parameter_nodes(len(domain.box))
    digits = -math.log10(rtol)
    if options.elements != "legendre":
        equal = (GREEDY.finite_element_nodes,) * len(domain.box)
        return Nodes(options.time_nodes or GREEDY.finite_element_nodes, counts or equal)
    time = options.time_nodes or min(max(nodes_for(rtol, 5.6), 6), 24)
    if counts is not None:
        return Nodes(time, counts)
    few = len(domain.box) <= FEW_PARAMETERS
    common = max(round((4.0 if few else 2.0) + 1.2 * digits), 4)
    tolerance = ACCUMULATED if few else 0.01 * rtol
    resolving = [_resolving(system, j, *bounds, tolerance) for j, bounds in enumerate(domain.box)]
    return Nodes(time, tuple(max(common, count) for count in resolving))


def _resolving(system: System, dimension: int, lower: float, upper: float, tolerance: float) -> int:
    """Nodes that resolve the factors of one parameter to a part of the largest of each."""
    fine = LegendreBasis(lower, upper, GREEDY.fine_degree)
    relative = fine.relative_spectrum(system.parameter_factors(dimension, fine.nodes))
    return int(np.flatnonzero(relative > tolerance).max(initial=0)) + 2


def _more(nodes: int) -> int:
    """The next larger number of nodes; odd stays odd, as quadratic elements need."""
    return min(nodes + 2 * max(2, nodes // 6), 2 * GREEDY.fine_degree)
