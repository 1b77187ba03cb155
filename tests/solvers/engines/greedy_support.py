"""Solving with the classic method, and the error of its solutions."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

import rankone as ro
from rankone.solvers.engines.greedy_engine import ENGINE
from rankone.solvers.outcome import Outcome

Array = NDArray[np.float64]


def solve(problem: ro.Problem, rtol: float, check: int = 24, **options: Any) -> Outcome:
    """The outcome for a problem; ``preset`` is among the options."""
    return ENGINE.run(ro.compile(problem).system, rtol, check=check, **options)


def l2_error(outcome: Outcome, exact: Callable[[Array, Array], Array], box: Array) -> float:
    """L2 error over time and one parameter, on Gauss points inside every slab."""
    xi, weights = np.polynomial.legendre.leggauss(4)
    pieces = 160
    edges = np.linspace(*box, pieces + 1)
    width = np.diff(edges)[:, None]
    p = (edges[:-1, None] + width * 0.5 * (xi + 1)).ravel()
    p_weights = (0.5 * width * weights).ravel()
    square = 0.0
    for slab in outcome.slabs:
        length = slab.end - slab.start
        t = slab.start + length * 0.5 * (xi + 1)
        pairs = np.repeat(t, p.size), np.tile(p, t.size)[None]
        gap = (slab(*pairs)[0] - exact(pairs[0], pairs[1][0])).reshape(t.size, p.size)
        square += 0.5 * length * float(weights @ gap**2 @ p_weights)
    return float(np.sqrt(square))
