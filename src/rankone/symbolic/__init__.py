"""Passes over a problem, from its equations to the separated form and the features.

======================  ============================================================================
:mod:`~.first_order`    orders reduced, masses inverted: the system u' = f, then its weak form
:mod:`~.separation`     the separated form: terms, factors, and what does not separate
:mod:`~.tabulated`      the separated form of a table of terms, without expressions
:mod:`~.splitting`      one expression as a sum of products of functions of one coordinate
:mod:`~.levels`         staircases and tables of unknowns, as sums of steps and kinks
:mod:`~.lifting`        functions of the unknowns become unknowns, so that the system separates
:mod:`~.stretches`      the system over stretches between events at known times
:mod:`~.features`       where a system is not smooth: cuts of each coordinate
:mod:`~.rests`          where speeds are zero by the equations, and jumps of rates that are none
:mod:`~.superposition`  parameters whose effects add up, such as the amount of a dose
:mod:`~.switches`       switches of the rates, each held on one side of its surface
:mod:`~.surfaces`       functions that vanish where the system kinks, jumps or is narrow
:mod:`~.well_posed`     is everything finite on a domain, and has every function a branch there?
======================  ============================================================================

Each pass takes frozen data and returns frozen data. Code generation reads the last,
:mod:`rankone.ir.forms`.
"""

from rankone.symbolic.first_order import FirstOrderSystem, WeakForm, first_order, weak_form
from rankone.symbolic.separation import separate, symbolic_forms
from rankone.symbolic.well_posed import (
    check_known,
    check_moved,
    check_stages,
    check_start,
    check_tables,
)

__all__ = [
    "FirstOrderSystem",
    "WeakForm",
    "check_known",
    "check_moved",
    "check_stages",
    "check_start",
    "check_tables",
    "first_order",
    "separate",
    "symbolic_forms",
    "weak_form",
]
