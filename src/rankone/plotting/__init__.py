"""Plots of a solution: its values, statistics and base functions, and how it was found.

They need Matplotlib: ``pip install matplotlib``, or ``pip install ".[plot]"`` in the folder of the
sources.

Nothing is shown: ``ax.figure.savefig("name.png")`` writes a figure, ``matplotlib.pyplot.show()``
shows it. All draw into the axes given as ``ax``, or into those of a new figure, and return them,
those with several panels an array of them.
"""

from rankone.plotting.calibrations import plot_calibration
from rankone.plotting.densities import plot_density
from rankone.plotting.estimates import plot_design, plot_posterior, plot_profiles
from rankone.plotting.fits import plot_fit
from rankone.plotting.loops import plot_history
from rankone.plotting.modes import plot_modes
from rankone.plotting.populations import plot_population
from rankone.plotting.sensitivities import plot_main_effects, plot_sobol
from rankone.plotting.surfaces import plot_surface
from rankone.plotting.trajectories import plot_bands, plot_trajectories

__all__ = [
    "plot_bands",
    "plot_calibration",
    "plot_density",
    "plot_design",
    "plot_fit",
    "plot_history",
    "plot_main_effects",
    "plot_modes",
    "plot_population",
    "plot_posterior",
    "plot_profiles",
    "plot_sobol",
    "plot_surface",
    "plot_trajectories",
]
