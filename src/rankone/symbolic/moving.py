"""May a compiled problem be solved on another box or horizon than the one it was written for?"""

from __future__ import annotations

import warnings
from dataclasses import replace

from rankone.expressions.admissible import located_defect
from rankone.frontend.problem import Problem
from rankone.ir.domain import Domain
from rankone.ir.forms import SeparatedForm
from rankone.ir.system import System
from rankone.support.errors import OptionError, ProblemError, RankoneWarning
from rankone.symbolic.first_order import FirstOrderSystem
from rankone.symbolic.general import check_known, check_start, check_tables

__all__ = ["check_moved"]

_REMEDY = "choose other ranges, or compile the problem with these"


def check_moved(
    problem: Problem,
    first_order: FirstOrderSystem,
    form: SeparatedForm,
    system: System,
    domain: Domain,
) -> None:
    """Raise unless the problem is well posed on a domain and its separated form holds there.

    The form was found on the box of the problem: the signs under its roots are those of that box.

    Raises
    ------
    OptionError
        As a new problem on that domain would, or if a factor is not finite and real on it.
    """
    t, *_ = problem.time
    box = dict(zip(problem.parameters, domain.box, strict=True))
    intervals = (domain.horizon, *domain.box)
    pairs = zip(form.coordinates, intervals, strict=True)
    moved_all = [replace(c, lower=lower, upper=upper) for c, (lower, upper) in pairs]
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RankoneWarning)
            Problem(problem.equations, (t, *domain.horizon), box, problem.initial)
        check_tables(first_order, moved_all)
        if form.general:
            check_known(first_order, moved_all)
            check_start(first_order, system, moved_all)
    except ProblemError as error:
        raise OptionError(str(error), term=error.term) from error
    for dimension, moved in enumerate(moved_all):
        for factor in form.factors[dimension]:
            wrong = located_defect(factor.expression, moved, dimension)
            if wrong is not None:
                raise OptionError(wrong, term=factor.expression, remedy=_REMEDY)
