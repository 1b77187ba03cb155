"""What counts as rounding, as the same place, and as nothing: the numbers that all rooms share.

Each is a relative size, but for :data:`TINY`. A room has a number of its own only where another
one changes a verdict or the work.
"""

from __future__ import annotations

import numpy as np

EPSILON = float(np.finfo(float).eps)
"""Spacing of the floating-point numbers at 1."""
TINY = float(np.finfo(float).tiny)
"""Smallest normal number: what a size that may be zero is raised to before it divides."""
ROUNDING = 64.0 * EPSILON
"""Error of a number that a few operations made of rounded ones, about 1e-14."""
COINCIDENT = 4096.0 * EPSILON
"""Difference below which two times or places are one, about 1e-12, in sizes of these."""
NEGLIGIBLE = 1e-9
"""Share below which a difference counts as none; about the error of the tightest solve."""
