"""Initial values of fields, and their mass matrices."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import scipy.sparse
import sympy as sp
from sympy.core.function import AppliedUndef

from rankone.problem.equations import (
    Symbols,
    check_value,
    state_of,
)
from rankone.problem.expressions.notation import exact, expression_of
from rankone.problem.field_rates import State
from rankone.problem.fields import (
    Field,
    FieldDerivative,
    Operator,
    Vector,
    constant_of,
    size_of,
)
from rankone.support.errors import ProblemError, count, did_you_mean, listing, quote, shown
from rankone.tensors.coordinates import name_of


def initial_fields(
    written: object, rates: Mapping[State, sp.Expr], symbols: Symbols
) -> dict[State, sp.Expr]:
    """The initial value of each state, an elementwise expression of parameters."""
    if not isinstance(written, Mapping):
        raise ProblemError(
            f"initial is {shown(written)}, not a mapping",
            term=written,
            remedy="give {u: array, v: number, ...}",
        )
    given: dict[State, sp.Expr] = {}
    for key, value in written.items():
        state = _state_of(key, rates, symbols)
        given[state] = _start(state, value, symbols)
    missing = [state for state in rates if state not in given]
    if missing:
        raise ProblemError(
            f"no initial value for {listing(missing)}",
            term=missing[0],
            remedy=f"add it to `initial`, for example {{{missing[0]}: 0}}",
        )
    return {state: given[state] for state in rates}


def _state_of(key: object, rates: Mapping[State, sp.Expr], symbols: Symbols) -> State:
    """The state that a key of ``initial`` names."""
    if isinstance(key, sp.Expr) and key in rates:
        return key
    named = {name_of(state): state for state in rates}
    if isinstance(key, FieldDerivative | str):
        name = key if isinstance(key, str) else name_of(key)
        if name in named:
            return named[name]
        if isinstance(key, FieldDerivative) and key.expr in rates:
            raise ProblemError(
                f"the initial value of {quote(key)} is not needed: the equations determine this "
                "derivative",
                term=key,
                remedy="leave it out",
            )
    elif isinstance(key, AppliedUndef | sp.Subs) and (state := state_of(key, symbols)) in rates:
        return state
    text = str(key)
    raise ProblemError(
        f"the key {shown(key)} of `initial` is no unknown{did_you_mean(text, named)}",
        term=key,
        remedy=f"use the unknowns themselves as keys: {listing(rates)}",
    )


def _start(state: State, value: object, symbols: Symbols) -> sp.Expr:
    """One initial value as an expression."""
    subject, size = f"the initial value of {quote(state)}", size_of(state)
    expression = expression_of(value) if isinstance(value, sp.Basic) or _is_number(value) else None
    if expression is None:
        remedy = f"give a number, an array of {size} numbers, or an expression of parameters"
        if isinstance(value, str | Mapping | sp.MatrixBase | None):
            raise ProblemError(f"{subject} is {shown(value)}", term=value, remedy=remedy)
        expression = constant_of(value, subject)
        if isinstance(expression, Operator):
            raise ProblemError(
                f"{subject} has the shape {expression.shape}",
                term=value,
                remedy="give an array of one dimension",
            )
    expression = exact(symbols.shorthand.put_in(expression))
    if size_of(expression) not in (1, size):
        raise ProblemError(
            f"{subject} has {size_of(expression)} entries",
            term=value,
            remedy=f"give {count(size, 'entry', 'entries')}, or one number for all",
        )
    remedy = "give a number, an array, or an expression of the parameters and of arrays"
    unknowns = expression.atoms(Field, AppliedUndef, FieldDerivative)
    if unknowns or symbols.time[0] in expression.free_symbols:
        term = listing(unknowns) if unknowns else f"the time {quote(symbols.time[0])}"
        raise ProblemError(f"{subject} names {term}", term=value, remedy=remedy)
    constants = {s: sp.Dummy() for s in expression.free_symbols if isinstance(s, Vector)}
    plain = expression.xreplace(constants)
    declared = [*symbols.parameters, *constants.values()]
    check_value(plain, subject, symbols, declared, remedy)
    return expression


def _is_number(value: object) -> bool:
    return isinstance(value, int | float | np.generic)


def mass_matrices(
    written: Mapping[Any, Any] | None, rates: Mapping[State, sp.Expr], unknowns: Iterable[sp.Expr]
) -> dict[State, Operator]:
    """The mass matrices of states; of a field of second order it is that of its velocity."""
    if written is None:
        return {}
    if not isinstance(written, Mapping):
        raise ProblemError(
            f"mass is {shown(written)}, not a mapping", term=written, remedy="give {u: M}"
        )
    fields = {name_of(u): u for u in unknowns if isinstance(u, Field)}
    velocities = {name_of(state): state for state in rates}
    masses: dict[State, Operator] = {}
    for key, matrix in written.items():
        named = key if isinstance(key, str) else getattr(key, "name", None)
        if named not in fields or not isinstance(key, Field | str):
            raise ProblemError(
                f"mass has {shown(key)}, which is no field of the problem",
                term=key,
                remedy=f"choose from {listing(fields.values())}",
            )
        state = velocities.get(f"{named}_t", fields[named])
        masses[state] = _mass(matrix, fields[named])
    return masses


def _mass(written: object, unknown: Field) -> Operator:
    """One mass matrix; its factorisation tells whether it is singular."""
    subject = f"the mass matrix of {quote(unknown)}"
    matrix = written if isinstance(written, Operator) else constant_of(written, subject)
    shape = matrix.shape if isinstance(matrix, Operator) else (matrix.size,)
    if isinstance(matrix, Vector) or shape != (unknown.size, unknown.size):
        raise ProblemError(
            f"{subject} is {' x '.join(map(str, shape))}",
            term=written,
            remedy=f"give a matrix of {unknown.size} x {unknown.size} entries",
        )
    try:
        scipy.sparse.linalg.splu(scipy.sparse.csc_array(matrix.matrix))
    except RuntimeError:
        raise ProblemError(
            f"{subject} is singular",
            term=written,
            remedy="leave out degrees of freedom that have no mass, or take those at the boundary "
            "from the boundary values",
        ) from None
    return matrix
