"""From a problem with fields to the system that solvers read.

In come rates as the user wrote them, of a few lines whatever the number of entries; out go sparse
matrices, vectors, and the text of coefficients and elementwise functions. The work is proportional
to the entries of the matrices.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np
import scipy.sparse as ss
import sympy as sp

from rankone.compiler.codegen.field_source import FieldSource
from rankone.compiler.field_agreement import check_field_agreement
from rankone.compiler.passes.field_shapes import shape_terms
from rankone.compiler.passes.field_terms import (
    FieldTerms,
    Linear,
    Matrix,
    Pointwise,
    Source,
    Term,
    merged,
)
from rankone.problem.field_events import known_field_time
from rankone.problem.field_problem import CheckedFields
from rankone.problem.fields import Field, size_of
from rankone.problem.forms import affine_coefficients
from rankone.problem.user_events import Event
from rankone.support.arrays import Array
from rankone.support.errors import SeparationError, quote
from rankone.tensors.coordinates import name_of
from rankone.trajectories.fields.field_system import (
    FieldEvent,
    FieldSystem,
    LinearTerm,
    PointwiseTerm,
    SourceTerm,
    TermSum,
    Unknown,
)
from rankone.trajectories.system.features import BOTH, FALLING, RISING

_DIRECTIONS = {"rising": RISING, "falling": FALLING, "both": BOTH}


def field_system(problem: CheckedFields, *, check: bool = True) -> FieldSystem:
    """The system of a problem with fields.

    Parameters
    ----------
    problem : FieldProblem
        What :class:`rankone.Problem` makes of equations with fields.
    check : bool
        Whether to compare rates and derivatives with the expressions that the user wrote, at a few
        entries of random states.

    Returns
    -------
    FieldSystem
        Linear terms with one matrix for each coefficient, sources, and elementwise functions.

    Raises
    ------
    SeparationError
        If a matrix is applied to a nonlinear expression inside of a function, or in what crosses
        zero at an event.
    DisagreementError
        If the system does not compute what the user wrote.
    """
    unknowns = _unknowns(problem)
    places = {state: unknown.rows for state, unknown in zip(problem.rates, unknowns, strict=True)}
    splitter = FieldTerms(places)
    terms = merged(
        term for state, rate in problem.rates.items() for term in splitter.of_rate(state, rate)
    )
    resets = [_reset_terms(event, problem, splitter) for event in problem.events]
    source = FieldSource(problem.time[0], tuple(problem.parameters))
    every = [*terms, *(term for reset in resets for term in reset)]
    coefficients = _numbered([sp.S.One, *(term.coefficient for term in every)])
    source.add_coefficients(list(coefficients))
    writer = _Writer(coefficients, splitter, source)
    rates = writer.sum_of(terms)
    initial_vectors = _initial_vectors(problem, places, source)
    events = writer.events(problem, resets)
    parameters = problem.coordinates[1:]
    system = FieldSystem(
        unknowns=unknowns,
        parameters=tuple(parameter.name for parameter in parameters),
        box=tuple((parameter.lower, parameter.upper) for parameter in parameters),
        horizon=problem.time[1:],
        linear=rates.linear,
        sources=rates.sources,
        pointwise=rates.pointwise,
        initial_vectors=initial_vectors,
        source=source.text(),
        mass=_mass(problem, unknowns),
        scales=tuple(parameter.scale for parameter in parameters),
        time=problem.time[0].name,
        events=events,
    )
    if check:
        check_field_agreement(problem, system, places)
    return system


def _unknowns(problem: CheckedFields) -> tuple[Unknown, ...]:
    """The states with their entries in the stacked vector."""
    unknowns: list[Unknown] = []
    first = 0
    for state in problem.rates:
        name, size = name_of(state), size_of(state)
        absolute = (problem.atol or {}).get(name, 0.0)
        unknowns.append(Unknown(name, first, size, isinstance(state, Field), absolute))
        first += size
    return tuple(unknowns)


def _numbered(expressions: Iterable[sp.Expr]) -> dict[sp.Expr, int]:
    return {expression: i for i, expression in enumerate(dict.fromkeys(expressions))}


def _sorted(matrix: Matrix) -> Matrix:
    """A matrix without zeros that are stored, each row in order."""
    matrix = ss.csr_array(matrix)
    matrix.sum_duplicates()
    matrix.eliminate_zeros()
    return matrix


def _reset_terms(event: Event, problem: CheckedFields, splitter: FieldTerms) -> list[Term]:
    """The terms of all states after an event; those that it does not reset stay as they are."""
    if event.then is None:
        return []
    after = {state: event.then.get(state, state) for state in problem.rates}
    return merged(term for state, value in after.items() for term in splitter.of_rate(state, value))


class _Writer:
    """Writes functions of terms into a source, one after the other."""

    def __init__(
        self, coefficients: Mapping[sp.Expr, int], splitter: FieldTerms, source: FieldSource
    ) -> None:
        self._coefficients, self._splitter, self._source = coefficients, splitter, source
        self._count = 0

    def sum_of(self, terms: Sequence[Term]) -> TermSum:
        """Terms with numbers in place of their coefficients."""
        numbers = self._coefficients
        return TermSum(
            linear=tuple(
                LinearTerm(numbers[term.coefficient], _sorted(term.matrix))
                for term in terms
                if isinstance(term, Linear)
            ),
            sources=tuple(
                SourceTerm(numbers[term.coefficient], term.vector)
                for term in terms
                if isinstance(term, Source)
            ),
            pointwise=tuple(
                self._pointwise_term(term) for term in terms if isinstance(term, Pointwise)
            ),
        )

    def _pointwise_term(self, term: Pointwise) -> PointwiseTerm:
        """A function with its arguments; its text is added to the source."""
        name, n = self._named("g"), term.after.shape[1]
        arguments, vectors = self._add_function(name, term.function, n)
        return PointwiseTerm(
            coefficient=self._coefficients[term.coefficient],
            after=_sorted(term.after),
            arguments=arguments,
            vectors=vectors,
            function=name,
        )

    def _named(self, letter: str) -> str:
        self._count += 1
        return f"{letter}{self._count - 1}"

    def _add_function(
        self, name: str, function: sp.Expr, n: int
    ) -> tuple[tuple[Matrix, ...], Array]:
        """Add the text of a function of n entries; its arguments, and its vectors (v, n)."""
        present = function.free_symbols
        named = {s: array for s, array in self._splitter.arguments.items() if s in present}
        vectors = {s: array for s, array in named.items() if isinstance(array, np.ndarray)}
        arguments = {s: array for s, array in named.items() if s not in vectors}
        self._source.add_function(name, function, [*arguments], [*vectors])
        matrices = tuple(_sorted(matrix) for matrix in arguments.values())
        return matrices, np.array([*vectors.values()]).reshape(len(vectors), n)

    def _height(self, event: Event) -> sp.Expr:
        """What crosses zero, as a function of arguments."""
        try:
            return self._splitter.function_of(event.when)
        except SeparationError as error:
            raise SeparationError(
                f"`when` of event {quote(event.name)} has {quote(error.term)}, and events of "
                "fields take functionals that are linear in the fields alone",
                term=error.term,
                remedy="write a function of linear functionals, f(apply(row, u)), or make it a "
                "scalar unknown with a rate of its own",
            ) from None

    def events(
        self, problem: CheckedFields, resets: Sequence[Sequence[Term]]
    ) -> tuple[FieldEvent, ...]:
        """The events; times that are known are added to the source."""
        known: list[sp.Expr] = []
        events = []
        for event, terms in zip(problem.events, resets, strict=True):
            name = self._named("height")
            height = self._height(event)
            arguments, vectors = self._add_function(name, height, 1)
            at = known_field_time(event, problem.time[0])
            known += [] if at is None else [at]
            parameters = tuple(problem.parameters)
            events.append(
                FieldEvent(
                    name=str(event.name),
                    direction=_DIRECTIONS[event.direction],
                    terminal=event.terminal,
                    height=name,
                    arguments=arguments,
                    vectors=vectors,
                    after=None if event.then is None else self.sum_of(terms),
                    known=None if at is None else len(known) - 1,
                    coefficients=None if at is None else affine_coefficients(at, parameters),
                )
            )
        if known:
            self._source.add_known_times(known)
        return tuple(events)


def _initial_vectors(
    problem: CheckedFields, places: Mapping[sp.Expr, slice], source: FieldSource
) -> Array:
    """Vectors (N, v) of the initial values; the text of their coefficients is added."""
    size = max(rows.stop for rows in places.values())
    splitter = FieldTerms(places)
    columns: dict[sp.Expr, Array] = {sp.S.One: np.zeros(size)}
    for state, start in problem.initial.items():
        for term in splitter.of(start, size_of(state)):
            for coefficient, vector in _products(term, splitter, problem, state):
                column = columns.setdefault(coefficient, np.zeros(size))
                column[places[state]] += vector
    if not np.any(columns[sp.S.One]) and len(columns) > 1:
        del columns[sp.S.One]
    source.add_initial_coefficients(list(columns))
    return np.stack([*columns.values()], axis=1)


def _products(
    term: Term, splitter: FieldTerms, problem: CheckedFields, state: sp.Expr
) -> Sequence[tuple[sp.Expr, Array]]:
    """An initial value as functions of parameters and the vectors that they multiply."""
    if isinstance(term, Source):
        return [(term.coefficient, term.vector)]
    if isinstance(term, Pointwise):
        present = term.function.free_symbols
        vectors = {s: np.asarray(a) for s, a in splitter.arguments.items() if s in present}
        shapes = shape_terms(term.function, vectors, problem.coordinates[1:])
        if shapes is not None:
            return [(term.coefficient * f, term.after @ vector) for f, vector in shapes]
    raise SeparationError(
        f"the initial value of {quote(state)} is no sum of arrays times functions of parameters",
        term=problem.initial[state],
        remedy="a parameter moves or sharpens it too much: narrow the interval of that parameter, "
        "or make the shape wider",
    )


def _mass(problem: CheckedFields, unknowns: Iterable[Unknown]) -> Matrix | None:
    """The mass matrix of all states; None if it is one."""
    if not problem.masses:
        return None
    blocks = [
        problem.masses[state].matrix if state in problem.masses else ss.eye_array(unknown.size)
        for state, unknown in zip(problem.rates, unknowns, strict=True)
    ]
    return _sorted(ss.block_diag(blocks, format="csr"))
