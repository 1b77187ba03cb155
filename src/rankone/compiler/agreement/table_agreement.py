"""Generated code compared with the table of terms that a problem came with."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import sympy as sp
from numpy.typing import NDArray

from rankone.compiler.agreement.agreement import REMEDY, ComparedPoints, DisagreementError
from rankone.problem.expressions.parsing import syntax_trees
from rankone.problem.expressions.values import ArrayProgram, value_of
from rankone.problem.problem import Problem
from rankone.problem.tables.term_table import TermTable
from rankone.support.arrays import Array
from rankone.support.wording import quote
from rankone.tensors.bases.coordinates import name_of
from rankone.trajectories.system.system import System, pattern_of

_POINTS = 3  # Points at which a table is compared: each term is in all of them
_ROUNDING = 1e-11  # Differences below this share of the terms are rounding
_STEP = 1e-30  # Imaginary step to a derivative
_SEED = 1938  # Of directions in which the Jacobian is compared


def check_table(problem: Problem, table: TermTable, system: System) -> None:
    """Compare rates, Jacobian and initial values with the terms of a problem, summed one by one.

    Terms that were read from texts are compared with these, too; where there are forms, the texts
    alone are what generated code is compared with.

    A DisagreementError names the first state that is off by more than rounding.
    """
    with np.errstate(all="ignore"):
        points = ComparedPoints.of(system, _POINTS)
        t, p, u = points.time, points.parameters, points.states
        _check_start(problem, system, p)
        if table.forms:
            _check_forms(problem, table, system, points)
            return
        sums = _Sums(problem, table)
        rates, sizes = sums.rates(t, p, u)
        _compare(problem, "rate", points.rates, rates, sizes)
        if table.texts or table.rates:
            _compare(problem, "rate", _written_rates(problem, table, t, p, u), rates, sizes)
        direction = np.random.default_rng(_SEED).uniform(0.5, 1.0, u.shape) * u
        slopes, sizes = sums.slopes(t, p, u, direction)
        _compare(problem, "Jacobian", _along(system, t, p, u, direction), slopes, sizes)


def _check_start(problem: Problem, system: System, p: Array) -> None:
    """Compare initial values at parameters (d, m)."""
    start = [_at_points(e, [*problem.parameters], p) for e in problem.initial.values()]
    generated = np.asarray(system.initial(p), dtype=float)
    _compare(problem, "initial value", generated, np.array(start), np.abs(start))


def _check_forms(
    problem: Problem, table: TermTable, system: System, points: ComparedPoints
) -> None:
    """Compare rates and Jacobian with the texts as they are written.

    The derivative along a direction is the imaginary part of the rates a tiny imaginary step ahead
    (Squire and Trapp, SIAM Review 40 (1998) 110).
    """
    t, p, u = points.time, points.parameters, points.states
    direction = np.random.default_rng(_SEED).uniform(0.5, 1.0, u.shape) * np.where(u, u, 1.0)
    ahead = _written_rates(problem, table, t, p, u + 1j * _STEP * direction)
    slopes = np.where(np.isfinite(points.rates), ahead.imag / _STEP, np.nan)
    sizes = np.abs(points.rates) + _along(system, t, p, u, np.abs(direction), np.abs)
    rates = np.where(np.isfinite(points.rates), ahead.real, np.nan)
    _compare(problem, "rate", points.rates, rates, sizes)
    _compare(problem, "Jacobian", _along(system, t, p, u, direction), slopes, sizes)


def _written_rates(problem: Problem, table: TermTable, t: Array, p: Array, u: Array) -> Array:
    """Right-hand sides at points, evaluated as they are written."""
    constants = problem.constants or {}
    leaves = [problem.time[0], *problem.parameters, *problem.initial, *constants]
    at = [t, *p, *u, *(np.full(t.shape, float(number)) for number in constants.values())]
    if table.texts:
        values = dict(zip(map(name_of, leaves), at, strict=True))
        pieces = map(syntax_trees, table.texts)
        sums = (sum(value_of(tree, values) for _, tree in each) for each in pieces)
        return np.array([np.broadcast_to(rate, t.shape) for rate in sums])
    program = ArrayProgram(dict(zip(leaves, at, strict=True)))
    return np.array([np.broadcast_to(program(rate), t.shape) for rate in table.rates])


Places = NDArray[np.intp]


class _Sums:
    """The terms of a table as arrays, grouped by how many states they multiply."""

    def __init__(self, problem: Problem, table: TermTable) -> None:
        self.functions, self.n = table.functions, len(table.states)
        self.symbols = [problem.time[0], *problem.parameters]
        by_degree: dict[int, list[tuple[float, int, int, tuple[int, ...]]]] = {}
        for coefficient, rate, function, states in table.terms:
            row = float(coefficient), rate, function, states
            by_degree.setdefault(len(states), []).append(row)
        self.groups = [
            tuple(np.array(column) for column in zip(*rows, strict=True))
            for rows in by_degree.values()
        ]

    def rates(self, t: Array, p: Array, u: Array) -> tuple[Array, Array]:
        """Sums of all terms at times (m,), parameters (d, m) and states (n, m); their sizes."""
        sums, sizes = np.zeros_like(u), np.zeros_like(u)
        for scale, rates, states in self._scaled(t, p):
            product = scale * np.prod(u[states], axis=1)
            np.add.at(sums, rates, product)
            np.add.at(sizes, rates, np.abs(product))
        return sums, sizes

    def slopes(self, t: Array, p: Array, u: Array, direction: Array) -> tuple[Array, Array]:
        """Their derivatives along a direction (n, m)."""
        sums, sizes = np.zeros_like(u), np.zeros_like(u)
        for scale, rates, states in self._scaled(t, p):
            for k in range(states.shape[1]):
                others = np.delete(states, k, axis=1)
                product = scale * np.prod(u[others], axis=1) * direction[states[:, k]]
                np.add.at(sums, rates, product)
                np.add.at(sizes, rates, np.abs(product))
        return sums, sizes

    def _scaled(self, t: Array, p: Array) -> list[tuple[Array, Places, Places]]:
        """Of each group coefficients times functions (k, m), rates (k,) and states (k, degree)."""
        columns = np.concatenate([t[None], p])
        functions = np.array([_at_points(f, self.symbols, columns) for f in self.functions])
        return [
            (coefficients[:, None] * functions[of], rates, states.astype(np.intp))
            for coefficients, rates, of, states in self.groups
        ]


def _along(
    system: System,
    t: Array,
    p: Array,
    u: Array,
    direction: Array,
    part: Callable[[Array], Array] = np.asarray,
) -> Array:
    """The generated Jacobian, or a ``part`` of its entries, times a direction (n, m)."""
    pattern = pattern_of(system.jacobian)
    if pattern is None:
        jacobian = np.broadcast_to(system.jacobian(t, u, p), (len(u), *u.shape))
        return np.asarray(np.einsum("ijm,jm->im", part(jacobian), direction))
    slopes, entries = np.zeros_like(u), part(pattern.entries(t, u, p))
    np.add.at(slopes, pattern.rows, entries * direction[pattern.columns])
    return slopes


def _at_points(expression: sp.Expr, symbols: list[sp.Symbol], columns: Array) -> Array:
    """An expression of symbols (k) at their values (k, m), by SymPy's own evaluation."""
    if expression.is_number:
        return np.full(columns.shape[1], float(expression))
    places = [dict(zip(symbols, column, strict=True)) for column in columns.T.tolist()]
    return np.array([float(expression.evalf(subs=place)) for place in places])


def _compare(problem: Problem, what: str, ours: Array, exact: Array, sizes: Array) -> None:
    off = np.abs(ours - exact) > _ROUNDING * sizes
    if (off & np.isfinite(exact)).any():
        state = list(problem.initial)[int(np.argmax(off.any(axis=1)))]
        raise DisagreementError(
            f"the generated {what} of {quote(state)} is not the sum of its terms",
            term=state,
            remedy=REMEDY,
        )
