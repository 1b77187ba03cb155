"""Problem: what it holds, and what it refuses with which words."""

from __future__ import annotations

import dataclasses
import math

import pytest
import sympy as sp

from rankone.problem.problem import Problem
from rankone.support.errors import ProblemError, RankoneWarning

t, s, k, m, q = sp.symbols("t s k m q")
x, y = sp.Function("x")(t), sp.Function("y")(t)
dx, dy = x.diff(t), y.diff(t)
GOOD = sp.Eq(dx, -k * x)


def problem(equations=(GOOD,), time=(t, 0, 1), parameters=None, initial=None) -> Problem:
    return Problem(
        equations,
        time,
        {k: (1, 2)} if parameters is None else parameters,
        {x: 1} if initial is None else initial,
    )


# -- what it holds ----------------------------------------------------------------------------


def test_attributes():
    p = Problem([GOOD], (t, 0, sp.pi), {k: (sp.Rational(1, 2), 2)}, {x: 3}, name="decay")
    assert p.equations == (GOOD,)
    assert p.time == (t, 0.0, math.pi)
    assert p.parameters == {k: (0.5, 2.0)}
    assert p.initial == {x: 3}
    assert p.unknowns == (x,)
    assert [(c.name, c.lower, c.upper) for c in p.coordinates] == [("t", 0, math.pi), ("k", 0.5, 2)]


def test_is_immutable():
    p = problem()
    with pytest.raises(dataclasses.FrozenInstanceError):
        p.name = "other"
    with pytest.raises(TypeError):
        p.parameters[k] = (0, 1)


def test_unknowns_follow_the_equations():
    equations = [sp.Eq(dy, k * x), sp.Eq(dx, y)]
    assert problem(equations, initial={x: 1, y: 2}).unknowns == (y, x)


def test_unknowns_of_one_equation_follow_initial():
    equations = [sp.Eq(dx + dy, k * x), sp.Eq(dx - dy, y)]
    assert problem(equations, initial={y: 1, x: 2}).unknowns == (y, x)


@pytest.mark.parametrize("key", [dx, dx.subs(t, 0), sp.Subs(dx, t, 0)])
def test_initial_keys_for_derivatives(key):
    p = problem([x.diff(t, 2) + k * x], initial={x.subs(t, 0): 1, key: 2})
    assert dict(p.initial) == {x: 1, dx: 2}


def test_repr_is_what_was_written():
    text = repr(
        Problem([sp.Eq(k * (dx + 1), 10)], (t, 0, 5), {k: (1, 10)}, {x: 0.5}, name="linear")
    )
    assert text.splitlines() == [
        "Problem 'linear': 1 unknown, 1 parameter",
        "  k*(dx/dt + 1) = 10",
        "  x(0) = 0.5",
        "  t in [0, 5], k in [1, 10]",
    ]


def test_latex():
    text = problem()._repr_latex_()
    assert text.startswith("$$\\begin{aligned}")
    assert r"\frac{d x}{d t} &= - k x" in text
    assert r"k &\in [1, 2]" in text


def test_a_symbol_is_no_unknown():
    equation = sp.Eq(q.diff(t), -k * q)  # SymPy: 0 = -k q
    with pytest.raises(ProblemError, match=r'1: `q` .* is a symbol.*sympy.Function\("q"\)\(t\)'):
        problem([equation], initial={q: 1})


@pytest.mark.parametrize("key", ["x'", "dx/dt"])
def test_keys_are_unknowns(key):
    with pytest.raises(ProblemError, match=r"a derivative; remedy: write the name .* `x`"):
        Problem.from_strings({key: "-k*x"}, {"x": 1}, {"k": (1, 2)}, (0, 1))


def test_unused_parameter_warns():
    with pytest.warns(RankoneWarning, match="parameter `m` appears nowhere") as caught:
        problem(parameters={k: (1, 2), m: (0, 1)})
    assert caught[0].filename == __file__
    with pytest.warns(RankoneWarning, match="parameter `q` appears nowhere") as caught:
        Problem.from_strings({"x": "-x"}, {"x": 1}, {"q": (1, 2)}, (0, 1))
    assert caught[0].filename == __file__


def test_parameter_of_the_initial_values_is_used(recwarn):
    problem(parameters={k: (1, 2), m: (0, 1)}, initial={x: m})
    assert not recwarn


# -- equations --------------------------------------------------------------------------------

OTHER_K = sp.Symbol("k", positive=True)
OTHER_T = sp.Symbol("t", real=True)


@pytest.mark.parametrize(
    ("equations", "message"),
    [
        ([sp.Eq(dx, q * x)], "equation 1: unknown symbol `q`; remedy: declare it"),
        ([sp.Eq(dx, sp.Symbol("K") * x)], r"unknown symbol `K` \(did you mean `k`\?\)"),
        ([sp.Eq(dx, OTHER_K * x)], "`k` has other assumptions .*positive=True here, none there"),
        ([sp.Eq(dx, k * sp.Symbol("x"))], r"symbol `x` is not the unknown `x\(t\)`"),
        ([sp.Eq(dx, k * y)], r"equation 1: `y\(t\)` has no equation"),
        ([sp.Eq(dx, k * x), sp.Eq(dx, 2 * x)], "2 equations for 1 unknown"),
        ([sp.Eq(dx, k * x + dy)], "1 equation for 2 unknowns"),
        ([sp.Eq(dx**2, k * x), dy], r"term `Derivative\(x\(t\), t\)\*\*2` is not linear in"),
        ([sp.Eq(sp.sin(dx), k * x), dy], "is not linear in"),
        ([sp.Eq(dx * dy, k), sp.Eq(dx, y)], "is not linear in"),
        ([sp.Eq(dx, dx)], "`True` is a truth value"),
        ([], "the list of equations is empty"),
        (GOOD, "not a list"),
        ({GOOD}, "not a list"),
        ("x' = k*x", "not a list of SymPy equations.*from_strings"),
        (None, "not a list"),
        ([3.0], "equation 1: `3.0` is a float, not a scalar equation"),
        ([GOOD, "y"], "equation 2: `y` is a str"),
        (
            [sp.Eq(dx, k * x.subs(t, t - 1))],
            "delays are not supported.*chain of n further unknowns",
        ),
        ([sp.Eq(dx, k * x.subs(t, t - k))], "delays are not supported"),
        ([sp.Eq(dx, k * dx.subs(t, t - 1))], "delays are not supported"),
        ([sp.Eq(dx, k * x.subs(t, 2 * t))], "at another time than `t`; .* at the time t alone"),
        ([sp.Eq(dx, q * x), sp.Eq(q, x**2)], r"2: `q` is given by an equation.*{q: x\(t\)\*\*2}"),
        ([sp.Eq(dx, k * x.subs(t, s))], r"`x\(s\)` is not a function of the time `t` alone"),
        ([sp.Eq(dx, k * x.subs(t, OTHER_T))], "another symbol `t` than the time"),
        ([sp.Eq(dx, sp.Integral(x, t))], r"`Integral\(x\(t\), t\)` is not supported"),
        ([sp.Eq(sp.Derivative(x, k), x)], r"not a derivative in the time `t`"),
        ([sp.Eq(dx, sp.I * k * x)], "complex coefficients"),
        ([sp.Eq(dx, sp.oo * k)], "is not finite"),
    ],
)
def test_bad_equations(equations, message):
    with pytest.raises(ProblemError, match=message):
        problem(equations, initial={x: 1, y: 2})


@pytest.mark.parametrize(
    ("equations", "message"),
    [
        ([sp.Eq(dx + dy, k), sp.Eq(2 * dx + 2 * dy, y)], "mass matrix of .* is singular"),
        ([sp.Eq(k * dx + dy, k), sp.Eq(2 * k * dx + 2 * dy, y)], "mass matrix of .* is singular"),
        ([sp.Eq((k - 1.3) * dx, k * x), dy], r"coefficient `k - 1\.3` .*vanishes at k = 1\.3"),
        ([sp.Eq((k - 1.5) * dx, (k - 1.5) * x), dy], "vanishes at k = 1.5"),
        ([sp.Eq((t - 0.3) * dx, k * x), dy], "vanishes at t = 0.3"),
    ],
)
def test_singular_mass(equations, message):
    with pytest.raises(ProblemError, match=message):
        problem(equations, initial={x: 1, y: 2})


def test_error_carries_its_place():
    with pytest.raises(ProblemError) as caught:
        problem([sp.Eq(dx, k * x), sp.Eq(dy, q * x)], initial={x: 1, y: 2})
    assert caught.value.equation == 2
    assert caught.value.term == q
    assert "parameters" in caught.value.remedy


# -- time and parameters ----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("time", "message"),
    [
        ((t, 0, 0), "time horizon from 0 to 0 is zero"),
        ((t, 1, 0), "time horizon from 1 to 0 is negative"),
        ((t, 0, sp.oo), "the end of time is inf, not finite"),
        ((t, math.nan, 1), "the start of time is nan, not finite"),
        ((t, 0, "1"), "the end of time is '1', not a real number"),
        ((t, 0, 1j), "not a real number"),
        ((0, 1), r"time is `\(0, 1\)`; remedy: give the symbol, the start and the end"),
        (t, "time is `t`"),
        (("t", 0, 1), "time `t` is not a SymPy symbol"),
        ((k, 0, 1), "`k` is both the time and a parameter"),
    ],
)
def test_bad_time(time, message):
    with pytest.raises(ProblemError, match=message):
        problem(time=time)


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({k: (1, 1)}, r"the box \(1, 1\) of parameter `k` is empty"),
        ({k: (2, 1)}, r"the box \(2, 1\) of parameter `k` is reversed; remedy: write \(1, 2\)"),
        ({k: (1, math.inf)}, "upper bound of parameter `k` is inf"),
        ({k: (math.nan, 1)}, "lower bound of parameter `k` is nan"),
        ({k: 1}, "not a pair of numbers"),
        ({k: (1, 2, 3)}, "not a pair of numbers"),
        ({k: ("low", 2)}, "lower bound of parameter `k` is 'low', not a real number"),
        ({k: (True, 2)}, "not a real number"),
        ({"k": (1, 2)}, "parameter 'k' is not a SymPy symbol"),
        ([k], "not a mapping"),
        ({t: (1, 2)}, "`t` is both the time and a parameter"),
        ({k: (1, 2), sp.Symbol("x"): (1, 2)}, "`x` belongs both to parameter .* and to unknown"),
        ({k: (1, 2), OTHER_K: (1, 2)}, "the name `k` belongs both"),
        ({sp.Symbol("k", positive=True): (-1, 2)}, "contradicts the assumption that k is positive"),
        ({sp.Symbol("k", integer=True): (1, 2)}, "contradicts the assumption that k is integer"),
        ({sp.Symbol("k", imaginary=True): (1, 2)}, "declared not to be real"),
    ],
)
def test_bad_parameters(parameters, message):
    with pytest.raises(ProblemError, match=message):
        problem(parameters=parameters)


def test_state_names_must_differ_too():
    other = sp.Function("x_t")(t)
    with pytest.raises(ProblemError, match="the name `x_t` belongs both"):
        problem([x.diff(t, 2) + k, other.diff(t)], initial={x: 1, dx: 2, other: 3})


# -- initial values ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("initial", "message"),
    [
        ({}, r"no initial value for `x\(t\)`; remedy: add it"),
        ({x: t}, "names the time `t`"),
        ({x: y}, r"names the unknown `y\(t\)`"),
        ({x: x.subs(t, 0)}, r"names the unknown `x\(0\)`"),
        ({x: 1, y: 1}, r"value for `y\(t\)`, which no equation determines"),
        ({x: 1, dx: 2}, "is not needed: the equations determine this derivative"),
        ({"x": 1}, r"the key 'x' of `initial` is text \(did you mean `x\(t\)`\?\)"),
        ({sp.Symbol("x"): 1}, r"not an unknown \(did you mean `x\(t\)`\?\)"),
        ({sp.Function("x"): 1}, "not an unknown"),
        ({x.subs(t, 1): 1}, "not at the initial time 0"),
        ({x: 1, x.subs(t, 0): 1}, "two initial values"),
        ({x: "1"}, "is '1', not an expression"),
        ({x: None}, "not an expression"),
        ({x: math.inf}, "not a finite real number"),
        ({x: sp.I * k}, "not a finite real number"),
        ({x: q}, "unknown symbol `q`"),
        ({x: OTHER_K}, "other assumptions"),
        (None, "no initial value"),
        ([1], "not a mapping"),
    ],
)
def test_bad_initial(initial, message):
    with pytest.raises(ProblemError, match=message):
        problem(initial={} if initial is None else initial)


def test_missing_derivative_value():
    with pytest.raises(ProblemError, match=r"no initial value for `Derivative\(x\(t\), t\)`"):
        problem([x.diff(t, 2) + k * x])
