"""Initial values and resets of problems with algebraic equations: what they determine, and must.

Algebraic unknowns follow from the others. Where they were solved for, their initial values and
their values after a reset are expressions; else initial values are guesses for Newton's method.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import sympy as sp

from rankone.problem.algebra.algebraic import Constraint, Reduction
from rankone.problem.algebra.mass import evaluation
from rankone.problem.box import Time
from rankone.problem.expressions.notation import exact
from rankone.problem.forms import Coordinate
from rankone.problem.functions import known_applied
from rankone.problem.jumps import Resets
from rankone.problem.user_events import Event
from rankone.support.arrays import Array
from rankone.support.errors import ProblemError
from rankone.support.precision import NEGLIGIBLE
from rankone.support.wording import listing, quote

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
