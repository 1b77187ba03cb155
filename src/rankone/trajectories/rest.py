"""Steady states made exact by Newton's method, and the sums that no rate changes.

They are looked for in rates at random states. Their coefficients may depend on parameters, as those
of concentrations in compartments of different volumes do. Ratios of small numbers are made exact,
so that a total is kept to the last digit.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from rankone.support.arrays import COARSE, COINCIDENT, NEGLIGIBLE, TINY, Array
from rankone.support.errors import BlowUpError, ConvergenceError
from rankone.trajectories.integrators.integrator import Tolerances
from rankone.trajectories.integrators.integrator_choice import integrator_for
from rankone.trajectories.system.features import (
    NEWTON_STEPS,
    Constraints,
    Features,
    Jumps,
    VectorLike,
)
from rankone.trajectories.system.system import System

_SAMPLES = 8  # Random states for each state
EXACT = 1e-11
"""Relative error that Newton's method and singular values leave."""
_LARGEST_DENOMINATOR = 120  # Of coefficients that are taken for fractions


class ConservedSums:
    """The conserved sums of an autonomous system: ``count`` of them.

    ``exact`` has their coefficients (count, n) where these are the same at all parameters.
    """

    def __init__(self, system: System) -> None:
        self.system = system
        n, samples = system.n_differential, _SAMPLES * (system.n_differential + 1)
        rng = np.random.default_rng(1864)  # the same sums each time
        box = np.asarray(system.box, dtype=float).reshape(-1, 2)
        p = box[:, :1] + (box[:, 1:] - box[:, :1]) * rng.random((len(box), samples))
        size = np.abs(system.initial(p)).max(axis=1, keepdims=True)
        size = np.where(size > 0.0, size, size.max(initial=0.0) or 1.0)
        self._states = size * rng.uniform(0.3, 1.5, (n, samples))
        self._at: dict[bytes, Array] = {}
        everywhere, here = self._kernel(p), self._kernel(np.repeat(p[:, :1], samples, axis=1))
        self.count = len(here)
        self.exact = everywhere if len(everywhere) == self.count else None

    def __call__(self, p: VectorLike) -> Array:
        """The coefficients (count, n, m) at parameters p (d, m); NaN where there are others."""
        points = np.ascontiguousarray(np.asarray(p, dtype=float).T)
        n, m = len(self._states), len(points)
        if self.exact is not None:
            return np.broadcast_to(self.exact[:, :, None], (self.count, n, m))
        return np.moveaxis(np.array([self._coefficients(point) for point in points]), 0, 2)

    def _coefficients(self, point: Array) -> Array:
        """The coefficients (count, n) at a point (d,)."""
        if (key := point.tobytes()) not in self._at:
            kernel = self._kernel(np.repeat(point[:, None], self._states.shape[1], axis=1))
            same = len(kernel) == self.count
            kernel = kernel / np.abs(kernel).max(axis=1, keepdims=True)  # smooth over parameters
            self._at[key] = kernel if same else np.full((self.count, len(self._states)), np.nan)
        return self._at[key]

    def _kernel(self, p: Array) -> Array:
        """What rates at the random states, and as many parameters p (d, samples), leave unchanged.

        Rows (c, n) of coefficients.
        """
        with np.errstate(all="ignore"):
            rates = np.broadcast_to(self.system.rhs(0.0, self._states, p), self._states.shape)
        rates = rates[:, np.isfinite(rates).all(axis=0)]
        n = len(rates)
        if not rates.size:
            return np.zeros((0, n))
        rows = _without_zeros(np.abs(rates).max(axis=1, keepdims=True))
        scaled = rates / rows
        scaled = scaled / _without_zeros(np.abs(scaled).max(axis=0))
        left, singular, _ = np.linalg.svd(scaled)
        rank = int((singular > EXACT * max(singular[0], TINY)).sum())
        kernel = _reduced(left[:, rank:].T / rows.T)
        fractions = _as_fractions(kernel)
        change, sizes = np.abs(fractions @ rates), np.abs(fractions) @ np.abs(rates)
        return fractions if (change <= COINCIDENT * sizes).all() else kernel


def _without_zeros(sizes: Array) -> Array:
    return np.where(sizes > 0.0, sizes, 1.0)


def _reduced(rows: Array) -> Array:
    """Rows (c, n) that span the same, each with a one where the others have zeros."""
    reduced, columns = np.array(rows), np.ones(rows.shape[1], dtype=bool)
    for i in range(len(reduced)):
        largest = np.abs(reduced[i:]) * columns
        row, column = divmod(int(largest.argmax()), largest.shape[1])
        reduced[[i, i + row]] = reduced[[i + row, i]]
        reduced[i] /= reduced[i, column]
        columns[column] = False
        others = np.arange(len(reduced)) != i
        reduced[others] -= np.outer(reduced[others, column], reduced[i])
    return np.where(np.abs(reduced) > NEGLIGIBLE * np.abs(reduced).max(initial=0.0), reduced, 0.0)


def _as_fractions(rows: Array) -> Array:
    """Rows with entries close to fractions of small numbers made exact, as multiples of integers.

    As they are where some entry is close to none.
    """
    integers = np.array(rows)
    for i, row in enumerate(rows):
        fractions = [Fraction(x).limit_denominator(_LARGEST_DENOMINATOR) for x in row.tolist()]
        if any(abs(f - x) > NEGLIGIBLE for f, x in zip(fractions, row.tolist(), strict=True)):
            return rows
        common = np.lcm.reduce([fraction.denominator for fraction in fractions])
        integers[i] = [float(fraction * int(common)) for fraction in fractions]
    return integers


# -----------------------------------------------------------------------------
# Steady states: where trajectories come to rest, made exact by Newton's method.
#
# A trajectory decides which of several steady states is reached. It is followed over longer and
# longer times until a stable one is close. Linear combinations of states that no rate changes, such
# as totals of species, keep the values of the start.


@dataclass(frozen=True)
class _Settling:
    """When trajectories have come to rest."""

    accuracy: float
    least_size: float
    close: float
    noise: float
    lengthened: float


_SETTLING = _Settling(
    accuracy=1e-5,  # Relative tolerance of trajectories that only have to come close
    least_size=1e-6,  # Of a state beside the largest one, for its absolute tolerance
    # Distance from a steady state, in sizes of the states, that counts as having settled
    close=COARSE,
    noise=1e-18,  # A state below this share of the largest one on the way is zero
    lengthened=4.0,  # Factor from one time to the next at which trajectories are looked at
)
# Of differences of fourth order, over the width of the box or the parameter itself
_STEP = COINCIDENT**0.2
_CENTRAL = ((1 / 12, -2.0), (-2 / 3, -1.0), (2 / 3, 1.0), (-1 / 12, 2.0))  # Of fourth order

Follow = Callable[[Array, Array, float, float], tuple[Array, Array]]
"""States (n, m) at the end of trajectories, and their largest absolute values.

From states (n, m), points (m, d), and the times of the start and the end.
"""


@dataclass(frozen=True)
class Stability:
    """How perturbations of steady states grow: the largest growth rate at any point, and where.

    ``growth`` is negative if all are stable.
    """

    growth: float
    point: tuple[float, ...]


class SteadyStates:
    """The steady states that trajectories of a system reach, at parameter points.

    The system is autonomous, without jumps and events. Trajectories take up to the time ``settle``;
    the first look at them is at ``first``. One that starts at a steady state stays there, and with
    ``stable_only`` has to be stable as all others have. They are integrated by what suits the
    system, unless another way to ``follow`` them is given. ``sizes`` (n,) are the largest values of
    the states on all trajectories so far.
    """

    def __init__(
        self,
        system: System,
        first: float,
        settle: float,
        *,
        stable_only: bool = False,
        follow: Follow | None = None,
    ) -> None:
        self.system, self.first, self.settle = system, min(first, settle), settle
        self.stable_only = stable_only
        self.follow = self._integrated if follow is None else follow
        self.conserved = ConservedSums(system)
        self.latest = 0.0
        self.sizes = np.zeros(system.n_differential)
        self._reached: dict[bytes, Array] = {}
        self._last: dict[bytes, Array] = {}  # where trajectories were at the end
        self._constraints = self.constraints(range(system.n_differential))

    def __call__(self, p: VectorLike) -> Array:
        """The steady states (n, m) at parameters p (d, m).

        Raises
        ------
        ConvergenceError
            If a trajectory has not settled in time.
        BlowUpError
            If one blows up.
        """
        states = self.reached(p)
        if np.isnan(states).any():
            points = np.asarray(p, dtype=float).T
            raise self.not_settled(points[np.isnan(states).any(axis=0)])
        return states

    def reached(self, p: VectorLike) -> Array:
        """The steady states (n, m) at parameters p (d, m), NaN where trajectories do not settle.

        Each is followed once.
        """
        points = np.ascontiguousarray(np.asarray(p, dtype=float).T)
        keys = [point.tobytes() for point in points]
        new = sorted({key: i for i, key in enumerate(keys) if key not in self._reached}.values())
        if new:
            for i, state in zip(new, self._followed(points[new]).T, strict=True):
                self._reached[keys[i]] = state
        states = [self._reached[key] for key in keys]
        return np.array(states).reshape(len(keys), self.system.n_differential).T

    def constraints(self, rows: Sequence[int]) -> Constraints:
        """What vanishes at steady states, of the states at some positions; the others are zero."""
        system, columns = self.system, list(rows)

        def whole(u: VectorLike) -> Array:
            states = np.zeros((system.n_differential, *np.shape(u)[1:]))
            states[columns] = u
            return states

        def residuals(_t: float | Array, u: VectorLike, p: VectorLike) -> Array:
            states, parameters = whole(u), np.asarray(p)
            rates = np.broadcast_to(system.rhs(0.0, states, parameters), states.shape)
            change = states - system.initial(parameters)
            kept = np.einsum("cnm,nm->cm", self.conserved(parameters), change)
            further = system.constraints
            others = [further.residuals(0.0, states, parameters)] if further.names else []
            return np.concatenate([rates, kept, *others])

        def slopes(_t: float | Array, u: VectorLike, p: VectorLike) -> Array:
            states, parameters = whole(u), np.asarray(p)
            n, m = states.shape
            jacobian = np.broadcast_to(system.jacobian(0.0, states, parameters), (n, n, m))
            invariants = self._invariants(states, parameters)
            return np.concatenate([jacobian, *invariants])[:, columns]

        names = [f"rate of {name}" for name in system.states[: system.n_differential]]
        names += ["conserved"] * self.conserved.count
        return Constraints(
            (*names, *system.constraints.names), tuple(range(len(columns))), residuals, slopes
        )

    def leading(self, states: Array, points: Array) -> NDArray[np.complex128]:
        """The eigenvalues (m,) of largest real part at states (n, m) and points (m, d).

        They are those of perturbations that keep to what no rate changes, and to the constraints:
        -inf where there are none, inf where the Jacobian is not finite.
        """
        matrices, finite = self.perturbations(states, points)
        if not matrices.shape[1]:
            return np.where(finite, -np.inf, np.inf).astype(complex)
        rates = np.linalg.eigvals(matrices)
        first = np.argmax(rates.real, axis=1)
        return np.where(finite, rates[np.arange(len(first)), first], np.inf)

    def perturbations(self, states: Array, points: Array) -> tuple[Array, NDArray[np.bool_]]:
        """The matrices (m, k, k) of those of :meth:`leading`, and where they are finite (m,)."""
        n, m = states.shape
        columns = np.ascontiguousarray(points.T)
        jacobian = np.broadcast_to(self.system.jacobian(0.0, states, columns), (n, n, m))
        kept = np.concatenate([*self._invariants(states, columns)])
        sizes = np.abs(states)
        sizes = np.maximum(sizes, _SETTLING.least_size * sizes.max(axis=0))
        sizes = np.where(sizes > 0.0, sizes, 1.0)
        matrices = np.moveaxis(jacobian * sizes / sizes[:, None], 2, 0)
        finite = np.isfinite(matrices.sum(axis=(1, 2)) + kept.sum(axis=(0, 1)))
        matrices = np.where(finite[:, None, None], matrices, 0.0)
        across = np.where(finite[:, None, None], np.moveaxis(kept * sizes, 2, 0), 0.0)
        along = np.linalg.svd(across)[2][:, len(kept) :]  # rows that span what is left
        return along @ matrices @ np.swapaxes(along, 1, 2), finite

    def growth(self, states: Array, points: Array) -> Array:
        """The largest growth rate (m,) of perturbations of states (n, m) at points (m, d)."""
        return self.leading(states, points).real

    def _invariants(self, states: Array, columns: Array) -> Iterator[Array]:
        """Derivatives (k, n, m) of what is the same on all of a trajectory, by the states."""
        yield self.conserved(columns)
        further = self.system.constraints
        if further.names:
            slopes = further.slopes(0.0, states, columns)
            yield np.broadcast_to(slopes, (len(further.names), *states.shape))

    def decays(self, states: Array, points: Array) -> NDArray[np.bool_]:
        """At which points (m, d) perturbations of states (n, m) decay; not where these are NaN."""
        growth = self.growth(np.nan_to_num(states), points)
        return np.asarray(np.isfinite(states).all(axis=0) & (growth < -NEGLIGIBLE / self.first))

    def grows(self, states: Array, points: Array) -> NDArray[np.bool_]:
        """At which points (m, d) some perturbation of states (n, m) grows."""
        growth = self.growth(np.nan_to_num(states), points)
        return np.asarray(np.isfinite(states).all(axis=0) & (growth > NEGLIGIBLE / self.first))

    def slopes(self, points: Array) -> tuple[Array, Array]:
        """Derivatives (n, d, m) by the parameters at points (m, d), and the points.

        By central differences of steady states, at points moved inside of the box for them.
        """
        box = np.asarray(self.system.box, dtype=float).reshape(-1, 2)
        lower, upper = box.T
        widths = upper - lower
        steps = _STEP * np.minimum(widths, np.maximum(np.abs(points), _STEP * widths))
        points = np.clip(points, lower + 2.0 * steps, upper - 2.0 * steps)
        states, slopes = self(points.T), []
        for j in range(len(box)):
            total = np.zeros(states.shape)
            for weight, shift in _CENTRAL:
                moved = points.T.copy()
                moved[j] += shift * steps[:, j]
                total += weight * self._constraints.consistent(0.0, states, moved)
            slopes.append(total / steps[:, j])
        return np.array(slopes).reshape(len(box), *states.shape).swapaxes(0, 1), points

    def stability(self, points: Array) -> Stability:
        """How perturbations grow at points (m, d)."""
        growth = self.growth(self(points.T), points)
        worst = int(np.argmax(growth))
        return Stability(float(growth[worst]), tuple(points[worst].tolist()))

    def _followed(self, points: Array) -> Array:
        """The steady states (n, m) that trajectories at points (m, d) reach, or NaN."""
        states = np.array(self.system.initial(np.ascontiguousarray(points.T)))  # not part of points
        largest, before = np.abs(states), np.full(states.shape, np.nan)
        settled, _ = self._nearby(states, points, largest, EXACT)
        if self.stable_only:
            settled = np.where(self.decays(settled, points), settled, np.nan)
        time, later = 0.0, self.first
        while time < self.settle:
            open_ = np.flatnonzero(np.isnan(settled[0]))
            if not open_.size:
                break
            ends, sizes = self.follow(states[:, open_], points[open_], time, later)
            states[:, open_], largest[:, open_] = ends, np.maximum(largest[:, open_], sizes)
            close, sure = self._nearby(ends, points[open_], largest[:, open_], _SETTLING.close)
            close = np.where(self.decays(close, points[open_]), close, np.nan)
            sure |= (np.abs(close - before[:, open_]) <= _SETTLING.close * np.abs(close)).all(
                axis=0
            )
            settled[:, open_], before[:, open_] = np.where(sure, close, np.nan), close
            self.sizes = np.maximum(self.sizes, largest.max(axis=1))
            time, later = later, min(_SETTLING.lengthened * later, self.settle)
            self.latest = max(self.latest, time)
        for key, state in zip(points, states.T, strict=True):
            self._last[key.tobytes()] = state
        return settled

    def _nearby(
        self, states: Array, points: Array, largest: Array, distance: float
    ) -> tuple[Array, NDArray[np.bool_]]:
        """The steady states closer than a distance to states (n, m), NaN if there are none.

        And at which points (m,) they are that close in sizes of their own as well: what was far
        larger on its way may still pass by.
        """
        columns = np.ascontiguousarray(points.T)
        consistent = self._constraints.consistent(0.0, states, columns, NEWTON_STEPS, largest)
        units = np.where(largest > 0.0, largest, largest.max(axis=0))
        away = np.abs(consistent - states)
        consistent = np.where(
            np.abs(consistent) > _SETTLING.noise * units.max(axis=0), consistent, 0.0
        )
        near = (away <= distance * np.where(units > 0.0, units, 1.0)).all(axis=0)
        sure = np.asarray((away <= distance * np.abs(consistent)).all(axis=0))
        return np.where(near, consistent, np.nan), sure

    def _integrated(
        self, states: Array, points: Array, start: float, end: float
    ) -> tuple[Array, Array]:
        """States at the end of trajectories from states (n, m) on, and their largest values."""
        system = from_states(self.system, (start, end))
        moved = np.column_stack([points, states.T])
        sizes = np.maximum(np.abs(states), _SETTLING.least_size * np.abs(states).max(axis=0))
        size = sizes.max(axis=1, keepdims=True)
        least = _SETTLING.least_size * np.where(size > 0.0, size, 1.0)
        chosen = integrator_for(system, "auto")
        dense = chosen.run(
            system, moved, [start, end], Tolerances.down_to(_SETTLING.accuracy, least)
        )
        if dense.end < end * (1.0 - NEGLIGIBLE):
            worst = int(np.argmax(np.nan_to_num(np.abs(dense.state).max(axis=0), nan=np.inf)))
            raise BlowUpError(
                f"a trajectory blows up at t = {dense.end:.6g}{self._at(points[worst])}",
                time=dense.end,
                parameters=dict(zip(self.system.parameters, points[worst].tolist(), strict=True)),
                remedy="a steady state is where trajectories come to rest; narrow the box",
            )
        return dense.state, dense.largest

    def beside(self, points: Array) -> Array:
        """The steady states (n, m) next to where trajectories at points (m, d) were last."""
        states = np.array([self._last[point.tobytes()] for point in points]).T
        return self._constraints.consistent(0.0, states, np.ascontiguousarray(points.T))

    def settled(self, point: Array) -> Array | None:
        """The stable steady state (n, 1) that the trajectory at a point (d,) reaches, if any."""
        with suppress(BlowUpError):
            state = self.reached(point[:, None])
            if self.decays(state, point[None])[0]:
                return state
        return None

    def not_settled(self, points: Array, slowest: float = -np.inf) -> ConvergenceError:
        """The error for trajectories at points (m, d) that have not come to rest.

        ``slowest`` is the largest growth rate of perturbations elsewhere in the box.
        """
        states = self.beside(points)
        leading = self.leading(np.nan_to_num(states), points)
        growth = np.where(np.isfinite(states).all(axis=0), leading.real, np.nan)
        neutral = NEGLIGIBLE / self.first
        which = int(np.nanargmax(growth)) if np.isfinite(growth).any() else 0
        away = np.abs(states[:, which] - self._last[points[which].tobytes()])
        if growth[which] > neutral and (away <= 10.0 * _SETTLING.accuracy * self.sizes.max()).all():
            place = self._at(points[which])
            return ConvergenceError(
                f"trajectories come to rest at a steady state that is not stable{place}",
                remedy="change initial values, some of which perhaps are exactly zero",
            )
        message = f"trajectories have not settled by t = {self.settle:g}{self._at(points[which])}"
        rate = growth[which]
        if rate > neutral or (rate >= -neutral and leading[which].imag):
            message += ": a steady state nearby is not stable, they may oscillate"
            return ConvergenceError(message, remedy="narrow the box")
        if rate >= -neutral:
            message += (
                ": steady states nearby are not isolated (an eigenvalue is zero), so that the "
                "initial values decide on which one they end"
            )
            return ConvergenceError(message, remedy="solve over a long horizon instead")
        remedy = "give a larger settle=, or narrow the box"
        if np.isfinite(rate):
            message += f": next to the steady state perturbations decay at a rate of {-rate:.3g}"
            if rate < slowest < -neutral:
                rate = slowest
                message += f", elsewhere at {-rate:.3g}"
            longer = max(-np.log(_SETTLING.close * _SETTLING.close) / -rate, 2.0 * self.settle)
            digit = 10.0 ** np.floor(np.log10(longer))
            remedy = f"give settle={np.ceil(longer / digit) * digit:g}, or narrow the box"
        return ConvergenceError(message, remedy=remedy)

    def _at(self, point: Array) -> str:
        pairs = zip(self.system.parameters, point.tolist(), strict=True)
        return f" at {', '.join(f'{name} = {x:.6g}' for name, x in pairs)}" if point.size else ""


def from_states(system: System, horizon: tuple[float, float]) -> System:
    """The system from states on that follow the parameters, over a horizon."""
    d, n = len(system.parameters), system.n_differential
    moving = system.with_rates(
        lambda t, u, p: system.rhs(t, u, np.asarray(p)[:d]),
        lambda t, u, p: system.jacobian(t, u, np.asarray(p)[:d]),
    )
    return replace(
        moving.starting_at(lambda p: np.asarray(p)[d : d + n]),
        separated=False,
        horizon=horizon,
        constraints=Constraints(),
        specification=None,
        features=_in_first_parameters(system.features, d),
    )


def _in_first_parameters(features: Features, d: int) -> Features:
    """The features over the states alone, of the first parameters."""
    return replace(
        features,
        n_moving_cuts=0,
        n_moving_steps=0,
        state_surfaces=lambda t, u, p: features.state_surfaces(t, u, np.asarray(p)[:d]),
    )


def at_rest(steady: SteadyStates, rows: Sequence[int]) -> System:
    """The steady states at some positions as a system that never moves, from 0 to 1."""
    system, columns = steady.system, list(rows)
    n = len(columns)

    def still(_t: float | Array, u: VectorLike, _p: VectorLike) -> Array:
        return np.zeros(np.shape(u))

    def no_slopes(_t: float | Array, u: VectorLike, _p: VectorLike) -> Array:
        return np.zeros((n, *np.shape(u)))

    features = system.features
    return replace(
        system.starting_at(lambda p: steady(p)[columns]).with_rates(still, no_slopes),
        separated=False,
        states=tuple(system.states[i] for i in columns),
        n_differential=n,
        n_lifted=0,
        products=(),
        horizon=(0.0, 1.0),
        terms=(),
        with_products=lambda u: np.array(u, dtype=float),
        quadratic_jacobian=no_slopes,
        features=Features(
            cuts=((), *features.cuts[1:]),
            periodic_cuts=((), *features.periodic_cuts[1:]),
            n_parameter_surfaces=features.n_parameter_surfaces,
            parameter_surfaces=features.parameter_surfaces,
        ),
        jumps=Jumps(),
        constraints=replace(steady.constraints(columns), guessed=()),
        specification=None,
    )
