"""Numbers in expressions: exact inside, decimals for people."""

import pytest
import sympy as sp

from rankone.problem.expressions.notation import exact, plain_text
from rankone.support.errors import ProblemError


def test_numbers_before_variables_that_are_too_large_are_refused_and_others_written():
    x = sp.Symbol("x")
    assert plain_text((4 * x) ** 20000) == "1.5842603725730787e+12041*x**20000"
    for expression in ((4 * x * (1 - x)) ** 100000, sp.Integer(4) ** 100000, x / 4**100000):
        with pytest.raises(ProblemError, match=r"is too (large|small) a number"):
            exact(expression)
