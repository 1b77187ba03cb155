"""Steps of stacked trajectories that suit every trajectory.

Steps are made again, and shorter, where their interpolant is wrong between the stages, which the
estimate of the error does not see. Where it runs through something narrow in between, its slope
differs from the rates there: the defect. Defects are looked at between the nodes of Radau, where
trajectories cross state surfaces, and at random places.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Protocol

import numpy as np
import scipy.integrate
from numpy.typing import NDArray

from rankone.support.arrays import Array
from rankone.trajectories.defects import SHORTENING, DefectControl, Interpolant
from rankone.trajectories.integrator import Tolerances

# What only a step of Radau changes, except its factorisations
_RADAU_STATE = ("h_abs_old", "error_norm_old", "sol")
# What a step changes, and a refused one changes back
_STEP_STATE = ("t", "t_old", "y", "f", "h_abs", "status", *_RADAU_STATE)


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
        start: float,
        states: Array,
        end: float,
        tolerances: Tolerances,
        control: DefectControl | None = None,
    ) -> None:
        self.trajectory_states, self.control = len(states), control
        self.refusals, self._longest_refused = 0, 0.0
        absolute = np.broadcast_to(tolerances.absolute, states.shape).ravel()
        steps = {"rtol": tolerances.relative, "max_step": tolerances.longest_step}
        super().__init__(rates, start, states.ravel(), end, atol=absolute, **steps)
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
