"""The generated module, and its table of terms, compared with what the user wrote."""

from __future__ import annotations

from collections import ChainMap
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import sympy as sp
from mpmath.libmp import to_float
from numpy.typing import NDArray
from sympy.core.function import AppliedUndef

from rankone.compiler.comparison import LOST_SHARE, Comparison, NoValueError, total
from rankone.compiler.passes import FirstOrderSystem
from rankone.problem.algebra.term_table import TermTable
from rankone.problem.expressions.boundaries import ArrayProgram, value_of
from rankone.problem.expressions.conditions import rate_of
from rankone.problem.expressions.parsing import syntax_trees
from rankone.problem.forms import Jump
from rankone.problem.problem import Problem
from rankone.support.arrays import ACCUMULATED, COARSE, EPSILON, NEGLIGIBLE, SAME, SEED, Array
from rankone.support.errors import OptionError, ProblemError, quote
from rankone.tensors.coordinates import name_of
from rankone.trajectories.bifurcations import before_start
from rankone.trajectories.system.system import System, pattern_of

POINTS = 20
"""Points of the horizon, the box and plausible states at which a problem is compared."""
FEW_POINTS = 3  # Points at which what takes long is compared
AGREED = 1e-10
"""Differences below this share of the largest value are rounding of sums and products."""
_MOST_OPERATIONS = 12000  # Operations at a hundred digits for all rates: some tenths of a second
# Shares of the horizon over which states have moved from the start, at their first rate
_DRIFTS = (0.0, COARSE, 0.03, 0.3)
_NOISE = (NEGLIGIBLE, 1e-5, 0.01, 0.3)  # Relative distances of states from there; zeros move too
# One point of this many is still: its states are those at the start, apart from the noise
_STILL_PERIOD = len(_DRIFTS)
_LARGEST_DRIFT = 10.0  # Of a state over its largest initial value: a first rate may be a short peak
# Derivatives may be off by this many times the effect of relative errors of 1e-13, so of 1e-8
_SLOPE_SPREAD_RATIO = 1e5
REMEDY = "write it in another way, or change the units so that its numbers are closer to 1"
"""What to do where generated code is off."""


class DisagreementError(ProblemError):
    """Generated code differs from the problem by more than rounding."""


@dataclass(frozen=True)
class ComparedPoints:
    """Where a problem is compared: times (m,), parameters (d, m), states and rates (n, m).

    ``sizes`` (n,) are the sizes of the states, as far as the start and the first rates tell.
    """

    time: Array
    parameters: Array
    states: Array
    rates: Array
    sizes: Array

    @classmethod
    def of(cls, system: System, count: int) -> ComparedPoints:
        """Points over the horizon, the box and plausible states; the same for the same system."""
        rng = np.random.default_rng(SEED)
        start, end = system.horizon
        box = np.asarray(system.box, dtype=float).reshape(-1, 2)
        time = start + (end - start) * rng.random(count)
        p = box[:, :1] + (box[:, 1:] - box[:, :1]) * rng.random((len(box), count))
        initial = np.asarray(system.initial(p), dtype=float)
        first = np.nan_to_num(np.asarray(system.rhs(start, initial, p), dtype=float))
        drift = first * (time - start) * np.resize(_DRIFTS, count)
        size = np.abs(initial).max(axis=1, keepdims=True)
        longest = np.where(size > 0.0, _LARGEST_DRIFT * size, np.inf)
        moved = initial + np.clip(drift, -longest, longest)
        noise = np.repeat(_NOISE, -(-count // len(_NOISE)))[:count]
        states = moved * (1.0 + noise * rng.uniform(-1.0, 1.0, moved.shape))
        reach = np.abs(first).max(axis=1, keepdims=True) * (end - start)
        away = noise * np.where(reach > 0.0, reach, 1.0) * (np.resize(_DRIFTS, count) > 0.0)
        apart = rng.uniform(0.5, 1.0, moved.shape)  # terms of equal states may cancel exactly
        states = np.where(moved == 0.0, away * apart, states)
        states = np.where(np.isfinite(states), states, initial)
        states = system.constraints.projected(time, states, p)
        rates = np.asarray(system.rhs(time, states, p), dtype=float)
        return cls(time, p, states, rates, np.abs(moved).max(axis=1))


def disagreeing_rate(lifted: System, system: System) -> int | None:
    """The first state whose rate the lifted system has wrong; None if all are right.

    A lifted system is multiplied out, and its numbers may overflow where those of the original
    system do not.
    """
    with np.errstate(all="ignore"):
        points = ComparedPoints.of(system, POINTS)
        t, p, u = points.time, points.parameters, points.states
        states = np.concatenate([u, np.ones((lifted.n_lifted, t.size))])
        for _ in range(lifted.n_lifted):  # some stand for functions of others
            states[len(u) :] = lifted.meanings(t, states, p)
        finite = np.isfinite(points.rates).all(axis=0) & np.isfinite(states).all(axis=0)
        rates = np.asarray(lifted.rhs(t, states, p), dtype=float)[: len(u)]
        size = np.abs(points.rates[:, finite]).max(axis=1, initial=0.0)
        errors = np.abs(rates - points.rates)[:, finite]
        disagreeing = ~(errors <= SAME * size[:, None]).all(axis=1)
    return int(np.argmax(disagreeing)) if disagreeing.any() else None


def check_problem(
    problem: Problem, first_order: FirstOrderSystem, system: System, lost: float = LOST_SHARE
) -> None:
    """Compare rates, Jacobian, initial values and jumps with the problem as it was written.

    A DisagreementError names the first equation that is off by more than rounding, which may spoil
    the share ``lost`` of the largest value of each.
    """
    _ProblemCheck(problem, first_order, system, lost).run()


class _ProblemCheck:
    """The comparisons of one problem.

    ``highest`` are the indices of the states whose rates are not states themselves: the generated
    code computes these rates, and the equations determine them. ``few`` says whether the equations
    have so few operations that many points are compared.
    """

    def __init__(
        self, problem: Problem, first_order: FirstOrderSystem, system: System, lost: float
    ) -> None:
        self.problem, self.first_order, self.system, self.lost = problem, first_order, system, lost
        clock, *parameters = first_order.coordinates
        self.symbols = [c.symbol for c in parameters]
        self.parameters = _places(self.symbols)
        states = [state.expression for state in first_order.states]
        rates = [rate_of(state, clock.symbol) for state in states]
        lower = {*states}
        self.highest = [i for i, rate in enumerate(rates) if rate not in lower]
        computed = [rates[i] for i in self.highest]
        places = _places([clock.symbol, *self.symbols, *states, *computed])
        pairs = zip(problem.equations, problem.residuals, strict=True)
        written = [_written(*pair, problem.shorthand.put_in) for pair in pairs]
        own = {*computed}
        self.compared = [Comparison(*both, places, own) for both in written]
        functions = [{f for side in both for f in side.atoms(sp.Function)} for both in written]
        # differences are derivatives, unless functions of the user lack the digits
        self.smooth = [not any(hasattr(f, "_imp_") for f in applied) for applied in functions]

    def run(self) -> None:
        """Raise a DisagreementError at the first disagreement."""
        operations = sum(len(comparison.program.steps) for comparison in self.compared)
        count = max(min(POINTS, _MOST_OPERATIONS // max(operations, 1)), FEW_POINTS)
        self.few = count > FEW_POINTS
        with np.errstate(all="ignore"):
            self.points = ComparedPoints.of(self.system, count)
            self._check_rates()
            self._check_jacobian()
            self._check_initial()
            if self.first_order.jumps:
                self._check_jumps()
            if self.first_order.events:
                self._check_events()

    def _check_rates(self) -> None:
        """Raise if the generated rates do not solve the equations."""
        points, clock = self.points, self.first_order.coordinates[0]
        finite = _finite(points.states, points.rates)
        p, u, f = points.parameters, points.states, points.rates[self.highest]
        leaves = [np.array([points.time[k], *p[:, k], *u[:, k], *f[:, k]]) for k in finite]
        slowest = ACCUMULATED * np.nan_to_num(points.sizes) / (clock.upper - clock.lower)
        solved: dict[int | None, list[int]] = {}  # states by the equation solved for their rate
        for i, equation in enumerate(self.first_order.origins):
            solved.setdefault(equation, []).append(i)
        for origin, comparison in enumerate(self.compared, start=1):
            states = [*solved.get(origin, ()), *solved.get(None, ())]
            negligible = float(slowest[states].min(initial=np.inf)) if states else 0.0
            disagreement = comparison.beyond_rounding(leaves, self.lost, negligible)
            if disagreement is not None:
                equation = self.problem.equations[origin - 1]
                raise DisagreementError(
                    f"the generated code does not compute {quote(equation)} as it is written: at "
                    f"{self._described(finite[disagreement[0]])} the sides differ by "
                    f"{disagreement[1]:.3g}",
                    equation=origin,
                    term=equation,
                    remedy=REMEDY,
                )

    def _check_jacobian(self) -> None:
        """Raise if moving the states and, by the Jacobian, the rates leaves the equations."""
        points, highest = self.points, self.highest
        rng = np.random.default_rng(SEED)
        moving = [k for k in _finite(points.states, points.rates) if k % _STILL_PERIOD]
        for k in moving[: FEW_POINTS if self.few else 1]:
            t, p = points.time[k], points.parameters[:, k]
            u, f = points.states[:, k], points.rates[highest, k]
            jacobian = np.asarray(self.system.jacobian(t, u, p), dtype=float)
            size = np.where(u != 0.0, np.abs(u), 1.0)
            direction = size * rng.uniform(0.5, 1.0, len(u)) * rng.choice([-1.0, 1.0], len(u))
            direction = self.system.constraints.tangential(t, u, p, direction)
            change = jacobian @ direction
            if not np.isfinite(jacobian).all():
                continue
            here = np.array([t, *p, *u, *f])
            along = [
                np.array([0.0, *(0.0 * p), *direction, *(0.0 * f)]),
                np.array([0.0, *(0.0 * p), *(0.0 * u), *change[highest]]),
            ]
            negligible = 4.0 * EPSILON * np.abs(direction).max()
            for origin, comparison in enumerate(self.compared, start=1):
                if not self.smooth[origin - 1]:
                    continue
                try:
                    slopes = [comparison.slope(here, direction) for direction in along]
                    error = to_float(total(*slopes))
                    scale = sum(map(abs, map(to_float, slopes))) + comparison.residual(here)[1]
                    if abs(error) <= SAME * scale + negligible:
                        continue
                    spread = comparison.slope_spread(here, along, error)
                except (NoValueError, OverflowError):
                    continue
                if abs(error) > _SLOPE_SPREAD_RATIO * spread:
                    raise DisagreementError(
                        "the generated Jacobian is not the derivative of the equation: at "
                        f"{self._described(k)} it is off by {error:.3g} along the states",
                        equation=origin,
                        remedy=REMEDY,
                    )

    def _check_initial(self) -> None:
        """Raise if generated initial values are not those of the problem."""
        p = self.points.parameters
        generated = np.asarray(self.system.initial(p), dtype=float)
        if self.first_order.rest is not None:
            self._check_rest(generated)
            return
        guessed = self.first_order.constraints.guessed
        for i, start in enumerate(self.first_order.initial):
            state = quote(self.first_order.states[i].expression)
            subject = f"the initial value of {state}, {quote(start)},"
            if i not in guessed:
                self._check_value(subject, start, self.parameters, generated[i], p)

    def _check_rest(self, generated: Array) -> None:
        """Raise if generated starts at steady states are not those of the problem before it."""
        problem, rest, before = self.problem.rest, self.first_order.rest, self.system.rest
        size = np.abs(generated).max()
        if problem is not None and rest is not None and before is not None:
            system = before_start(self.system, before)
            check_problem(problem, rest.system, system, self.lost)
            # what decays to zero is compared with what it was
            begun = system.initial(self.points.parameters)
            size = max(size, float(np.abs(begun).max()))
        clock, points = self.first_order.coordinates[0], self.points.parameters.T
        for k, point in enumerate(points[:FEW_POINTS]):
            at = dict(zip(self.symbols, point.tolist(), strict=True))
            states = self.problem.trajectory({clock.symbol: clock.lower, **at}).states
            for state, start in zip(self.first_order.states, generated[:, k], strict=True):
                off = abs(float(states[state.name]) - start)
                if off > SAME * size:
                    raise DisagreementError(
                        f"the steady state at the start is not where a long integration ends: "
                        f"{quote(state.expression)} differs by {off:.3g} at {self._described(k)}",
                        term=state.expression,
                        remedy="give a larger settle= to SteadyState",
                    )

    def _check_jumps(self) -> None:
        """Raise if generated values after jumps are not those of the problem."""
        first_order, p, u = self.first_order, self.points.parameters, self.points.states
        clock = first_order.coordinates[0].name
        places = _places([*self.symbols, *first_order.functions])
        for kind, (values_after, times) in enumerate(Jump.kinds(first_order.jumps).items()):
            generated = np.asarray(self.system.jumps.jumped(kind, u, p), dtype=float)
            for i, after in enumerate(values_after):
                if after != first_order.functions[i]:
                    state = quote(first_order.states[i].expression)
                    at = f"the jump at {clock} = {times[0]:g}"
                    subject = f"the value of {state} after {at}, {quote(after)},"
                    self._check_value(subject, after, places, generated[i], np.concatenate([p, u]))

    def _check_events(self) -> None:
        """Raise if the generated events are not those of the problem."""
        first_order, p, u = self.first_order, self.points.parameters, self.points.states
        t = self.points.time
        clock = first_order.coordinates[0].symbol
        places = _places([clock, *self.symbols, *first_order.functions])
        columns = np.concatenate([t[None], p, u])
        for form, event in zip(first_order.events, self.system.events, strict=True):
            what = f"event {quote(form.name)}"
            pairs = (
                (form.when, event.when),
                (form.delay, event.delay),
                (form.priority, event.priority),
            )
            for written, function in pairs:
                if written is not None and function is not None:
                    values = np.broadcast_to(np.asarray(function(t, u, p), dtype=float), t.shape)
                    subject = f"{quote(written)} of {what}"
                    self._check_value(subject, written, places, values, columns)
            if form.at is not None and event.at is not None:
                subject = f"the time of {what}, {quote(form.at)},"
                self._check_value(subject, form.at, self.parameters, event.at(p), p)
            if form.then is None or event.then is None:
                continue
            generated = np.asarray(event.then(t, u, p), dtype=float)
            for i, after in enumerate(form.then):
                if after != first_order.functions[i]:
                    state = quote(first_order.states[i].expression)
                    subject = f"the value of {state} after {what}, {quote(after)},"
                    self._check_value(subject, after, places, generated[i], columns)

    def _check_value(
        self,
        subject: str,
        expression: sp.Expr,
        places: dict[sp.Expr, int],
        generated: Array,
        columns: Array,
    ) -> None:
        """Raise if generated values (m,) of an expression are off; see :func:`_value_error`."""
        error = _value_error(expression, places, columns, generated, self.lost)
        if error is not None:
            raise DisagreementError(
                f"the generated code does not compute {subject} as it is written: it is off by "
                f"{error:.3g}",
                term=expression,
                remedy=REMEDY,
            )

    def _described(self, k: int) -> str:
        """Where a point is, for messages."""
        points, (clock, *parameters) = self.points, self.first_order.coordinates
        named = [(clock.name, points.time[k])]
        named += zip((c.name for c in parameters), points.parameters[:, k], strict=True)
        named += zip((s.name for s in self.first_order.states), points.states[:, k], strict=True)
        return ", ".join(f"{name} = {coordinate:.6g}" for name, coordinate in named)


def check_outputs(
    expressions: Mapping[str, sp.Expr],
    values: Mapping[sp.Expr, Array],
    function: Callable[[int], Sequence[Array]],
) -> None:
    """Raise an OptionError unless quantities of interest are computed as their expressions say.

    ``expressions`` are the quantities by their names in messages, ``values`` (m,) those of the
    symbols at the points; ``function`` gives the computed quantities from the index of a point.
    """
    columns, places = np.array(list(values.values())), _places(values)
    count = columns.shape[1]
    outputs = np.array([[float(np.ravel(x)[0]) for x in function(k)] for k in range(count)])
    for i, (name, expression) in enumerate(expressions.items()):
        error = _value_error(
            expression, places, columns, outputs[:, i], LOST_SHARE, rounded_leaves=True
        )
        if error is not None:
            raise OptionError(
                f"{name}, {quote(expression)}, is not computed as it is written: it is off by "
                f"{error:.3g}",
                term=expression,
                remedy=REMEDY,
            )


def _value_error(
    expression: sp.Expr,
    places: dict[sp.Expr, int],
    columns: Array,
    generated: Array,
    lost: float,
    *,
    rounded_leaves: bool = False,
) -> float | None:
    """How far generated values (m,) of an expression are off.

    ``places`` has the rows of the columns (l, m) in which the values of leaves are; those of states
    of a solution are ``rounded_leaves``.
    """
    computed = sp.Dummy()
    own = ChainMap({computed: len(places)}, places)
    comparison = Comparison(computed, expression, own, {computed})
    columns = np.concatenate([columns, generated[None]])
    points = (columns[:, k] for k in _finite(columns))
    disagreement = comparison.beyond_rounding(points, lost, rounded_leaves=rounded_leaves)
    return None if disagreement is None else disagreement[1]


def _written(
    equation: sp.Basic, residual: sp.Expr, put_in: Callable[[sp.Expr], sp.Expr]
) -> tuple[sp.Expr, sp.Expr]:
    """Both sides of an equation, of unknowns and their derivatives alone.

    ``put_in`` puts in constants and definitions.
    """
    nested = any(not isinstance(d.expr, AppliedUndef) for d in equation.atoms(sp.Derivative))
    if isinstance(equation, sp.Eq) and not nested:
        return put_in(equation.lhs), put_in(equation.rhs)
    return residual if nested else put_in(equation), sp.S.Zero


def _places(leaves: Iterable[sp.Expr]) -> dict[sp.Expr, int]:
    """Each leaf with its row."""
    return {leaf: i for i, leaf in enumerate(leaves)}


def _finite(*arrays: Array) -> list[int]:
    """The points at which all is finite; others are refused elsewhere, or never met."""
    finite = np.logical_and.reduce([np.isfinite(array).all(axis=0) for array in arrays])
    return [int(k) for k in np.flatnonzero(finite)]


# -----------------------------------------------------------------------------
# Generated code compared with the table of terms that a problem came with.


def check_table(problem: Problem, table: TermTable, system: System) -> None:
    """Compare rates, Jacobian and initial values with the terms of a problem, summed one by one.

    Terms that were read from texts are compared with these, too; where there are forms, the texts
    alone are what generated code is compared with.

    A DisagreementError names the first state that is off by more than rounding.
    """
    with np.errstate(all="ignore"):
        points = ComparedPoints.of(system, FEW_POINTS)
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
        direction = np.random.default_rng(SEED).uniform(0.5, 1.0, u.shape) * u
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
    direction = np.random.default_rng(SEED).uniform(0.5, 1.0, u.shape) * np.where(u, u, 1.0)
    step = EPSILON**2
    ahead = _written_rates(problem, table, t, p, u + 1j * step * direction)
    slopes = np.where(np.isfinite(points.rates), ahead.imag / step, np.nan)
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
    off = np.abs(ours - exact) > AGREED * sizes
    if (off & np.isfinite(exact)).any():
        state = list(problem.initial)[int(np.argmax(off.any(axis=1)))]
        raise DisagreementError(
            f"the generated {what} of {quote(state)} is not the sum of its terms",
            term=state,
            remedy=REMEDY,
        )
