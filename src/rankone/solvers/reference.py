"""Reference trajectories at single parameter points: the yardstick every solve is held against.

All points are integrated together as one stacked system by SciPy, with the generated pointwise
right-hand side: DOP853, or Radau where the centre trajectory is stiff.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import scipy.integrate
import scipy.sparse

from rankone.arrays import Array
from rankone.discretization.radau import INSET
from rankone.errors import ConvergenceError
from rankone.solvers.outcome import Measured
from rankone.system import System
from rankone.tensors.slab import SlabTrain

__all__ = ["Reference", "check_points", "initial_values", "integrate_reference", "measure"]

_PROBE_STEPS = 100
"""DOP853 steps after which it is asked whether stability limits the step."""
_STIFF_PRODUCT = 3.0
"""Step times decay rate above which it does (stability ends at about 6)."""
_CHECK_TIMES = np.array([0.0, 0.13, 0.31, 0.5, 0.69, 0.87, 1.0])
"""Checked times, in slab lengths."""
_DENSE_STATES = 240
"""Largest stacked system whose Jacobian is factored densely."""


def check_points(
    box: Array, count: int, seed: int = 20140, special: Sequence[Sequence[float]] = ()
) -> Array:
    """The centre of the box, corners, and random interior points, shape (m, d).

    Parameters
    ----------
    box : ndarray (d, 2)
    count : int
        Number of random points; with it come all corners for d <= 3, else eight of them.
    special : sequence of sequences of float
        For each parameter values that must be among those checked.
    """
    rng = np.random.default_rng(seed)
    d = len(box)
    lower, width = box[:, 0], box[:, 1] - box[:, 0]
    if d == 0 or count == 0:
        return (lower + 0.5 * width)[None, :]
    if d <= 3:
        corners = np.stack(np.meshgrid(*[[0.0, 1.0]] * d, indexing="ij"), axis=-1).reshape(-1, d)
    else:
        corners = rng.integers(0, 2, size=(8, d)).astype(float)
        corners[0], corners[1] = 0.0, 1.0
    unit = np.concatenate([np.full((1, d), 0.5), corners, rng.random((count, d))])
    points = [lower + width * unit]
    for j, values in enumerate(special):
        more = lower + width * rng.random((len(values), d))
        more[:, j] = values
        points.append(more)
    return np.concatenate(points)


@dataclass(frozen=True)
class Reference:
    """Trajectories at the check points, dense in time.

    Attributes
    ----------
    points : ndarray (m, d)
        Parameter points; the first is the centre of the box.
    end : float
        Time reached; before the horizon where a trajectory blows up.
    stiff : bool
        Whether the stiff integrator was used.
    blown : int or None
        The point whose trajectory blows up at ``end``.
    batches : tuple
        Number of points and dense output of each integration, in the order of the points.
    states : int
    """

    points: Array
    start: float
    end: float
    stiff: bool
    blown: int | None
    batches: tuple[tuple[int, Any], ...]
    states: int

    def __call__(self, times: Array) -> Array:
        """States at the times (T,): shape (n, m, T)."""
        parts = [dense(times).reshape(self.states, count, -1) for count, dense in self.batches]
        return np.asarray(parts[0] if len(parts) == 1 else np.concatenate(parts, axis=1))

    def joined(self, other: Reference) -> Reference:
        """The trajectories of both, up to where the first of them blows up."""
        first, blown = self, self.blown
        if other.end < self.end and other.blown is not None:
            first, blown = other, len(self.points) + other.blown
        points = np.concatenate([self.points, other.points])
        batches, stiff = self.batches + other.batches, self.stiff or other.stiff
        return Reference(points, self.start, first.end, stiff, blown, batches, self.states)


def integrate_reference(
    system: System,
    points: Array,
    start: float,
    end: float,
    rtol: float,
    cuts: Sequence[float] = (),
) -> Reference:
    """Integrate the system from ``start`` to ``end`` at all points (m, d).

    Parameters
    ----------
    system : System
    points : ndarray (m, d)
    start, end : float
    rtol : float
        Relative tolerance of the integrator.
    cuts : sequence of float
        Times, ascending, at which the integration is begun anew: where the time factors jump,
        kink or are narrow.

    Raises
    ------
    ConvergenceError
        If not a single step can be made.
    """
    n, m = system.N_DIFFERENTIAL, len(points)
    initial = initial_values(system, np.ascontiguousarray(points.T))
    size = np.abs(initial).max(axis=1, keepdims=True)
    size = np.where(size > 0.0, size, size.max(initial=0.0) or 1.0)
    tolerances = {"rtol": rtol, "atol": (rtol * 1e-7 * np.broadcast_to(size, (n, m))).ravel()}
    integration = _Integration(system, points, initial, [start, *cuts, end], tolerances)
    with np.errstate(all="ignore"):
        stiff = not integration.run(scipy.integrate.DOP853)
        if stiff:
            integration.run(scipy.integrate.Radau, jac=_stacked_jacobian(system, points.T, n, m))
    if not integration.pieces:
        raise ConvergenceError(
            f"no trajectory can be integrated from t = {start:g}: the right-hand side is not "
            "finite there or varies without bound",
            remedy="check the initial values and the coefficients",
        )
    blown = None
    reached = integration.times[-1]
    if reached < end:
        growth = np.abs(integration.state.reshape(n, m)) / np.maximum(np.abs(initial), size)
        blown = int(np.argmax(np.nan_to_num(growth, nan=np.inf).max(axis=0)))
    dense = scipy.integrate.OdeSolution(integration.times, integration.pieces)
    return Reference(points, start, float(reached), stiff, blown, ((m, dense),), n)


@dataclass
class _Integration:
    """Stepwise integration of the stacked system over consecutive segments."""

    system: System
    points: Array
    initial: Array
    edges: list[float]
    tolerances: dict[str, Any]
    times: list[float] = field(default_factory=list)
    pieces: list[Any] = field(default_factory=list)
    state: Array = field(default_factory=lambda: np.zeros(0))

    def run(self, method: Any, **options: Any) -> bool:
        """Integrate until the end or a failure; False if an explicit method meets stiffness."""
        self.times, self.pieces, self.state = [self.edges[0]], [], self.initial.ravel()
        for a, b in itertools.pairwise(self.edges):
            solver = method(
                self._right_hand_side(a, b), a, self.state, b, **self.tolerances, **options
            )
            while solver.status == "running":
                solver.step()
                if solver.status == "failed":
                    return True
                self.times.append(solver.t)
                self.pieces.append(solver.dense_output())
                self.state = solver.y
                if method is scipy.integrate.DOP853 and len(self.pieces) % _PROBE_STEPS == 0:
                    decay = self._decay(solver.t)
                    if decay * solver.step_size > _STIFF_PRODUCT:
                        return False
        return True

    def _right_hand_side(self, a: float, b: float) -> Callable[[float, Array], Array]:
        """The stacked right-hand side on a segment; factors are never taken at its very ends."""
        rhs, shape = self.system.rhs, self.initial.shape
        parameters = np.ascontiguousarray(self.points.T)
        if len(self.edges) == 2:
            return lambda t, y: rhs(t, y.reshape(shape), parameters).ravel()
        least, most = a + INSET * (b - a), b - INSET * (b - a)
        return lambda t, y: rhs(min(max(t, least), most), y.reshape(shape), parameters).ravel()

    def _decay(self, t: float) -> float:
        """Fastest rate of decay over the points at the present state."""
        n, m = self.initial.shape
        jacobian = self.system.jacobian(t, self.state.reshape(n, m), self.points.T)
        blocks = np.moveaxis(np.broadcast_to(jacobian, (n, n, m)), 2, 0)
        if not np.isfinite(blocks).all():
            return 0.0
        return float(-np.linalg.eigvals(blocks).real.min())


def initial_values(system: System, parameters: Array) -> Array:
    """Initial states at parameter points (d, m): shape (n, m)."""
    m = parameters.shape[1]
    rows = [system.parameter_factors(j, parameters[j]) for j in range(len(parameters))]
    values = np.zeros((system.N_DIFFERENTIAL, m))
    for coefficient, state, factors in system.INITIAL:
        product = np.full(m, coefficient)
        for row, index in zip(rows, factors, strict=True):
            product = product * row[index]
        values[state] += product
    return values


def measure(
    slabs: Sequence[SlabTrain], reference: Reference, scale: Array, corners: int
) -> Measured:
    """Errors of the slabs against the reference over their whole time span.

    Parameters
    ----------
    slabs : sequence of SlabTrain
    reference : Reference
    scale : ndarray (n,)
        Size of each state over the interior points. Errors at corners are relative to the largest
        value over the corners, where that is larger.
    corners : int
        Number of check points, after the centre, that are corners of the box.
    """
    m, d = reference.points.shape
    errors = np.zeros((reference.states, m))
    largest = scale.copy()
    for slab in slabs:
        times = slab.start + (slab.end - slab.start) * _CHECK_TIMES
        exact = reference(times)
        pairs = np.tile(times, m), np.repeat(reference.points, times.size, axis=0).T
        values = slab(*pairs).reshape(exact.shape)
        errors = np.maximum(errors, np.abs(values - exact).max(axis=2))
        at_corners = np.abs(exact[:, 1 : 1 + corners]).max(axis=(1, 2), initial=0.0)
        largest = np.maximum(largest, at_corners)
    errors = np.where(np.isfinite(errors), errors, np.inf)
    at_corners = errors[:, 1 : 1 + corners].max(axis=1, initial=0.0) / largest
    interior = np.maximum(errors[:, 0], errors[:, 1 + corners :].max(axis=1, initial=0.0)) / scale
    if d <= 3:
        interior = np.maximum(interior, at_corners)
    stated = tuple(at_corners.tolist()) if corners else ()
    method = "Radau" if reference.stiff else "DOP853"
    return Measured(tuple(interior.tolist()), stated, m, method)


def _stacked_jacobian(system: System, parameters: Array, n: int, m: int) -> Any:
    """Block Jacobian of the stacked system in the order (state, point)."""
    rows = (np.arange(n)[:, None, None] * m + np.arange(m)) + np.zeros((n, n, m), dtype=int)
    columns = (np.arange(n)[None, :, None] * m + np.arange(m)) + np.zeros((n, n, m), dtype=int)
    shape = (n * m, n * m)

    def jacobian(t: float, y: Array) -> Any:
        blocks = np.broadcast_to(system.jacobian(t, y.reshape(n, m), parameters), (n, n, m))
        entries = (blocks.ravel(), (rows.ravel(), columns.ravel()))
        matrix = scipy.sparse.csc_matrix(entries, shape=shape)
        return matrix.toarray() if n * m <= _DENSE_STATES else matrix

    return jacobian
