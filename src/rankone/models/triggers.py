"""Conditions of events as what crosses zero, and whether they hold at the start.

A condition holds where its surface is positive: ``x > 1 and t > 2`` where the smaller one of
``x - 1`` and ``t - 2`` is. What changes in steps alone, such as states that only events reset, is
a case of its own: ``x > 1 and flag == 1`` holds where ``x - 1`` is positive while the flag is 1.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import sympy as sp
from sympy.core.function import AppliedUndef
from sympy.core.relational import Relational
from sympy.logic.boolalg import Boolean, BooleanFunction

from rankone.models.definitions import rate_of
from rankone.support.errors import ProblemError
from rankone.support.wording import quote

_IN_STEPS = (sp.floor, sp.ceiling, sp.sign, Relational, BooleanFunction)
_MOST_DERIVATIVES = 3  # By which it is told to which side a trajectory leaves a surface
_MOST_CASES = 100  # Pieces of a condition whose piecewise functions are written out


@dataclass(frozen=True)
class StartingPoint:
    """Where trajectories start, and how fast.

    Attributes
    ----------
    time : Symbol
        The time.
    start : float
        When they start.
    initial, rates : mapping of Expr to Expr
        For each unknown its value at the start, and its rate.
    """

    time: sp.Symbol
    start: float
    initial: Mapping[sp.Expr, sp.Expr]
    rates: Mapping[sp.Expr, sp.Expr]

    def value(self, expression: sp.Basic) -> sp.Basic:
        """The value of an expression or condition at the start."""
        at_start = expression.xreplace(dict(self.initial))
        return at_start.subs(self.time, sp.Rational(repr(self.start)))

    def moves(self, node: sp.Basic) -> bool:
        """Whether an expression changes otherwise than in steps."""
        if isinstance(node, _IN_STEPS):
            return False
        if isinstance(node, AppliedUndef):
            return bool(self.rates[node] != 0)
        return node == self.time or any(map(self.moves, node.args))

    def changes(self, node: sp.Basic) -> bool:
        """Whether an expression has the time or an unknown."""
        return bool(node.atoms(AppliedUndef)) or self.time in node.free_symbols

    def rate(self, expression: sp.Expr) -> sp.Expr:
        """How fast an expression changes along a trajectory."""
        unknowns = {u: sp.Dummy() for u in expression.atoms(AppliedUndef)}
        written = {symbol: u for u, symbol in unknowns.items()}

        def rate(symbol: sp.Symbol) -> sp.Expr:
            return self.rates[written[symbol]] if symbol in written else sp.S.Zero

        return rate_of(expression.xreplace(unknowns), self.time, rate).xreplace(written)

    def after(self, condition: Boolean) -> Boolean:
        """Whether a condition holds right after the start; it stays where parameters decide."""
        comparisons = condition.atoms(Relational)
        return condition.xreplace({each: self._after(each) for each in comparisons})

    def _after(self, comparison: Relational) -> Boolean:
        """The truth of one comparison right after the start."""
        difference = comparison.lhs - comparison.rhs
        for _ in range(_MOST_DERIVATIVES):
            height = self.value(difference)
            if not height.is_number or not _vanishes(height):
                break
            if isinstance(comparison, sp.Eq | sp.Ne) or not self.moves(difference):
                break
            difference = self.rate(difference)
        return comparison.func(self.value(difference), 0)


def surface(condition: Boolean, point: StartingPoint, subject: str) -> sp.Expr:
    """What is positive where a condition holds, and crosses zero where it begins or ends to hold.

    A ProblemError that names the ``subject`` if the condition is an equality of what changes
    continuously, or has too many cases.
    """
    condition = sp.to_nnf(_written_out(condition, subject), simplify=False)
    if not any(map(point.moves, _sides(condition))):
        return sp.Piecewise((1, condition), (-1, True))
    if isinstance(condition, Relational):
        return _difference(condition, subject)
    conditions = list(condition.args)
    moving = [c for c in conditions if any(map(point.moves, _sides(c)))]
    surfaces = [surface(c, point, subject) for c in moving]
    steps = condition.func(*(c for c in conditions if c not in moving))
    if isinstance(condition, sp.And):
        smallest = sp.Min(*surfaces)
        return sp.Piecewise((smallest, steps), (-1, True)) if steps != sp.true else smallest
    largest = sp.Max(*surfaces)
    return sp.Piecewise((1, steps), (largest, True)) if steps != sp.false else largest


def _comparisons(condition: Boolean) -> list[Relational]:
    return sorted(condition.atoms(Relational), key=sp.default_sort_key)


def _sides(condition: Boolean) -> list[sp.Expr]:
    """The two sides of all comparisons."""
    return [side for comparison in _comparisons(condition) for side in comparison.args]


def _difference(comparison: Relational, subject: str) -> sp.Expr:
    """What is positive where one comparison of continuous changes holds."""
    if isinstance(comparison, sp.Eq | sp.Ne):
        raise ProblemError(
            f"{subject} compares what changes continuously: {quote(comparison)}",
            term=comparison,
            remedy="write < or > in its trigger",
        )
    difference = comparison.lhs - comparison.rhs
    return difference if isinstance(comparison, sp.Gt | sp.Ge) else -difference


def _written_out(condition: Boolean, subject: str, cases: int = 1) -> Boolean:
    """The condition with comparisons of the branches in place of piecewise functions."""
    for comparison in _comparisons(condition):
        functions = sorted(comparison.atoms(sp.Piecewise), key=sp.default_sort_key)
        inner = [f for f in functions if not any(b.has(sp.Piecewise) for b in f.args)]
        if not inner:
            continue
        function = inner[0]
        cases *= len(function.args)
        if cases > _MOST_CASES:
            message = f"the trigger of {subject} has more than {_MOST_CASES} cases"
            raise ProblemError(message, term=condition, remedy="write it with fewer branches")
        before, pieces = sp.false, []
        for branch, where in function.args:
            reached = sp.And(where, sp.Not(before))
            pieces.append(sp.And(reached, comparison.xreplace({function: branch})))
            before = sp.Or(before, where)
        return _written_out(condition.xreplace({comparison: sp.Or(*pieces)}), subject, cases)
    return condition


def _vanishes(height: sp.Expr) -> bool:
    if height.is_zero is not None:
        return bool(height.is_zero)
    return bool(sp.N(height) == 0)
