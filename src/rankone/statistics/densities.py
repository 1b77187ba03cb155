"""Densities and probabilities of values at evenly spread points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.fft import dct
from scipy.optimize import brentq
from scipy.signal import fftconvolve

from rankone.support.arrays import Array

__all__ = ["Density", "Probability", "density_of"]

_BINS = 4096


@dataclass(frozen=True)
class Density:
    """Probability density of one unknown at one time.

    Attributes
    ----------
    unknown : str
    values : ndarray (values,)
        Values of the unknown.
    density : ndarray (values,)
        Their density, in one over the unit of the unknown.
    bandwidth : float
        Standard deviation of the kernel: details finer than that are lost.
    """

    unknown: str
    values: Array
    density: Array
    bandwidth: float


@dataclass(frozen=True)
class Probability:
    """Share of the box, weighted by its distributions, where a condition holds.

    Attributes
    ----------
    value, error : ndarray (*shape of the times)
        The probability and its standard error, from eight sets of points, each shifted by its own
        random numbers; at least one over the number of points.
    """

    value: Array
    error: Array


def density_of(sample: Array, at: Array | None) -> tuple[Array, Array, float]:
    """Values, density there, and bandwidth of a kernel estimate; 512 values if none are given.

    The width of the kernel is found from the sample (Botev, Grotowski & Kroese, "Kernel density
    estimation via diffusion", Annals of Statistics 38, 2010). Near the ends of the range, where the
    density may jump, it is fitted by a line instead of a constant (Jones, "Simple boundary
    correction for kernel density estimation", Statistics and Computing 3, 1993).
    """
    lower, upper = float(sample.min()), float(sample.max())
    width = upper - lower
    counts, edges = np.histogram(sample, _BINS, (lower, upper))
    shares = counts / sample.size
    bandwidth = float(np.sqrt(_best_time(dct(shares), sample)))
    smooth = np.maximum(_fitted(shares, bandwidth * _BINS), 0.0)
    smooth /= width * smooth.mean()
    if at is None:
        at = np.linspace(lower, upper, 512)
    centres = 0.5 * (edges[:-1] + edges[1:])
    inside = (at >= lower) & (at <= upper)
    return at, np.where(inside, np.interp(at, centres, smooth), 0.0), bandwidth * width


def _fitted(shares: Array, bandwidth: float) -> Array:
    """Values at bins of lines fitted to shares with a normal kernel, as wide as so many bins."""
    reach = min(int(8.0 * bandwidth) + 1, _BINS - 1)
    u = np.arange(-reach, reach + 1) / bandwidth
    kernel = np.exp(-0.5 * u**2)

    def around(of: Array, power: int) -> Array:
        """Sums of what is around each bin, with powers of the distance."""
        return np.asarray(fftconvolve(of, kernel * (-u) ** power)[reach : reach + _BINS])

    ones = np.ones(_BINS)
    zeroth, first, second = (around(ones, power) for power in range(3))
    value = second * around(shares, 0) - first * around(shares, 1)
    return np.asarray(value / (zeroth * second - first**2))


def _best_time(spectrum: Array, sample: Array) -> float:
    """The squared bandwidth, relative to that of the range, at which the error is estimated least:
    the fixed point of section 5 of the paper, or Silverman's rule where there is none."""
    squares = np.arange(1.0, _BINS) ** 2
    sizes = (0.5 * spectrum[1:]) ** 2
    size = sample.size

    def rest(time: float) -> float:
        found = _roughness(5, time, squares, sizes)
        for s in range(4, 1, -1):
            odd = np.prod(np.arange(1.0, 2 * s, 2)) / np.sqrt(2.0 * np.pi)
            factor = (1.0 + 0.5 ** (s + 0.5)) / 3.0
            earlier = (2.0 * factor * odd / (size * found)) ** (2.0 / (3.0 + 2.0 * s))
            found = _roughness(s, earlier, squares, sizes)
        return float(time - (2.0 * size * np.sqrt(np.pi) * found) ** -0.4)

    with np.errstate(all="ignore"):
        trial = np.geomspace(1e-8, 0.1, 60)
        signs = np.sign([rest(time) for time in trial])
        changes = np.flatnonzero((signs[:-1] < 0) & (signs[1:] > 0))
        if changes.size:
            return float(brentq(rest, trial[changes[0]], trial[changes[0] + 1]))
    quartiles = np.subtract(*np.quantile(sample, [0.75, 0.25])) / 1.34
    spread = min(part for part in (sample.std(), quartiles) if part > 0)
    return float((0.9 * spread * size**-0.2 / np.ptp(sample)) ** 2)


def _roughness(s: int, time: float, squares: Array, sizes: Array) -> float:
    """Squared norm of the derivative of order s of the density after some time."""
    terms = squares**s * sizes * np.exp(-squares * np.pi**2 * time)
    return float(2.0 * np.pi ** (2 * s) * terms.sum())
