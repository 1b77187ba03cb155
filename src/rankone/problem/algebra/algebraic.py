"""Algebraic equations among differential ones, and initial values that are consistent with them.

Algebraic unknowns follow from the others. Where they were solved for, their initial values and
their values after a reset are expressions; else initial values are guesses for Newton's method.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import scipy
import sympy as sp
from sympy.core.function import AppliedUndef

from rankone.problem.algebra.mass import (
    Eliminated,
    Elimination,
    LinearRow,
    MassForm,
    evaluation,
    leading_derivatives,
    linear_in,
)
from rankone.problem.box import Time
from rankone.problem.equations import algebraic_unknowns
from rankone.problem.expressions.conditions import slope
from rankone.problem.expressions.notation import exact
from rankone.problem.forms import Coordinate
from rankone.problem.functions import Table, known_applied
from rankone.problem.jumps import Resets
from rankone.problem.user_events import Event
from rankone.support.arrays import NEGLIGIBLE, Array
from rankone.support.errors import ProblemError, listing, quote

_POINTS = 6  # Points of the box at which initial values have to satisfy constraints

Values = Mapping[sp.Expr, sp.Expr]
"""States and what they are set to."""


def consistent_initial(
    initial: Values, states: Sequence[sp.Expr], reduction: Reduction, time: Time
) -> dict[sp.Expr, sp.Expr]:
    """The initial values of all states, those that were solved for included.

    A ProblemError if an algebraic unknown has no starting guess and needs one.
    """
    for unknown in reduction.guessed:
        if unknown not in initial:
            raise ProblemError(
                f"no starting guess for {quote(unknown)}: the equations that determine it are not "
                "linear in it",
                term=unknown,
                remedy=f"add one to `initial`, for example {{{unknown}: 1}}; Newton's method "
                "starts from it",
            )
    at_start = {**initial, time[0]: exact(sp.Float(time[1]))}
    solved = {u: _with_numbers(e.xreplace(at_start)) for u, e in reduction.solved.items()}
    return {state: solved.get(state, initial.get(state, sp.S.Zero)) for state in states}


def _with_numbers(expression: sp.Expr) -> sp.Expr:
    """The expression with the values of tables and users' functions at numbers."""
    return expression.xreplace(
        {
            applied: exact(sp.Float(float(applied._imp_(*map(float, applied.args)))))
            for applied in known_applied([expression])
            if all(arg.is_number for arg in applied.args)
        }
    )


def check_consistent(
    initial: Values, reduction: Reduction, coordinates: Sequence[Coordinate]
) -> None:
    """Raise a ProblemError if initial values of differential unknowns contradict a constraint."""
    clock = coordinates[0]
    at_start = {**initial, clock.symbol: exact(sp.Float(clock.lower))}
    for constraint in reduction.constraints:
        free = constraint.solved is None and not constraint.expression.has(*reduction.guessed)
        if not free:
            continue
        terms = [term.xreplace(at_start) for term in sp.Add.make_args(constraint.expression)]
        for trial in range(_POINTS):
            at = evaluation(coordinates, trial)
            values = [at(term) for term in terms]
            if not all(value.is_number for value in values):
                break
            off = sp.Add(*values)
            if abs(off) > NEGLIGIBLE * max(map(abs, values), default=0):
                raise _inconsistent(constraint, float(sp.re(off)), coordinates, at)


def _inconsistent(
    constraint: Constraint,
    off: float,
    coordinates: Sequence[Coordinate],
    at: Callable[[sp.Expr], sp.Expr],
) -> ProblemError:
    """The error for a constraint that initial values do not satisfy."""
    names = [f"{c.name} = {float(at(c.symbol)):.6g}" for c in coordinates[1:]]
    where = f" at {', '.join(names)}" if names else ""
    return ProblemError(
        f"the initial values do not satisfy {constraint.name}: "
        f"{quote(constraint.expression)} has to vanish and is {off:.6g}{where}",
        equation=constraint.equation,
        term=constraint.expression,
        remedy="give initial values of the differentiated unknowns that satisfy it everywhere in "
        "the box, for example as expressions of the parameters",
    )


def no_consistent_values(
    parameters: Sequence[str], point: Sequence[float] | Array, guessed: Sequence[object]
) -> ProblemError:
    """The error where Newton's method finds no values of guessed unknowns at a point (d,)."""
    pairs = zip(parameters, point, strict=True)
    where = ", ".join(f"{name} = {at:.6g}" for name, at in pairs)
    return ProblemError(
        f"Newton's method finds no initial values of {listing(guessed)} that satisfy the algebraic "
        f"equations{f' at {where}' if where else ''}",
        term=guessed[0],
        remedy="give starting guesses closer to them, as expressions of the parameters if need be; "
        "check that there is a solution everywhere in the box, and that it is not a double one",
    )


def check_impulses(residuals: Sequence[sp.Expr], time: sp.Symbol) -> None:
    """Raise a ProblemError for an impulse at a time that depends on parameters."""
    for i, residual in enumerate(residuals, 1):
        for impulse in sorted(residual.atoms(sp.DiracDelta), key=sp.default_sort_key):
            if impulse.free_symbols != {time}:
                raise ProblemError(
                    f"{quote(impulse)} is at a time that depends on parameters, beside algebraic "
                    "equations",
                    equation=i,
                    term=impulse,
                    remedy="give it as a jump: jumps={lag: {x: x + dose}}",
                )


def consistent_jumps(jumps: Resets, reduction: Reduction, time: sp.Symbol) -> dict[float, Values]:
    """The jumps with the algebraic unknowns that were solved for."""
    return {
        at: _followed(reset, f"the jump at {at:g}", reduction, {time: exact(sp.Float(at))})
        for at, reset in jumps.items()
    }


def consistent_events(events: Sequence[Event], reduction: Reduction) -> tuple[Event, ...]:
    """The events with the algebraic unknowns that were solved for."""
    return tuple(
        replace(event, then=_followed(event.then, f"event {quote(event.name)}", reduction, {}))
        if event.then
        else event
        for event in events
    )


def _followed(
    reset: Values, what: str, reduction: Reduction, now: Values
) -> dict[sp.Expr, sp.Expr]:
    """A reset together with the algebraic unknowns that follow from it.

    A ProblemError if it resets one of these, or a state in a constraint.
    """
    algebraic = [u for u in reset if u in reduction.solved or u in reduction.guessed]
    if algebraic:
        raise ProblemError(
            f"{what} resets {listing(algebraic)}, which the algebraic equations determine",
            term=algebraic[0],
            remedy="reset differentiated unknowns alone; the others follow",
        )
    for constraint in reduction.constraints:
        inside = [state for state in reset if constraint.expression.has(state)]
        if inside and constraint.solved is None:
            raise ProblemError(
                f"{what} resets {listing(inside)}, which {constraint.name} constrains: "
                f"0 = {quote(constraint.expression)}",
                equation=constraint.equation,
                term=inside[0],
                remedy="states in equations that are not solved symbolically cannot be reset; "
                "solve the equation for the algebraic unknown by hand, or choose other coordinates",
            )
    after = {**reset, **now}
    follows = {
        unknown: _with_numbers(meaning.xreplace(after))
        for unknown, meaning in reduction.solved.items()
        if meaning.has(*reset)
    }
    return {**reset, **follows}


# -----------------------------------------------------------------------------
# Algebraic equations among differential ones, reduced to rates and constraints.
#
# Unknowns that are never differentiated are algebraic. Where an equation gives one in terms of the
# others it is solved for and put in. The remaining ones, and the highest derivatives, follow from
# equations that are linear in them; an equation that has none of these is a constraint, and is
# replaced by its derivative in time until all are determined (the shuffle algorithm: Luenberger,
# IEEE Transactions on Automatic Control 22 (1977) 312-321). An algebraic unknown that enters in a
# nonlinear way becomes a state, with its derivative to be determined.
#
# Integrated alone, a derivative of a constraint g lets g drift. Its place is therefore taken by
# ``(d/dt + s)^m g = 0`` with a rate s of some tens over the horizon (Baumgarte, Computer Methods in
# Applied Mechanics and Engineering 1 (1972) 1-16): the same on trajectories, and others return to
# g.


_RETURNS = 20  # Rate at which trajectories return to a constraint, over the length of the horizon
_MOST_DIFFERENTIATED = 2  # Times that a constraint is differentiated: up to index 3
_ORDINALS = ("", "first ", "second ", "third ")


@dataclass(frozen=True)
class Constraint:
    """An expression of states that vanishes on all trajectories.

    It comes from the user's equation of a number, None where several were combined, differentiated
    ``order`` times. One that gives an unknown ``solved`` for is ``solved - its value``.
    """

    expression: sp.Expr
    equation: int | None
    order: int = 0
    solved: sp.Expr | None = None

    @property
    def name(self) -> str:
        """What messages and stages call it."""
        if self.solved is not None:
            return f"solved for {self.solved}"
        origin = "equations combined" if self.equation is None else f"equation {self.equation}"
        return f"the {_ORDINALS[self.order]}derivative of {origin}" if self.order else origin


@dataclass(frozen=True)
class Reduction:
    """Equations with algebraic ones among them as rates of all unknowns.

    Attributes
    ----------
    mass : MassForm
        The rates, with a mass of one each.
    constraints : tuple of Constraint
        What vanishes on all trajectories: the constraints, and the unknowns that were solved for.
    solved : mapping of Expr to Expr
        Algebraic unknowns in terms of the states.
    guessed : tuple of Expr
        The other algebraic unknowns, of which initial values are starting guesses.
    """

    mass: MassForm
    constraints: tuple[Constraint, ...]
    solved: Mapping[sp.Expr, sp.Expr]
    guessed: tuple[sp.Expr, ...]

    @property
    def iterated(self) -> tuple[sp.Expr, ...]:
        """What Newton's method finds at the start: guessed unknowns, and what depends on them."""
        dependent = (u for u, meaning in self.solved.items() if meaning.has(*self.guessed))
        return (*self.guessed, *dependent)


@dataclass
class _Row:
    """An equation, and the constraints whose derivative it is."""

    residual: sp.Expr
    equation: int | None
    chain: list[sp.Expr] = field(default_factory=list)


def reduced(
    residuals: Sequence[sp.Expr],
    unknowns: Sequence[sp.Expr],
    coordinates: Sequence[Coordinate],
    guesses: Collection[sp.Expr] = (),
) -> Reduction:
    """Reduce the residuals, one for each unknown, to rates and constraints.

    Algebraic unknowns that have ``guesses`` are not solved for alone. A ProblemError says which
    equations or unknowns leave no solution, or more than one.
    """
    return _Shuffle(residuals, unknowns, coordinates, guesses).reduction()


def has_constraints(
    residuals: Sequence[sp.Expr], unknowns: Sequence[sp.Expr], time: sp.Symbol
) -> bool:
    """Whether some unknown is not differentiated, or an equation has no highest derivative."""
    highest = {*leading_derivatives(residuals, unknowns, time)}
    if not highest.isdisjoint(unknowns):
        return True
    return any(highest.isdisjoint(r.atoms(sp.Derivative)) for r in residuals)


class _Shuffle:
    """The working state of a reduction."""

    def __init__(
        self,
        residuals: Sequence[sp.Expr],
        unknowns: Sequence[sp.Expr],
        coordinates: Sequence[Coordinate],
        guesses: Collection[sp.Expr],
    ) -> None:
        self.guesses = guesses
        self.time, self.unknowns = coordinates[0].symbol, tuple(unknowns)
        self.returning = exact(sp.Float(_RETURNS / (coordinates[0].upper - coordinates[0].lower)))
        self.eliminate = Elimination(coordinates)
        self.rows = [_Row(residual, i) for i, residual in enumerate(residuals, 1)]
        self.leading = dict(
            zip(unknowns, leading_derivatives(residuals, unknowns, self.time), strict=True)
        )
        self.algebraic = list(algebraic_unknowns(residuals))  # to be solved for
        self.solved: dict[sp.Expr, sp.Expr] = {}
        self.guessed: list[sp.Expr] = []
        self._check_structure()

    def reduction(self) -> Reduction:
        """Solve, differentiate what is left over, and so on until all is determined."""
        self._solve_algebraic()
        while True:
            self._guess_nonlinear()
            leading = self._unsolved()
            eliminated = self.eliminate(self._linear(leading, stable=False))
            if not eliminated.constraints:
                break
            for position, constraint in eliminated.constraints.items():
                self._differentiate(self.rows[position], constraint)
        eliminated = self.eliminate(self._linear(leading, stable=True))
        return self._reduction(leading, eliminated)

    def _unsolved(self) -> list[sp.Expr]:
        """The highest derivatives and the algebraic unknowns that remain."""
        return [self.leading[u] for u in self.unknowns if u not in self.solved]

    def _check_structure(self) -> None:
        """Raise unless each unknown can have an equation of its own."""
        present = [[row.residual.has(unknown) for unknown in self.unknowns] for row in self.rows]
        matching = scipy.sparse.csgraph.maximum_bipartite_matching(
            scipy.sparse.csr_matrix(np.array(present, dtype=int)), perm_type="column"
        )
        without = [row.equation for row, j in zip(self.rows, matching, strict=True) if j < 0]
        if not without:
            return
        left = [u for j, u in enumerate(self.unknowns) if j not in matching]
        raise ProblemError(
            f"the equations are structurally singular: nothing is left for equation {without[0]} "
            f"to determine, and no equation determines {listing(left)}",
            equation=without[0],
            term=left[0],
            remedy="give one independent equation for each unknown",
        )

    def _solve_algebraic(self) -> None:
        """Solve algebraic equations that are linear in an algebraic unknown, as long as any is.

        Where all is linear anyway, all is solved together. Unknowns with a guess are left to
        Newton's method, since functions put into each other lose digits.
        """
        if not self._nonlinear():
            return
        while (solvable := self._solvable()) is not None:
            row, unknown, meaning = solvable
            self.rows.remove(row)
            self.algebraic.remove(unknown)
            put_in = {unknown: meaning}
            self.solved = {u: e.xreplace(put_in) for u, e in self.solved.items()} | put_in
            for other in self.rows:
                other.residual = other.residual.xreplace(put_in)

    def _solvable(self) -> tuple[_Row, sp.Expr, sp.Expr] | None:
        """An algebraic equation, the unknown that it gives, and in terms of what."""
        highest = {self.leading[u] for u in self.unknowns if u not in self.algebraic}
        rows = [
            (row, [z for z in self.algebraic if row.residual.has(z)])
            for row in self.rows
            if not row.residual.has(*highest)
        ]
        uses = {z: sum(row.residual.has(z) for row in self.rows) for z in self.algebraic}
        for row, present in sorted(rows, key=lambda pair: len(pair[1])):
            for unknown in sorted(present, key=uses.__getitem__):
                if unknown in self.guesses:
                    continue
                symbol = sp.Dummy()
                residual = row.residual.xreplace({unknown: symbol})
                coefficient = sp.diff(residual, symbol)
                if coefficient.has(symbol):
                    coefficient = sp.expand(coefficient)
                if coefficient.has(symbol) or self.eliminate.sign(coefficient) is None:
                    continue
                rest = residual.xreplace({symbol: sp.S.Zero})
                terms = (-term / coefficient for term in sp.Add.make_args(rest))
                return row, unknown, sp.Add(*terms)
        return None

    def _guess_nonlinear(self) -> None:
        """Make states of the algebraic unknowns that enter in a nonlinear way."""
        for unknown in self._nonlinear():
            self.algebraic.remove(unknown)
            self.guessed.append(unknown)
            self.leading[unknown] = sp.Derivative(unknown, self.time)

    def _nonlinear(self) -> list[sp.Expr]:
        """The algebraic unknowns that enter in a nonlinear way."""
        nonlinear: set[sp.Expr] = set()
        stand_ins = {v: sp.Dummy() for v in self._unsolved()}
        symbols = {symbol: v for v, symbol in stand_ins.items()}
        for row in self.rows:
            for term in sp.Add.make_args(row.residual.xreplace(stand_ins)):
                for unknown in self.algebraic:
                    if not term.has(stand_ins[unknown]):
                        continue
                    other = sp.diff(term, stand_ins[unknown]).free_symbols & symbols.keys()
                    if other:
                        nonlinear |= {unknown} | {symbols[s] for s in other}
        return [unknown for unknown in self.algebraic if unknown in nonlinear]

    def _linear(self, leading: Sequence[sp.Expr], *, stable: bool) -> list[LinearRow]:
        """The equations as they are linear in derivatives and unknowns; ``stable`` ones return."""
        places = {v: i for i, v in enumerate(leading)}
        rows = []
        for row in self.rows:
            entries, rest = linear_in(places, row.residual, row.equation)
            if stable:
                rest += self._returning(row.chain)
            rows.append(LinearRow(entries, sp.Add(*rest)))
        return rows

    def _returning(self, chain: Sequence[sp.Expr]) -> list[sp.Expr]:
        """What is added to the last derivative of a constraint, so that it returns to zero."""
        m = len(chain)
        return [
            sp.binomial(m, k) * self.returning ** (m - k) * constraint
            for k, constraint in enumerate(chain)
        ]

    def _differentiate(self, row: _Row, constraint: sp.Expr) -> None:
        """Replace a row by the derivative of the constraint that is left over from it."""
        origin = f"equation {row.equation}"
        if not constraint.has(AppliedUndef):
            vanishes = self.eliminate.vanishes(sp.expand(constraint))
            raise ProblemError(
                f"the equations are dependent: with the others, {origin} says nothing"
                if vanishes
                else f"the equations contradict each other: with the others, {origin} says "
                f"{quote(constraint)} = 0",
                equation=row.equation,
                term=constraint,
                remedy="give one independent equation for each unknown",
            )
        if len(row.chain) == _MOST_DIFFERENTIATED + bool(self.guessed):
            raise ProblemError(
                f"the derivatives of {origin} do not determine {listing(self._undetermined())}: "
                "its index is higher than 3, or the equations leave these unknowns free",
                equation=row.equation,
                term=constraint,
                remedy="give one independent equation for each unknown, or differentiate the "
                "constraint by hand and give its derivative in its place",
            )
        row.residual = self._along(constraint, origin, row.equation)
        row.chain.append(constraint)

    def _undetermined(self) -> list[sp.Expr]:
        return self.algebraic or [*self.unknowns]

    def _along(self, expression: sp.Expr, what: str, equation: int | None) -> sp.Expr:
        """The derivative of an expression in time along a trajectory."""
        states = sorted(expression.atoms(sp.Derivative), key=sp.default_sort_key)
        plain = {state: sp.Dummy(real=True) for state in states}
        without = expression.xreplace(plain)
        applied = sorted(without.atoms(AppliedUndef), key=sp.default_sort_key)
        plain |= {state: sp.Dummy(real=True) for state in applied}
        without = without.xreplace(plain)
        terms = [slope(without, self.time)] if without.has(self.time) else []
        terms += [
            slope(without, dummy) * sp.Derivative(state, self.time).doit()
            for state, dummy in plain.items()
        ]
        steps = [
            f for f in known_applied([without]) if isinstance(f, Table) and f.kind == "previous"
        ]
        if any(term.has(sp.nan) for term in terms) or steps:
            raise ProblemError(
                f"{what} is differentiated in time, but {quote(expression)} may jump, or its "
                "derivative is not known",
                equation=equation,
                term=expression,
                remedy="use functions that are continuous, such as Abs, Max and Min, or take the "
                "unknown out of the problem and ask for it with solution.output",
            )
        written = {dummy: state for state, dummy in plain.items()}
        return sp.Add(*terms).xreplace(written)

    def _reduction(self, leading: Sequence[sp.Expr], eliminated: Eliminated) -> Reduction:
        """The rates of all unknowns, and what vanishes."""
        determined = dict(zip(leading, eliminated.solutions, strict=True))
        put_in = {z: determined[z] for z in self.algebraic}
        solved = {z: e.xreplace(put_in) for z, e in self.solved.items()} | put_in
        equations: dict[sp.Expr, int | None] = {
            leading[c]: self.rows[p].equation for c, p in eliminated.alone.items()
        }
        rates: dict[sp.Expr, sp.Expr] = {
            self.leading[u]: determined[self.leading[u]] for u in self.unknowns if u not in solved
        }
        for unknown in self.unknowns:
            if unknown in solved:
                along = self._along(solved[unknown], f"the value of {quote(unknown)}", None)
                rates[sp.Derivative(unknown, self.time)] = along.xreplace(rates)
        order = {
            u: sp.Derivative(u, self.time) if u in solved else self.leading[u]
            for u in self.unknowns
        }
        mass = MassForm(
            tuple(order.values()),
            tuple({i: sp.S.One} for i in range(len(order))),
            tuple([-term for term in sp.Add.make_args(rates[v])] for v in order.values()),
            tuple(equations.get(v) for v in order.values()),
        )
        return Reduction(mass, tuple(self._constraints(solved)), solved, tuple(self.guessed))

    def _constraints(self, solved: Mapping[sp.Expr, sp.Expr]) -> Iterable[Constraint]:
        for row in self.rows:
            for order, expression in enumerate(row.chain):
                yield Constraint(expression, row.equation, order)
        for unknown, meaning in solved.items():
            yield Constraint(unknown - meaning, None, solved=unknown)
