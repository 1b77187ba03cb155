"""Fields of a small linear system with random orthonormal modes, and the same by plain NumPy."""

from dataclasses import replace
from functools import cache

import numpy as np
import sympy as sp

import rankone as ro
from rankone.solution.fields.field_solution import FieldSolution
from rankone.solvers.reduced.field_modes import FieldModes
from rankone.trajectories.fields.field_system import Unknown

N, R = 60, 4
"""Entries of the field `u`, and its modes."""
BOX = {"k": (0.5, 2.0), "s": (0.5, 1.5)}


@cache
def coefficients(rtol=1e-4):
    """Solved to 1e-7, for fields of another tolerance: `u_0` to `u_3`, which couple, and `w`."""
    t, k, s = sp.symbols("t k s")
    a = [sp.Function(f"u_{i}")(t) for i in range(R)]
    w = sp.Function("w")(t)
    rates = [-k * (i + 1) * a[i] + s * a[(i + 1) % R] * sp.Rational(1, 4) for i in range(R)]
    equations = [sp.Eq(x.diff(t), rate) for x, rate in zip(a, rates, strict=True)]
    equations.append(sp.Eq(w.diff(t), s - w))
    initial = {**{x: 1 / sp.Integer(i + 1) for i, x in enumerate(a)}, w: 0}
    problem = ro.Problem(equations, (t, 0, 1), {k: BOX["k"], s: BOX["s"]}, initial)
    solved = ro.solve(problem, rtol=1e-7)
    return ro.Solution(solved.outcome, replace(solved.metadata, rtol=rtol))


def orthonormal_modes(n=N, r=R, seed=3):
    """Modes with ``modes.T @ modes == n * eye(r)``."""
    rng = np.random.default_rng(seed)
    return np.sqrt(n) * np.linalg.qr(rng.standard_normal((n, r)))[0]


def small_fields(errors=(2e-5, 1e-6)):
    """A field of sixty entries, and a scalar unknown."""
    unknowns = (Unknown("u", 0, N), Unknown("w", N, 1, is_field=False))
    modes = FieldModes(unknowns, (orthonormal_modes(), np.ones((1, 1))), (5.0, 1.0), errors, 12)
    return FieldSolution(coefficients(), modes)


def without_scalars():
    """The field alone."""
    both = small_fields()
    unknowns, modes = both.modes.unknowns[:1], both.modes.modes[:1]
    alone = FieldModes(unknowns, modes, (5.0,), both.modes.errors[:1], 12)
    return FieldSolution(both.coefficients.output([*alone.names]), alone)
