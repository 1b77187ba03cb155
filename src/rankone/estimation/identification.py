"""Which parameters, and which combinations of them, the data identify.

Flat directions of the least squares are found by the singular values of the Jacobian, and checked
by going along them: a parameter whose profile interval ends only where the box does is not
identified. What is left of several is named: the row space of the Jacobian with respect to their
logarithms holds the powers of a product that is identified, such as (1, -1) for C_D/m.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction

import numpy as np

from rankone.estimation.least_squares import LeastSquares
from rankone.estimation.profiles import Best, Profile, profiles
from rankone.support.arrays import Array

__all__ = ["Identification", "identify"]

_SUSPICIOUS = 0.25
"""Half a linear interval from which the profile is looked at, in widths of the box."""
_WIDE, _WIDER = 0.1, 3.0
"""A flat interval is at least so wide in the box, and so many times what its neighbours leave."""
_SIMPLE = 0.04
"""How far a power may be from a simple fraction."""
_DENOMINATORS = 4
_USED, _RANK = 0.5, 1e-7
"""Change of the residuals from one end of the cube to the other, in standard deviations, and over
that along the steepest direction, from which a direction is fitted to the data."""
_CLOSE = 0.05
"""How exactly the ends of intervals are found."""
_LEVEL = 0.25
"""Share of the limit up to which a profile is along the flat direction."""
_NAMED = 0.1
"""Variation of a combination along a path from which it is none."""
_CONSTANT = 0.02
"""Variation of a product along a path that is none, in shares of that of its factors."""


@dataclass(frozen=True)
class Identification:
    """What the data say of the free parameters.

    Attributes
    ----------
    flat : tuple of int
        Those that are not identified.
    root : ndarray (n, n - q)
        A root of the covariance in z over the directions that are identified, for unit sigma.
    null : ndarray (n, q)
        Orthonormal directions in z that are not.
    combinations : tuple of str
        Identified combinations of the flat parameters.
    used : int
        Number of directions along which the data can be followed within the cube.
    """

    flat: tuple[int, ...]
    root: Array
    null: Array
    combinations: tuple[str, ...]
    used: int

    @property
    def spread(self) -> Array:
        """Standard deviations in z for unit sigma, infinite for what is not identified."""
        found = np.sqrt(np.sum(self.root**2, axis=1))
        found[list(self.flat)] = np.inf
        return np.asarray(found)


def identify(
    problem: LeastSquares, z: Array, cost: float, jacobian: Array, quantile: float, sigma: float
) -> Identification:
    """What is identified at the best point z (n,), with the Jacobian (m, n) there.

    ``quantile`` is half the length of intervals in standard deviations, ``sigma`` the standard
    deviation of the scaled residuals.
    """
    _, singular, right = np.linalg.svd(jacobian, full_matrices=False)
    floor = 1e-13 * singular[0] if singular[0] > 0.0 else 1.0
    root = right.T / np.maximum(singular, floor)
    used = int(np.count_nonzero(singular > max(_USED * sigma, _RANK * singular[0])))
    half = quantile * sigma * np.sqrt(np.sum(root**2, axis=1))
    suspects = np.flatnonzero(half > _SUSPICIOUS)
    nothing = Identification((), root, np.zeros((z.size, 0)), (), used)
    if not suspects.size:
        return nothing
    best = Best(z, cost, np.minimum(half / quantile, 1.0))
    limit = max((quantile * sigma) ** 2, 1e-12 * cost)
    found = profiles(problem, best, limit, suspects.tolist(), _CLOSE)
    boxed = [p for p in found if p.bounded_by_box and p.width > _WIDE]
    if not boxed:
        return nothing
    order = np.argsort(singular)
    for q in range(1, z.size + 1):
        kept = np.sort(order[q:])
        left = quantile * sigma * np.sqrt(np.sum(root[:, kept] ** 2, axis=1))
        if all(2.0 * left[p.index] * _WIDER < p.width for p in boxed) or q == z.size:
            break
    flat = tuple(p.index for p in boxed if p.width > _WIDER * 2.0 * left[p.index] or q == z.size)
    if not flat:
        return nothing
    names = _combinations(problem, z, jacobian, flat, q, boxed, limit)
    return Identification(flat, root[:, kept], right[order[:q]].T, names, used)


def _combinations(
    problem: LeastSquares,
    z: Array,
    jacobian: Array,
    flat: Sequence[int],
    q: int,
    found: Sequence[Profile],
    limit: float,
) -> tuple[str, ...]:
    """Texts of the combinations of flat parameters that are constant along flat directions."""
    names = [problem.free.names[i] for i in flat]
    widest = max(found, key=lambda p: p.width)
    inside = widest.path[widest.rise <= _LEVEL * limit]
    path = problem.free.values(inside)[:, list(flat)]
    linear = _reduced(jacobian / problem.free.width, flat, q)
    if not len(linear):
        return ()
    in_sums = _variation(path, linear)
    if ((path > 0.0).all(axis=0) | (path < 0.0).all(axis=0)).all():
        powers = _reduced(jacobian / problem.free.width * problem.free.values(z), flat, q)
        in_powers = _variation(np.log(np.abs(path)), powers)
        if in_powers <= max(_CONSTANT, min(in_sums, _NAMED)):
            return tuple(_product(names, row) for row in powers)
    return tuple(_sum(names, row) for row in linear) if in_sums <= _NAMED else ()


def _reduced(jacobian: Array, flat: Sequence[int], q: int) -> Array:
    """Rows over the flat parameters that are orthogonal to the q flattest directions."""
    scale = np.linalg.norm(jacobian, axis=0)
    scale = np.where(scale > 0.0, scale, 1.0)
    _, _, right = np.linalg.svd(np.linalg.qr(jacobian / scale, mode="r"))
    null = (right[-q:] / scale)[:, list(flat)]
    _, singular, rows = np.linalg.svd(null)
    rank = int(np.count_nonzero(singular > 1e-6 * singular[0]))
    rows = rows[rank:].copy()
    for k in range(len(rows)):  # reduced row echelon form: few parameters in each row
        pivot = int(np.argmax(np.abs(rows[k])))
        rows[k] /= rows[k, pivot]
        for other in range(len(rows)):
            if other != k:
                rows[other] -= rows[other, pivot] * rows[k]
    rows[np.abs(rows) < _SIMPLE] = 0.0
    return rows


def _variation(path: Array, rows: Array) -> float:
    """How much combinations vary along a path, as a share of what their parts do."""
    parts = np.sum(np.abs(rows) * np.ptp(path, axis=0), axis=1)
    return float(np.max(np.ptp(path @ rows.T, axis=0) / np.maximum(parts, 1e-300)))


def _scaled(row: Array) -> list[tuple[int, str]]:
    """Sign and text of each number, as simple fractions if they all are; the first is positive."""
    used = row[row != 0.0]
    row = row * np.sign(used[0]) / np.abs(used).max()
    for scale in (np.abs(used).max() / np.abs(used).min(), 1.0):
        near = [Fraction(float(v * scale)).limit_denominator(_DENOMINATORS) for v in row]
        pairs = zip(near, row * scale, strict=True)
        if all(abs(float(simple) - v) <= _SIMPLE * abs(v) for simple, v in pairs):
            return [((v > 0) - (v < 0), _fraction(abs(v))) for v in near]
    return [(int(np.sign(v)), f"{abs(v):.3g}") for v in row]


def _fraction(value: Fraction) -> str:
    return str(value) if value.denominator == 1 else f"({value})"


def _product(names: Sequence[str], row: Array) -> str:
    """Powers as text, such as ``C_D/m``."""
    sides: dict[int, list[str]] = {1: [], -1: []}
    for name, (sign, power) in zip(names, _scaled(row), strict=True):
        if sign:
            sides[sign].append(name if power == "1" else f"{name}**{power}")
    top, below = "*".join(sides[1]), sides[-1]
    if not below:
        return top
    return f"{top}/{below[0]}" if len(below) == 1 else f"{top}/({'*'.join(below)})"


def _sum(names: Sequence[str], row: Array) -> str:
    """Coefficients as text, such as ``a + 2*b``."""
    text = ""
    for name, (sign, factor) in zip(names, _scaled(row), strict=True):
        if sign:
            joined = (" + " if sign > 0 else " - ") if text else ""
            text += joined + (name if factor == "1" else f"{factor}*{name}")
    return text
