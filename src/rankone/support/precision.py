"""What counts as rounding, as the same place, as nothing and as many: numbers all rooms share.

A room has a number of its own only where another one changes a verdict or the work.
"""

from __future__ import annotations

import numpy as np

EPSILON = float(np.finfo(float).eps)
"""Spacing of the floating-point numbers at 1."""
TINY = float(np.finfo(float).tiny)
"""Smallest normal number: what a size that may be zero is raised to before it divides."""
ROUNDING = 64.0 * EPSILON
"""Error of a number that a few operations made of rounded ones, about 1e-14."""
ACCUMULATED = 512.0 * EPSILON
"""Error of what a long computation makes of them, about 1e-13."""
COINCIDENT = 4096.0 * EPSILON
"""Difference below which two times or places are one, about 1e-12, in sizes of these."""
NEGLIGIBLE = 1e-9
"""Share below which a difference counts as none; about the error of the tightest solve."""
EXACT_DIGITS = 20
"""Decimal digits of numbers that stand for exact ones: a few more than floats hold."""
MANY_STATES = 64
"""States from which on tables and sparse matrices serve better than a line and a row for each."""
AT_ONCE = 1 << 19
"""Numbers of a large array that are held at once where it is made piece by piece: 4 MB."""
SEED = 20140
"""Of points that only have to be spread: the same call always has the same ones."""
DIFFERENCE = EPSILON ** (1.0 / 3.0)
"""Step of central differences, in sizes of what is changed: rounding and curvature err alike."""
