"""Surrogates of trajectories by other tools, on one footing: used by ``peers.py``.

Every tool is given trajectories of its choice, integrated by SciPy as stacked systems, at fixed
Chebyshev nodes of time, and returns a :class:`Surrogate`: features of the parameters times
coefficients. Evaluating them is one matrix product for all of them. Parameters are in [-1, 1].
"""

from __future__ import annotations

import contextlib
import itertools
import math
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.linalg
from scipy.integrate import solve_ivp
from scipy.stats import qmc

from tests.reference.measure import Array, Independent

__all__ = ["TOOLS", "Samples", "Surrogate", "Tool"]

STACKED = 500
"""Trajectories in a stack."""
BATCH = 250
"""Parameter points evaluated at once."""
_FEW = 150
"""Points from which a Gaussian process finds its lengths."""


class Samples:
    """Trajectories at the time nodes, in units of the size of each unknown, and their number.

    Time nodes are as few, and the tolerance of SciPy as loose, as a tenth of ``rtol`` permits.
    """

    def __init__(self, system: Independent, rtol: float) -> None:
        self.system, self.rtol, self.count = system, rtol, 0
        self.box = np.array(system.box).T
        self.dimensions = len(system.box)
        points = np.random.default_rng(1).uniform(-1.0, 1.0, (self.dimensions, 100))
        times = np.linspace(system.start, system.end, 201)
        self.tolerance = 1e-5 * rtol
        exact = self._integrated(points, times)
        self.sizes = np.abs(exact).max(axis=(0, 2))

        def far(found: Array) -> bool:
            return bool(np.any(np.abs(found - exact).max(axis=(0, 2)) > 0.1 * rtol * self.sizes))

        for count in (3, 5, 7, 9, 12, 16, 20, 25, 32, 40, 50, 64, 80, 100, 128, 160, 200, 256):
            self.nodes = system.start + (system.end - system.start) * (chebyshev(count) + 1.0) / 2.0
            if not far(self._integrated(points, self.nodes) @ cardinals(self.nodes, times).T):
                break
        self.tolerance = 0.3 * rtol
        while far(self._integrated(points, times)):
            self.tolerance /= 3.0

    def __call__(self, points: Array) -> Array:
        """Trajectories (m, unknowns * nodes) at points (d, m)."""
        self.count += points.shape[1]
        stacks = np.split(points, range(STACKED, points.shape[1], STACKED), axis=1)
        found = np.concatenate([self._integrated(stack, self.nodes) for stack in stacks])
        return np.asarray((found / self.sizes[:, None]).reshape(len(found), -1))

    def _integrated(self, points: Array, times: Array) -> Array:
        """States (m, n, times)."""
        p = self.box[0][:, None] + np.diff(self.box, axis=0).T * (points + 1.0) / 2.0
        count = p.shape[1]
        rows = [np.broadcast_to(row, count) for row in self.system.initial(p)]
        start = np.stack(rows).astype(float)
        n = len(start)

        def rates(t: float, u: Array) -> Array:
            found = self.system.rhs(t, u.reshape(n, count), p)
            return np.concatenate([np.broadcast_to(row, count) for row in found])

        span = (self.system.start, self.system.end)
        atol = np.repeat(np.array(self.system.sizes), count) * self.tolerance
        options = {"method": "DOP853", "rtol": self.tolerance, "atol": atol}
        run = solve_ivp(rates, span, start.ravel(), t_eval=times, **options)
        return np.asarray(run.y.reshape(n, count, -1).transpose(1, 0, 2))


@dataclass(frozen=True, eq=False)
class Surrogate:
    """Curves as features of the parameters times coefficients (features, unknowns * nodes)."""

    features: Callable[[Array], Array]
    coefficients: Array
    samples: Samples

    def curves(self, points: Array, times: Array) -> Array:
        """Unknowns (n, m, times) at points (d, m) of the box."""
        lower, upper = self.samples.box
        x = 2.0 * (points - lower[:, None]) / (upper - lower)[:, None] - 1.0
        n, nodes = len(self.samples.sizes), len(self.samples.nodes)
        weights = cardinals(self.samples.nodes, times)
        at_times = self.coefficients.reshape(-1, n, nodes) @ weights.T
        at_times *= self.samples.sizes[:, None]
        matrix = at_times.reshape(len(at_times), -1)
        parts = np.split(x, range(BATCH, x.shape[1], BATCH), axis=1)
        found = np.concatenate([self.features(part) @ matrix for part in parts])
        return np.asarray(found.reshape(x.shape[1], n, -1).transpose(1, 0, 2))


@dataclass(frozen=True)
class Tool:
    """A way to make a surrogate of some size, the sizes to try, and what a size is called."""

    name: str
    fit: Callable[[Samples, int], Surrogate]
    sizes: Callable[[int], Iterator[int]]
    shown: str


def chebyshev(count: int) -> Array:
    """Chebyshev points of [-1, 1] with its ends."""
    return -np.cos(np.pi * np.arange(count) / (count - 1))


def cardinals(nodes: Array, x: Array) -> Array:
    """Interpolation from Chebyshev points with ends to x, (len(x), len(nodes)): barycentric."""
    weights = (-1.0) ** np.arange(len(nodes))
    weights[[0, -1]] /= 2.0
    distances = x[:, None] - nodes
    hit = distances == 0.0
    ratios = weights / np.where(hit, 1.0, distances)
    values = ratios / ratios.sum(axis=1, keepdims=True)
    return np.where(hit.any(axis=1, keepdims=True), hit, values)


def _spread(dimensions: int, count: int) -> Array:
    """Points (d, count) spread over [-1, 1]: denser at the ends for few dimensions."""
    shares = qmc.Halton(dimensions, seed=0).random(count).T
    return -np.cos(np.pi * shares) if dimensions <= 3 else 2.0 * shares - 1.0


def _weights(points: Array) -> Array:
    """Square roots of weights that make polynomials orthogonal at the points of _spread."""
    if len(points) > 3:
        return np.ones(points.shape[1])
    return np.asarray(np.prod((1.0 - points**2) ** 0.25, axis=0))


# -- tensor grid ----------------------------------------------------------------------------------


def _grid(samples: Samples, size: int) -> Surrogate:
    """Interpolation on the tensor grid of Chebyshev points."""
    nodes = chebyshev(size)
    points = nodes[np.indices([size] * samples.dimensions).reshape(samples.dimensions, -1)]

    def features(x: Array) -> Array:
        product = np.ones((x.shape[1], 1))
        for row in x:
            product = (product[:, :, None] * cardinals(nodes, row)[:, None]).reshape(len(row), -1)
        return product

    return Surrogate(features, samples(points), samples)


# -- polynomial chaos -----------------------------------------------------------------------------


def _degrees(dimensions: int, total: int) -> Array:
    """Exponents (terms, d) up to a total degree."""
    if dimensions == 1:
        return np.arange(total + 1)[:, None]
    blocks = []
    for first in range(total + 1):
        rest = _degrees(dimensions - 1, total - first)
        blocks.append(np.hstack([np.full((len(rest), 1), first), rest]))
    return np.concatenate(blocks)


def _chaos(samples: Samples, size: int) -> Surrogate:
    """Least squares in Legendre polynomials up to a total degree, two points for each term."""
    degrees = _degrees(samples.dimensions, size)
    norms = np.sqrt(2.0 * np.arange(size + 1) + 1.0)

    def features(x: Array) -> Array:
        product = np.ones((x.shape[1], len(degrees)))
        for row, chosen in zip(x, degrees.T, strict=True):
            product *= (np.polynomial.legendre.legvander(row, size) * norms)[:, chosen]
        return product

    points = _spread(samples.dimensions, 2 * len(degrees))
    weights = _weights(points)[:, None]
    matrix, values = weights * features(points), weights * samples(points)
    return Surrogate(features, np.linalg.solve(matrix.T @ matrix, matrix.T @ values), samples)


def _chaospy(samples: Samples, size: int) -> Surrogate:
    """chaospy: Gaussian quadrature up to three parameters, regression beyond."""
    import chaospy

    box = chaospy.Iid(chaospy.Uniform(-1, 1), samples.dimensions)
    expansion = chaospy.generate_expansion(size, box, normed=True)

    def features(x: Array) -> Array:
        return np.asarray(expansion(*x), dtype=float).T

    if samples.dimensions <= 3:
        points, weights = chaospy.generate_quadrature(size, box, rule="gaussian")
        given = expansion, points, weights, samples(points)
        coefficients = chaospy.fit_quadrature(*given, retall=True)[1]
    else:
        points = _spread(samples.dimensions, 2 * len(expansion))
        given = expansion, points, samples(points)
        coefficients = chaospy.fit_regression(*given, retall=True)[1]
    return Surrogate(features, np.asarray(coefficients), samples)


# -- tensor train ---------------------------------------------------------------------------------


def _teneva(samples: Samples, size: int) -> Surrogate:
    """TT-cross of teneva on Chebyshev points; unknowns and times are one more dimension."""
    import teneva

    nodes, d = chebyshev(size), samples.dimensions
    shape = [size] * d
    known = np.empty(0, dtype=np.int64)
    values = np.empty((0, len(samples.sizes) * len(samples.nodes)))

    def entries(indices: Array) -> Array:
        """Entries of the tensor; a trajectory is integrated once for all of its entries."""
        nonlocal known, values
        keys = np.ravel_multi_index(tuple(indices[:, :d].astype(int).T), shape)
        new = np.setdiff1d(keys, known)
        if new.size:
            values = np.concatenate(
                [values, samples(nodes[np.stack(np.unravel_index(new, shape))])]
            )
            known = np.concatenate([known, new])
            order = np.argsort(known)
            known, values = known[order], values[order]
        return np.asarray(values[np.searchsorted(known, keys), indices[:, d].astype(int)])

    start = teneva.rand([*shape, values.shape[1]], 2, seed=0)
    cores = teneva.cross(entries, start, e=samples.rtol, nswp=8, dr_max=8)

    def features(x: Array) -> Array:
        product = np.ones((x.shape[1], 1))
        for row, core in zip(x, cores[:-1], strict=True):
            r, m, s = core.shape
            wide = (product @ core.reshape(r, m * s)).reshape(-1, m, s)
            product = np.einsum("im,ims->is", cardinals(nodes, row), wide)
        return product

    return Surrogate(features, cores[-1][:, :, 0], samples)


# -- Gaussian process -----------------------------------------------------------------------------


def _gaussian_process(samples: Samples, size: int) -> Surrogate:
    """scikit-learn: a squared exponential kernel with a length for each parameter.

    The curves are reduced to their singular vectors; lengths are found from a few points, and of
    three levels of noise the one is taken whose errors at points left out are least.
    """
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import RBF, ConstantKernel

    points = _spread(samples.dimensions, size).T
    left, sizes, curves = np.linalg.svd(samples(points.T), full_matrices=False)
    kept = sizes > 0.01 * samples.rtol * sizes[0]
    targets = left[:, kept] * sizes[kept]
    lengths = RBF([0.3] * samples.dimensions, (0.02, 100.0))
    kernel: Any = ConstantKernel(1.0, (1e-4, 1e8)) * lengths
    found: list[tuple[float, Any]] = []
    for noise in (1e-12, 1e-10, 1e-8):
        with warnings.catch_warnings(), contextlib.suppress(np.linalg.LinAlgError):
            warnings.simplefilter("ignore")
            few = GaussianProcessRegressor(kernel, alpha=noise).fit(points[:_FEW], targets[:_FEW])
            rest = GaussianProcessRegressor(few.kernel_, alpha=noise, optimizer=None)
            rest.fit(points, targets)
            inverse = scipy.linalg.solve_triangular(rest.L_, np.eye(size), lower=True)
            left_out = rest.alpha_.reshape(size, -1) / (inverse**2).sum(axis=0)[:, None]
            found.append((float(np.sqrt(np.mean(left_out**2))), rest))
    best = min(found, key=lambda each: each[0])[1]
    coefficients = best.alpha_.reshape(size, -1) @ curves[kept]
    return Surrogate(lambda x: best.kernel_(x.T, points), coefficients, samples)


# -- what there is --------------------------------------------------------------------------------

_NUMBERS = (3, 4, 5, 6, 7, 8, 10, 12, 14, 17, 20, 24, 29, 34, 40, 48, 58, 70)
_MOST_GRID, _MOST_TERMS, _MOST_POINTS = 60_000, 3_500, 3_000


def _grids(d: int) -> Iterator[int]:
    return itertools.takewhile(lambda m: m**d <= _MOST_GRID, iter(_NUMBERS))


def _totals(d: int) -> Iterator[int]:
    return itertools.takewhile(lambda k: math.comb(d + k, d) <= _MOST_TERMS, iter(_NUMBERS))


def _counts(d: int) -> Iterator[int]:
    counts = (round(8 * 2 ** (i / 2)) for i in itertools.count())
    return itertools.takewhile(lambda m: m <= _MOST_POINTS, counts)


TOOLS = (
    Tool("Chebyshev grid (SciPy)", _grid, _grids, "{} nodes"),
    Tool("polynomial chaos by hand", _chaos, _totals, "degree {}"),
    Tool("chaospy", _chaospy, _totals, "degree {}"),
    Tool("teneva (TT-cross)", _teneva, lambda d: iter(_NUMBERS[2:]), "{} nodes"),
    Tool("Gaussian process (scikit-learn)", _gaussian_process, _counts, "{} points"),
)
