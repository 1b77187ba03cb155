"""Figures of solutions, fits and populations: the public names of :mod:`rankone.share.plotting`."""

from rankone.share.plotting import *  # noqa: F403
from rankone.share.plotting import __all__ as __all__
