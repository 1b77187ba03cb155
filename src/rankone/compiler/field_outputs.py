"""Outputs of fields as expressions of functionals, which are linear in the coefficients.

``apply(row, u)`` with a matrix of one row is a functional of u. ``apply(row, u**2)``, and the same
of other products of two fields, are sums of squares of functionals, one for each mode at most.
Functions inside of ``apply`` are written out where the row has few entries that are not zero.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import scipy.sparse as ss
import sympy as sp

from rankone.compiler.passes.field_terms import FieldTerms, Linear, Matrix, Source
from rankone.problem.expressions.conditions import unknown_of
from rankone.problem.expressions.notation import expression_of
from rankone.problem.fields import Apply, Field, FieldDerivative, Vector, apply, size_of
from rankone.solvers.outcome import SolutionMetadata
from rankone.solvers.reduced.field_modes import FieldModes
from rankone.solvers.reduced.functionals import Functional, Functionals, combined
from rankone.support.arrays import Array
from rankone.support.errors import OptionError, RankoneError, count, is_line, listing, quote
from rankone.tensors.coordinates import name_of
from rankone.trajectories.fields.field_system import Unknown

_MOST_ENTRIES = 32  # Entries of a row at which a function of fields is written out one by one


@dataclass(frozen=True)
class FieldOutputs:
    """Outputs by name, of states: scalar unknowns, and functionals, in the order of the states.

    Each output is an expression of ``x(t)`` of the states, a text, or something that is no
    expression. ``texts`` have those that were written by expressions, and ``linear`` all outputs as
    functionals, if that is what they are.
    """

    outputs: Mapping[str, object]
    states: Mapping[str, Functional]
    texts: Mapping[str, str]
    linear: Mapping[str, Functional] | None


def field_outputs(
    outputs: Mapping[str, object], modes: FieldModes, metadata: SolutionMetadata
) -> FieldOutputs:
    """Outputs in terms of functionals; an OptionError for what has no such form.

    ``metadata`` is that of the coefficients.
    """
    lowering = _Lowering(modes, metadata)
    lowered = {name: lowering.output(name, term) for name, term in outputs.items()}
    states = lowering.states
    linear = {name: _linear(term, lowering) for name, term in lowered.items()}
    whole = {name: functional for name, functional in linear.items() if functional is not None}
    texts = {
        name: text
        for name, term in outputs.items()
        if isinstance(term, sp.Basic) and is_line(text := f"{name} = {term}")
    }
    return FieldOutputs(lowered, states, texts, whole if len(whole) == len(outputs) else None)


def entry_of(unknown: Unknown, position: int, time: str) -> sp.Expr:
    """One entry of a field, or a scalar unknown, as an expression."""
    if not unknown.is_field:
        return unknown_of(unknown.name, sp.Symbol(time))
    row = ss.csr_array(([1.0], ([0], [position])), shape=(1, unknown.size))
    applied: sp.Expr = apply(row, Field(unknown.name, unknown.size))
    return applied


def _linear(term: object, lowering: _Lowering) -> Functional | None:
    """An output as a functional, if it is a sum of states times numbers."""
    if not isinstance(term, sp.Expr):
        return None
    weights = term.as_coefficients_dict()
    states, numbers = [], []
    for state, number in weights.items():
        if state not in lowering.functions or not number.is_Number:
            return None
        states.append(lowering.states[lowering.functions[state]])
        numbers.append(float(number))
    return combined(states, numbers) if states else None


class _Lowering:
    """What replaces applied matrices by functionals."""

    def __init__(self, modes: FieldModes, metadata: SolutionMetadata) -> None:
        self.modes, self.metadata = modes, metadata
        self._time = sp.Symbol(metadata.time)
        self._functionals = Functionals(modes)
        self._unknowns = {unknown.name: unknown for unknown in modes.unknowns}
        places = {self._state(unknown): unknown.rows for unknown in modes.unknowns}
        self._terms = FieldTerms(places)
        taken = {*self._unknowns, *metadata.coordinates, *dict(metadata.constants)}
        self._prefix = "functional_"
        while any(name.startswith(self._prefix) for name in taken):
            self._prefix = f"_{self._prefix}"
        self._scalars: dict[str, Functional] = {}
        for unknown in modes.unknowns:
            if not unknown.is_field:
                number = self._functionals.linear(self._row_of(unknown))
                self._scalars[unknown.name] = self._functionals.listed[number]

    def _state(self, unknown: Unknown) -> sp.Expr:
        if unknown.is_field:
            return Field(unknown.name, unknown.size)
        return unknown_of(unknown.name, self._time)

    def _row_of(self, unknown: Unknown) -> Matrix:
        """The row (1, N) of a scalar unknown."""
        columns = sum(each.size for each in self.modes.unknowns)
        return ss.csr_array(([1.0], ([0], [unknown.first])), shape=(1, columns))

    @property
    def states(self) -> dict[str, Functional]:
        """Scalar unknowns, and functionals, by name."""
        listed = self._functionals.listed
        return self._scalars | {f"{self._prefix}{k}": each for k, each in enumerate(listed)}

    @property
    def functions(self) -> dict[sp.Expr, str]:
        """The names of the states by what stands for them in expressions."""
        return {unknown_of(name, self._time): name for name in self.states}

    def _functional(self, number: int) -> sp.Expr:
        return unknown_of(f"{self._prefix}{number}", self._time)

    def output(self, name: str, term: object) -> object:
        """An output in terms of functionals; what is no expression as it is."""
        if isinstance(term, str):
            self._refuse_fields(term, name)
        expression = None if isinstance(term, str) else expression_of(term)
        if expression is None:
            return term
        own = {
            symbol: sp.Symbol(symbol.name)
            for symbol in expression.free_symbols
            if not isinstance(symbol, Field | Vector)
        }
        where = f"the output {quote(name)}"
        try:
            return self._scalar(expression.xreplace(own), where)
        except OptionError:
            raise
        except RankoneError as error:
            message = f"{where}: {error.message}"
            raise OptionError(message, term=term, remedy=error.remedy) from None

    def _refuse_fields(self, text: str, name: str) -> None:
        """Raise an OptionError if a text names a field."""
        names = re.findall(r"\w+", text)
        for unknown in self.modes.unknowns:
            if unknown.is_field and unknown.name in names:
                raise OptionError(
                    f"the output {quote(name)} names the field {quote(unknown.name)} of "
                    f"{count(unknown.size, 'entry', 'entries')}, and an output is one number",
                    term=text,
                    remedy=f'give one entry, solution["{unknown.name}"][3], or apply a matrix of '
                    "one row: rankone.apply(row, u); texts take scalar unknowns, parameters and "
                    "time",
                )

    def _scalar(self, expression: sp.Basic, where: str) -> sp.Basic:
        """An expression that is one number, in terms of functionals."""
        if isinstance(expression, Apply) and size_of(expression) == 1:
            return self._applied(expression, where)
        if isinstance(expression, Field | FieldDerivative | Vector | Apply):
            raise OptionError(
                f"{where} has {quote(expression)}, which has {size_of(expression)} entries, and an "
                "output is one number",
                term=expression,
                remedy="give one entry, solution[u][3], or apply a matrix of one row: "
                "rankone.apply(row, u)",
            )
        if not expression.args:
            return expression
        return expression.func(*(self._scalar(argument, where) for argument in expression.args))

    def _applied(self, applied: Apply, where: str) -> sp.Expr:
        """A matrix of one row, applied, in terms of functionals."""
        self._check_fields(applied, where)
        total = []
        for term in self._terms.of(applied, 1):
            if isinstance(term, Linear):
                value = self._functional(self._functionals.linear(ss.csr_array(term.matrix)))
            elif isinstance(term, Source):
                value = sp.Float(float(term.vector[0]))
            else:
                row = ss.csr_array(term.after).toarray()[0]
                value = self._pointwise(row, term.function, applied, where)
            total.append(term.coefficient * value)
        return sp.Add(*total)

    def _check_fields(self, applied: Apply, where: str) -> None:
        """Raise an OptionError unless fields are those of the solution, and no derivatives."""
        for derivative in applied.atoms(FieldDerivative):
            raise OptionError(
                f"{where} has the derivative {quote(derivative)}",
                term=derivative,
                remedy=self._instead_of(derivative),
            )
        for state in applied.atoms(Field):
            own = self._unknowns.get(state.name)
            if own is None or not own.is_field or own.size != state.size:
                raise OptionError(
                    f"{where} has the field {quote(state)} of {state.size} entries, which the "
                    "solution does not hold",
                    term=state,
                    remedy="its fields are "
                    + listing(f"{u.name}, {u.size} entries" for u in self.modes.unknowns),
                )

    def _instead_of(self, derivative: FieldDerivative) -> str:
        """What to write for a derivative: the state that it is, or an output of derivatives."""
        state = self._unknowns.get(name_of(derivative))
        if state is not None and state.is_field and state.size == derivative.size:
            return f'write the state instead: rankone.field("{state.name}", {state.size})'
        return f"ask for outputs of derivatives: solution.diff({quote(self._time)}).output({{...}})"

    def _pointwise(self, row: Array, function: sp.Expr, applied: Apply, where: str) -> sp.Expr:
        """``row @ function``, whose arguments are matrices times all unknowns, and vectors."""
        arguments = self._terms.arguments
        used = [symbol for symbol in arguments if function.has(symbol)]
        matrices = {s: ss.csr_array(arguments[s]) for s in used if arguments[s].ndim == 2}
        vectors = {s: np.asarray(arguments[s]) for s in used if arguments[s].ndim == 1}
        entries: list[int] = np.flatnonzero(row).tolist()
        if len(entries) <= _MOST_ENTRIES:
            return sp.Add(
                *(
                    float(row[i]) * function.xreplace(self._at(i, matrices, vectors))
                    for i in entries
                )
            )
        products = self._products(function, matrices, vectors)
        if products is None:
            raise OptionError(
                f"{where} takes {quote(applied)} at {len(entries)} entries, and the function "
                "inside is no polynomial of second degree in the fields, with coefficients that "
                "are numbers",
                term=applied,
                remedy=f"give a row of at most {_MOST_ENTRIES} entries that are not zero, or take "
                "the function of a functional: f(apply(row, u))",
            )
        return sp.Add(
            *(
                scalar * self._product(row * vector, [matrices[s] for s in factors])
                for scalar, vector, factors in products
            )
        )

    def _at(
        self, i: int, matrices: Mapping[sp.Symbol, Matrix], vectors: Mapping[sp.Symbol, Array]
    ) -> dict[sp.Symbol, sp.Expr]:
        """What the arguments of a function are at one entry."""
        numbers = {s: sp.Float(float(vector[i])) for s, vector in vectors.items()}
        return numbers | {
            s: self._functional(self._functionals.linear(ss.csr_array(matrix[[i]])))
            for s, matrix in matrices.items()
        }

    def _products(
        self,
        function: sp.Expr,
        matrices: Mapping[sp.Symbol, Matrix],
        vectors: Mapping[sp.Symbol, Array],
    ) -> list[tuple[sp.Expr, Array | float, list[sp.Symbol]]] | None:
        """A polynomial as terms: a scalar, a vector, and at most two arguments; or None."""
        try:
            polynomial = sp.Poly(function, *matrices)
        except sp.PolynomialError:
            return None
        if polynomial.total_degree() > 2:
            return None
        products: list[tuple[sp.Expr, Array | float, list[sp.Symbol]]] = []
        for powers, coefficient in polynomial.terms():
            factors = [s for s, k in zip(matrices, powers, strict=True) for _ in range(k)]
            for part in sp.Add.make_args(sp.expand(coefficient)):
                scalar, of_vectors = part.as_independent(*vectors, as_Add=False)
                if of_vectors.free_symbols - {*vectors}:
                    return None
                vector = sp.lambdify([*vectors], of_vectors, "numpy")(*vectors.values())
                products.append((scalar, vector, factors))
        return products

    def _product(self, row: Array, factors: list[Matrix]) -> sp.Expr:
        """``row @ (A u * B u)`` of two matrices, one, or none."""
        if len(factors) < 2:
            if not factors:
                return sp.Float(float(row.sum()))
            linear = ss.csr_array(row[None] @ factors[0])
            return self._functional(self._functionals.linear(linear))
        first, second = factors
        if first is second:
            return self._squares(row, first)
        one, other = (self._functionals.size_of(matrix) or 1.0 for matrix in factors)
        total = ss.csr_array(first / one + second / other)
        difference = ss.csr_array(first / one - second / other)
        squares = self._squares(row, total) - self._squares(row, difference)
        return 0.25 * one * other * squares

    def _squares(self, row: Array, matrix: Matrix) -> sp.Expr:
        """``row @ (A u)**2``: squares of positive weights less those of negative ones."""
        total = []
        for sign in (1, -1):
            numbers = self._functionals.squares(np.maximum(sign * row, 0.0), matrix)
            total += [sign * self._functional(k) ** 2 for k in numbers]
        return sp.Add(*total)
