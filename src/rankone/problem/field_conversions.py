"""Matrices as problems with one field, and problems with fields entry by entry."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import scipy.sparse
import sympy as sp
from sympy.core.function import AppliedUndef

from rankone.problem.algebra.matrices import Addends, addends_of
from rankone.problem.expressions.conditions import rate_of, unknown_of
from rankone.problem.expressions.notation import exact
from rankone.problem.field_problem import CheckedFields
from rankone.problem.field_rates import State
from rankone.problem.fields import Apply, Field, Operator, Vector, apply, constant_of, size_of
from rankone.problem.user_events import Event
from rankone.support.arrays import Array
from rankone.support.errors import ProblemError, count, quote, shown
from rankone.tensors.coordinates import name_of

_MOST_COUPLED = 200  # Entries of a mass matrix whose inverse is written out
_MOST_ENTRIES = 2000  # Of fields that are written entry by entry: seconds of SymPy
_ORDERS = {"M": 2, "C": 1, "K": 0}


# -- matrices as fields ------------------------------------------------------------------------


def field_of_matrices(
    matrices: Mapping[str, object],
    force: object,
    time: sp.Symbol,
    initial: object,
    name: object,
) -> dict[str, Any]:
    """Equations, initial values and mass of ``M q'' + C q' + K q = force`` for one field.

    A ProblemError if matrices do not fit each other, or are not of numbers.
    """
    if not isinstance(name, str):
        raise ProblemError(
            f"names are {shown(name)}", term=name, remedy='with fields=True give one name, "q"'
        )
    terms = {
        _ORDERS[key]: (key, _of_numbers(addends_of(matrix, f"the matrix {key}"), key))
        for key, matrix in matrices.items()
        if matrix is not None
    }
    if not terms or max(terms) == 0:
        raise ProblemError("neither M nor C is given", remedy="give M, or C for first order")
    order = max(terms)
    size = terms[order][1][0][1].shape[0]
    for key, addends in terms.values():
        for _, array in addends:
            if array.shape != (size, size):
                raise ProblemError(
                    f"the matrix {key} is {' x '.join(map(str, array.shape))}",
                    term=key,
                    remedy=f"give {size} x {size} entries",
                )
    q = Field(name, size)
    rate = _force(force, size)
    for lower, (_, addends) in terms.items():
        if lower < order:
            state = q.diff(time) if lower else q
            rate -= sp.Add(*(coefficient * apply(array, state) for coefficient, array in addends))
    mass = _total(terms[order][1], terms[order][0])
    arguments: dict[str, Any] = {"initial": _initial_of(initial, q, time, order)}
    diagonal = mass.diagonal()
    if abs(mass - scipy.sparse.diags_array(diagonal)).sum() == 0.0 and diagonal.all():
        rate = rate if (diagonal == 1.0).all() else apply(1.0 / diagonal, rate)
    else:
        arguments["mass"] = {q: mass}
    return {**arguments, "equations": [sp.Eq(q.diff(time, order), rate, evaluate=False)]}


def _of_numbers(addends: Addends, key: str) -> Addends:
    """Coefficients and matrices of numbers."""
    numbers: Addends = []
    for coefficient, array in addends:
        if isinstance(array, sp.MatrixBase):
            if array.free_symbols or array.atoms(AppliedUndef):
                raise ProblemError(
                    f"{key} has entries that are not numbers",
                    term=array,
                    remedy="give sums of coefficients times matrices of numbers, {k: K1}",
                )
            array = np.array(array.tolist(), dtype=float)
        numbers.append((coefficient, array))
    return numbers


def _total(addends: Addends, key: str) -> scipy.sparse.csr_array:
    """The mass matrix."""
    total = 0.0
    for coefficient, array in addends:
        if not coefficient.is_number:
            raise ProblemError(
                f"the matrix {key} of the highest derivatives has the coefficient "
                f"{quote(coefficient)}",
                term=coefficient,
                remedy="mass matrices of fields are of numbers: divide by the coefficient",
            )
        total = total + scipy.sparse.csr_array(array) * float(coefficient)
    return scipy.sparse.csr_array(total)


def _force(written: object, size: int) -> sp.Expr:
    """The right-hand side."""
    if written is None:
        return sp.S.Zero
    addends = _of_numbers(addends_of(written, "the force"), "the force")
    for _, array in addends:
        if array.shape not in ((size,), (size, 1)):
            raise ProblemError(
                f"the force has the shape {tuple(array.shape)}",
                term=written,
                remedy=f"give {count(size, 'entry', 'entries')}",
            )
    columns = ((c, a if isinstance(a, np.ndarray) else a.toarray()) for c, a in addends)
    return sp.Add(*(c * constant_of(column.reshape(size), "the force") for c, column in columns))


def _initial_of(written: object, q: Field, time: sp.Symbol, order: int) -> dict[sp.Expr, Any]:
    """Initial values of a field, and of its velocity: an array, a pair of arrays, or a mapping."""
    states = [q, q.diff(time)][:order]
    if isinstance(written, Mapping):
        names = {name_of(state) for state in states}
        given = {k if isinstance(k, str) else name_of(k): value for k, value in written.items()}
        unknown = [key for key in given if key not in names]
        if unknown:
            raise ProblemError(
                f"the key {shown(unknown[0])} of `initial` is no state",
                term=unknown[0],
                remedy=f"choose from {', '.join(map(quote, sorted(names)))}",
            )
        return {state: given.get(name_of(state), 0) for state in states}
    pair = isinstance(written, tuple | list) and all(np.ndim(column) == 1 for column in written)
    columns: Sequence[Any] = written if pair and isinstance(written, Sequence) else [written]
    if len(columns) > order:
        raise ProblemError(
            f"initial has {len(columns)} arrays for a system of order {order}",
            term=written,
            remedy="give the values of the field, then those of its derivative",
        )
    return dict(zip(states, [*columns, *[0] * (order - len(columns))], strict=True))


# -- fields entry by entry ---------------------------------------------------------------------


def scalar_arguments(problem: CheckedFields) -> dict[str, Any]:
    """The arguments of the problem whose unknowns are the entries ``u0``, ``u1``, ..."""
    if problem.size > _MOST_ENTRIES:
        raise ProblemError(
            f"the fields have {problem.size} entries together; up to {_MOST_ENTRIES} are written "
            "one by one",
            term=problem.name,
            remedy="use a coarser grid to check the equations, or keep the fields",
        )
    entries = _Entries(problem)
    rates = {}
    for state, rate in problem.rates.items():
        column = entries.of(rate, size_of(state))
        if state in problem.masses:
            column = _divided(problem.masses[state], column)
        rates[state] = column
    time = problem.time[0]
    named = {name_of(state): [name_of(e) for e in entries.states[state]] for state in rates}
    spread = {
        key: {e: at for name, at in (values or {}).items() for e in named.get(name, [name])}
        for key, values in (("units", problem.units), ("atol", problem.atol))
    }
    return {
        "equations": [
            sp.Eq(rate_of(entry, time), rate, evaluate=False)
            for state, column in rates.items()
            for entry, rate in zip(entries.states[state], column, strict=True)
        ],
        "time": problem.time,
        "parameters": problem.written_parameters(),
        "initial": {
            entry: start
            for state, value in problem.initial.items()
            for entry, start in zip(
                entries.states[state], entries.of(value, size_of(state)), strict=True
            )
        },
        "events": [entries.event(event) for event in problem.events],
        "name": problem.name,
        "tail": problem.tail,
        "correlation": problem.written["correlation"],
        **spread,
    }


class _Entries:
    """Elementwise expressions written out; each is written once."""

    def __init__(self, problem: CheckedFields) -> None:
        time = problem.time[0]
        self.states: dict[State, list[sp.Expr]] = {
            state: [unknown_of(f"{state.name}{i}", time) for i in range(state.size)]
            if isinstance(state, Field)
            else [state]
            for state in problem.rates
        }
        self._written: dict[tuple[sp.Basic, int], list[sp.Expr]] = {}

    def of(self, expression: sp.Basic, size: int) -> list[sp.Expr]:
        """The entries of an expression."""
        key = expression, size
        if key not in self._written:
            column = self._of(expression, size)
            self._written[key] = column * size if len(column) == 1 else column
        return self._written[key]

    def event(self, event: Event) -> Event:
        """An event with entries in place of fields."""
        then = None
        if event.then is not None:
            then = {
                entry: after
                for state, value in event.then.items()
                for entry, after in zip(
                    self.states[state], self.of(value, size_of(state)), strict=True
                )
            }
        return replace(event, when=self.of(event.when, 1)[0], then=then)

    def _of(self, expression: sp.Basic, size: int) -> list[sp.Expr]:
        if expression in self.states:
            return self.states[expression]
        if isinstance(expression, Vector):
            return _fractions(expression.array)
        if isinstance(expression, Apply):
            return self._applied(expression)
        if not expression.args or isinstance(expression, AppliedUndef):
            return [expression]
        columns = [self.of(argument, size) for argument in expression.args]
        return [expression.func(*entries) for entries in zip(*columns, strict=True)]

    def _applied(self, applied: Apply) -> list[sp.Expr]:
        """The rows of a matrix times the entries of what it is applied to."""
        matrix = applied.operator.matrix
        operand = self.of(applied.operand, matrix.shape[1])
        factors, ends = _fractions(matrix.data), matrix.indptr.tolist()
        products = [f * operand[j] for f, j in zip(factors, matrix.indices, strict=True)]
        return [sp.Add(*products[a:b]) for a, b in itertools.pairwise(ends)]


def _fractions(numbers: Array) -> list[sp.Expr]:
    """Numbers as the exact decimals that they stand for."""
    known = {number: exact(sp.Float(number)) for number in np.unique(numbers).tolist()}
    return [known[number] for number in numbers.tolist()]


def _divided(mass: Operator, column: Sequence[sp.Expr]) -> list[sp.Expr]:
    """The inverse of a mass matrix times a column."""
    if len(column) > _MOST_COUPLED and mass.matrix.nnz > len(column):
        raise ProblemError(
            f"a mass matrix couples {len(column)} entries; up to {_MOST_COUPLED} are written one "
            "by one",
            term=mass,
            remedy="lump the mass matrix, or use a coarser grid to check the equations",
        )
    inverse = np.linalg.inv(mass.matrix.toarray())
    inverse[np.abs(inverse) < np.finfo(float).eps * np.abs(inverse).max()] = 0.0
    rows = [_fractions(row) for row in inverse]
    return [
        sp.Add(*(factor * rate for factor, rate in zip(row, column, strict=True))) for row in rows
    ]
