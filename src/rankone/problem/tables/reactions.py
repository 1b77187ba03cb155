"""Networks of reactions: a stoichiometric matrix, and the rate of each reaction."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import partial
from typing import Any

import numpy as np
import scipy.sparse
import sympy as sp
from sympy.core.function import AppliedUndef

from rankone.problem.algebra.matrices import array_of, named_unknowns, numbers_of
from rankone.problem.expressions.notation import exact, expression_of
from rankone.problem.tables.term_table import (
    FEWEST_TABULATED,
    Entry,
    TabulatedEquations,
    TermTable,
    fraction_of,
    written_rates,
)
from rankone.support.errors import ProblemError
from rankone.support.wording import count, quote, shown

Powers = tuple[tuple[int, Fraction], ...]
"""Species and their powers."""
_REACTANTS = "reactants"


@dataclass(frozen=True)
class Network:
    """Species that change by reactions: ``x' = stoichiometry @ rates``.

    The rate of a reaction is its law times powers of species, ``orders``, of mass action.
    """

    unknowns: tuple[sp.Expr, ...]
    time: sp.Symbol
    changes: tuple[tuple[int, int, Fraction], ...]
    """Species, reaction and the change of the one by the other."""
    laws: tuple[sp.Expr, ...]
    orders: tuple[Powers, ...]

    @classmethod
    def of(
        cls, stoichiometry: Any, laws: Any, orders: Any, time: sp.Symbol, names: str | Sequence[str]
    ) -> Network:
        """The network of a matrix and laws; a ProblemError if they do not fit."""
        matrix = _matrix(stoichiometry, "the stoichiometric matrix")
        species, reactions = matrix.shape
        if not species or not reactions:
            raise ProblemError(
                f"the stoichiometric matrix is {species} x {reactions}",
                term=stoichiometry,
                remedy="give a row for each species and a column for each reaction",
            )
        changes = tuple((i, j, fraction_of(entry)) for (i, j), entry in numbers_of(matrix))
        return cls(
            named_unknowns(names, species, time),
            time,
            changes,
            _laws(laws, reactions),
            _orders(orders, matrix),
        )

    @property
    def equations(self) -> Sequence[sp.Basic]:
        """One for each species; of many they are written out when they are read."""
        table, n = self._table(), len(self.unknowns)
        if table is None:
            return self._written()
        if n < FEWEST_TABULATED:
            return written_rates(table, self.time, n)
        return TabulatedEquations(n, partial(written_rates, table, self.time, n), table)

    def _table(self) -> TermTable | None:
        """The terms of all rates; None if laws name species, or powers are no whole numbers."""
        powers = [power for each in self.orders for _, power in each]
        if any(law.atoms(AppliedUndef) for law in self.laws):
            return None
        if not all(power.denominator == 1 and power > 0 for power in powers):
            return None
        functions: dict[sp.Expr, int] = {}
        split = [_number_and_function(law) for law in self.laws]
        places = [functions.setdefault(f, len(functions)) for _, f in split]
        multiplied = [
            tuple(i for i, power in each for _ in range(int(power))) for each in self.orders
        ]
        terms: list[Entry] = [
            (change * split[j][0], i, places[j], multiplied[j])
            for i, j, change in self.changes
            if split[j][0]
        ]
        return TermTable(self.unknowns, tuple(functions), tuple(terms))

    def _written(self) -> list[sp.Eq]:
        """The equations of any laws."""
        rates = [
            sp.Mul(law, *(self.unknowns[i] ** _rational(power) for i, power in each))
            for law, each in zip(self.laws, self.orders, strict=True)
        ]
        terms: list[list[sp.Expr]] = [[] for _ in self.unknowns]
        for i, j, change in self.changes:
            terms[i].append(_rational(change) * rates[j])
        pairs = zip(self.unknowns, terms, strict=True)
        return [sp.Eq(u.diff(self.time), sp.Add(*own), evaluate=False) for u, own in pairs]


def _matrix(written: Any, subject: str) -> Any:
    """A matrix of numbers, dense or sparse."""
    array = array_of(written, subject)
    if isinstance(array, sp.MatrixBase):
        if array.free_symbols or array.atoms(AppliedUndef):
            raise ProblemError(
                f"{subject} has entries that are no numbers",
                term=written,
                remedy="give numbers, and what depends on parameters in the laws",
            )
        array = np.array(array, dtype=float)
    if len(array.shape) != 2:
        raise ProblemError(
            f"{subject} has the shape {array.shape}",
            term=written,
            remedy="give a row for each species and a column for each reaction",
        )
    return array


def _laws(written: Any, reactions: int) -> tuple[sp.Expr, ...]:
    """The law of each reaction as an expression."""
    remedy = f"give {count(reactions, 'law')}, numbers or expressions, one for each reaction"
    if isinstance(written, str | Mapping) or not hasattr(written, "__iter__"):
        raise ProblemError(f"the laws are {shown(written)}", term=written, remedy=remedy)
    laws = [_law(law) for law in written]
    if len(laws) != reactions:
        raise ProblemError(
            f"there are {count(len(laws), 'law')} for {count(reactions, 'reaction')}",
            term=written,
            remedy=remedy,
        )
    return tuple(laws)


def _law(written: Any) -> sp.Expr:
    law = expression_of(written)
    if law is None:
        raise ProblemError(
            f"the law {quote(written)} is no number or expression",
            term=written,
            remedy="give an expression of SymPy, such as k*x",
        )
    return exact(law)


def _orders(written: Any, matrix: Any) -> tuple[Powers, ...]:
    """For each reaction the species that multiply its law, and their powers."""
    species, reactions = matrix.shape
    if written is None:
        return tuple(() for _ in range(reactions))
    remedy = 'give orders="reactants", or a matrix of the shape of the stoichiometric one'
    if isinstance(written, str):
        if written != _REACTANTS:
            raise ProblemError(f"orders are {shown(written)}", term=written, remedy=remedy)
        powers: Any = -scipy.sparse.csr_matrix(matrix)
        powers = powers.maximum(0)
    else:
        powers = _matrix(written, "the matrix of orders")
        if powers.shape != (species, reactions):
            shape = " x ".join(map(str, powers.shape))
            message = f"the matrix of orders is {shape}, not {species} x {reactions}"
            raise ProblemError(message, term=written, remedy=remedy)
    listed: list[list[tuple[int, Fraction]]] = [[] for _ in range(reactions)]
    for (i, j), power in sorted(numbers_of(powers)):
        listed[j].append((i, fraction_of(power)))
    return tuple(map(tuple, listed))


def _number_and_function(law: sp.Expr) -> tuple[Fraction, sp.Expr]:
    """A law as a rational number times a function."""
    coefficient, function = law.as_coeff_Mul()
    if not coefficient.is_Rational:
        return Fraction(1), law
    return Fraction(int(coefficient.p), int(coefficient.q)), function


def _rational(number: Fraction) -> sp.Rational:
    return sp.Rational(number.numerator, number.denominator)
