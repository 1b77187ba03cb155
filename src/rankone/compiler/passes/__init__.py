"""Passes over a problem, from its equations to the separated form and the features.

- ``feature_pass``: the features of a system: all that is not smooth, or so narrow that samples
  may miss it
- ``field_shapes``: shapes that move or widen with parameters, as sums of vectors times functions
- ``field_terms``: rates of fields as sums of linear terms, sources and elementwise functions
- ``first_order``: reduction to first order, the weak form, and parameters whose effects add up
- ``lifting``: functions of the unknowns become unknowns themselves, with equations of their own
- ``over_stretches``: systems over the pseudo-time of their stretches, and functions with many
  levels
- ``separation``: the separated form: every term a product of functions of one coordinate
- ``splitting``: splitting an expression into products of functions of one coordinate
- ``surfaces``: functions that vanish where a system is not smooth, and what vanishes by the
  equations there
- ``switches``: switches of the rates, each held on one side of its surface until a trajectory
  crosses it
- ``well_posed``: is a problem well defined on a domain, its own or one that it is moved to?

Each pass takes frozen data and returns frozen data. Code generation reads the last,
:mod:`rankone.problem.forms`.
"""

from rankone.compiler.passes.first_order import FirstOrderSystem, WeakForm, first_order, weak_form
from rankone.compiler.passes.separation import separate, symbolic_forms
from rankone.compiler.passes.well_posed import (
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
