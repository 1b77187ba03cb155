"""Constraints: expressions of the states that vanish on all trajectories of a system.

They come from algebraic equations. Newton's method finds the unknowns with guessed initial values
from them, and shows how far states are from satisfying them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rankone.support.arrays import Array
from rankone.support.budget import charge
from rankone.support.costs import CALL, pseudo_inverse
from rankone.support.precision import COINCIDENT, EPSILON, NEGLIGIBLE, TINY
from rankone.trajectories.system.features import OfStates, no_rows

_CALLS = 30  # Of NumPy in a step of Newton's method
_MOST_STEPS = 100  # Steps of Newton's method; damped ones from far away are many
_MOST_HALVINGS = 30  # Of a step that does not lower the residual
_LEAST_FALL = 0.1  # Part of the residual by which a step lowers it, at least, for its length
_SHORT = EPSILON**0.5  # Relative length of steps from which rounding decides on the residual
_MOST_PROJECTIONS = 20  # Steps of Newton's method towards all constraints, from close by


@dataclass(frozen=True, eq=False)
class Constraints:
    """Constraints of a system with n states; none where ``names`` is empty.

    ``names`` say which equation each one comes from, ``guessed`` are the states whose initial
    values are only starting guesses. ``residuals`` (k, ...) are what vanishes and ``slopes``
    (k, n, ...) its derivatives, at t, u (n, ...) and p (d, ...).
    """

    names: tuple[str, ...] = ()
    guessed: tuple[int, ...] = ()
    residuals: OfStates = no_rows
    slopes: OfStates = no_rows

    def consistent(
        self, t: float, u: Array, p: Array, steps: int = _MOST_STEPS, sizes: Array | None = None
    ) -> Array:
        """States u (n, m) at p (d, m) with the guessed ones such that constraints hold.

        NaN for those that Newton's method does not find in a number of steps. States are as exact
        as rounding of their ``sizes`` (n, m) allows, by default of their own.
        """
        states, rows = np.array(u, dtype=float), list(self.guessed)
        if not rows:
            return states
        least = NEGLIGIBLE * (np.zeros(states.shape) if sizes is None else sizes)
        with np.errstate(all="ignore"):
            converged = np.zeros(states.shape[1], dtype=bool)
            before = np.full(states.shape[1], np.inf)
            for _ in range(steps):
                open_ = np.flatnonzero(~converged)
                if not open_.size:
                    break
                charge(_CALLS * CALL + open_.size * pseudo_inverse(len(self.names), len(rows)))
                states[:, open_], changes = self._stepped(
                    t, states[:, open_], p[:, open_], least[:, open_]
                )
                rounding = (changes <= _SHORT) & (changes >= (1.0 - _LEAST_FALL) * before[open_])
                converged[open_] = (changes <= COINCIDENT) | rounding
                before[open_] = changes
            states[rows] = np.where(
                converged & self._hold(t, states, p, least), states[rows], np.nan
            )
        return states

    def _stepped(self, t: float, u: Array, p: Array, least: Array) -> tuple[Array, Array]:
        """States after a step of Newton's method, and the largest relative change (m,).

        The step is halved until the residual falls. Sizes of states are ``least`` (n, m) or more.
        """
        rows = list(self.guessed)
        residuals, slopes = self._at(t, u, p)
        sizes = np.abs(u[rows])
        sizes = np.maximum(np.maximum(sizes, least[rows]), NEGLIGIBLE * sizes.max(axis=0))
        sizes = np.where(sizes > 0.0, sizes, 1.0)
        scaled = slopes[:, rows] * sizes
        scale = np.abs(scaled).max(axis=1)
        scale = np.where(scale > 0.0, scale, np.inf)  # rows without guessed states do not count
        matrices = np.nan_to_num(np.moveaxis(scaled / scale[:, None], 2, 0))
        inverse = np.linalg.pinv(matrices, rcond=COINCIDENT)
        steps = -np.einsum("mgk,km->gm", inverse, residuals / scale)
        before, shares = np.linalg.norm(residuals / scale, axis=0), np.ones(u.shape[1])
        short = np.abs(steps).max(axis=0) <= _SHORT  # rounding decides on the residual
        stepped = u.copy()
        for _ in range(_MOST_HALVINGS):
            stepped[rows] = u[rows] + shares * sizes * steps
            after = np.linalg.norm(self._at(t, stepped, p)[0] / scale, axis=0)
            worse = np.logical_not((after <= before * (1.0 - _LEAST_FALL * shares)) | short)
            if not worse.any():
                break
            shares = np.where(worse, 0.5 * shares, shares)
        return stepped, shares * np.abs(steps).max(axis=0)

    def _hold(
        self, t: float | Array, u: Array, p: Array, least: float | Array = 0.0
    ) -> NDArray[np.bool_]:
        """At which points (m,) all constraints hold, up to rounding of sizes from ``least`` on."""
        residuals, slopes = self._at(t, u, p)
        sizes = np.maximum(np.maximum(np.abs(u), least), NEGLIGIBLE * np.abs(u).max(axis=0))
        terms = np.einsum("knm,nm->km", np.abs(slopes), sizes)
        return np.asarray((np.abs(residuals) <= NEGLIGIBLE * terms + TINY).all(axis=0))

    def _at(self, t: float | Array, u: Array, p: Array) -> tuple[Array, Array]:
        """Residuals (k, m) and slopes (k, n, m)."""
        k, n, m = len(self.names), len(u), u.shape[1]
        residuals = np.broadcast_to(self.residuals(t, u, p), (k, m))
        return residuals, np.broadcast_to(self.slopes(t, u, p), (k, n, m))

    def projected(self, t: Array, u: Array, p: Array) -> Array:
        """States u (n, m) at times t (m,) moved to where all constraints hold; NaN if they do not.

        By Newton's method with the least relative change of all states.
        """
        states = np.array(u, dtype=float)
        if not self.names:
            return states
        sizes = np.abs(states).max(axis=1, initial=0.0)
        sizes = np.where(sizes > 0.0, sizes, sizes.max(initial=0.0) or 1.0)
        for _ in range(_MOST_PROJECTIONS):
            states = states - self._least_changes(t, states, p, sizes)
        with np.errstate(all="ignore"):
            return np.where(self._hold(t, states, p), states, np.nan)

    def tangential(self, t: float, u: Array, p: Array, direction: Array) -> Array:
        """A direction (n,) from states u (n,) at p (d,), along the constraints."""
        if not self.names:
            return direction
        _, slopes = self._at(t, u[:, None], p[:, None])
        sizes = np.where(u != 0.0, np.abs(u), 1.0)
        scaled = slopes[:, :, 0] * sizes
        across = np.linalg.pinv(scaled) @ (scaled @ (direction / sizes))
        return np.asarray(direction - sizes * across)

    def distances(self, t: float | Array, u: Array, p: Array, sizes: Array) -> Array:
        """How far each state u (n, m), at times t (m,), is from satisfying the constraints: (n, m).

        By the least change of all states, in units of their sizes (n,), that satisfies them to
        first order.
        """
        return np.abs(self._least_changes(t, u, p, sizes))

    def _least_changes(self, t: float | Array, u: Array, p: Array, sizes: Array) -> Array:
        """The least changes (n, m) in units of the sizes (n,) that leave what satisfies them."""
        with np.errstate(all="ignore"):
            residuals, slopes = self._at(t, u, p)
            scaled = np.moveaxis(slopes * sizes[None, :, None], 2, 0)
            scale = np.abs(scaled).max(axis=2, keepdims=True)
            scale = np.where(scale > 0.0, scale, 1.0)
            finite = np.isfinite(scaled.sum(axis=(1, 2)) + residuals.sum(axis=0))
            matrices = np.where(finite[:, None, None], scaled / scale, 0.0)
            inverse = np.linalg.pinv(matrices, rcond=COINCIDENT)
            changes = np.einsum("mnk,mk->nm", inverse, residuals.T / scale[:, :, 0])
        return np.where(finite, changes * sizes[:, None], np.inf)
