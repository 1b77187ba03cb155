"""Taylor steps of stacked trajectories whose rates are polynomials in the states.

The coefficients of a step come from those before by products of polynomials (Jorba & Zou, A
software package for the numerical integration of ODEs by means of high-order Taylor methods,
Experimental Mathematics 14 (2005), 99). An order of all trajectories takes a few calls of NumPy,
however many terms the rates have, and the steps are longer than those of DOP853.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from weakref import WeakKeyDictionary

import numpy as np
import scipy.integrate
import scipy.sparse
from numpy.typing import NDArray
from scipy.integrate import DOP853

from rankone.support.arrays import COARSE, MANY_STATES, MINOR, NEGLIGIBLE, TINY, Array
from rankone.support.budget import charge
from rankone.support.costs import CALL, Cost
from rankone.trajectories.integrators.integrator import NODES, Tolerances
from rankone.trajectories.stacks import explicit
from rankone.trajectories.system.system import System


@dataclass(frozen=True)
class _SeriesSteps:
    """How the order and the steps of a series are chosen."""

    least_order: int
    most_order: int
    affine_orders: float
    step_orders: float
    last: int
    aimed_error: float
    most_error: float
    first_share: float
    first_trials: int
    over_dop853: float
    least_parts: int
    most_parts: int
    stiff_share: float
    kept: int


_SERIES = _SeriesSteps(
    least_order=8,
    most_order=40,
    # Order of the series of affine rates over that of others: they converge everywhere, so that
    # steps grow with the order
    affine_orders=1.6,
    step_orders=8.0,  # Orders that cost as much as what a step takes besides
    last=2,  # Coefficients that choose a step: one may vanish by symmetry
    # Size of the last coefficient, and the largest error of a step, over the tolerance
    aimed_error=MINOR,
    most_error=0.2,
    first_share=COARSE,  # First trial of the first step, over the way
    first_trials=12,  # Trials of a first step whose coefficients are not finite
    over_dop853=4.2,  # Steps over those of DOP853 at a tolerance of one
    # Parts of a step, and the largest product of the distances of a share from all nodes of a path
    least_parts=4,
    most_parts=64,
    # Step times decay rate from which stability limits a step, over the one at which the last
    # coefficient is as large as the state
    stiff_share=0.7,
    kept=20,  # Steps to the end that cost less than implicit ones from the start
)
DOP853_POWER = 1.0 / DOP853.order
"""Steps of DOP853 grow with this power of one over the tolerance."""
_DERIVATIVE_SHARES = np.linspace(0.0, 1.0, 4)  # Of a step, where a derivative is looked at
_NODE_PRODUCT = 0.5 ** (2 * NODES.size - 2)
_ORDER_COST = Cost(9 * CALL, 0.6)  # An order: once, and for each number that is read
_STEP_COST = Cost(80 * CALL, 0.5)  # A step: once, and for each product of coefficients


def steps_ratio(tolerance: float, affine: bool = False) -> float:
    """Steps of a series over those of DOP853, where the tolerance limits both."""
    ratio = _SERIES.over_dop853 * math.pow(tolerance, DOP853_POWER)
    if not affine:
        return ratio
    usual, order = taylor_order(tolerance), taylor_order(tolerance, affine=True)
    return ratio * _affine_step(tolerance, usual) / _affine_step(tolerance, order)


def taylor_order(tolerance: float, affine: bool = False) -> int:
    """The order for a tolerance: more than Jorba & Zou take, since calls of NumPy are what costs.

    The last coefficient then falls by a factor e with each order, but for ``affine`` rates.
    """
    digits = max(-math.log(tolerance), 0.0)
    order = 0.5 * (digits + math.sqrt(digits**2 + 4.0 * _SERIES.step_orders * digits))
    order *= _SERIES.affine_orders if affine else 1.0
    return min(max(round(order), _SERIES.least_order), _SERIES.most_order)


def _affine_step(tolerance: float, order: int) -> float:
    """The step of affine rates, times the fastest of them, by the series of an exponential."""
    return math.exp((math.lgamma(order + 1.0) + math.log(tolerance)) / order)


@dataclass(frozen=True)
class _Products:
    """Products of variables ``left`` and ``right``, which are the variables at ``places``."""

    left: NDArray[np.intp]
    right: NDArray[np.intp]
    places: slice


@dataclass(frozen=True)
class TaylorSeries:
    """The rates of m trajectories as polynomials in n states, for their Taylor coefficients.

    Variables are the states, then their ``products``, level by level. The rates are ``constant``
    (n, m) and ``sums`` (n, flows) of the ``factors`` (flows, m) times the ``variables`` (flows,):
    a flow may appear in several rates, as that of a reaction does. Where no factor depends on the
    parameters, ``sums`` (n, variables) takes all variables. Of many states it is a sparse matrix.
    """

    constant: Array
    sums: Array | scipy.sparse.csr_array
    products: tuple[_Products, ...]
    variables: NDArray[np.intp]
    factors: Array | None = None

    @classmethod
    def of(cls, system: System, parameters: Array) -> TaylorSeries:
        """The series of a separated system without functions of time at parameters (d, m)."""
        return TaylorTerms.of(system).at(system, parameters)

    @property
    def size(self) -> int:
        """Number of variables."""
        return len(self.constant) + sum(level.left.size for level in self.products)

    def coefficients(self, states: Array, h: float, order: int) -> Array:
        """Taylor coefficients of the states (n, m), times powers of ``h``: (order + 1, n, m)."""
        return Recursion(self, order)(states, h).reshape(-1, *states.shape)

    def agrees(self, states: Array, rates: Array) -> bool:
        """Whether rates (n, m) at states are those of the series, but for rounding."""
        flows = self._flows(states)
        missed = np.abs(self.sums @ flows + self.constant - rates)
        terms = abs(self.sums) @ np.abs(flows) + np.abs(self.constant)
        return bool((missed <= NEGLIGIBLE * terms).all())

    def _flows(self, states: Array) -> Array:
        """What the sums are of, at states (n, m): (flows, m) or (variables, m)."""
        variables = np.empty((self.size, states.shape[1]))
        variables[: len(states)] = states
        for level in self.products:
            variables[level.places] = variables[level.left] * variables[level.right]
        return variables if self.factors is None else variables[self.variables] * self.factors

    def cost(self, order: int) -> float:
        """Operations of a step."""
        n, m = self.constant.shape
        return _step_cost(order, m, n, self.products, self.variables.size)


def _step_cost(order: int, m: int, n: int, products: Sequence[_Products], variables: int) -> float:
    """Operations of a step of m trajectories of n states, with so many products and variables."""
    count = sum(level.left.size for level in products)
    multiplied = m * 0.5 * order * order * count
    read = m * (2.0 * n + variables + 2.0 * count)
    return float(order * _ORDER_COST(read) + _STEP_COST(multiplied))


@dataclass(frozen=True)
class TaylorTerms:
    """The terms of n rates as polynomials in the states, whatever the parameters are.

    ``constants`` are the terms without a state: coefficient, rate, and rows of the factor of each
    parameter. ``flows`` are such rows for each flow, empty where no factor depends on the
    parameters. The others are those of a :class:`TaylorSeries`.
    """

    n: int
    constants: tuple[tuple[float, int, tuple[int, ...]], ...]
    sums: Array | scipy.sparse.csr_array
    products: tuple[_Products, ...]
    variables: NDArray[np.intp]
    flows: tuple[tuple[int, ...], ...]

    @classmethod
    def of(cls, system: System) -> TaylorTerms:
        """The terms of a separated system without functions of time."""
        if system not in _terms:
            _terms[system] = _terms_of(system)
        return _terms[system]

    def at(self, system: System, parameters: Array) -> TaylorSeries:
        """The series of the system at parameters (d, m)."""
        m = parameters.shape[1]
        rows = [system.parameter_factors(j, p) for j, p in enumerate(parameters)]
        constant = np.zeros((self.n, m))
        for coefficient, state, indices in self.constants:
            constant[state] += coefficient * _factor(rows, indices, m)
        factors = None
        if self.flows:
            factors = np.array([_factor(rows, indices, m) for indices in self.flows])
        return TaylorSeries(constant, self.sums, self.products, self.variables, factors)

    @property
    def affine(self) -> bool:
        """Whether the rates have no products of states."""
        return not self.products

    def cost(self, tolerance: float, m: int) -> float:
        """Operations of as many steps of m trajectories as one of DOP853 is long."""
        order = taylor_order(tolerance, self.affine)
        step = _step_cost(order, m, self.n, self.products, self.variables.size)
        return steps_ratio(tolerance, self.affine) * step


_terms: WeakKeyDictionary[System, TaylorTerms] = WeakKeyDictionary()
"""The terms of systems in order, for as long as there are these."""


def _terms_of(system: System) -> TaylorTerms:
    n, constants = system.n_differential, list[tuple[float, int, tuple[int, ...]]]()
    entries, targets, columns = list[float](), list[int](), list[int]()
    flows = dict[tuple[tuple[int, ...], tuple[int, ...]], int]()
    for coefficient, state, (_, *indices), states in system.terms:
        if not states:
            constants.append((coefficient, state, tuple(indices)))
            continue
        flow = tuple(sorted(states)), tuple(indices)
        entries.append(coefficient)
        targets.append(state)
        columns.append(flows.setdefault(flow, len(flows)))
    places, products = _variables(n, [monomial for monomial, _ in flows])
    variables = np.array([places[monomial] for monomial, _ in flows], dtype=np.intp)
    varying = any(any(indices) for _, indices in flows)
    if not varying:
        columns = variables[columns].tolist()
    shape = n, len(flows) if varying else len(places)
    sums: Array | scipy.sparse.csr_array = np.zeros(shape if n < MANY_STATES else 0)
    if n < MANY_STATES:
        np.add.at(sums, (targets, columns), entries)
    else:
        sums = scipy.sparse.csr_array((entries, (targets, columns)), shape=shape)
    of_flows = tuple(indices for _, indices in flows) if varying else ()
    return TaylorTerms(n, tuple(constants), sums, products, variables, of_flows)


@dataclass(frozen=True)
class _Factors:
    """The coefficients (order + 1, q, m) of the factors of products, at ``places`` of the powers.

    They are a copy of these unless they stand side by side.
    """

    rows: Array
    places: NDArray[np.intp] | None

    @classmethod
    def of(cls, powers: Array, places: NDArray[np.intp]) -> _Factors:
        if (np.diff(places) == 1).all():
            return cls(powers[:, places[0] : places[-1] + 1], None)
        return cls(np.empty((len(powers), places.size, powers.shape[2])), places)

    def copied(self, k: int) -> list[tuple[NDArray[np.intp], Array]]:
        """What is copied of the coefficients of a power: places, and where to."""
        return [] if self.places is None else [(self.places, self.rows[k])]


class Recursion:
    """The coefficients of steps of one order, in buffers that serve all of them.

    The buffers hold the ``powers`` (order + 1, variables, m) and, for each level of products, the
    coefficients of factors that do not stand side by side among them.
    """

    def __init__(self, series: TaylorSeries, order: int) -> None:
        n, m = series.constant.shape
        self.series, self.order = series, order
        self.powers = powers = np.empty((order + 1, series.size, m))
        self._of_states = powers.reshape(order + 1, -1)[:, : n * m]
        self._states = [each[:n] for each in powers]
        levels = [
            (level.places, _Factors.of(powers, level.left), _Factors.of(powers, level.right))
            for level in series.products
        ]
        self._convolutions = [
            [
                (
                    left.copied(k) + right.copied(k),
                    left.rows[: k + 1],
                    right.rows[k::-1],
                    now[places],
                )
                for places, left, right in levels
            ]
            for k, now in enumerate(powers[:-1])
        ]

    def __call__(self, states: Array, h: float) -> Array:
        """Coefficients from states (n, m), times powers of ``h``: (order + 1, n m).

        The next call overwrites them.
        """
        series, powers = self.series, self.powers
        factors, variables, sums = series.factors, series.variables, series.sums
        shares = h / np.arange(1.0, self.order + 1.0)
        scaled = shares[:, None, None] * sums if isinstance(sums, np.ndarray) else None
        powers[0, : len(states)] = states
        for k, convolutions in enumerate(self._convolutions):
            now = powers[k]
            for copied, left, right, product in convolutions:
                for places, rows in copied:
                    now.take(places, axis=0, out=rows, mode="clip")
                np.einsum("kqm,kqm->qm", left, right, out=product)
            weighted = now if factors is None else now.take(variables, axis=0) * factors
            slopes = self._states[k + 1]
            if scaled is not None:
                np.dot(scaled[k], weighted, out=slopes)
            else:
                slopes[:] = shares[k] * (sums @ weighted)
            if not k:
                self._states[1] += h * series.constant
        return self._of_states


def _factor(rows: Sequence[Array], indices: Sequence[int], m: int) -> Array:
    """The product of the factors of all parameters with their indices, (m,)."""
    factor = np.ones(m)
    for row, index in zip(rows, indices, strict=True):
        factor = factor * row[index] if index else factor
    return factor


def _variables(
    n: int, monomials: Sequence[tuple[int, ...]]
) -> tuple[dict[tuple[int, ...], int], tuple[_Products, ...]]:
    """Places of the variables, by the states that they multiply, and the products that they are.

    A product of three or four states is one of variables that stand before it.
    """
    needed = sorted({part for monomial in monomials for part in _halved(monomial)})
    places: dict[tuple[int, ...], int] = {(state,): state for state in range(n)}
    levels: list[_Products] = []
    for level in (1, 2):
        chosen = [part for part in needed if len(part) > 1 and (len(part) > 2) == (level == 2)]
        if not chosen:
            continue
        first = len(places)
        halves = [(part[: len(part) // 2], part[len(part) // 2 :]) for part in chosen]
        left, right = np.array([(places[a], places[b]) for a, b in halves], dtype=np.intp).T
        places |= {part: first + i for i, part in enumerate(chosen)}
        levels.append(_Products(left, right, slice(first, len(places))))
    return places, tuple(levels)


def _halved(monomial: tuple[int, ...]) -> list[tuple[int, ...]]:
    """A monomial of at most four states, and its halves that are products."""
    half = len(monomial) // 2
    return [monomial, *(part for part in (monomial[:half], monomial[half:]) if len(part) > 1)]


class TaylorPiece(explicit.Piece):
    """A step of a Taylor series: powers of the time since its start, in units of a trial step.

    On each of its parts the polynomials of paths are within the ``tolerances`` of it.
    """

    method = "Taylor"

    def __init__(
        self,
        times: tuple[float, float],
        states: tuple[Array, Array],
        rows: Array,
        unit: float,
        tolerances: tuple[float, Array],
    ) -> None:
        super().__init__(times, states, rows)
        self.h, self.order, self.tolerances = unit, len(rows), tolerances

    def kept(self) -> TaylorPiece:
        self.rows = self.rows.copy()
        return self

    @cached_property
    def parts(self) -> int:  # type: ignore[override]
        share, (relative, absolute) = (self.t - self.t_old) / self.h, self.tolerances
        sizes = np.maximum(np.abs(self.y_old), np.abs(self.y))
        allowed = absolute + relative * np.maximum(sizes, share * np.abs(self.rows[0]))
        with np.errstate(over="ignore"):
            missed = interpolation_errors(share, self.rows) / np.maximum(allowed, TINY)
        enough = min(_SERIES.most_parts, float(missed.max(initial=0.0)) ** (1.0 / NODES.size))
        return int(max(_SERIES.least_parts, math.ceil(enough)))

    def weights(self, shares: Array) -> Array:
        return explicit.powers_of(shares, self.order)


def interpolation_errors(share: float, rows: Array) -> Array:
    """About the largest error (n m,) of the polynomial of a path over a share of a series' unit.

    The ``rows`` (order, n m) are coefficients of powers, from the first. The error is that of the
    first derivative which the polynomial misses, at a few places.
    """
    missing, weights = _missed_derivatives(len(rows))
    return np.asarray(np.abs((weights * share**missing) @ rows[NODES.size - 1 :]).max(axis=0))


@cache
def _missed_derivatives(order: int) -> tuple[NDArray[np.intp], Array]:
    """Powers whose derivative a path misses, and what they add to it at a few places, weighted."""
    missing = np.arange(NODES.size, order + 1)
    binomials = np.array([math.comb(power, NODES.size) for power in missing.tolist()], dtype=float)
    places = _DERIVATIVE_SHARES[:, None] ** (missing - NODES.size)
    return missing, places * binomials * _NODE_PRODUCT


class _TaylorSolver(scipy.integrate.OdeSolver):  # type: ignore[misc]
    """What SciPy's solvers of Runge and Kutta begin with, for a series."""

    def __init__(
        self,
        rates: explicit.Rates,
        start: float,
        states: Array,
        end: float,
        *,
        rtol: float,
        atol: Array,
        max_step: float,
    ) -> None:
        super().__init__(rates, start, states, end, vectorized=False)
        self.rtol, self.atol, self.max_step = rtol, atol, max_step


class StackedTaylor(explicit.Stepper, _TaylorSolver):
    """Steps that suit every trajectory, of the order that suits the tolerance.

    The last coefficients choose the step. The defect at its end, where the series has to have the
    slope that the rates have, is the error that it leaves: it has to be within the tolerance.
    """

    t: float
    y: Array
    y_old: Array
    rtol: float
    atol: Array
    steps_kept = _SERIES.kept

    def __init__(
        self,
        rates: explicit.Rates,
        span: tuple[float, float],
        states: Array,
        tolerances: Tolerances,
        series: TaylorSeries,
    ) -> None:
        super().__init__(rates, span, states, tolerances)
        self.series = series
        self.order = taylor_order(tolerances.relative, affine=not series.products)
        self.stiff_product = _SERIES.stiff_share * math.exp(
            math.lgamma(self.order + 1.0) / self.order
        )
        self.cost = series.cost(self.order)
        self.recursion = Recursion(series, self.order)
        self.h_abs, self.unit, self.most = (
            _SERIES.first_share * (span[1] - span[0]),
            0.0,
            1.0 / _SERIES.first_share,
        )
        self.powers = np.empty((0, 0))

    def _step_impl(self) -> tuple[bool, str | None]:
        """A step whose error is within the tolerance."""
        t, y = self.t, self.y
        shortest = explicit.LEAST_STEP * float(np.spacing(abs(t)))
        self.unit = min(self.h_abs, self.max_step)
        self.powers = powers = self._powers(shortest)
        h = min(max(self._longest(powers), shortest), self.max_step)
        while h >= shortest:
            end = min(t + h, self.t_bound)
            h = end - t
            y_new, slope = self._at(powers, h / self.unit)
            scale = self.atol + np.maximum(np.abs(y), np.abs(y_new)) * self.rtol
            missed = np.abs(slope / self.unit - self.fun(end, y_new)) / scale
            error = float(missed.max(initial=0.0)) * h / (self.order + 1)
            if error <= _SERIES.most_error:
                self.h_abs, self.most = h, explicit.MOST_FACTOR
                self.t, self.y, self.y_old = end, y_new, y
                return True, None
            reduced = (_SERIES.aimed_error / error) ** (1.0 / (self.order + 1))
            h *= max(explicit.LEAST_FACTOR, reduced)  # the least if not a number
        return False, self.TOO_SMALL_STEP

    def _powers(self, shortest: float) -> Array:
        """Coefficients in powers of a trial step, of which all are finite: (order + 1, n m).

        The next step overwrites them.
        """
        states = self.y.reshape(self.trajectory_states, -1)
        for _ in range(_SERIES.first_trials):
            charge(self.cost)
            powers = self.recursion(states, self.unit)
            if np.isfinite(powers[-_SERIES.last :]).all() or self.unit < shortest:
                break
            self.unit *= _SERIES.first_share
        return powers

    def _longest(self, powers: Array) -> float:
        """The longest step whose last terms are within the tolerance, for the worst state."""
        scale = self.atol + self.rtol * np.maximum(np.abs(powers[0]), np.abs(powers[1]))
        last = np.abs(powers[-_SERIES.last :] / scale).max(axis=1, initial=0.0)
        factor = self.most
        for i, size in enumerate(last.tolist()):
            k = self.order + 1 - _SERIES.last + i
            if size > 0.0:
                factor = min(factor, (_SERIES.aimed_error / size) ** (1.0 / k))
        return factor * self.unit

    def _at(self, powers: Array, share: float) -> tuple[Array, Array]:
        """States at a share of the trial step, and their slopes over it."""
        exponents = np.arange(self.order + 1)
        weights = share**exponents
        of_slopes = exponents[1:] * weights[:-1]
        return np.dot(weights, powers), np.dot(of_slopes, powers[1:])

    def dense_output(self) -> TaylorPiece:
        """The last step as a function of time."""
        times, states = (self.t_old, self.t), (self.y_old, self.y)
        return TaylorPiece(times, states, self.powers[1:], self.unit, (self.rtol, self.atol))
