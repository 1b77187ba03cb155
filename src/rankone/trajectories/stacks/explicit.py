"""Explicit steps (DOP853) of stacked trajectories, and the step that suits all of them.

Steps are made again, and shorter, where their interpolant is wrong between the stages, which the
estimate of the error does not see. Where it runs through something narrow in between, its slope
differs from the rates there: the defect. Defects are looked at between the nodes of Radau, where
trajectories cross state surfaces, and at random places.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cached_property
from typing import Protocol

import numpy as np
import scipy.integrate
from numpy.typing import NDArray

from rankone.support.arrays import Array
from rankone.trajectories.integrators.defects import SHORTENING, DefectControl, Interpolant
from rankone.trajectories.integrators.integrator import Tolerances
from rankone.trajectories.stacks.kinks import (
    DividedInterpolant,
    DividedSteps,
    Kinks,
    crossed_once,
    divided_steps,
    error_norm,
    nested,
)

# What only a step of Radau changes, except its factorisations
_RADAU_STATE = ("h_abs_old", "error_norm_old", "sol")
# What a step changes, and a refused one changes back
_STEP_STATE = ("t", "t_old", "y", "f", "h_abs", "status", *_RADAU_STATE)


LEAST_FACTOR, MOST_FACTOR = 0.2, 10.0
"""Change of the step from one to the next."""
SAFETY = 0.9
"""Part of the step that the estimate of the error allows."""
LEAST_STEP = 10.0
"""Shortest step, in floating-point numbers."""


class Rates(Protocol):
    """The rates of m stacked trajectories."""

    def __call__(self, t: float, y: Array) -> Array:
        """Rates (n m,) at a time and a stacked state."""

    def at(self, times: Array, states: Array) -> Array:
        """Rates (k, n m) at times (k,) and stacked states (k, n m)."""

    def of(self, columns: NDArray[np.intp]) -> Callable[[Array, Array], Array]:
        """Rates (n, c) of some trajectories, at times (c,) and states (n, c)."""


class Piece(scipy.integrate.DenseOutput):  # type: ignore[misc]
    """A step as a function of time: its start, and ``rows`` (k, n m) weighted by polynomials.

    It goes over ``times`` and from the first to the second of the ``states`` (n m,). ``method`` is
    the name of what made it. A long step is looked at in several ``parts``.
    """

    method: str
    parts = 1

    def __init__(
        self, times: tuple[float, float], states: tuple[Array, Array], rows: Array
    ) -> None:
        super().__init__(*times)
        (self.y_old, self.y), self.rows = states, rows
        self.h = self.t - self.t_old

    def kept(self) -> Piece:
        """The piece with rows of its own, which the next step does not overwrite."""
        return self

    @property
    def nbytes(self) -> int:
        """Bytes of its arrays, but for the state that the next step begins with."""
        inside = self.parts if self.parts > 1 else 0
        return int((1 + inside) * self.y_old.nbytes + self.rows.nbytes)

    def weights(self, shares: Array) -> Array:
        """Weights (T, k) of the rows at shares (T,) of a step."""
        raise NotImplementedError

    @cached_property
    def ends(self) -> Array:
        """Ends of the parts, ascending: (parts,)."""
        ends = self.t_old + (self.t - self.t_old) / self.parts * np.arange(1.0, self.parts + 1.0)
        ends[-1] = self.t
        return np.asarray(ends)

    @cached_property
    def at_ends(self) -> Array:
        """States at the ends of the parts, stacked: (parts, n m)."""
        return self.y[None] if self.parts == 1 else self.at(self.ends)

    def at(self, times: Array, out: Array | None = None) -> Array:
        """States at times (T,), stacked: (T, n m); into ``out`` if it is given."""
        return self.weighted(self.weights((times - self.t_old) / self.h), out)

    def weighted(self, weights: Array, out: Array | None = None) -> Array:
        """States by weights (T, k) of the rows, stacked: (T, n m); into ``out`` if it is given."""
        if len(weights) == 1:  # BLAS adds up in another order if they are strided
            weights = weights.copy()
        states = np.matmul(weights, self.rows, out=out)
        states += self.y_old
        return np.asarray(states)

    def of(self, trajectories: slice, n: int) -> Piece:
        """The step of some of the trajectories, which have n states each."""
        part = object.__new__(type(self))
        part.__dict__.update(self.__dict__)
        part.__dict__.pop("at_ends", None)
        part.y_old, part.y = (
            state.reshape(n, -1)[:, trajectories].ravel() for state in (self.y_old, self.y)
        )
        count = len(self.rows)
        part.rows = self.rows.reshape(count, n, -1)[:, :, trajectories].reshape(count, -1)
        return part

    def _call_impl(self, t: Array) -> Array:
        return self.at(np.atleast_1d(t)).T.reshape(-1, *t.shape)


def powers_of(shares: Array, count: int) -> Array:
    """The first powers of shares (T,), from the shares themselves: (T, count)."""
    powers = np.empty((count, shares.size))
    powers[:] = shares
    return np.multiply.accumulate(powers, axis=0, out=powers).T


class Stepper(scipy.integrate.OdeSolver):  # type: ignore[misc]
    """Steps that are made again where they missed something.

    The stacked state is in the order (state, trajectory); ``states`` (n, m) are those at the start.
    ``refusals`` counts the steps made again since the last call of :meth:`longest_tried`.
    ``stiff_product`` is the step times a decay rate from which stability limits explicit steps. So
    many ``steps_kept`` are made to the end all the same.
    """

    stiff_product = 3.0  # DOP853 is unstable from about 6
    steps_kept = 0

    def __init__(
        self,
        rates: Rates,
        span: tuple[float, float],
        states: Array,
        tolerances: Tolerances,
        control: DefectControl | None = None,
    ) -> None:
        self.trajectory_states, self.control = len(states), control
        self.refusals, self._longest_refused = 0, 0.0
        absolute = np.broadcast_to(tolerances.absolute, states.shape).ravel()
        steps = {"rtol": tolerances.relative, "max_step": tolerances.longest_step}
        super().__init__(rates, span[0], states.ravel(), span[1], atol=absolute, **steps)
        self.fun = rates  # without SciPy's checks and counts in between

    def interpolant(self, columns: NDArray[np.intp]) -> Interpolant:
        """The trajectories of some columns within the last step."""
        raise NotImplementedError

    def error_of(self, defect: Array, columns: NDArray[np.intp]) -> Array:
        """The error that a defect (n, c), times the step, of some trajectories amounts to."""
        return defect

    def longest_tried(self) -> float:
        """The longest of the last step and of those refused since the last call."""
        longest = max(self.step_size, self._longest_refused)
        self.refusals, self._longest_refused = 0, 0.0
        return float(longest)

    def step(self) -> str | None:
        """Make a step as SciPy does, again and shorter while it misses something."""
        members = self.__dict__
        before = {name: members[name] for name in _STEP_STATE if name in members}
        while True:
            message: str | None = super().step()
            if self.status == "failed":
                return message
            h = self.t - before["t"]
            shortening = self._shortening(before["y"])
            if shortening >= 1.0 or h <= 1e3 * np.spacing(max(abs(self.t), abs(before["t"]))):
                return message
            self.refusals, self._longest_refused = self.refusals + 1, max(self._longest_refused, h)
            self.__dict__.update(before)
            self._restart(h * shortening)

    def _shortening(self, y_before: Array) -> float:
        """Part of the step to try next; one if the step is good."""
        missed = self.control is not None and self.control.missed(self, y_before).any()
        return SHORTENING if missed else 1.0

    def _restart(self, h: float) -> None:
        self.h_abs = h


# -----------------------------------------------------------------------------
# Explicit steps of stacked trajectories: DOP853, for stacks in one array.
#
# The method, its coefficients and its control of the step are SciPy's (Hairer, Nørsett & Wanner,
# Solving Ordinary Differential Equations I, II.5 and II.10). A stack of small systems spends its
# time in calls of NumPy, so that the stages are made here, with as few of them as there can be.


_NESTED_ROWS = 7  # Rows of a step
_FIRST_FACTOR = 3.5  # The first step, at most, over SciPy's, whose error is far below the tolerance
# Error, in tolerances, from which a step is divided at a kink: below, kinks are not its reason
_DIVIDED_ERROR = 0.2


class NestedPiece(Piece):
    """A step of DOP853: a nested polynomial of the share and what is left of it."""

    method = "DOP853"

    def weights(self, shares: Array) -> Array:
        factors = np.empty((shares.size, _NESTED_ROWS))
        factors[:, ::2], factors[:, 1::2] = shares[:, None], 1.0 - shares[:, None]
        return factors.cumprod(axis=1)


class DividedPiece(NestedPiece):
    """A step of DOP853 that some trajectories divide at a kink."""

    def __init__(self, piece: NestedPiece, divided: DividedInterpolant) -> None:
        super().__init__((piece.t_old, piece.t), (piece.y_old, piece.y), piece.rows)
        self.divided = divided

    def at(self, times: Array, out: Array | None = None) -> Array:
        states = super().at(times, out)
        columns, shares = self.divided.columns, (times - self.t_old) / self.h
        places = np.tile(np.arange(columns.size), times.size)
        there, _ = self.divided(places, np.repeat(shares, columns.size), slopes=False)
        n = len(there)
        each = there.reshape(n, times.size, columns.size).swapaxes(0, 1)
        states.reshape(times.size, n, -1)[:, :, columns] = each
        return states


class StackedDOP853(Stepper, scipy.integrate.DOP853):  # type: ignore[misc]
    """Steps that suit every trajectory: the error is the largest of all, not their mean.

    Of ``smooth`` rates the first step is longer than SciPy's: nothing hides between its stages.
    """

    t: float
    y: Array
    _dense: NestedPiece | None = None
    _divided: DividedSteps | None = None
    _weights = np.stack([scipy.integrate.DOP853.E5, scipy.integrate.DOP853.E3])

    def __init__(
        self,
        rates: Rates,
        span: tuple[float, float],
        states: Array,
        tolerances: Tolerances,
        control: DefectControl | None = None,
        kinks: Kinks | None = None,
        smooth: bool = False,
    ) -> None:
        self.kinks = kinks
        super().__init__(rates, span, states, tolerances, control)
        if smooth:
            start, end = span
            steps = math.ceil((end - start) / min(_FIRST_FACTOR * self.h_abs, self.max_step))
            self.h_abs = (end - start) / steps

    def _step_impl(self) -> tuple[bool, str | None]:
        """A step whose error is within the tolerance, shorter than the last one if it must be."""
        t, y, shortest = self.t, self.y, LEAST_STEP * float(np.spacing(abs(self.t)))
        h, refused = min(max(self.h_abs, shortest), self.max_step), False
        while h >= shortest:
            end = min(t + h, self.t_bound)
            h = end - t
            y_new, f_new = self._stages(h)
            scale = self.atol + np.maximum(np.abs(y), np.abs(y_new)) * self.rtol
            errors = h * self._errors(scale)
            divided = None if self.kinks is None else self._divided_steps(h, y_new, errors)
            if divided is not None:
                y_new, f_new = divided.into(y_new, f_new)
                errors[divided.columns] = divided.errors
            error = float(errors.max())
            factor = SAFETY * error**self.error_exponent if error else MOST_FACTOR
            if error < 1.0:
                self.h_abs = h * min(factor, 1.0 if refused else MOST_FACTOR)
                self.h_previous, self.y_old = h, y
                self.t, self.y, self.f = end, y_new, f_new
                self._divided = divided
                return True, None
            h *= max(LEAST_FACTOR, factor)  # the least one where the error is not a number
            refused = True
        return False, self.TOO_SMALL_STEP

    def _stages(self, h: float) -> tuple[Array, Array]:
        """The state after a step and its rates; the rates at all stages are in ``K``."""
        rates, t, y, slopes = self.fun, self.t, self.y, self.K
        weights, argument = h * self.A, np.empty_like(y)
        slopes[0] = self.f
        for stage, share in enumerate(self.C[1:].tolist(), start=1):
            np.dot(weights[stage, :stage], slopes[:stage], out=argument)
            argument += y
            slopes[stage] = rates(t + share * h, argument)
        y_new = np.asarray(y + np.dot(h * self.B, slopes[:-1]))
        f_new = slopes[-1] = rates(t + h, y_new)
        return y_new, f_new

    def _errors(self, scale: Array) -> Array:
        """The errors of a step over its length, in units of ``scale``, of each trajectory (m,)."""
        errors = np.square(self._weights @ self.K / scale)
        fifth, third = errors.reshape(2, self.trajectory_states, -1).sum(axis=1)
        return error_norm(fifth, third, self.trajectory_states)

    def _divided_steps(self, h: float, y_new: Array, errors: Array) -> DividedSteps | None:
        """The steps of trajectories whose errors a kink makes large, divided there.

        None where others are as large, or the kinks were not found.
        """
        rough = np.flatnonzero(~(errors <= _DIVIDED_ERROR))
        if not rough.size or self.kinks is None:
            return None
        shape = self.trajectory_states, -1
        heights, step = self.kinks.heights(rough), np.full(rough.size, self.t)
        old, new = self.y.reshape(shape), y_new.reshape(shape)
        last = heights(step + h, new[:, rough])
        crossed, which = crossed_once(heights(step, old[:, rough]), last)
        columns = rough[crossed]
        others = np.delete(errors, columns)
        if not columns.size or not np.all(others < 1.0):
            return None
        heights, each = self.kinks.heights(columns), np.arange(columns.size)
        return divided_steps(
            columns,
            self.fun.of(columns),
            lambda times, states: heights(times, states)[which, each],
            (self.t, h, old[:, columns], self.f.reshape(shape)[:, columns]),
            last[which, crossed],
            (self.rtol, self.atol.reshape(shape)[:, columns]),
        )

    def dense_output(self) -> NestedPiece:
        """The last step as a function of time, made once for each step."""
        if self._dense is None or self._dense.t != self.t or self._dense.t_old != self.t_old:
            rows = np.empty((_NESTED_ROWS, self.n))
            h, slopes, before = self.h_previous, self.K_extended, self.y_old
            weights, argument = h * self.A_EXTRA, np.empty(self.n)
            for extra, share in enumerate(self.C_EXTRA.tolist()):
                stage = self.n_stages + 1 + extra
                np.dot(weights[extra, :stage], slopes[:stage], out=argument)
                argument += before
                slopes[stage] = self.fun(self.t_old + share * h, argument)
            np.subtract(self.y, before, out=rows[0])
            np.subtract(h * slopes[0], rows[0], out=rows[1])
            rows[2] = 2.0 * rows[0] - h * (self.f + slopes[0])
            np.dot(h * self.D, slopes, out=rows[3:])
            piece = NestedPiece((self.t_old, self.t), (before, self.y), rows)
            divided = None if self._divided is None else self._divided.interpolant()
            self._dense = piece if divided is None else DividedPiece(piece, divided)
        return self._dense

    def interpolant(self, columns: NDArray[np.intp]) -> Interpolant:  # a nested polynomial
        n, dense = self.trajectory_states, self.dense_output()
        coefficients = dense.rows.reshape(len(dense.rows), n, -1)[:, :, columns]
        start = dense.y_old.reshape(n, -1)[:, columns]

        def evaluate(shares: Array, slopes: bool) -> tuple[Array, Array]:
            return nested(coefficients, start, shares, slopes)

        divided = dense.divided if isinstance(dense, DividedPiece) else None
        return evaluate if divided is None else divided.into(evaluate, columns)
