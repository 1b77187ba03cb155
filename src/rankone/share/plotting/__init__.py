"""Plots of a solution: its values, statistics and base functions, and how it was found.

Their public names are those of :mod:`rankone.plotting`.

- ``estimate_plots``: what data say about parameters and populations
- ``fit_plots``: measurements, fitted curves and residuals, of fits and of calibrations
- ``line_ends``: names at the ends of lines, which are moved apart whenever a figure is drawn
- ``mode_plots``: densities, base functions, surfaces, and what happened in the loops of a solve
- ``sensitivity_plots``: what the parameters do to an unknown: `plot_sobol` and
  `plot_main_effects`
- ``style``: what all plots share: checked arguments, figures and axes, legends and labels
- ``trajectory_plots``: unknowns over time, for given parameters or over the box:
  `plot_trajectories`, `plot_bands`
"""

from rankone.share.plotting.estimate_plots import (
    plot_design,
    plot_population,
    plot_posterior,
    plot_profiles,
)
from rankone.share.plotting.fit_plots import plot_calibration, plot_fit
from rankone.share.plotting.mode_plots import plot_density, plot_history, plot_modes, plot_surface
from rankone.share.plotting.sensitivity_plots import plot_main_effects, plot_sobol
from rankone.share.plotting.trajectory_plots import plot_bands, plot_trajectories

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
