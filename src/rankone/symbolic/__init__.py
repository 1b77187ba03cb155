"""The symbolic front end: from SymPy equations to the separated form.

============================  =====================================================================
:mod:`~.problem`              what the user wrote, validated (:mod:`~.checks`, :mod:`~.parsing`)
:mod:`~.explicit`             mass matrices and higher derivatives: the first-order system u' = f
:mod:`~.weak_form`            residual times test function, integrated over every dimension
:mod:`~.separation`           the separated form, by splitting every product (:mod:`~.splitting`)
:mod:`~.admissible`           every factor is finite and real on its interval
============================  =====================================================================

Only this package and :mod:`rankone.codegen` import SymPy.
"""

from rankone.symbolic.problem import Problem
from rankone.symbolic.separation import separate
from rankone.symbolic.weak_form import WeakForm, weak_form

__all__ = ["Problem", "WeakForm", "separate", "weak_form"]
