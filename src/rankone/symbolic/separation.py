"""The separated form of a problem: every term a product of functions of one coordinate.

Applied functions and derivatives are replaced by plain symbols, every right-hand side is split once
(:mod:`~rankone.symbolic.splitting`), like terms merge, and terms and factors are put in an order
that depends on nothing but the mathematics.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import sympy as sp

from rankone.errors import ProblemError, SeparationError
from rankone.ir import Coordinate, Factor, SeparatedForm, Term
from rankone.symbolic.admissible import defect
from rankone.symbolic.problem import Problem
from rankone.symbolic.splitting import Indivisible, Product, Splitter, Sum, accumulate
from rankone.wording import listing, quote

__all__ = ["separate"]


def separate(problem: Problem) -> SeparatedForm:
    """Separate a problem.

    Parameters
    ----------
    problem : Problem
        A validated problem.

    Returns
    -------
    SeparatedForm
        The residual u' - f and the initial values. Terms are ordered by equation, then the
        derivative, then by degree, monomial and factors; factors as SymPy orders expressions.

    Raises
    ------
    SeparationError
        If a term does not factor, or is not polynomial in the unknowns.
    ProblemError
        If a factor is not finite and real everywhere on its interval.
    """
    return _Separation(problem).form()


class _Separation:
    """The working state of one separation."""

    def __init__(self, problem: Problem) -> None:
        self.problem = problem
        self.coordinates = problem.coordinates
        self.plain = {state.expression: sp.Symbol(state.name) for state in problem.states}
        self.written = {symbol: expression for expression, symbol in self.plain.items()}
        self.splitter = Splitter(self.coordinates, list(self.plain.values()))

    def form(self) -> SeparatedForm:
        rhs = [self._split(i, f, initial=False) for i, f in enumerate(self.problem.rhs)]
        values = self.problem.initial.values()
        initial = [self._split(i, value, initial=True) for i, value in enumerate(values)]
        factors = self._factors([*rhs, *initial])
        self._check_factors(factors, rhs, initial)
        index = [{f: i for i, f in enumerate(distinct)} for distinct in factors]
        n = len(self.coordinates)
        return SeparatedForm(
            coordinates=self.coordinates,
            states=self.problem.states,
            factors=tuple(
                tuple(Factor(j, f) for f in distinct) for j, distinct in enumerate(factors)
            ),
            terms=tuple(
                term
                for i, f in enumerate(rhs)
                for term in (Term(i, 1.0, (0,) * n, (i,), 1), *self._terms(i, f, index, -1))
            ),
            initial=tuple(
                term for i, value in enumerate(initial) for term in self._terms(i, value, index, 1)
            ),
        )

    # -- splitting --------------------------------------------------------------------------

    def _split(self, state: int, expression: sp.Expr, *, initial: bool) -> Sum:
        """Split one right-hand side or initial value; explain what cannot be split."""
        total: Sum = {}
        for term in sp.Add.make_args(expression.xreplace(self.plain)):
            try:
                split = self.splitter.split(term)
                for product in split:
                    self._check_powers(product)
            except Indivisible as reason:
                raise self._explain(reason, term, state, initial=initial) from None
            accumulate(total, split)
        return {product: number for product, number in total.items() if number != 0}

    def _check_powers(self, product: Product) -> None:
        for state, power in product.powers:
            if power < 0:
                raise Indivisible(list(self.written)[state] ** power, "not polynomial")

    def _explain(
        self, reason: Indivisible, term: sp.Expr, state: int, *, initial: bool
    ) -> ProblemError:
        part = reason.part.xreplace(self.written)
        written = term.xreplace(self.written)
        within = "" if part == written else f" in the term {quote(written)}"
        where = f"initial value of {quote(self.problem.states[state].expression)}: "
        message = f"{where if initial else ''}{'' if within else 'term '}{quote(part)}{within} "
        equation = None if initial else self._equation(state)
        names = [c.symbol for c in self.coordinates if c.symbol in reason.part.free_symbols]
        if reason.reason == "not polynomial":
            states = [e for s, e in self.written.items() if s in reason.part.free_symbols]
            return SeparationError(
                f"{message}is not polynomial in {listing(states)}",
                equation=equation,
                term=written,
                remedy="right-hand sides must be polynomial in the unknowns; take the function as "
                "a further unknown with an equation of its own, such as s = sin(x) with "
                "s' = cos(x) x'",
            )
        if reason.reason == "not real":
            boxes = [f"{c.name} in [{c.lower:g}, {c.upper:g}]" for c in self._among(names)]
            return ProblemError(
                f"{message}is not real for all {', '.join(boxes)}",
                equation=equation,
                term=written,
                remedy="change the box",
            )
        way_out = (
            "take it as a further unknown with an equation of its own, such as z' = -k*z, "
            "z(0) = 1 for exp(-k*t)"
            if self.coordinates[0].symbol in names
            else "take the combination as a parameter of its own"
        )
        return SeparationError(
            f"{message}couples {listing(names)} and does not factor",
            equation=equation,
            term=written,
            remedy="write it as a sum of products of functions of one coordinate each, or "
            + way_out,
        )

    def _among(self, symbols: Iterable[sp.Symbol]) -> list[Coordinate]:
        wanted = set(symbols)
        return [c for c in self.coordinates if c.symbol in wanted]

    def _equation(self, state: int) -> int | None:
        """Return the number of the equation, as the user wrote them, that a state comes from."""
        return self.problem.origins[state]

    # -- factors ----------------------------------------------------------------------------

    def _factors(self, sums: Sequence[Sum]) -> list[list[sp.Expr]]:
        """Return for each dimension its distinct factors: one, then in SymPy's order."""
        distinct: list[dict[sp.Expr, None]] = [{} for _ in self.coordinates]
        for terms in sums:
            for product in terms:
                for found, factor in zip(distinct, product.factors, strict=True):
                    found[factor] = None
        return [
            [sp.S.One, *sorted((f for f in found if f is not sp.S.One), key=sp.default_sort_key)]
            for found in distinct
        ]

    def _check_factors(
        self, factors: Sequence[Sequence[sp.Expr]], rhs: Sequence[Sum], initial: Sequence[Sum]
    ) -> None:
        for j, (coordinate, distinct) in enumerate(zip(self.coordinates, factors, strict=True)):
            for factor in distinct:
                wrong = defect(factor, coordinate)
                if wrong is None:
                    continue
                users = [i for i, f in enumerate(rhs) if any(p.factors[j] == factor for p in f)]
                interval = f"[{coordinate.lower:g}, {coordinate.upper:g}]"
                kind = "the horizon" if j == 0 else f"the box of parameter {quote(coordinate.name)}"
                where = "" if users else "in an initial value, "
                if users and self._equation(users[0]) is None:
                    where = "after solving for the derivatives, "
                raise ProblemError(
                    f"{where}factor {quote(factor)} {wrong}, inside {kind} {interval}",
                    equation=self._equation(users[0]) if users else None,
                    term=factor,
                    remedy="change the interval so that the factor is finite and real on it",
                )

    # -- terms ------------------------------------------------------------------------------

    def _terms(
        self,
        equation: int,
        terms: Mapping[Product, sp.Expr],
        index: Sequence[Mapping[sp.Expr, int]],
        direction: int,
    ) -> list[Term]:
        """Return the terms of one equation, with the sign of the residual, in order."""
        found = [
            Term(
                equation=equation,
                coefficient=direction * self._float(number, equation),
                factors=tuple(
                    place[factor] for place, factor in zip(index, product.factors, strict=True)
                ),
                monomial=tuple(s for s, power in product.powers for _ in range(power)),
            )
            for product, number in terms.items()
        ]
        return sorted(found, key=lambda t: (len(t.monomial), t.monomial, t.factors))

    def _float(self, number: sp.Expr, state: int) -> float:
        try:
            value = float(number)
        except (TypeError, OverflowError):
            value = float("nan")
        if not abs(value) < float("inf"):
            raise ProblemError(
                f"coefficient {quote(number)} is not a finite real number",
                equation=self._equation(state),
                term=number,
                remedy="rescale the equations or change the coefficients",
            )
        return value
