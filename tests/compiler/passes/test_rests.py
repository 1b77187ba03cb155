"""Where speeds at a surface are zero by the equations, and jumps of rates that are none."""

import pytest
import sympy as sp

from rankone.compiler.passes.surfaces import only_kinks, zero_where

x, y = (sp.Function(name)(sp.Symbol("t")) for name in ("x", "y"))
t, k = sp.symbols("t k")
side, own = sp.Dummy("side", real=True), sp.Dummy("own", real=True)
state = sp.Function("side_0")(t)
SIDES = {side: state}


@pytest.mark.parametrize(
    ("speed", "where"),
    [
        (sp.S.Zero, sp.true),
        (k - k * (1 + side) / 2 - k * (1 - side) / 2, sp.true),
        (k * x * (1 - side), state > sp.Rational(1, 2)),
        (sp.Piecewise((0, side > 0), (k * x, True)), state > sp.Rational(1, 2)),
        (sp.Piecewise((0, sp.cos(t) > 0), (k, True)), sp.cos(t) > 0),
        (k * x, sp.false),
        (sp.Piecewise((1e-12 * k, side > 0), (k, True)), sp.false),
    ],
)
def test_zero_is_a_matter_of_the_equations(speed, where):
    assert sp.simplify(sp.Equivalent(zero_where(speed, SIDES), where)) == sp.true


@pytest.mark.parametrize(
    ("rate", "kinks"),
    [
        (sp.Piecewise((0, (side > 0) & (own > 0)), (k - x, True)), True),
        ((k - x) * (1 + own), True),
        (sp.Piecewise((0, (side > 0) & (own > 0)), (k, True)), False),
        (k * own, False),
        ((k - x) * own + (1 - side) * (1 + own), False),
    ],
)
def test_rates_that_are_alike_on_both_sides_where_these_meet_have_a_kink(rate, kinks):
    assert only_kinks([rate], k - x, own, SIDES) == kinks
