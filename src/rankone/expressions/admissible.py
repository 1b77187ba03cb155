"""Is a function of one coordinate finite and real on its interval?

A small pass whose only job is a good error: ``1/k`` with 0 inside the box of k, ``sqrt(k)`` or
``log(k)`` with k below zero, ``1/(t - 1)`` inside the horizon. Functions are sampled, and whatever
must not vanish (denominators, arguments of logarithms) is searched for changes of sign and zeros.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import sympy as sp

from rankone.expressions.stable import NUMPY, stable
from rankone.ir.forms import Coordinate
from rankone.support.arrays import Array
from rankone.support.wording import quote

__all__ = ["defect", "largest", "located_defect", "sign", "zero"]

_SAMPLES = 501
_ZOOMS = 6
_VANISHES = 1e-13
_NEAR, _FLAT = 1e-12, 0.5
"""Distance from a zero, in widths of the interval, and the largest part of the value there that is
left at it."""


def defect(expression: sp.Expr, coordinate: Coordinate) -> str | None:
    """Say what is wrong with a function of one coordinate alone on the interval of it.

    For example ``"is not finite at k = 0"``; None if nothing is wrong.
    """
    if expression.is_polynomial(coordinate.symbol):
        return None
    try:
        for part in _must_not_vanish(expression):
            pole = zero(part, coordinate)
            if pole is not None:
                return f"is not finite at {coordinate.name} = {pole:.6g}"
        points = _points(coordinate)
        values = _numeric(expression, coordinate)(points)
    except (NameError, TypeError, ValueError, AttributeError, ArithmeticError, NotImplementedError):
        return "cannot be evaluated numerically"
    bad = points[~np.isfinite(values)]
    if not bad.size:
        return None
    # NumPy gives nan both outside the domain and at 0/0: SymPy tells them apart.
    value = expression.subs(coordinate.symbol, sp.Float(bad[0]))
    kind = "real" if value.is_finite and value.is_extended_real is False else "finite"
    return f"is not {kind} at {coordinate.name} = {bad[0]:.6g}"


def located_defect(expression: sp.Expr, coordinate: Coordinate, dimension: int) -> str | None:
    """The same with the factor and its interval: ``"factor `1/k` is not finite at k = 0, ..."``."""
    wrong = defect(expression, coordinate)
    if wrong is None:
        return None
    where = "the box of parameter " + quote(coordinate.name) if dimension else "the horizon"
    interval = f"[{coordinate.lower:g}, {coordinate.upper:g}]"
    return f"factor {quote(expression)} {wrong}, inside {where} {interval}"


def sign(expression: sp.Expr, coordinate: Coordinate) -> int:
    """Return 1 or -1 if a function is nowhere negative or nowhere positive, else 0."""
    values = _numeric(expression, coordinate)(_points(coordinate))
    if np.all(values >= 0):
        return 1
    return -1 if np.all(values <= 0) else 0


def largest(expression: sp.Expr, coordinate: Coordinate) -> float:
    """The largest finite value of a function on its interval; 0 if there is none."""
    values = _numeric(expression, coordinate)(_points(coordinate))
    finite = values[np.isfinite(values)]
    return float(finite.max()) if finite.size else 0.0


def zero(expression: sp.Expr, coordinate: Coordinate) -> float | None:
    """Return a point at which a function vanishes on the interval, None if there is none."""
    if coordinate.symbol not in expression.free_symbols:
        return None
    function, points = _numeric(expression, coordinate), _points(coordinate)
    values = function(points)
    if not np.any(np.isfinite(values)):
        return None
    exact = points[values == 0]
    if exact.size:
        return float(exact[0])
    (changes,) = np.nonzero(np.diff(np.sign(values)))
    least = int(np.nanargmin(np.abs(values)))
    for i in [least, *changes]:
        point, smallest = _zoom_in(function, points, int(i))
        nearby = np.abs(values[max(int(i) - 1, 0) : int(i) + 2])
        if smallest <= _VANISHES * float(np.nanmax(nearby)):  # beside, it is far larger
            flat = np.abs(function(point + _NEAR * (points[-1] - points[0]) * np.array([-1, 1])))
            if smallest < _FLAT * float(np.nanmax(flat)):  # a minimum above zero is flat
                return point
    return None


def _points(coordinate: Coordinate) -> Array:
    """Uniform and Chebyshev points with the ends, and zero if it is inside."""
    a, b = coordinate.lower, coordinate.upper
    angles = np.linspace(0.0, np.pi, _SAMPLES)
    chebyshev = 0.5 * (a + b) - 0.5 * (b - a) * np.cos(angles)
    points = np.concatenate([np.linspace(a, b, _SAMPLES), chebyshev, [0.0] if a <= 0 <= b else []])
    return np.unique(np.clip(points, a, b))


def _numeric(expression: sp.Expr, coordinate: Coordinate) -> Callable[[Array], Array]:
    """Compile an expression; it gives nan where it is not real."""
    function = sp.lambdify(coordinate.symbol, stable(expression), [NUMPY, "numpy", "scipy"])

    def evaluate(points: Array) -> Array:
        with np.errstate(all="ignore"):
            values = np.asarray(function(points))
        if np.iscomplexobj(values):
            values = np.where(values.imag == 0, values.real, np.nan)
        return np.broadcast_to(values.astype(np.float64), points.shape)

    return evaluate


def _must_not_vanish(expression: sp.Expr) -> Iterator[sp.Expr]:
    """Yield the denominators and the arguments of logarithms."""
    if isinstance(expression, sp.Piecewise):
        return  # its conditions may guard a pole: sampling decides
    if isinstance(expression, sp.tan | sp.sec):
        yield sp.cos(*expression.args)
    elif isinstance(expression, sp.cot | sp.csc):
        yield sp.sin(*expression.args)
    elif isinstance(expression, sp.coth | sp.csch | sp.log):
        yield expression.args[0]
    elif expression.is_Pow and expression.exp.could_extract_minus_sign():
        yield expression.base
    for argument in expression.args:
        yield from _must_not_vanish(argument)


def _zoom_in(function: Callable[[Array], Array], points: Array, i: int) -> tuple[float, float]:
    """Return the point of least magnitude near sample ``i``, and that magnitude."""
    fine = points[max(i - 1, 0) : i + 3]
    values = np.abs(function(fine))
    for _ in range(_ZOOMS):
        j = int(np.nanargmin(values))
        fine = np.linspace(fine[max(j - 1, 0)], fine[min(j + 1, fine.size - 1)], _SAMPLES)
        values = np.abs(function(fine))
    j = int(np.nanargmin(values))
    return float(fine[j]), float(values[j])
