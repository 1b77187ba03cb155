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

__all__ = ["LOST", "Comparison", "check_outputs", "sides"]


_STEP = number(1e-35)
_TOLERANCE = 1e-13
"""Residuals below this part of the terms are rounding. A larger one is compared with what relative
errors of this size in all intermediate results do."""
_LAST_DIGITS = 1e-90
"""Relative error of the evaluation itself, in which log(1 + 1e-178) has no digits either."""
_RUNS, _SEED, _FACTOR = 4, 1914, 10.0
"""Runs with disturbed intermediate results; the largest residual in units of their spread."""
LOST = 0.01
"""A residual above this part of the largest value leaves no digits that count."""
_BELOW_ALL = 1e-30
"""Residuals below this part of the terms do not matter, for example between two steep steps."""
_TINY, _UNDERFLOW = 1e-120, 1e-280
"""Residuals below these are underflow: relative to the largest terms, and absolute."""


def sides(equation: sp.Basic) -> tuple[sp.Expr, sp.Expr]:
    """Both sides of an equation; of an expression that vanishes the right one is zero."""
    return tuple(equation.args) if isinstance(equation, sp.Eq) else (equation, sp.S.Zero)


class Comparison:
    """The difference of two expressions where leaves have values.

    Parameters
    ----------
    left, right : Expr
    leaves : sequence of Expr
        What has values: symbols, functions of time, derivatives.
    computed : sequence of Expr
        Those that generated code gave the values of.
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

    def residual(self, values: Sequence[Number]) -> tuple[float, float]:
        """The difference, and the sum of the absolute values of all terms."""
        residual, size, _ = self._sums(self._program(values))
        return to_float(residual), to_float(size)

    def slope(
        self,
        here: Sequence[Number],
        direction: Sequence[Number],
        noise: int | None = None,
    ) -> Number:
        """The derivative of the residual along a direction, from a difference of tiny step.

        ``noise`` is the seed of intermediate errors that are the same at both points.
        """
        pairs = zip(here, direction, strict=True)
        there = [mpf_add(x, mpf_mul(_STEP, v, PRECISION, "n"), PRECISION, "n") for x, v in pairs]
        before, after = (
            self._sums(self._program(values, _generator(noise), _TOLERANCE))[0]
            for values in (here, there)
        )
        slope: Number = mpf_div(mpf_sub(after, before, PRECISION, "n"), _STEP, PRECISION, "n")
        return slope

    def slope_spread(
        self, here: Sequence[Number], directions: Sequence[Sequence[Number]], exact: float
    ) -> float:
        """How far rounding moves the sum of the derivatives along directions."""
        sums = [
            sum(to_float(self.slope(here, direction, run)) for direction in directions)
            for run in range(_RUNS)
        ]
        return float(max(abs(value - exact) for value in sums))

    def beyond_rounding(
        self, points: Iterable[Sequence[Number]], lost: float = LOST, nothing: float | None = None
    ) -> tuple[int, float] | None:
        """The first point at which the residual is larger than rounding explains, and it.

        Rounding is no excuse for more than the part ``lost`` of the largest value that was
        computed, unless that is below ``nothing``; where that is zero, of each value on its own.
        Where the expressions have no value nothing is said.
        """
        values = list(points)
        at = [self._sums_at(point) for point in values]
        sums = {k: tuple(map(to_float, found)) for k, found in enumerate(at) if found is not None}
        floor = max(_TINY * max((size for _, size, _ in sums.values()), default=0.0), _UNDERFLOW)
        for k, (residual, size, _) in sums.items():
            if abs(residual) > max(_TOLERANCE * size, floor):
                spread = self._spread(values[k], residual)
                if spread is not None and abs(residual) > _FACTOR * spread:
                    return k, residual
        largest = max((abs(part) for *_, part in sums.values()), default=0.0)
        terms = max((size for _, size, _ in sums.values()), default=0.0)
        least = max(floor, nothing or 0.0, _BELOW_ALL * terms)
        for k, (residual, _, part) in sums.items():
            value = abs(part) if nothing == 0.0 else largest
            if abs(residual) > max(lost * value, least):
                unsure = self._spread(values[k], residual, _LAST_DIGITS)
                if unsure is not None and abs(residual) > _FACTOR * unsure:
                    return k, residual
        return None

    def _spread(
        self, values: Sequence[Number], exact: float, size: float = _TOLERANCE
    ) -> float | None:
        """How far rounding of a size moves the residual; None if that cannot be told."""
        rng = np.random.default_rng(_SEED)
        spread = 0.0
        for _ in range(_RUNS):
            sums = self._sums_at(values, rng, size)
            if sums is None:
                return None
            spread = max(spread, abs(to_float(sums[0]) - exact))
        return spread

    def _sums_at(
        self,
        values: Sequence[Number],
        noise: np.random.Generator | None = None,
        size: float = _TOLERANCE,
    ) -> tuple[Number, Number, Number] | None:
        """Residual, size of the terms and what was computed; None where there is no value."""
        try:
            sums = self._sums(self._program(values, noise, size))
            for value in sums:
                to_float(value)
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


def _generator(seed: int | None) -> np.random.Generator | None:
    return None if seed is None else np.random.default_rng([_SEED, seed])


def check_outputs(
    expressions: Mapping[str, sp.Expr],
    values: Mapping[sp.Expr, Array],
    function: Callable[[int], Sequence[Array]],
) -> None:
    """Compare quantities with what was written, at points.

    Parameters
    ----------
    expressions : mapping of str to Expr
        The quantities by how messages name them.
    values : mapping of Expr to ndarray (m,)
        What the symbols are at the points.
    function : callable
        From the number of a point to the computed value of each quantity.

    Raises
    ------
    OptionError
        If one of them is off by more than rounding.
    """
    computed = sp.Dummy()
    leaves = [*values, computed]
    compared = [Comparison(computed, value, leaves, [computed]) for value in expressions.values()]
    count = len(next(iter(values.values())))
    results = np.array([[float(np.ravel(v)[0]) for v in function(k)] for k in range(count)])
    for i, (name, comparison) in enumerate(zip(expressions, compared, strict=True)):
        columns = [*values.values(), results[:, i]]
        finite = np.flatnonzero(np.isfinite(columns).all(axis=0))
        points = ([number(column[k]) for column in columns] for k in finite)
        wrong = comparison.beyond_rounding(points)
        if wrong is not None:
            raise OptionError(
                f"{name}, {quote(expressions[name])}, is not computed as it is written: it is off "
                f"by {wrong[1]:.3g}",
                term=expressions[name],
                remedy="write it in another way, or change the units so that its numbers are "
                "closer to 1",
            )
