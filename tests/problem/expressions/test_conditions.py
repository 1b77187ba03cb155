"""Conditions in one form: as they were written, but of functions that are smooth."""

import itertools

import pytest
import sympy as sp

from rankone.problem.expressions.conditions import definite_sign, with_plain_conditions
from rankone.problem.forms import Coordinate

t, a, k = sp.symbols("t a k", real=True)
x, v = sp.symbols("x v", real=True)


def when(condition):
    return sp.Piecewise((x + 2, condition), (-k, True), evaluate=False)


STEPPED = sp.Piecewise((0, t < 1), (2, True))
CASES = [
    when(sp.Abs(t - a) < 1),
    when((t - a) ** 2 <= 1),
    when(sp.Max(x, v) < 1),
    when(sp.Min(x, 2 * v, t) >= 1),
    when((sp.Abs(v) > 1) & ((x - 1) * (v - k) > 0)),
    when(x < STEPPED),
    when(sp.ITE(t < 1, x < 2, v < 1)),
    when(sp.Xor(x > 1, v > 1)),
    sp.Heaviside(1 - sp.Abs(t - a)),
    sp.Heaviside((t - a) * (a + 1 - t)),
    sp.sign((x - 1) * (v - k)) + k,
    sp.Min(1, k * (STEPPED - x)),
    when(k * sp.Abs(x) - sp.Abs(v) > -1),
]


@pytest.mark.parametrize("written", CASES, ids=str)
def test_values_are_those_that_were_written(written):
    plain = with_plain_conditions(written)
    for values in itertools.product(
        (-1.3, 0.4, 2.7), (0.7, 1.6), (0.3, 1.9), (-2.2, 0.9), (-1.7, 1.2)
    ):
        at = dict(zip((t, a, k, x, v), values, strict=True))
        assert plain.subs(at) == pytest.approx(written.subs(at), rel=1e-12)


@pytest.mark.parametrize("written", CASES[:-1], ids=str)
def test_conditions_compare_smooth_functions(written):
    plain = with_plain_conditions(written)
    assert not plain.has(sp.ITE)
    for node in plain.atoms(sp.core.relational.Relational, sp.sign, sp.Heaviside):
        assert not node.has(sp.Abs, sp.Max, sp.Min, sp.Piecewise)


def test_the_spellings_of_a_pulse_are_one():
    pulses = [
        when(sp.Abs(t - a) < 1),
        when((t > a - 1) & (t < a + 1)),
        when((t - a) ** 2 < 1),
        when(sp.Max(t - a, a - t) < 1),
    ]
    heights = [
        {abs(each.lhs - each.rhs) for each in plain.atoms(sp.core.relational.Relational)}
        for plain in map(with_plain_conditions, pulses)
    ]
    assert all(each == heights[0] for each in heights)


@pytest.mark.parametrize(
    ("written", "wanted"),
    [
        (sp.Piecewise((-12, x < -12), (12, x > 12), (x, True)), sp.Max(-12, sp.Min(12, x))),
        (
            sp.Piecewise((x - k, x > k), (x + k, x < -k), (0, True)),
            sp.Max(x - k, sp.Min(x + k, 0)),
        ),
        (sp.Piecewise((k * (x - v), x >= v), (0, True)), None),
        (sp.Piecewise((1, x > 0), (0, True)), None),
        (sp.Piecewise((x + 1, x > 0), (0, True)), None),
        (sp.Piecewise((0, x < 0), (2 * x, True)), sp.Max(0, 2 * x)),
    ],
)
def test_branches_that_meet_where_they_change_are_extremes(written, wanted):
    plain = with_plain_conditions(written, (Coordinate("k", k, 0.5, 2.0),))
    assert plain == (written if wanted is None else wanted)


@pytest.mark.slow
def test_the_sign_of_a_sum_of_many_parameters_is_that_of_its_two_extremes():
    many = [Coordinate(s.name, s, 0.1, 0.3) for s in sp.symbols("q:40", real=True)]
    total = sp.Add(*((-1) ** i * c.symbol for i, c in enumerate(many)))
    assert definite_sign(total - 5, many) == -1
    assert definite_sign(total + 5, many) == 1
    assert definite_sign(total - 3.9, many) is None
    product = sp.Mul(*(c.symbol for c in many))
    assert definite_sign(product + total + 100, many) is None
