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
from rankone.problem.field_problem import CheckedFields
from rankone.problem.fields import Field, size_of
from rankone.support.arrays import Array
from rankone.support.errors import SeparationError, quote
from rankone.tensors.coordinates import name_of
from rankone.trajectories.fields.field_system import (
    FieldSystem,
    LinearTerm,
    PointwiseTerm,
    SourceTerm,
    Unknown,
)


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
        If a matrix is applied to a nonlinear expression inside of a function.
    DisagreementError
        If the system does not compute what the user wrote.
    """
    unknowns = _unknowns(problem)
    places = {state: unknown.rows for state, unknown in zip(problem.rates, unknowns, strict=True)}
    splitter = FieldTerms(places)
    terms = merged(
        term for state, rate in problem.rates.items() for term in splitter.of_rate(state, rate)
    )
    source = FieldSource(problem.time[0], tuple(problem.parameters))
    coefficients = _numbered([sp.S.One, *(term.coefficient for term in terms)])
    source.add_coefficients(list(coefficients))
    pointwise = [term for term in terms if isinstance(term, Pointwise)]
    functions = tuple(
        _pointwise_term(f"g{i}", term, coefficients, splitter, source)
        for i, term in enumerate(pointwise)
    )
    initial_vectors = _initial_vectors(problem, places, source)
    parameters = problem.coordinates[1:]
    system = FieldSystem(
        unknowns=unknowns,
        parameters=tuple(parameter.name for parameter in parameters),
        box=tuple((parameter.lower, parameter.upper) for parameter in parameters),
        horizon=problem.time[1:],
        linear=tuple(
            LinearTerm(coefficients[term.coefficient], _sorted(term.matrix))
            for term in terms
            if isinstance(term, Linear)
        ),
        sources=tuple(
            SourceTerm(coefficients[term.coefficient], term.vector)
            for term in terms
            if isinstance(term, Source)
        ),
        pointwise=functions,
        initial_vectors=initial_vectors,
        source=source.text(),
        mass=_mass(problem, unknowns),
        scales=tuple(parameter.scale for parameter in parameters),
        time=problem.time[0].name,
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


def _pointwise_term(
    name: str,
    term: Pointwise,
    coefficients: Mapping[sp.Expr, int],
    splitter: FieldTerms,
    source: FieldSource,
) -> PointwiseTerm:
    """A function with its arguments; its text is added to the source."""
    present = term.function.free_symbols
    named = {s: array for s, array in splitter.arguments.items() if s in present}
    vectors = {s: array for s, array in named.items() if isinstance(array, np.ndarray)}
    arguments = {s: array for s, array in named.items() if s not in vectors}
    source.add_function(name, term.function, [*arguments], [*vectors])
    n = term.after.shape[1]
    return PointwiseTerm(
        coefficient=coefficients[term.coefficient],
        after=_sorted(term.after),
        arguments=tuple(_sorted(matrix) for matrix in arguments.values()),
        vectors=np.array([*vectors.values()]).reshape(len(vectors), n),
        function=name,
    )


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
