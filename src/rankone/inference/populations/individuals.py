"""Empirical Bayes: the most probable random effects of each subject.

For each subject they minimise -2 log p(y | eta) + eta' Omega^-1 eta, by damped Gauss-Newton steps
on the pseudo-residuals of the data with a secant correction, for many population parameters and all
subjects at once. The parameters of subjects stay in the box of the solution. Steps are those of the
whitened effects b with eta = L b and Omega = L L', so that Omega may be nearly singular.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rankone.inference.estimation.formulas import Dual, Operand, value_of, with_shape
from rankone.inference.estimation.noise import terms
from rankone.inference.populations.population_layout import Layout
from rankone.inference.populations.subjects import Subjects
from rankone.support.arrays import COARSE, COINCIDENT, MOST_ROUNDS, NEGLIGIBLE, Array


@dataclass(frozen=True)
class EffectTuning:
    """Tuning of the search for random effects."""

    steps_together: int = 4
    """Steps after which subjects that have converged are left out."""
    least_decrement: float = 1e-10
    """Squared length of a step, in standard deviations of eta, that ends."""
    damping_factor: float = 6.0
    """Factor on the damping after a step in vain."""
    least_damping: float = COARSE
    """Damping below which there is none."""
    most_damping: float = 1e9
    """Largest damping."""
    trusted_curvatures: tuple[float, float] = (0.2, 20.0)
    """Second derivatives, in units of the expected ones."""
    least_cosine: float = 1e-8
    """Of the angle between a step and what a secant update adds."""


TUNING = EffectTuning()


class Start(NamedTuple):
    """Random effects (n, q) to begin from, a correction (n, q, q) of the information, and damping.

    The first two perhaps with a first axis of several population parameters.
    """

    eta: Array
    correction: Array
    damping: Array | float = 0.0

    @classmethod
    def at(cls, eta: Array) -> Start:
        """A start at some random effects, without a correction."""
        return cls(eta, np.zeros((*eta.shape, eta.shape[-1])))


@dataclass(frozen=True)
class Linearised:
    """The data of all subjects, linearised in their coordinates z.

    ``cost`` (K, n) is -2 log p(y | eta) up to a constant, ``gradient`` (K, n, E) half of its
    derivatives, ``information`` (K, n, E, E) the Fisher information, ``squares`` (K, n) the sums
    of squared residuals in standard deviations. Where the cost is infinite, as at a prediction of
    zero with noise in proportion to it, the derivatives and the information are zero.
    """

    cost: Array
    gradient: Array
    information: Array
    squares: Array


@dataclass(frozen=True)
class Individuals:
    """The most probable random effects ``eta`` (K, n, q), and the data linearised there.

    ``whitened`` (K, n, q) are these with unit covariance, ``penalty`` (K, n) is the sum of their
    squares, ``correction`` (K, n, q, q) what the Fisher information lacks of half the second
    derivatives, ``damping`` (K, n) that of the last steps. ``converged`` (K, n) tells where the
    search ended.
    """

    eta: Array
    whitened: Array
    at: Linearised
    penalty: Array
    correction: Array
    damping: Array
    converged: NDArray[np.bool_]

    def replaced(self, which: NDArray[np.intp], others: Individuals) -> Individuals:
        """The individuals with others in place of some subjects."""
        names = [field.name for field in fields(Linearised)]
        at = [_joined(getattr(self.at, n), getattr(others.at, n), which) for n in names]
        converged = self.converged.copy()
        converged[:, which] = others.converged
        return Individuals(
            _joined(self.eta, others.eta, which),
            _joined(self.whitened, others.whitened, which),
            Linearised(*at),
            _joined(self.penalty, others.penalty, which),
            _joined(self.correction, others.correction, which),
            _joined(self.damping, others.damping, which),
            converged,
        )

    def at_position(self, k: int) -> Individuals:
        """Those at one of the population parameters."""
        one = slice(k, k + 1)
        return Individuals(
            self.eta[one],
            self.whitened[one],
            Linearised(*(getattr(self.at, field.name)[one] for field in fields(Linearised))),
            self.penalty[one],
            self.correction[one],
            self.damping[one],
            self.converged[one],
        )

    def start(self, k: int = 0) -> Start:
        """Where a search at similar population parameters begins."""
        return Start(self.eta[k], self.correction[k])


def linearised(subjects: Subjects, layout: Layout, psi: Array, coordinates: Array) -> Linearised:
    """The data at coordinates (K, n, E) of the subjects, with levels of noise from psi (K, P)."""
    values = layout.values(coordinates)[:, subjects.owner]
    columns = {name: e for e, name in enumerate(layout.names)}
    at = {name: values[..., e] for name, e in columns.items()}
    order = [name for name in subjects.solution.parameters if name in columns]
    places = [list(subjects.solution.parameters).index(name) for name in order]
    # displaced variances and levels of noise leave the coordinates where they are
    _, first, which = np.unique(coordinates, axis=0, return_index=True, return_inverse=True)
    points = subjects.points({name: row[first] for name, row in at.items()})
    which = which.ravel()  # NumPy 2.0.0 gives it the axis of the coordinates
    states, moved = (each[which] for each in subjects.states.linearised(points, places))
    slopes = np.zeros((*states.shape, len(columns)))
    slopes[..., [columns[name] for name in order]] = moved
    per_coordinate = layout.slopes(values)
    column = Dual(states, slopes * per_coordinate[:, :, None, :])
    operands = {**_levels(layout, psi), **_parameters(columns, values, per_coordinate)}
    return _collected(subjects, operands, column, len(psi), len(columns))


def _levels(layout: Layout, psi: Array) -> dict[str, Operand]:
    levels = np.exp(psi[:, layout.noise])
    zeros = dict.fromkeys(layout.zero_levels, 0.0)
    return {**zeros, **{name: levels[:, j, None, None] for j, name in enumerate(layout.levels)}}


def _parameters(
    columns: Mapping[str, int], values: Array, per_coordinate: Array
) -> dict[str, Operand]:
    """The parameters of all records with their derivatives, (K, n, 1) each."""
    parameters: dict[str, Operand] = {}
    for name, e in columns.items():
        slope = np.zeros((*values.shape[:2], 1, len(columns)))
        slope[..., 0, e] = per_coordinate[..., e]
        parameters[name] = Dual(values[..., e, None], slope)
    return parameters


def _collected(
    subjects: Subjects, operands: Mapping[str, Operand], column: Dual, count: int, width: int
) -> Linearised:
    """What all observables of each subject add."""
    records = subjects.owner.size
    cost, gradient = np.zeros((count, records)), np.zeros((count, records, width))
    information = np.zeros((count, records, width, width))
    squares = np.zeros((count, records))
    with np.errstate(all="ignore"):
        for i, one in enumerate(subjects.measured):
            own = subjects.operands(i, operands, column)
            prediction = one.formula(own)
            sigma = one.noise.sigma({**own, one.name: prediction})
            shape = (count, *one.data.shape)
            full = with_shape(prediction, shape, width)
            spread = with_shape(sigma, shape, width) if one.noise.estimated else value_of(sigma)
            each = terms(one.noise, one.data, full, spread, width, one.present)
            cost += each.cost
            squares += np.sum(each.weights * each.standardised**2, axis=-1)
            gradient += (each.residuals[..., None, :] @ each.jacobian)[..., 0, :]
            information += each.jacobian.swapaxes(-1, -2) @ each.jacobian
    finite = np.isfinite(cost)
    cost = np.where(finite, cost, np.inf)
    gradient = np.where(finite[..., None], gradient, 0.0)
    information = np.where(finite[..., None, None], information, 0.0)
    sums = (subjects.over_records(rows, 1) for rows in (cost, gradient, information, squares))
    return Linearised(*sums)


class EmpiricalBayes:
    """The search for the random effects of all subjects."""

    def __init__(self, subjects: Subjects, layout: Layout) -> None:
        self.subjects, self.layout = subjects, layout
        box = subjects.solution.parameters
        ends = np.array([box[name] for name in layout.names]).T
        self.lower, self.upper = layout.coordinates(ends)

    def __call__(self, psi: Array, start: Start, steps: int = MOST_ROUNDS) -> Individuals:
        """The random effects at psi (K, P), in a number of steps at most.

        A start has no first axis, or one of population parameters. Subjects that need many steps
        go on without the others.
        """
        descent = _Descent(self, psi, start)
        for _ in range(min(steps, TUNING.steps_together)):
            if not descent.advance():
                return descent.individuals
        individuals, rest = descent.individuals, steps - TUNING.steps_together
        which = np.flatnonzero(~individuals.converged.all(axis=0))
        if rest <= 0:
            return individuals
        fewer = EmpiricalBayes(self.subjects.selected(which), self.layout.selected(which))
        rows = (individuals.eta, individuals.correction, individuals.damping)
        begin = Start(*(row[:, which] for row in rows))
        return individuals.replaced(which, fewer(psi, begin, rest))

    def at_ends(self, psi: Array, eta: Array) -> NDArray[np.int_]:
        """For each subject and parameter -1 or 1 at an end of the box, else 0: (n, E)."""
        place = self.layout.typical(psi[None])[0]
        place[:, list(self.layout.random)] += eta
        slack = NEGLIGIBLE * (self.upper - self.lower)
        at_upper, at_lower = place >= self.upper - slack, place <= self.lower + slack
        return np.asarray(at_upper.astype(int) - at_lower.astype(int))


class _Descent:
    """The steps of :class:`EmpiricalBayes`, for all subjects at all population parameters."""

    def __init__(self, search: EmpiricalBayes, psi: Array, start: Start) -> None:
        self.search, self.psi = search, psi
        self.random = list(search.layout.random)
        self.factor = search.layout.cholesky(psi)[:, None]
        self.typical = search.layout.typical(psi)
        middle = self.typical[..., self.random]
        self.lower = search.lower[self.random] - middle
        self.upper = search.upper[self.random] - middle
        self.eta = np.clip(np.broadcast_to(start.eta, middle.shape), self.lower, self.upper)
        self.whitened = self._whitened(self.eta)
        self.here = self._at(self.eta)
        self.correction = np.broadcast_to(start.correction, (*middle.shape, len(self.random)))
        self.damping = np.broadcast_to(start.damping, middle.shape[:2])
        self.converged = np.zeros(middle.shape[:2], dtype=bool)

    @property
    def individuals(self) -> Individuals:
        """What has been reached."""
        return Individuals(
            self.eta,
            self.whitened,
            self.here,
            _squared(self.whitened),
            self.correction,
            self.damping,
            self.converged,
        )

    def advance(self) -> bool:
        """Take a step where it lowers the sum; False once all have converged."""
        step, whitened, decrement = self._step()
        self.converged |= (decrement < TUNING.least_decrement) & np.isfinite(self.here.cost)
        if self.converged.all():
            return False
        there = self._at(self.eta + step)
        before = self.here.cost + _squared(self.whitened)
        better = there.cost + _squared(whitened) <= before + COINCIDENT * np.abs(before)
        better &= np.isfinite(there.cost)
        change = (there.gradient - self.here.gradient)[..., self.random]
        self.correction = _secant(
            self.correction, self._information(there), step, change, better & (decrement > 0.0)
        )
        self.eta = np.where(better[..., None], self.eta + step, self.eta)
        self.whitened = np.where(better[..., None], whitened, self.whitened)
        self.here = _chosen(better, there, self.here)
        eased = np.where(
            self.damping > TUNING.least_damping, self.damping / TUNING.damping_factor**2, 0.0
        )
        raised = np.clip(
            self.damping * TUNING.damping_factor, TUNING.least_damping, TUNING.most_damping
        )
        self.damping = np.where(better, eased, raised)
        return True

    def _at(self, eta: Array) -> Linearised:
        """The data at random effects (K, n, q)."""
        place = self.typical.copy()
        place[..., self.random] += eta
        place = np.clip(place, self.search.lower, self.search.upper)
        return linearised(self.search.subjects, self.search.layout, self.psi, place)

    def _whitened(self, eta: Array) -> Array:
        """The whitened effects of random effects (K, n, q)."""
        return np.asarray(np.linalg.solve(self.factor, eta[..., None])[..., 0])

    def _information(self, at: Linearised) -> Array:
        """The Fisher information (K, n, q, q) of the data about the random effects."""
        return np.asarray(at.information[..., self.random, :][..., self.random])

    def _step(self) -> tuple[Array, Array, Array]:
        """A damped step (K, n, q) inside of the ends, and the whitened effects after it.

        Beside them is its squared length (K, n) without damping. Effects at an end that the
        gradient pushes outwards stay.
        """
        turned = self.factor.swapaxes(-1, -2)
        gradient = (turned @ self.here.gradient[..., self.random, None])[..., 0] + self.whitened
        ways = self._ways(gradient)
        onto = np.asarray(self.factor @ ways)
        back = onto.swapaxes(-1, -2)
        push = (ways @ gradient[..., None])[..., 0]
        information = back @ self._information(self.here) @ onto
        usable = np.asarray(np.isfinite(information).all(axis=(-1, -2)))
        usable &= np.isfinite(push).all(axis=-1)
        push = np.where(usable[..., None], push, 0.0)
        information = np.where(usable[..., None, None], information, 0.0)
        correction = np.where(usable[..., None, None], back @ self.correction @ onto, 0.0)
        expected = np.eye(len(self.random)) + information
        solved, decrement = _solved(expected, correction, self.damping, push)
        free = self.eta - (onto @ solved[..., None])[..., 0]
        eta = np.clip(free, self.lower, self.upper)
        inside = (eta == free).all(axis=-1)[..., None]
        return (
            eta - self.eta,
            np.where(inside, self.whitened - solved, self._whitened(eta)),
            decrement,
        )

    def _ways(self, gradient: Array) -> Array:
        """The projection (K, n, q, q) of whitened effects on those that leave held effects at ends.

        ``gradient`` (K, n, q) is half of the derivatives of the sum by whitened effects.
        """
        turned = self.factor.swapaxes(-1, -2)
        outwards = np.linalg.solve(turned, gradient[..., None])[..., 0]
        held = (self.eta <= self.lower) & (outwards > 0.0)
        held |= (self.eta >= self.upper) & (outwards < 0.0)
        ways = np.broadcast_to(np.eye(len(self.random)), (*held.shape, len(self.random)))
        some = held.any(axis=-1)
        if some.any():
            rows = self.factor / np.linalg.norm(self.factor, axis=-1, keepdims=True)
            rows = np.where(held[..., None], rows, 0.0)[some]
            ways = ways.copy()
            ways[some] -= np.linalg.pinv(rows) @ rows
        return ways


def _squared(rows: Array) -> Array:
    return np.asarray((rows**2).sum(axis=-1))


def _solved(fisher: Array, correction: Array, damping: Array, right: Array) -> tuple[Array, Array]:
    """The solution (..., q) of a system with the information, corrected and damped.

    In the metric of the Fisher information, the corrected one is kept between two factors. Beside
    it the squared length (...) of the solution without damping.
    """
    root = np.linalg.cholesky(fisher)
    across = np.linalg.solve(root, np.linalg.solve(root, correction).swapaxes(-1, -2))
    curvatures, vectors = np.linalg.eigh(np.eye(fisher.shape[-1]) + across)
    curvatures = np.clip(curvatures, *TUNING.trusted_curvatures)
    along = (vectors.swapaxes(-1, -2) @ np.linalg.solve(root, right[..., None]))[..., 0]
    damped = (along / (curvatures + damping[..., None]))[..., None]
    solution = np.linalg.solve(root.swapaxes(-1, -2), vectors @ damped)[..., 0]
    return np.asarray(solution), np.asarray((along**2 / curvatures**2).sum(axis=-1))


def _secant(
    correction: Array, fisher: Array, step: Array, change: Array, taken: NDArray[np.bool_]
) -> Array:
    """The symmetric update of rank one that meets the change of the gradient along a step.

    What the Fisher information lacks of the second derivatives (Dennis, Gay & Welsch, ACM Trans.
    Math. Softw. 7, 1981, with the update of Davidon).
    """
    with np.errstate(all="ignore"):
        lacking = change - ((fisher + correction) @ step[..., None])[..., 0]
        along = (lacking * step).sum(axis=-1)
        lengths = np.linalg.norm(lacking, axis=-1) * np.linalg.norm(step, axis=-1)
        update = lacking[..., :, None] * lacking[..., None, :] / along[..., None, None]
        sound = taken & (np.abs(along) > TUNING.least_cosine * lengths)
        sound &= np.asarray(np.isfinite(update).all(axis=(-1, -2)))
    return np.where(sound[..., None, None], correction + update, correction)


def _joined(rows: Array, others: Array, which: NDArray[np.intp]) -> Array:
    """Rows (K, n, ...) with others in place of some columns."""
    rows = rows.copy()
    rows[:, which] = others
    return rows


def _chosen(better: NDArray[np.bool_], there: Linearised, here: Linearised) -> Linearised:
    return Linearised(
        np.where(better, there.cost, here.cost),
        np.where(better[..., None], there.gradient, here.gradient),
        np.where(better[..., None, None], there.information, here.information),
        np.where(better, there.squares, here.squares),
    )
