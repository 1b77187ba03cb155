"""Shapes that move or widen with parameters, as sums of vectors times functions of parameters.

An elementwise function g(x, p) of given vectors x is interpolated in a few entries i: the functions
are the values g(x_i, p) themselves, and the vectors are those that reproduce samples of g best
(empirical interpolation: Barrault, Maday, Nguyen and Patera, C. R. Acad. Sci. Paris 339, 2004; the
entries are those of a pivoted QR decomposition, Drmač and Gugercin, SIAM J. Sci. Comput. 38, 2016).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import scipy.linalg
import sympy as sp

from rankone.problem.expressions.notation import exact
from rankone.problem.expressions.stable import NUMPY, in_floats, stable
from rankone.problem.forms import Coordinate
from rankone.support.arrays import ACCUMULATED, NEGLIGIBLE, SAMPLES, SEED, Array, spread
from rankone.tensors.coordinates import LINEAR


def shape_terms(
    function: sp.Expr, vectors: Mapping[sp.Symbol, Array], coordinates: Sequence[Coordinate]
) -> list[tuple[sp.Expr, Array]] | None:
    """Functions of parameters and the vectors (n,) that they multiply.

    ``vectors`` are what the other symbols of the function stand for. None if the sum misses the
    function at points that it was not made of, by more than 1e-9 of its largest value.
    """
    parameters = [coordinate.symbol for coordinate in coordinates]
    arguments = [*vectors, *parameters]
    formula = in_floats(stable(function))
    compiled = sp.lambdify(arguments, formula, [NUMPY, "numpy", "scipy"], cse=True)
    columns = [vector[:, None] for vector in vectors.values()]

    def values(points: Array) -> Array:
        rows = np.broadcast_shapes(*(column.shape for column in columns))[0]
        return np.broadcast_to(compiled(*columns, *points), (rows, points.shape[1]))

    rng = np.random.default_rng(SEED)
    samples, others = (_points(coordinates, n, rng) for n in (2 * SAMPLES, SAMPLES))
    taken = values(samples)
    if not np.isfinite(taken).all():
        return None
    modes, sizes, _ = np.linalg.svd(taken, full_matrices=False)
    modes = modes[:, sizes > ACCUMULATED * sizes[0]]
    _, _, order = scipy.linalg.qr(modes.T, mode="economic", pivoting=True)
    entries = order[: modes.shape[1]]
    interpolating = modes @ np.linalg.inv(modes[entries])
    exact_values = values(others)
    error = np.abs(interpolating @ exact_values[entries] - exact_values).max()
    if not error <= NEGLIGIBLE * np.abs(exact_values).max():
        return None
    return [
        (function.xreplace({s: exact(sp.Float(float(v[i]))) for s, v in vectors.items()}), column)
        for i, column in zip(entries, interpolating.T, strict=True)
    ]


def _points(coordinates: Sequence[Coordinate], count: int, rng: np.random.Generator) -> Array:
    """Points (d, count) of the box, even on the scales of the parameters."""
    unit = spread(count, len(coordinates), rng).T
    rows = []
    for coordinate, row in zip(coordinates, unit, strict=True):
        a, b = coordinate.lower, coordinate.upper
        positive = coordinate.scale != LINEAR and a > 0.0
        rows.append(a * (b / a) ** row if positive else a + row * (b - a))
    return np.array(rows)
