"""Residuals of expressions at a hundred digits, and whether they are more than rounding."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence

import numpy as np
import sympy as sp
from mpmath.libmp import fzero, mpf_abs, mpf_add, mpf_div, mpf_mul, mpf_neg, mpf_sub, to_float

from rankone.agreement.precise import PRECISION, NoValueError, Number, Program, number
from rankone.support.arrays import Array
from rankone.support.errors import OptionError
from rankone.support.wording import quote

# Step of difference quotients: half of the hundred digits remain in the difference
_STEP = number(1e-35)
# Residuals below this share of the terms are rounding. A larger one is compared with the effect of
# relative errors of this size in all intermediate results.
_TOLERANCE = 1e-13
# Relative error of the evaluation itself, in which log(1 + 1e-178) has no digits either
_LAST_DIGITS = 1e-90
_RUNS = 4  # Evaluations with disturbed intermediate results: few, as only the largest effect counts
_SEED = 1914
_SPREAD_RATIO = 10.0  # Largest residual over that effect: a few runs do not meet the worst errors
LOST_SHARE = 0.01
"""A residual above this share of the largest value leaves no digits that count."""
# Residuals below this share of the terms do not matter, for example between two steep steps
_NEGLIGIBLE_SHARE = 1e-30
_TINY_SHARE = 1e-120  # Residuals below this share of the largest terms are underflow
# Residuals below this are underflow: products of floating-point numbers end near 1e-308
_UNDERFLOW = 1e-280


def sides(equation: sp.Basic) -> tuple[sp.Expr, sp.Expr]:
    """Both sides of an equation; of an expression that vanishes the right one is zero."""
    return tuple(equation.args) if isinstance(equation, sp.Eq) else (equation, sp.S.Zero)


class Comparison:
    """The difference of two expressions where their leaves have values.

    Parameters
    ----------
    left, right : Expr
    leaves : sequence of Expr
        Symbols, functions of time and derivatives, whose values are given.
    computed : sequence of Expr
        The leaves whose values generated code has computed.
    """

    def __init__(
        self,
        left: sp.Expr,
        right: sp.Expr,
        leaves: Sequence[sp.Expr],
        computed: Sequence[sp.Expr],
    ) -> None:
        terms = [*sp.Add.make_args(left), *sp.Add.make_args(right)]
        self._left = len(sp.Add.make_args(left))
        self._computed = [i for i, term in enumerate(terms) if term.has(*computed)]
        self._program = Program(terms, leaves)

    @property
    def operations(self) -> int:
        """How many operations an evaluation takes."""
        return self._program.operations

    def residual(self, point: Sequence[Number]) -> tuple[float, float]:
        """The difference, and the sum of the absolute values of all terms."""
        residual, size, _ = self._sums(self._program(point))
        return to_float(residual), to_float(size)

    def slope(
        self, here: Sequence[Number], direction: Sequence[Number], seed: int | None = None
    ) -> Number:
        """The derivative of the residual along a direction, from a difference of tiny step.

        With a ``seed``, intermediate results are disturbed, in the same way at both points.
        """
        pairs = zip(here, direction, strict=True)
        there = [mpf_add(x, mpf_mul(_STEP, v, PRECISION, "n"), PRECISION, "n") for x, v in pairs]
        residuals = []
        for point in (here, there):
            noise = None if seed is None else np.random.default_rng([_SEED, seed])
            residuals.append(self._sums(self._program(point, noise, _TOLERANCE))[0])
        change = mpf_sub(residuals[1], residuals[0], PRECISION, "n")
        slope: Number = mpf_div(change, _STEP, PRECISION, "n")
        return slope

    def slope_spread(
        self, here: Sequence[Number], directions: Sequence[Sequence[Number]], exact: float
    ) -> float:
        """How far rounding moves the sum of the derivatives along directions."""
        sums = [
            sum(to_float(self.slope(here, direction, run)) for direction in directions)
            for run in range(_RUNS)
        ]
        return float(max(abs(disturbed - exact) for disturbed in sums))

    def beyond_rounding(
        self,
        points: Iterable[Sequence[Number]],
        lost: float = LOST_SHARE,
        negligible: float | None = None,
    ) -> tuple[int, float] | None:
        """The first point at which rounding does not explain the residual, and the residual.

        A residual above the share ``lost`` of the largest computed value is never rounding, unless
        it is below ``negligible``. If that is zero, each point counts on its own. Points at which
        the expressions have no value are left out.
        """
        leaves = list(points)
        exact_sums = [self._sums_at(point) for point in leaves]
        sums = {k: tuple(map(to_float, s)) for k, s in enumerate(exact_sums) if s is not None}
        largest_size = max((size for _, size, _ in sums.values()), default=0.0)
        floor = max(_TINY_SHARE * largest_size, _UNDERFLOW)
        for k, (residual, size, _) in sums.items():
            if abs(residual) > max(_TOLERANCE * size, floor):
                spread = self._spread(leaves[k], residual)
                if spread is not None and abs(residual) > _SPREAD_RATIO * spread:
                    return k, residual
        largest = max((abs(computed) for *_, computed in sums.values()), default=0.0)
        least = max(floor, negligible or 0.0, _NEGLIGIBLE_SHARE * largest_size)
        for k, (residual, _, computed) in sums.items():
            scale = abs(computed) if negligible == 0.0 else largest
            if abs(residual) > max(lost * scale, least):
                spread = self._spread(leaves[k], residual, _LAST_DIGITS)
                if spread is not None and abs(residual) > _SPREAD_RATIO * spread:
                    return k, residual
        return None

    def _spread(
        self, point: Sequence[Number], exact: float, size: float = _TOLERANCE
    ) -> float | None:
        """How far rounding of a size moves the residual; None if that cannot be told."""
        noise = np.random.default_rng(_SEED)
        spread = 0.0
        for _ in range(_RUNS):
            sums = self._sums_at(point, noise, size)
            if sums is None:
                return None
            spread = max(spread, abs(to_float(sums[0]) - exact))
        return spread

    def _sums_at(
        self,
        point: Sequence[Number],
        noise: np.random.Generator | None = None,
        size: float = _TOLERANCE,
    ) -> tuple[Number, Number, Number] | None:
        """Residual, size of the terms, computed terms; None where they have no value."""
        try:
            sums = self._sums(self._program(point, noise, size))
            for each in sums:
                to_float(each)
        except (NoValueError, OverflowError):
            return None
        return sums

    def _sums(self, terms: Sequence[Number]) -> tuple[Number, Number, Number]:
        residual, size, computed = fzero, fzero, fzero
        for i, term in enumerate(terms):
            signed = term if i < self._left else mpf_neg(term)
            residual = mpf_add(residual, signed, PRECISION, "n")
            size = mpf_add(size, mpf_abs(term), PRECISION, "n")
            if i in self._computed:
                computed = mpf_add(computed, signed, PRECISION, "n")
        return residual, size, computed


def check_outputs(
    expressions: Mapping[str, sp.Expr],
    values: Mapping[sp.Expr, Array],
    function: Callable[[int], Sequence[Array]],
) -> None:
    """Raise an OptionError unless quantities of interest are computed as their expressions say.

    Parameters
    ----------
    expressions : mapping of str to Expr
        The quantities, by their names in messages.
    values : mapping of Expr to ndarray (m,)
        The values of the symbols at the points.
    function : callable
        From the index of a point to the computed value of each quantity.
    """
    computed = sp.Dummy()
    leaves = [*values, computed]
    count = len(next(iter(values.values())))
    outputs = np.array([[float(np.ravel(x)[0]) for x in function(k)] for k in range(count)])
    for i, (name, expression) in enumerate(expressions.items()):
        columns = [*values.values(), outputs[:, i]]
        finite = np.flatnonzero(np.isfinite(columns).all(axis=0))
        points = ([number(column[k]) for column in columns] for k in finite)
        comparison = Comparison(computed, expression, leaves, [computed])
        disagreement = comparison.beyond_rounding(points)
        if disagreement is not None:
            raise OptionError(
                f"{name}, {quote(expression)}, is not computed as it is written: it is off by "
                f"{disagreement[1]:.3g}",
                term=expression,
                remedy="write it in another way, or change the units so that its numbers are "
                "closer to 1",
            )
