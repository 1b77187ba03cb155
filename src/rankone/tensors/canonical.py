"""The canonical form: sums of products of functions of one coordinate.

    u(t, p_1, ..., p_d) = sum_i alpha_i T_i(t) P_i^1(p_1) ... P_i^d(p_d)

A solution is a tensor train for each time slab. To write one unknown in canonical form, its slabs
are added up to one train over the horizon (time becomes one axis of piecewise polynomials) and
rounded. The train is split into orthogonal products by singular value decompositions, one
dimension after the other, always the largest branch first (Batselier, Liu, Wong, "A constructive
arbitrary-degree Kronecker product decomposition of tensors", 2017), until the rest is below the
tolerance. In one parameter that is the singular value decomposition and optimal; otherwise
alternating least squares, started from the leading products, look for a form of fewer terms.

Everything is held by values at Gauss points times the square root of the weights, so that
Euclidean products are mean products over the box and the horizon.
"""

from __future__ import annotations

import heapq
import itertools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, reduce

import numpy as np
from numpy.polynomial.legendre import leggauss

from rankone.support.arrays import COINCIDENT, MINOR, NEGLIGIBLE, ROUNDING, Array
from rankone.support.errors import EvaluationError, listing, warn
from rankone.support.options import OUTPUT_RTOLS, RTOL, checked_number
from rankone.tensors import IDENTITY, Basis1D, Scale, legendre_values
from rankone.tensors.coordinates import Coordinates, name_of, round_off
from rankone.tensors.slab import SlabTrain
from rankone.tensors.train import Train, block_diagonal

_MAX_SWEEPS = 400  # Most sweeps of least squares: slower convergence is not worth the time
_MAX_TERM_SWEEPS = 20_000  # Most sweeps times terms: a sweep costs in proportion to the terms


@dataclass(frozen=True)
class Axis:
    """Piecewise polynomials of a coordinate, held by values at Gauss points.

    ``breaks`` are the ends of the elements, ``degrees`` their numbers of Gauss points. They are
    polynomials in the coordinate of ``scale``; breaks and nodes are values of the parameter.
    """

    name: str
    breaks: tuple[float, ...]
    degrees: tuple[int, ...]
    scale: Scale = IDENTITY

    @cached_property
    def nodes(self) -> Array:
        """Gauss points of all elements, ascending, shape (N,)."""
        scaled = np.concatenate(
            [0.5 * (a + b) + 0.5 * (b - a) * leggauss(count)[0] for a, b, count in self._elements]
        )
        return self.scale.from_scale(scaled)

    @cached_property
    def weights(self) -> Array:
        """Weights of the mean over the interval, of sum one, shape (N,)."""
        width = self.breaks[-1] - self.breaks[0]
        weights = np.concatenate(
            [0.5 * (b - a) / width * leggauss(count)[1] for a, b, count in self._elements]
        )
        return weights if self.scale.is_identity else weights / self.scale.slope(self.nodes)

    @property
    def _elements(self) -> Iterator[tuple[float, float, int]]:
        """Ends, in the scale, and number of Gauss points of each element."""
        breaks = self._scaled_breaks
        return zip(breaks[:-1], breaks[1:], self.degrees, strict=True)

    @cached_property
    def _scaled_breaks(self) -> tuple[float, ...]:
        if self.scale.is_identity:
            return self.breaks
        return tuple(self.scale.to_scale(np.array(self.breaks)).tolist())

    def interpolate(self, values: Array, points: Array) -> Array:
        """Interpolate values at the nodes, (N, R), to points (M,): shape (M, R)."""
        breaks, points = self._scaled_breaks, self.scale.to_scale(points)
        element = np.searchsorted(breaks[1:-1], points, side="right")
        offsets = np.concatenate([[0], np.cumsum(self.degrees)])
        interpolated = np.empty((points.size, values.shape[1]))
        for e in np.unique(element):
            a, b, count = breaks[e], breaks[e + 1], self.degrees[e]
            xi, weights = leggauss(count)
            to_modal = legendre_values(xi, count).T * (0.5 * weights)
            here = np.flatnonzero(element == e)
            local = legendre_values((2.0 * points[here] - (a + b)) / (b - a), count)
            interpolated[here] = local @ (to_modal @ values[offsets[e] : offsets[e + 1]])
        return interpolated


@dataclass(frozen=True, eq=False, repr=False)
class CanonicalForm:
    """One unknown as a sum of products of functions of one coordinate.

    Attributes
    ----------
    name : str
        The unknown.
    amplitudes : ndarray (R,)
        Positive, descending.
    factors : dict of str to ndarray (N, R)
        For time and each parameter the values of the R modes at the nodes; each mode has the
        mean square one over its interval. In one parameter the modes are orthonormal.
    axes : tuple of Axis
        Time, then the parameters: nodes, weights and interpolation.
    error : float
        Root of the mean square error over box and horizon against the solution, relative to the
        root of the unknown's mean square.
    rtol : float
        Largest ``error`` allowed.
    """

    name: str
    amplitudes: Array
    factors: dict[str, Array]
    axes: tuple[Axis, ...]
    error: float
    rtol: float

    @property
    def rank(self) -> int:
        """Number of terms."""
        return self.amplitudes.size

    @property
    def success(self) -> bool:
        """Whether the error is within the tolerance."""
        return self.error <= self.rtol

    @property
    def nodes(self) -> dict[str, Array]:
        """For time and each parameter the points (N,) at which the factors are given."""
        return {axis.name: axis.nodes for axis in self.axes}

    @property
    def weights(self) -> dict[str, Array]:
        """For time and each parameter the weights (N,) of the mean, of sum one."""
        return {axis.name: axis.weights for axis in self.axes}

    def __call__(self, *at: object, **named: object) -> Array:
        """Evaluate as a solution does: the result has the broadcast shape of the values."""
        intervals = [(axis.breaks[0], axis.breaks[-1]) for axis in self.axes]
        coordinates = Coordinates([axis.name for axis in self.axes], intervals)
        gathered = coordinates.gather(at, named)
        points, shape = coordinates.broadcast(coordinates.arrays(gathered))
        products = np.ones((points.shape[1], self.rank))
        for axis, row in zip(self.axes, points, strict=True):
            products *= axis.interpolate(self.factors[axis.name], row)
        return np.asarray((products @ self.amplitudes).reshape(shape))

    def __repr__(self) -> str:
        shown = ", ".join(f"{amplitude:.3g}" for amplitude in self.amplitudes[:5])
        ellipsis = ", ..." if self.rank > 5 else ""
        over = ", ".join(f"{axis.name} ({axis.nodes.size} nodes)" for axis in self.axes)
        return (
            f"CanonicalForm of {self.name}: {self.rank} terms over {over}, "
            f"error {self.error:.2g}, amplitudes {shown}{ellipsis}"
        )


class CanonicalForms(Mapping[str, CanonicalForm]):
    """The canonical form of each unknown, by name or symbol, in the order of the unknowns.

    Forms of other states, such as ``forms["x_t"]``, are computed on demand; they are not ``in`` the
    mapping, and iteration skips them. With a single unknown, ``amplitudes``, ``factors`` and
    ``nodes`` are those of its form.

    Parameters
    ----------
    form : callable
        From the row and the label of a state to its form.
    states : sequence of str
        Names of all states.
    unknowns : sequence of str
        States whose forms are computed at once.
    hint : callable
        What to say behind a name that is no state.
    """

    def __init__(
        self,
        form: Callable[[int, str], CanonicalForm],
        states: Sequence[str],
        unknowns: Sequence[str],
        hint: Callable[[str], str],
    ) -> None:
        self._form, self._states, self._unknowns = form, tuple(states), tuple(unknowns)
        self._hint = hint
        self._forms = {name: form(self._states.index(name), name) for name in unknowns}

    def __getitem__(self, state: object) -> CanonicalForm:
        name = name_of(state)
        if name not in self._states:
            raise KeyError(
                f"no unknown {name}{self._hint(name)}; known are {listing(self._states, name)}"
            )
        if name not in self._forms:
            self._forms[name] = self._form(self._states.index(name), name)
        return self._forms[name]

    def __contains__(self, state: object) -> bool:
        try:
            return name_of(state) in self._unknowns
        except EvaluationError:
            return False

    def __iter__(self) -> Iterator[str]:
        return iter(self._unknowns)

    def __len__(self) -> int:
        return len(self._unknowns)

    @property
    def error(self) -> float:
        """The largest error of the forms."""
        return max(form.error for form in self.values())

    @property
    def rank(self) -> int:
        """The largest number of terms of the forms."""
        return max(form.rank for form in self.values())

    @property
    def amplitudes(self) -> Array:
        """Amplitudes of the only form."""
        return self._only("amplitudes").amplitudes

    @property
    def factors(self) -> dict[str, Array]:
        """Factors of the only form."""
        return self._only("factors").factors

    @property
    def nodes(self) -> dict[str, Array]:
        """Nodes of the only form."""
        return self._only("nodes").nodes

    def _only(self, attribute: str) -> CanonicalForm:
        if len(self) != 1:
            raise EvaluationError(
                f"there are {len(self)} canonical forms: {listing(self)}",
                remedy=f"choose one: forms[{self._unknowns[0]!r}].{attribute}",
            )
        return self[self._unknowns[0]]

    def __repr__(self) -> str:
        return "\n".join(repr(form) for form in self.values())


def canonical_form(
    slabs: Sequence[SlabTrain],
    names: Sequence[str],
    row: int,
    label: str,
    *,
    rtol: float = RTOL,
    max_rank: int = 500,
) -> CanonicalForm:
    """Write the state in a row of consecutive slabs, whose name is ``label``, in canonical form.

    The names are those of time and the parameters. Tolerance, errors and warnings as in
    :meth:`~rankone.solution.solution.Solution.to_canonical`.
    """
    rtol = checked_number("rtol", rtol, *OUTPUT_RTOLS, float)
    max_rank = checked_number("max_rank", max_rank, 1)
    axes = _common_axes(slabs, names)
    # rounding the train of the horizon takes a minor share of the tolerance
    train, norm, rounding = _horizon_train(slabs, row, axes, MINOR * rtol)
    if norm == 0.0:
        nothing = {axis.name: np.ones((axis.nodes.size, 0)) for axis in axes}
        return CanonicalForm(label, np.empty(0), nothing, axes, 0.0, rtol)
    tolerance = (1.0 - 1.1 * MINOR) * rtol * norm
    amplitudes, modes = _branches(train, tolerance, max_rank)
    error = _distance(train, amplitudes, modes)
    if len(axes) > 2 and rtol >= NEGLIGIBLE:
        amplitudes, modes, error = _shortened(train, amplitudes, modes, error, tolerance, norm)
    relative = error / norm + rounding
    if relative > rtol:
        warn(
            f"canonical form of {label}: {len(amplitudes)} terms leave a relative error of "
            f"{relative:.2g}, more than rtol = {rtol:g}",
            remedy="a larger max_rank or rtol",
        )
    amplitudes, modes = _standard(amplitudes, modes)
    pairs = zip(modes, axes, strict=True)
    factors = {axis.name: mode / np.sqrt(axis.weights)[:, None] for mode, axis in pairs}
    return CanonicalForm(label, amplitudes, factors, axes, relative, rtol)


def _common_axes(slabs: Sequence[SlabTrain], names: Sequence[str]) -> tuple[Axis, ...]:
    """Axes on which every slab is represented exactly."""
    ends = (*(slab.start for slab in slabs), slabs[-1].end)
    axes = [Axis(names[0], ends, tuple(slab.cores[0].shape[1] for slab in slabs))]
    for j, name in enumerate(names[1:]):
        bases = [slab.bases[j] for slab in slabs]
        breaks, scale = _common_edges(bases), bases[0].scale
        # in a scale, products of modes have the density of the parameter as another factor
        density = 1
        if not scale.is_identity:
            density = scale.slope_modes(bases[0].lower, bases[0].upper, inverse=True)
        degree = max(basis.degree for basis in bases) + density // 2
        axes.append(Axis(name, tuple(breaks.tolist()), (degree,) * (breaks.size - 1), scale))
    return tuple(axes)


def _common_edges(bases: Sequence[Basis1D]) -> Array:
    """Ends of elements each of which lies in one element of every basis."""
    if not any(basis.breaks for basis in bases):
        elements = math.lcm(*(basis.elements for basis in bases))
        return replace(bases[0], elements=elements).edges
    lower, upper = bases[0].lower, bases[0].upper
    inside = np.unique(np.concatenate([basis.edges[1:-1] for basis in bases]))
    rounding = round_off(lower, upper)  # between the same break, computed in two ways
    apart = np.diff(inside, prepend=lower) > rounding
    return np.array([lower, *inside[apart & (upper - inside > rounding)], upper])


def _slab_train(slab: SlabTrain, state: int, axes: Sequence[Axis]) -> Train:
    """Scaled values of one state on the axes; time on the nodes of the slab alone."""
    first = slab.cores[0][state]
    xi, weights = leggauss(len(first))
    width = (slab.end - slab.start) / (axes[0].breaks[-1] - axes[0].breaks[0])
    modes = legendre_values(xi, len(first)) * np.sqrt(0.5 * width * weights)[:, None]
    cores = [(modes @ first)[None]]
    for core, basis, axis in zip(slab.cores[1:], slab.bases, axes[1:], strict=True):
        modes = basis.modal_values(axis.nodes) * np.sqrt(axis.weights)[:, None]
        cores.append(np.matmul(modes, core))
    return Train(tuple(cores))


def _horizon_train(
    slabs: Sequence[SlabTrain], state: int, axes: Sequence[Axis], rtol: float
) -> tuple[Train, float, float]:
    """Add the slabs up pairwise, rounding every sum: train, norm and relative error bound."""
    trains = [_slab_train(slab, state, axes).right_orthonormal(0.0) for slab in slabs]
    norm = math.hypot(*(float(np.linalg.norm(train.first)) for train in trains))
    levels = 1 + math.ceil(math.log2(len(trains)))
    error = 0.0  # errors on different slabs are orthogonal, those of successive sums are not
    while True:
        share = rtol * norm / levels / math.sqrt(len(trains))
        rounded = [train.truncated(share) for train in trains]
        trains = [train.right_orthonormal(0.0) for train, _ in rounded]
        error += math.hypot(*(lost for _, lost in rounded))
        if len(trains) == 1:
            return trains[0], norm, error / norm if norm else 0.0
        pairs = zip(trains[::2], trains[1::2], strict=False)
        joined = [_joined(*pair).right_orthonormal(0.0) for pair in pairs]
        trains = [*joined, *trains[2 * len(joined) :]]


def _joined(a: Train, b: Train) -> Train:
    """Two trains on successive pieces of the time axis as one."""
    if len(a.cores) == 1:
        return Train((np.concatenate([a.first, b.first], axis=1),))
    first = block_diagonal(a.first.transpose(1, 0, 2), b.first.transpose(1, 0, 2))
    middle = map(block_diagonal, a.cores[1:-1], b.cores[1:-1])
    last = np.concatenate([a.cores[-1], b.cores[-1]])
    return Train((first.transpose(1, 0, 2), *middle, last))


def _branches(train: Train, tolerance: float, most: int) -> tuple[Array, list[Array]]:
    """Split a right-orthonormal train into orthogonal products, the largest first.

    Each branch holds the modes of the dimensions it has passed and a vector into the next core;
    as the remaining cores have orthonormal rows, its amplitude is its norm.
    """
    remainder = total = float(np.linalg.norm(train.first)) ** 2
    ticket = itertools.count()
    heap: list[tuple[float, int, tuple[Array, ...], Array]] = [
        (-math.sqrt(total), next(ticket), (), np.ones(1))
    ]
    products: list[tuple[float, tuple[Array, ...]]] = []
    while heap and len(products) < most:
        negative, _, modes, vector = heapq.heappop(heap)
        if len(modes) == len(train.cores):
            products.append((-negative, modes))
            remainder -= negative**2
            # the running difference loses digits, the sum over the heap does not
            nearly = remainder <= tolerance**2 + COINCIDENT * total
            if nearly and math.fsum(branch[0] ** 2 for branch in heap) <= tolerance**2:
                break
            continue
        core = np.tensordot(vector, train.cores[len(modes)], 1)
        scale = -negative if modes else 1.0
        u, s, vt = np.linalg.svd(core, full_matrices=False)
        for k in range(s.size):
            if s[k] > 0.0:
                heapq.heappush(heap, (-scale * s[k], next(ticket), (*modes, u[:, k]), vt[k]))
    amplitudes, branches = zip(*products, strict=True)
    return np.array(amplitudes), [np.stack(modes, axis=1) for modes in zip(*branches, strict=True)]


def _shortened(
    train: Train,
    amplitudes: Array,
    modes: list[Array],
    error: float,
    tolerance: float,
    norm: float,
) -> tuple[Array, list[Array], float]:
    """Look for fewer terms, or as many with a smaller error if the tolerance is not met."""
    count = len(amplitudes)
    best = amplitudes, modes, error
    tries = [math.ceil(count * share) for share in (0.25, 0.5, 0.75)]
    for terms in sorted({*tries, count} if error > tolerance else {*tries} - {count}):
        start = [mode[:, :terms] for mode in modes]
        shorter, shorter_modes = _least_squares(train, amplitudes[:terms], start, tolerance, norm)
        reached = _distance(train, shorter, shorter_modes)
        if reached <= tolerance:
            return shorter, shorter_modes, reached
        if reached < best[2]:
            best = shorter, shorter_modes, reached
    return best


def _least_squares(
    train: Train, amplitudes: Array, modes: list[Array], tolerance: float, norm: float
) -> tuple[Array, list[Array]]:
    """Alternating least squares on the modes of one dimension after the other.

    Convergence is linear; it is given up when its rate will not lead to the tolerance in time.
    """
    modes = list(modes)
    dimensions = range(len(train.cores))
    grams = [mode.T @ mode for mode in modes]
    previous = math.inf
    most = max(min(_MAX_SWEEPS, _MAX_TERM_SWEEPS // len(amplitudes)), 10)
    for sweep in range(most):
        rights = [np.ones((1, len(amplitudes)))]
        for j in reversed(dimensions[1:]):
            rights.append(_absorb(train.cores[j].transpose(2, 1, 0), rights[-1], modes[j]))
        left = np.ones((1, len(amplitudes)))
        for j in dimensions:
            spread = np.tensordot(left, train.cores[j], ([0], [0]))
            target = np.einsum("inb,bi->ni", spread, rights[-1 - j])
            gram = reduce(np.multiply, [*grams[:j], *grams[j + 1 :]])
            eigenvalues, vectors = np.linalg.eigh(gram)
            kept = eigenvalues > ROUNDING * eigenvalues[-1]
            inverse = (vectors[:, kept] / eigenvalues[kept]) @ vectors[:, kept].T
            scaled = target @ inverse
            amplitudes = np.linalg.norm(scaled, axis=0)
            modes[j] = scaled / np.where(amplitudes > 0.0, amplitudes, 1.0)
            grams[j] = modes[j].T @ modes[j]
            left = _absorb(train.cores[j], left, modes[j])
        square = norm**2 - 2.0 * float(np.sum(target * scaled))
        square += float(amplitudes @ (gram * grams[-1]) @ amplitudes)
        error = math.sqrt(max(square, 0.0))
        if error <= 0.9 * tolerance:
            break
        ratio = min(error / previous, 2.0)  # larger powers may overflow, and say the same
        if sweep > 3 and error * ratio ** (most - sweep) > tolerance:
            break
        previous = error
    return amplitudes, modes


def _absorb(core: Array, left: Array, modes: Array) -> Array:
    """For each term contract a core (r, n, s) with columns of (r, R) and (n, R): shape (s, R)."""
    return np.asarray(np.einsum("inb,ni->bi", np.tensordot(left, core, ([0], [0])), modes))


def _distance(train: Train, amplitudes: Array, modes: Sequence[Array]) -> float:
    """Norm of a train minus products, by orthogonalisation: no digits cancel.

    The difference is a train of rank r + R; from left to right only triangular factors are kept.
    """
    left = np.ones((1, 1))
    products = -amplitudes[None]
    for core, mode in zip(train.cores[:-1], modes[:-1], strict=True):
        block = np.concatenate([np.tensordot(left, core, 1), products[:, None, :] * mode], axis=2)
        r = np.asarray(np.linalg.qr(block.reshape(-1, block.shape[2]), mode="r"))
        left, products = r[:, : core.shape[2]], r[:, core.shape[2] :]
    return float(np.linalg.norm(left @ train.cores[-1][:, :, 0] + products @ modes[-1].T))


def _standard(amplitudes: Array, modes: Sequence[Array]) -> tuple[Array, list[Array]]:
    """Descending amplitudes; the largest entry of each parameter mode is positive."""
    order = np.argsort(-amplitudes, kind="stable")
    order = order[amplitudes[order] > 0.0]
    ordered = [mode[:, order] for mode in modes]
    for mode in ordered[1:]:
        signs = np.sign(mode[np.argmax(np.abs(mode), axis=0), np.arange(mode.shape[1])])
        mode *= signs
        ordered[0] *= signs
    return amplitudes[order], ordered
