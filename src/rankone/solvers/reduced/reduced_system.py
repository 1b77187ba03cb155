"""The system of the coefficients of fields: a Galerkin projection, dense and small.

With u = V a it is V'MV a' = V' f(t, V a, p). All that does not depend on coefficients, time and
parameters is multiplied beforehand; elementwise functions are interpolated.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TypeVar

import numpy as np

from rankone.solvers.outcome import Role, SolutionMetadata
from rankone.solvers.reduced.field_bases import Interpolation
from rankone.solvers.reduced.field_modes import FieldModes
from rankone.solvers.reduced.reduced_events import ReducedEvents
from rankone.support import __version__
from rankone.support.arrays import Array
from rankone.support.costs import CALL
from rankone.trajectories.fields.field_system import Elementwise, FieldSystem, PointwiseTerm
from rankone.trajectories.system.features import VectorLike
from rankone.trajectories.system.system import System, UserFunction, system_of

Answer = TypeVar("Answer")


@dataclass(frozen=True, eq=False)
class ReducedTerm:
    """A pointwise term of coefficients: ``coefficient * after @ g(t, arguments @ a, vectors, p)``.

    ``after`` is (R, k) and ``arguments`` (arguments, k, R), for k entries.
    """

    coefficient: int
    after: Array
    arguments: Array
    vectors: Array
    function: str


@dataclass(frozen=True, eq=False)
class ReducedSystem:
    """The rates of R coefficients; it is what a :class:`System` is loaded from, in any process.

    ``linear`` (c, R, R) and ``sources`` (c, R) belong to the numbers of the ``fields``, those of
    their coefficients that have such terms: ``linear_numbers``, ``source_numbers``. ``start``
    (R, v) times the initial numbers are the initial values. ``scales`` (R,) are what errors of
    the coefficients are relative to: together they are then relative to the sizes of the fields, in
    the root mean square over entries. Its ``events`` are those of the fields.
    """

    names: tuple[str, ...]
    coefficients: FieldSystem
    linear_numbers: tuple[int, ...]
    linear: Array
    source_numbers: tuple[int, ...]
    sources: Array
    pointwise: tuple[ReducedTerm, ...]
    start: Array
    scales: Array
    rtol: float
    events: ReducedEvents

    @property
    def absolute(self) -> tuple[tuple[str, float], ...]:
        """The tolerances of the coefficients by name."""
        return tuple(zip(self.names, (self.rtol * self.scales).tolist(), strict=True))

    @property
    def metadata(self) -> SolutionMetadata:
        """What a solution of the coefficients says was asked."""
        fields = self.coefficients
        return SolutionMetadata(
            states=self.names,
            roles=(Role.UNKNOWN,) * len(self.names),
            parameters=fields.parameters,
            box=fields.box,
            time=fields.time,
            horizon=fields.horizon,
            rtol=self.rtol,
            method="cross",
            version=__version__,
            atol=self.absolute,
        )

    @property
    def namespace(self) -> Mapping[str, UserFunction]:
        """The functions of the user that the system calls."""
        return {k: v for k, v in self.coefficients.namespace.items() if callable(v)}

    def call(self, function: Callable[..., Answer], *arguments: object) -> Answer:
        """``function(system, *arguments)``, in any process."""
        return function(self.system, *arguments)

    def __getstate__(self) -> dict[str, object]:
        return {name: value for name, value in self.__dict__.items() if name != "system"}

    @cached_property
    def system(self) -> System:
        """The system that engines solve."""
        fields = self.coefficients
        system = system_of(
            {
                "SEPARATED": False,
                "STATES": self.names,
                "N_DIFFERENTIAL": len(self.names),
                "PRODUCTS": (),
                "PARAMETERS": fields.parameters,
                "TIME": fields.horizon,
                "BOX": fields.box,
                "SCALES": fields.scales,
                "ATOL": self.absolute,
                "time_factors": _one,
                "parameter_factors": lambda j, p: _one(p),
                "rhs": self.rates,
                "jacobian": self.jacobian,
                "with_products": lambda u: np.array(u, dtype=float),
                "unseparated_initial": self.initial,
                **self.events.members(),
                "at_point": self.at,
                "LONGEST_STEP": fields.longest_step,
            }
        )
        object.__setattr__(system, "specification", self)
        return system

    def initial(self, p: VectorLike) -> Array:
        """Initial coefficients at p (d, ...): (R, ...)."""
        points = np.asarray(p, dtype=float)
        numbers = self.coefficients.initial_coefficients(points)
        return np.tensordot(self.start, numbers, axes=1)

    def rates(self, t: float | Array, u: VectorLike, p: VectorLike) -> Array:
        """The derivatives of the coefficients at u (R, ...)."""
        shape, times, states, points = _columns(t, u, p)
        c = self.coefficients.coefficients(times, points)
        return self._rates(c, times, states, points).reshape(-1, *shape)

    def _rates(self, c: Array, t: Array, a: Array, p: Array) -> Array:
        total = np.zeros_like(a)
        if len(self.linear):
            each = (self.linear.reshape(-1, len(a)) @ a).reshape(-1, *a.shape)
            total += np.einsum("cm,crm->rm", c[list(self.linear_numbers)], each)
        if len(self.sources):
            total += self.sources.T @ c[list(self.source_numbers)]
        for term in self.pointwise:
            total += term.after @ (c[term.coefficient] * self.values(term, t, a, p))
        return total

    def values(self, term: ReducedTerm, t: Array, a: Array, p: Array) -> Array:
        """g of a term at its entries (k, m), at times (m,), a (R, m) and p (d, m)."""
        return self.coefficients.elementwise(term.function)(t, _arguments(term, a), p)

    def jacobian(self, t: float | Array, u: VectorLike, p: VectorLike) -> Array:
        """The derivatives (R, R, ...) of the rates by the coefficients."""
        shape, times, states, points = _columns(t, u, p)
        c = self.coefficients.coefficients(times, points)
        r = len(states)
        total = np.zeros((r * r, states.shape[1]))
        if len(self.linear):
            total += self.linear.reshape(-1, r * r).T @ c[list(self.linear_numbers)]
        for term, products in zip(self.pointwise, self._products, strict=True):
            name = f"{term.function}_slopes"
            slopes = self.coefficients.elementwise(name)(times, _arguments(term, states), points)
            for slope, product in zip(slopes, products, strict=True):
                total += product @ (c[term.coefficient] * slope)
        return total.reshape(r, r, *shape)

    def at(self, p: Array) -> ReducedRates:
        """The rates at parameters (d,)."""
        return ReducedRates(self, p)

    @cached_property
    def _products(self) -> list[list[Array]]:
        """For each argument of each term the matrices (R R, k) that slopes are multiplied with."""
        return [
            [
                (term.after[:, None, :] * argument.T[None]).reshape(-1, term.after.shape[1])
                for argument in term.arguments
            ]
            for term in self.pointwise
        ]


class ReducedRates:
    """The rates at parameters (d,): what does not depend on time is added up once.

    Fulfils :class:`~rankone.trajectories.system.system.PointRates`.
    """

    def __init__(self, reduced: ReducedSystem, p: Array) -> None:
        fields = reduced.coefficients
        self._fields, self._p, timed = fields, p, fields.timed
        self._timed = bool(timed)
        self._numbers = fields.coefficients(fields.horizon[0], p)
        linear = list(zip(reduced.linear_numbers, reduced.linear, strict=True))
        sources = list(zip(reduced.source_numbers, reduced.sources, strict=True))
        r = len(reduced.names)
        self._matrix, self._source = np.zeros((r, r)), np.zeros(r)
        for number, matrix in linear:
            if number not in timed:
                self._matrix += self._numbers[number] * matrix
        for number, vector in sources:
            if number not in timed:
                self._source += self._numbers[number] * vector
        self._moving_linear = [pair for pair in linear if pair[0] in timed]
        self._moving_sources = [pair for pair in sources if pair[0] in timed]
        self._terms = [_PointTerm.of(term, fields) for term in reduced.pointwise]

    @property
    def cost(self) -> float:
        """Operations of a call."""
        calls = 3 + len(self._moving_linear) + len(self._moving_sources) + 6 * len(self._terms)
        entries = (1 + len(self._moving_linear)) * self._matrix.size
        entries += sum(term.arguments.size + term.after.size for term in self._terms)
        return calls * CALL + 0.5 * entries

    def rates(self, t: float, a: Array) -> Array:
        """The derivatives (R,) of the coefficients a (R,)."""
        c = self._at(t)
        total = self._matrix @ a
        total += self._source
        for number, matrix in self._moving_linear:
            total += c[number] * (matrix @ a)
        for number, vector in self._moving_sources:
            total += c[number] * vector
        for term in self._terms:
            total += term.after @ (c[term.coefficient] * term.function(t, term.at(a), self._p))
        return total

    def jacobian(self, t: float, a: Array) -> Array:
        """The derivatives (R, R) of the rates by the coefficients."""
        c, total = self._at(t), self._matrix.copy()
        for number, matrix in self._moving_linear:
            total += c[number] * matrix
        for term in self._terms:
            if not len(term.matrices):
                continue
            slopes = c[term.coefficient] * term.slopes(t, term.at(a), self._p)
            inner = np.einsum("km,kmr->mr", slopes, term.matrices)
            total += term.after @ inner
        return total

    def _at(self, t: float) -> Array:
        return self._fields.coefficients(t, self._p) if self._timed else self._numbers


@dataclass(frozen=True, eq=False)
class _PointTerm:
    """A pointwise term as one trajectory needs it: ``arguments`` (arguments k, R) are stacked."""

    coefficient: int
    after: Array
    arguments: Array
    matrices: Array
    vectors: tuple[Array, ...]
    function: Elementwise
    slopes: Elementwise

    @staticmethod
    def of(term: ReducedTerm, fields: FieldSystem) -> _PointTerm:
        return _PointTerm(
            term.coefficient,
            np.ascontiguousarray(term.after),
            term.arguments.reshape(-1, term.arguments.shape[-1]),
            term.arguments,
            tuple(term.vectors),
            fields.elementwise(term.function),
            fields.elementwise(f"{term.function}_slopes"),
        )

    def at(self, a: Array) -> list[Array]:
        """The arguments of the function at coefficients (R,)."""
        values = (self.arguments @ a).reshape(self.matrices.shape[:2])
        return [*values, *self.vectors]


def reduced_system(
    fields: FieldSystem,
    modes: FieldModes,
    interpolations: Sequence[Interpolation],
    rtol: float,
) -> ReducedSystem:
    """The system of the coefficients, whose errors are relative to the sizes of the fields."""
    spread = spread_modes(modes)
    sizes = [unknown.size for unknown in modes.unknowns]
    tests = spread.T / np.repeat(sizes, modes.counts)[:, None]  # of means over entries
    mass = tests @ (spread if fields.mass is None else fields.mass @ spread)

    def solved(right: Array) -> Array:
        return np.asarray(np.linalg.solve(mass, tests @ right))

    linear = [solved(term.matrix @ spread) for term in fields.linear]
    sources = [solved(term.vector[:, None])[:, 0] for term in fields.sources]
    pointwise = [
        _reduced_term(term, interpolation, spread, solved)
        for term, interpolation in zip(fields.pointwise, interpolations, strict=True)
    ]
    start = tests @ fields.initial_vectors  # the projection is that of the modes, not of the mass
    r = len(modes.names)
    return ReducedSystem(
        names=modes.names,
        coefficients=fields,
        linear_numbers=tuple(term.coefficient for term in fields.linear),
        linear=np.array(linear).reshape(-1, r, r),
        source_numbers=tuple(term.coefficient for term in fields.sources),
        sources=np.array(sources).reshape(-1, r),
        pointwise=tuple(pointwise),
        start=start,
        scales=np.repeat(np.divide(modes.scales, np.sqrt(modes.counts)), modes.counts),
        rtol=rtol,
        events=ReducedEvents.of(fields, spread, tests),
    )


def spread_modes(modes: FieldModes) -> Array:
    """The modes of all unknowns as one matrix (N, R)."""
    spread = np.zeros((sum(unknown.size for unknown in modes.unknowns), len(modes.names)))
    for k, (unknown, block) in enumerate(zip(modes.unknowns, modes.modes, strict=True)):
        spread[unknown.rows, modes.coefficients_of(k)] = block
    return spread


def _reduced_term(
    term: PointwiseTerm,
    interpolation: Interpolation,
    spread: Array,
    solved: Callable[[Array], Array],
) -> ReducedTerm:
    entries = interpolation.entries
    arguments = [matrix[entries] @ spread for matrix in term.arguments]
    return ReducedTerm(
        coefficient=term.coefficient,
        after=solved(term.after @ interpolation.modes) @ interpolation.weights,
        arguments=np.array(arguments).reshape(-1, len(entries), spread.shape[1]),
        vectors=term.vectors[:, entries],
        function=term.function,
    )


def _arguments(term: ReducedTerm, a: Array) -> list[Array]:
    """The arguments of a function at coefficients (R, m): (k, m) each."""
    return [*(argument @ a for argument in term.arguments), *term.vectors[:, :, None]]


def _columns(
    t: float | Array, u: VectorLike, p: VectorLike
) -> tuple[tuple[int, ...], Array, Array, Array]:
    """The shape of t (...), u (R, ...) and p (d, ...) together, and these as columns."""
    states, points = np.asarray(u, dtype=float), np.asarray(p, dtype=float)
    shape = np.broadcast_shapes(np.shape(t), states.shape[1:], points.shape[1:])
    times = np.broadcast_to(t, shape).ravel()
    states = np.broadcast_to(states, (len(states), *shape)).reshape(len(states), -1)
    points = np.broadcast_to(points, (len(points), *shape)).reshape(len(points), times.size)
    return shape, times, states, points


def _one(points: Array) -> Array:
    return np.ones((1, len(points)))
