"""The functions made of quantities of interest compared with the expressions they are made of."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np
import sympy as sp

from rankone.agreement.comparison import Comparison
from rankone.agreement.precise import number
from rankone.support.arrays import Array
from rankone.support.errors import OptionError
from rankone.support.wording import quote

__all__ = ["check_outputs"]


def check_outputs(
    expressions: Mapping[str, sp.Expr],
    values: Mapping[sp.Expr, Array],
    function: Callable[[int], Sequence[Array]],
) -> None:
    """Compare quantities with what was written, at points.

    Parameters
    ----------
    expressions : mapping of str to Expr
        The quantities by how messages name them.
    values : mapping of Expr to ndarray (m,)
        What the symbols are at the points.
    function : callable
        From the number of a point to the computed value of each quantity.

    Raises
    ------
    OptionError
        If one of them is off by more than rounding.
    """
    computed = sp.Dummy()
    leaves = [*values, computed]
    compared = [Comparison(computed, value, leaves, [computed]) for value in expressions.values()]
    count = len(next(iter(values.values())))
    results = np.array([[float(np.ravel(v)[0]) for v in function(k)] for k in range(count)])
    for i, (name, comparison) in enumerate(zip(expressions, compared, strict=True)):
        columns = [*values.values(), results[:, i]]
        finite = np.flatnonzero(np.isfinite(columns).all(axis=0))
        points = ([number(column[k]) for column in columns] for k in finite)
        wrong = comparison.beyond_rounding(points)
        if wrong is not None:
            raise OptionError(
                f"{name}, {quote(expressions[name])}, is not computed as it is written: it is off "
                f"by {wrong[1]:.3g}",
                term=expressions[name],
                remedy="write it in another way, or change the units so that its numbers are "
                "closer to 1",
            )
