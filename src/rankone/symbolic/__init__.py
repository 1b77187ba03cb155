"""The symbolic front end: from SymPy equations to the separated form.

============================  =====================================================================
:mod:`~.problem`              what the user wrote, validated (:mod:`~.box`, :mod:`~.equations`,
                              :mod:`~.initial`, :mod:`~.jumps`, :mod:`~.mass`), or read from text
                              (:mod:`~.parsing`)
:mod:`~.first_order`          orders reduced, masses inverted: the first-order system u' = f
:mod:`~.impulses`             a ``DiracDelta`` of time as a jump
:mod:`~.lifting`              functions of the unknowns as further unknowns
:mod:`~.weak_form`            residual times test function, integrated over every dimension
:mod:`~.separation`           the separated form, by splitting every product (:mod:`~.splitting`)
:mod:`~.general`              what does not separate is finite where trajectories start
:mod:`~.admissible`           every factor is finite and real on its interval, also on that of a
                              problem that is moved (:mod:`~.moving`)
============================  =====================================================================

Only this package and :mod:`rankone.codegen` import SymPy.
"""

from rankone.symbolic.first_order import FirstOrderSystem, first_order
from rankone.symbolic.general import check_known, check_start, check_tables
from rankone.symbolic.moving import check_moved
from rankone.symbolic.separation import separate
from rankone.symbolic.weak_form import WeakForm, weak_form

__all__ = [
    "FirstOrderSystem",
    "WeakForm",
    "check_known",
    "check_moved",
    "check_start",
    "check_tables",
    "first_order",
    "separate",
    "weak_form",
]
