"""A system of fields as solvers see it: sparse operators and elementwise functions.

The unknowns are vectors, stacked to ``u`` (N,). With a mass matrix M, which is one where it is left
out,

    M u' = sum_k c_k(t, p) (K_k u + b_k) + sum_l c_l(t, p) A_l g_l(t, E_l1 u, E_l2 u, ..., v_l, p),

where the coefficients c are numbers, K, A and E sparse matrices, b and v vectors, and g functions
that are taken elementwise. Nothing here needs SymPy: coefficients and functions are text.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import TypeAlias, cast

import numpy as np
import scipy.sparse as ss

from rankone.support.arrays import Array
from rankone.support.errors import OptionError
from rankone.tensors.coordinates import LINEAR

Matrix: TypeAlias = "ss.csr_array"
Coefficients: TypeAlias = Callable[["float | Array", Array], Array]
"""Numbers (c, ...) at t (...) and p (d, ...)."""
Elementwise: TypeAlias = Callable[["float | Array", "list[Array]", Array], Array]
"""Values (n, ...) at t (...), arguments (n, ...) each, and p (d, ...)."""


@dataclass(frozen=True)
class Unknown:
    """A field, or a scalar unknown beside fields: its entries in the stacked vector.

    ``absolute`` over the relative tolerance adds to the size that errors of it are relative to.
    """

    name: str
    first: int
    size: int
    is_field: bool = True
    absolute: float = 0.0

    @property
    def rows(self) -> slice:
        """Its entries."""
        return slice(self.first, self.first + self.size)


@dataclass(frozen=True, eq=False)
class LinearTerm:
    """``coefficient * matrix @ u``: the number of the coefficient, and a matrix (N, N)."""

    coefficient: int
    matrix: Matrix


@dataclass(frozen=True, eq=False)
class SourceTerm:
    """``coefficient * vector``: the number of the coefficient, and a vector (N,)."""

    coefficient: int
    vector: Array


@dataclass(frozen=True, eq=False)
class PointwiseTerm:
    """``coefficient * after @ g(t, E_1 u, ..., E_k u, v_1, ..., p)``.

    ``function`` is the name of g, whose arguments are those of ``arguments``, matrices (n, N), and
    then the ``vectors`` (v, n); ``after`` is (N, n). The function ``{name}_slopes`` has the
    derivatives of g by the first k arguments, (k, n, ...).
    """

    coefficient: int
    after: Matrix
    arguments: tuple[Matrix, ...]
    vectors: Array
    function: str


@dataclass(frozen=True, eq=False)
class TermSum:
    """A function of t, u and p with values (N,): a sum of terms."""

    linear: tuple[LinearTerm, ...] = ()
    sources: tuple[SourceTerm, ...] = ()
    pointwise: tuple[PointwiseTerm, ...] = ()


@dataclass(frozen=True, eq=False)
class FieldEvent:
    """A root of one number, where fields are reset or trajectories end.

    The number is ``height(t, [E_1 u, ..., v_1, ...], p)``, the name of a function, with
    ``arguments`` E (1, N) and ``vectors`` v (k, 1). ``direction`` is 1 where it rises, -1 where
    it falls, 0 for both. ``after`` gives all unknowns after it, if it resets any. ``known`` is its
    row in ``known_times`` of the system, for events at times of the parameters alone;
    ``coefficients`` are the constant and slopes of those that are affine.
    """

    name: str
    direction: int
    terminal: bool
    height: str
    arguments: tuple[Matrix, ...]
    vectors: Array
    after: TermSum | None = None
    known: int | None = None
    coefficients: tuple[float, ...] | None = None

    @property
    def jumps(self) -> bool:
        """Whether fields jump there, or end."""
        return self.terminal or self.after is not None


@dataclass(frozen=True, eq=False)
class FieldSystem:
    """Vectors of unknowns, their rates, and events that reset them.

    No step is longer than ``longest_step``.

    The ``source`` is a module that defines ``coefficients(t, p)``, of which those numbered in
    ``TIMED`` depend on time, the functions of the pointwise terms, and ``initial_coefficients(p)``:
    the initial values are ``initial_vectors`` (N, v) times these numbers (v, ...). ``namespace``
    has functions of the user that it calls. ``scales`` are those of the parameters, words of
    :data:`~rankone.tensors.coordinates.SCALES`.
    """

    unknowns: tuple[Unknown, ...]
    parameters: tuple[str, ...]
    box: tuple[tuple[float, float], ...]
    horizon: tuple[float, float]
    linear: tuple[LinearTerm, ...]
    sources: tuple[SourceTerm, ...]
    pointwise: tuple[PointwiseTerm, ...]
    initial_vectors: Array
    source: str
    mass: Matrix | None = None
    scales: tuple[str, ...] = ()
    time: str = "t"
    events: tuple[FieldEvent, ...] = ()
    longest_step: float = math.inf
    namespace: Mapping[str, object] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not self.scales:
            object.__setattr__(self, "scales", (LINEAR,) * len(self.box))

    def __getstate__(self) -> dict[str, object]:
        derived = ("_functions", "_union", "velocities")
        return {name: value for name, value in self.__dict__.items() if name not in derived}

    @property
    def user_functions(self) -> frozenset[str]:
        """Names of the functions of the user that the system calls."""
        return frozenset(self.namespace)

    @property
    def size(self) -> int:
        """Number of all entries, N."""
        return sum(unknown.size for unknown in self.unknowns)

    @cached_property
    def _functions(self) -> Mapping[str, object]:
        names: dict[str, object] = {"__name__": "fields", **self.namespace}
        exec(compile(self.source, "<rankone fields>", "exec"), names)
        for name in ("coefficients", "TIMED"):
            if name not in names:
                raise OptionError(f"the module of a system of fields defines no {name}")
        return names

    def coefficients(self, t: float | Array, p: Array) -> Array:
        """The numbers of all terms at t (...) and p (d, ...): shape (c, ...)."""
        return cast(Coefficients, self._functions["coefficients"])(t, p)

    @property
    def timed(self) -> frozenset[int]:
        """The coefficients that depend on time."""
        return frozenset(cast(tuple[int, ...], self._functions["TIMED"]))

    def elementwise(self, name: str) -> Elementwise:
        """A function of pointwise terms."""
        return cast(Elementwise, self._functions[name])

    def initial(self, p: Array) -> Array:
        """Initial values (N,) at p (d,)."""
        return np.asarray(self.initial_vectors @ self.initial_coefficients(p))

    def initial_coefficients(self, p: Array) -> Array:
        """The numbers of the initial vectors at p (d, ...): (v, ...)."""
        return cast(Callable[[Array], Array], self._functions["initial_coefficients"])(p)

    def values(self, term: PointwiseTerm, t: float | Array, u: Array, p: Array) -> Array:
        """g of a term at u (N,) or (N, T), t (T,) and p (d,)."""
        return self.elementwise(term.function)(t, self._arguments(term, u), p)

    def slopes(self, term: PointwiseTerm, t: float | Array, u: Array, p: Array) -> Array:
        """The derivatives of g of a term by each of its arguments: (k, n, ...)."""
        return self.elementwise(f"{term.function}_slopes")(t, self._arguments(term, u), p)

    def _arguments(self, term: PointwiseTerm, u: Array) -> list[Array]:
        vectors = term.vectors if u.ndim == 1 else term.vectors[:, :, None]
        return [*(matrix @ u for matrix in term.arguments), *vectors]

    def mapped(self, terms: TermSum, t: float | Array, u: Array, p: Array) -> Array:
        """A sum of terms at t, u (N,) and p (d,), or t (m,), u (N, m) and p (d, m)."""
        c, total = self.coefficients(t, p), np.zeros_like(u)
        for linear in terms.linear:
            total += c[linear.coefficient] * (linear.matrix @ u)
        for source in terms.sources:
            total += c[source.coefficient] * (
                source.vector if u.ndim == 1 else source.vector[:, None]
            )
        for term in terms.pointwise:
            values = np.broadcast_to(
                self.values(term, t, u, p), (term.after.shape[1], *u.shape[1:])
            )
            total += c[term.coefficient] * (term.after @ values)
        return total

    def height(
        self, event: FieldEvent, t: float | Array, arguments: list[Array], p: Array
    ) -> Array:
        """What crosses zero at t (m,), for arguments (m,) each and p (d, m): (m,)."""
        vectors = [np.broadcast_to(vector, np.shape(t)) for vector in event.vectors]
        heights = self.elementwise(event.height)(t, [*arguments, *vectors], p)
        return np.array(np.broadcast_to(heights, np.shape(t)), dtype=float)

    def known_times(self, p: Array) -> Array:
        """Times of the events at known times, at p (d, ...): (events, ...)."""
        return cast(Callable[[Array], Array], self._functions["known_times"])(p)

    def at(self, p: Array) -> FieldRates:
        """Rates and Jacobians at parameters (d,)."""
        return FieldRates(self, p)

    @cached_property
    def _union(self) -> tuple[Matrix, Array]:
        """The pattern of all linear terms, and their entries in it (terms, entries)."""
        n = self.size
        pattern = ss.csr_array((n, n))
        for term in self.linear:
            pattern = pattern + abs(term.matrix)
        pattern.sort_indices()
        pattern.data = np.arange(1.0, pattern.nnz + 1.0)
        entries = np.zeros((len(self.linear), pattern.nnz))
        for row, term in zip(entries, self.linear, strict=True):
            mask = term.matrix.astype(bool).astype(float)
            places = (pattern * mask).tocoo()
            matrix = term.matrix.tocoo()
            order = np.lexsort((places.col, places.row))
            own = np.lexsort((matrix.col, matrix.row))
            row[places.data[order].astype(np.intp) - 1] = matrix.data[own]
        return pattern, entries

    @cached_property
    def velocities(self) -> Mapping[int, int]:
        """Numbers of positions u, each with that of its velocity v: u' = c(t, p) v."""
        pairs: dict[int, int] = {}
        for k, unknown in enumerate(self.unknowns):
            for j, other in enumerate(self.unknowns):
                free = j != k and j not in pairs and k not in pairs.values()
                if free and other.size == unknown.size and self._is_velocity(other, unknown):
                    pairs[k] = j
                    break
        return pairs

    def _is_velocity(self, velocity: Unknown, position: Unknown) -> bool:
        """Whether the rate of a position is a velocity times numbers, and no mass is before it."""
        rows, size = position.rows, position.size
        others = [source.vector[rows].any() for source in self.sources]
        others += [term.after[rows].nnz > 0 for term in self.pointwise]
        matrices = [term.matrix[rows] for term in self.linear]
        matrices = [matrix for matrix in matrices if matrix.nnz]
        if any(others) or not matrices:
            return False
        if self.mass is not None:
            one = ss.eye_array(size, self.size, k=rows.start)
            if (self.mass[rows] != one).nnz or (self.mass[:, rows] != one.T).nnz:
                return False
        columns = np.arange(velocity.rows.start, velocity.rows.stop)
        return all(
            matrix.nnz == size
            and np.array_equal(matrix.indptr, np.arange(size + 1))
            and np.array_equal(matrix.indices, columns)
            and bool((matrix.data == matrix.data[0]).all())
            for matrix in matrices
        )

    def matrix(self, numbers: Array) -> Matrix:
        """The sum of all linear terms, each times a number."""
        pattern, entries = self._union
        return ss.csr_array(
            (numbers @ entries, pattern.indices, pattern.indptr), shape=pattern.shape
        )


class FieldRates:
    """M u' and its derivatives at parameters (d,).

    The sum of linear terms is kept as long as their numbers are the same.
    """

    def __init__(self, system: FieldSystem, p: Array) -> None:
        self._system, self._p = system, p
        self._linear = [term.coefficient for term in system.linear]
        self._numbers: Array | None = None
        self._matrix = ss.csr_array((0, 0))

    def force(self, t: float, u: Array) -> Array:
        """M u' at u (N,)."""
        system, c = self._system, self._system.coefficients(t, self._p)
        total = self._linear_part(c) @ u
        for source in system.sources:
            total += c[source.coefficient] * source.vector
        for term in system.pointwise:
            values = system.values(term, t, u, self._p)
            total += c[term.coefficient] * (term.after @ values)
        return np.asarray(total)

    def jacobian(self, t: float, u: Array) -> ss.csc_array:
        """The derivatives (N, N) of the same by u."""
        system, c = self._system, self._system.coefficients(t, self._p)
        total = self._linear_part(c)
        for term in system.pointwise:
            for matrix, slope in zip(
                term.arguments, system.slopes(term, t, u, self._p), strict=True
            ):
                scaled = ss.diags_array(c[term.coefficient] * slope) @ matrix
                total = total + term.after @ scaled
        return ss.csc_array(total)

    def _linear_part(self, c: Array) -> Matrix:
        numbers = c[self._linear]
        if self._numbers is None or not np.array_equal(numbers, self._numbers):
            self._numbers, self._matrix = numbers, self._system.matrix(numbers)
        return self._matrix
