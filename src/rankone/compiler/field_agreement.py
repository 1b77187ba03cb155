"""A system of fields compared with the rates that the user wrote, at a few entries.

Values come from the expression tree, with matrices applied as they were given, in extended
precision. Only the entries that a compared one depends on are computed.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache

import mpmath
import numpy as np
import scipy.sparse as ss
import sympy as sp
from numpy.typing import NDArray
from sympy.core.function import AppliedUndef

from rankone.compiler.agreement import FEW_POINTS, POINTS, REMEDY, DisagreementError
from rankone.problem.field_problem import CheckedFields
from rankone.problem.fields import Apply, Field, Vector, size_of
from rankone.support.arrays import (
    DIFFERENCE,
    EXACT_DIGITS,
    MINOR,
    NEGLIGIBLE,
    SAME,
    SEED,
    TINY,
    Array,
)
from rankone.support.errors import quote
from rankone.tensors.coordinates import name_of
from rankone.trajectories.fields.field_system import FieldSystem, Matrix

Extended = NDArray[np.longdouble]
Places = NDArray[np.intp]
_UFUNCS: dict[str, Callable[[Extended], Extended]] = {
    name: getattr(np, name) for name in ("exp", "log", "sin", "cos", "tan", "sinh", "cosh", "tanh")
}


def check_field_agreement(
    problem: CheckedFields, system: FieldSystem, places: Mapping[sp.Expr, slice]
) -> None:
    """Raise a DisagreementError unless what a system computes is as written.

    That is rates, derivatives, initial values and events. They are compared near initial values,
    and at states of the same size away from them, where values that are not finite do not count.
    """
    rng = np.random.default_rng(SEED)
    lower, upper = np.array(system.box).reshape(-1, 2).T
    many = max(FEW_POINTS, POINTS // len(places))
    rows = {state: _sample(where, many, rng) for state, where in places.items()}
    for away in (False, True):
        p = lower + rng.random(lower.size) * (upper - lower)
        t = system.horizon[0] + rng.random() * (system.horizon[1] - system.horizon[0])
        start = system.initial(p)
        numbers = dict(zip(problem.parameters, p.tolist(), strict=True))
        numbers[problem.time[0]] = t
        tree = _Tree(numbers, places, start)
        sizes = _sizes(system, start)
        for state, value in problem.initial.items():
            own = rows[state]
            gap = start[own + places[state].start] - tree.value(value, own)
            size = np.maximum(tree.magnitude(value, own), sizes[places[state]][own])
            _compare(gap, size, NEGLIGIBLE, "initial value", state)
        u = start * (1.0 + MINOR * rng.standard_normal(system.size))
        if away:
            u = sizes * (0.5 + rng.random(system.size))
        direction = sizes * rng.standard_normal(system.size)
        computed = _Computed.of(system, t, u, p, direction)
        for state, rate in problem.rates.items():
            own = rows[state]
            here = _Tree(numbers, places, u)
            size = here.magnitude(rate, own)
            values, slopes, scale = computed.at(own + places[state].start)
            gap = values - here.value(rate, own)
            counted = np.isfinite(gap) if away else np.isfinite(size)
            _compare(np.where(counted, gap, 0.0), size, NEGLIGIBLE, "rate", state)
            near, far = (
                _slope(numbers, places, (u, h * direction), rate, own) / np.longdouble(h)
                for h in (DIFFERENCE, 2.0 * DIFFERENCE)
            )
            curvature = np.abs(far - near)  # three times what the step leaves in the nearer one
            gap = np.maximum(np.abs(slopes - near) - curvature, 0.0)
            counted = np.isfinite(gap if away else curvature)
            _compare(
                np.where(counted, gap, 0.0),
                size + scale,
                SAME,
                "derivative of the rate",
                state,
            )
        _check_events(problem, system, places, (numbers, t, u, p), rows)


def _check_events(
    problem: CheckedFields,
    system: FieldSystem,
    places: Mapping[sp.Expr, slice],
    where: tuple[Mapping[sp.Expr, float], float, Array, Array],
    rows: Mapping[sp.Expr, Places],
) -> None:
    """Compare what crosses zero at events, and the states after them, at a state.

    ``where`` are numbers for symbols, the time, the state (N,) and the parameters (d,).
    """
    numbers, t, u, p = where
    tree, first = _Tree(numbers, places, u), np.zeros(1, dtype=np.intp)
    for event, own in zip(problem.events, system.events, strict=True):
        name = sp.Symbol(str(event.name))
        arguments = [row @ u for row in own.arguments]
        with np.errstate(all="ignore"):
            height = system.height(own, np.array([t]), arguments, p[:, None])
            after = None if own.after is None else system.mapped(own.after, t, u, p)
        gap, size = height - tree.value(event.when, first), tree.magnitude(event.when, first)
        _compare(np.where(np.isfinite(gap), gap, 0.0), size, NEGLIGIBLE, "crossing", name)
        for state in problem.rates if after is not None else ():
            some = rows[state]
            value = (event.then or {}).get(state, state)
            gap = np.asarray(after)[some + places[state].start] - tree.value(value, some)
            size = tree.magnitude(value, some)
            gap = np.where(np.isfinite(gap), gap, 0.0)
            _compare(gap, size, NEGLIGIBLE, f"{name_of(state)} after the event", name)


def _sizes(system: FieldSystem, start: Array) -> Array:
    """The size of each state by its largest initial value, one where that is zero."""
    sizes = np.ones(system.size)
    for unknown in system.unknowns:
        sizes[unknown.rows] = np.abs(start[unknown.rows]).max() or 1.0
    return sizes


def _slope(
    numbers: Mapping[sp.Expr, float],
    places: Mapping[sp.Expr, slice],
    segment: tuple[Array, Array],
    rate: sp.Expr,
    rows: Places,
) -> Extended:
    """Half the difference of a rate at a state plus and minus a change, at some entries."""
    state, change = (np.asarray(part, dtype=np.longdouble) for part in segment)
    after, before = (_Tree(numbers, places, state + side * change) for side in (1, -1))
    return (after.value(rate, rows) - before.value(rate, rows)) / np.longdouble(2.0)


def _sample(rows: slice, many: int, rng: np.random.Generator) -> Places:
    """Entries of a state, its ends among them."""
    n = rows.stop - rows.start
    inner = rng.integers(0, n, many - 2)
    return np.unique([0, n - 1, *inner])


def _compare(gap: Extended, size: Extended, share: float, what: str, state: sp.Expr) -> None:
    """Raise if a difference is more than a share of a size; where there is no size, nothing."""
    defined = np.isfinite(size)
    off = np.where(defined, ~(np.abs(gap) <= share * size + TINY), False)
    if off.any():
        first = int(np.argmax(off))
        raise DisagreementError(
            f"the system of fields does not compute the {what} of {quote(name_of(state))} as it is "
            f"written: it is off by {float(abs(gap[first])):.3g}, where its terms are "
            f"{float(size[first]):.3g} together",
            term=state,
            remedy=REMEDY,
        )


@dataclass(frozen=True, eq=False)
class _Computed:
    """What a system computes at a state: coefficients, functions, and their changes."""

    system: FieldSystem
    coefficients: Array
    state: Array
    direction: Array
    functions: list[Array]
    changes: list[Array]

    @classmethod
    def of(cls, system: FieldSystem, t: float, u: Array, p: Array, direction: Array) -> _Computed:
        """All functions, at all entries."""
        functions, changes = [], []
        with np.errstate(all="ignore"):
            for term in system.pointwise:
                arguments = [*(matrix @ u for matrix in term.arguments), *term.vectors]
                functions.append(system.elementwise(term.function)(t, arguments, p))
                slopes = system.elementwise(f"{term.function}_slopes")(t, arguments, p)
                moved = [matrix @ direction for matrix in term.arguments]
                products = (s * m for s, m in zip(slopes, moved, strict=True))
                changes.append(sum(products, np.zeros(term.after.shape[1])))
            return cls(system, system.coefficients(t, p), u, direction, functions, changes)

    def at(self, rows: Places) -> tuple[Array, Array, Array]:
        """Rates at some entries, their change along the direction, and its size."""
        c = self.coefficients
        values, slopes, size = np.zeros((3, len(rows)))
        with np.errstate(all="ignore"):
            for linear in self.system.linear:
                matrix = c[linear.coefficient] * linear.matrix[rows]
                values += matrix @ self.state
                slopes += matrix @ self.direction
                size += abs(matrix) @ abs(self.direction)
            for source in self.system.sources:
                values += c[source.coefficient] * source.vector[rows]
            for term, function, change in zip(
                self.system.pointwise, self.functions, self.changes, strict=True
            ):
                after = c[term.coefficient] * term.after[rows]
                values += after @ np.broadcast_to(function, (after.shape[1],))
                slopes += after @ change
                size += abs(after) @ abs(change)
        return values, slopes, size


class _Tree:
    """Expressions as they were written, at numbers for symbols and states."""

    def __init__(
        self,
        numbers: Mapping[sp.Expr, float],
        places: Mapping[sp.Expr, slice],
        states: Array | Extended,
    ) -> None:
        self._numbers = {symbol: np.longdouble(number) for symbol, number in numbers.items()}
        self._places, self._states = places, np.asarray(states, dtype=np.longdouble)

    def value(self, expression: sp.Basic, rows: Places) -> Extended:
        """The value at some entries."""
        with np.errstate(all="ignore"):
            return np.broadcast_to(self._value(expression, rows), rows.shape)

    def magnitude(self, expression: sp.Basic, rows: Places) -> Extended:
        """The sum of the absolute values of all terms, as rounding sees it."""
        with np.errstate(all="ignore"):
            return np.broadcast_to(self._magnitude(expression, rows), rows.shape)

    def _value(self, expression: sp.Basic, rows: Places) -> Extended:
        if expression in self._numbers:
            return np.asarray(self._numbers[expression])
        if isinstance(expression, Field | AppliedUndef):
            return _taken(self._states[self._places[expression]], rows)
        if isinstance(expression, Vector):
            return _taken(expression.array.astype(np.longdouble), rows)
        if isinstance(expression, Apply):
            return self._applied(expression, rows, self._value, lambda entries: entries)
        if not expression.args:
            return np.asarray(_number(expression))
        arguments = [self._value(argument, rows) for argument in expression.args]
        if expression.is_Add:
            return np.asarray(sum(arguments[1:], arguments[0]))
        if expression.is_Mul:
            return _product(arguments)
        if expression.is_Pow and not isinstance(expression, sp.exp):
            exponent = expression.exp
            return arguments[0] ** (int(exponent) if exponent.is_Integer else arguments[1])
        name = type(expression).__name__
        if name in _UFUNCS and len(arguments) == 1:
            return _UFUNCS[name](arguments[0])
        return _by_mpmath(expression.func, arguments)

    def _magnitude(self, expression: sp.Basic, rows: Places) -> Extended:
        if isinstance(expression, Apply):
            return self._applied(expression, rows, self._magnitude, np.abs)
        if expression.is_Add:
            sizes = [self._magnitude(argument, rows) for argument in expression.args]
            return np.asarray(sum(sizes[1:], sizes[0]))
        if expression.is_Mul:
            return _product([self._magnitude(argument, rows) for argument in expression.args])
        if expression.is_Pow and expression.exp.is_Integer and expression.exp > 0:
            return self._magnitude(expression.base, rows) ** int(expression.exp)
        return np.abs(self._value(expression, rows))

    def _applied(
        self,
        applied: Apply,
        rows: Places,
        inner: Callable[[sp.Basic, Places], Extended],
        entries_of: Callable[[Extended], Extended],
    ) -> Extended:
        """Some rows of a matrix times what ``inner`` gives of the operand."""
        matrix: Matrix = applied.operator.matrix
        own = ss.coo_array(matrix[np.zeros_like(rows) if matrix.shape[0] == 1 else rows])
        columns, positions = np.unique(own.coords[1], return_inverse=True)
        if size_of(applied.operand) == 1:
            operand = inner(applied.operand, np.zeros(1, dtype=np.intp))
            columns = columns[:0]
            products = entries_of(own.data.astype(np.longdouble)) * operand
        else:
            operand = np.broadcast_to(inner(applied.operand, columns), columns.shape)
            products = entries_of(own.data.astype(np.longdouble)) * operand[positions]
        total = np.zeros(rows.shape, dtype=np.longdouble)
        np.add.at(total, own.coords[0], products)
        return total


def _taken(entries: Extended, rows: Places) -> Extended:
    """Some entries; of a scalar its value."""
    return entries if entries.size == 1 else entries[rows]


def _product(factors: list[Extended]) -> Extended:
    total = factors[0]
    for factor in factors[1:]:
        total = total * factor
    return np.asarray(total)


@cache
def _number(expression: sp.Basic) -> np.longdouble:
    """A number without symbols."""
    if isinstance(expression, sp.Rational):
        return np.longdouble(int(expression.p)) / np.longdouble(int(expression.q))
    return np.longdouble(str(sp.N(expression, EXACT_DIGITS)))


def _by_mpmath(function: Callable[..., sp.Expr], arguments: list[Extended]) -> Extended:
    """A function that NumPy lacks, entry by entry; NaN where it has no real value."""
    symbols = sp.symbols(f"x:{len(arguments)}", real=True)
    compiled = sp.lambdify(symbols, function(*symbols), "mpmath")
    columns = np.broadcast_arrays(*arguments)
    values = np.full(columns[0].shape, np.nan, dtype=np.longdouble)
    with mpmath.workdps(EXACT_DIGITS):
        for place in np.ndindex(values.shape):
            entries = (mpmath.mpf(str(column[place])) for column in columns)
            try:
                outcome = compiled(*entries)
                values[place] = np.longdouble(mpmath.nstr(mpmath.mpf(outcome), EXACT_DIGITS))
            except (ArithmeticError, ValueError, TypeError):
                continue
    return values
