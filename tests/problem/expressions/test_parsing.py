"""Text to problems: the same as SymPy, any names, and nothing is ever evaluated."""

from __future__ import annotations

import pytest
import sympy as sp

from rankone.compiler.passes import first_order, separate
from rankone.problem.expressions.parsing import parse_expression
from rankone.problem.problem import Problem
from rankone.support.errors import ProblemError
from tests.problems import REFERENCE


def parse(text: str, **changes) -> Problem:
    given = {
        "rhs": {"x": text},
        "initial": {"x": 1},
        "parameters": {"k": (1, 2)},
        "time": (0, 1),
        **changes,
    }
    return Problem.from_strings(**given)


@pytest.mark.parametrize(
    ("text", "same"),
    [
        ("k*x^2 + 2^-k", "k*x**2 + 2**(-k)"),
        ("pow(x, k)", "x**k"),
        ("arctan(x) + arcsinh(k) + arctan2(x, k)", "atan(x) + asinh(k) + atan2(x, k)"),
        ("log10(x)", "log(x)/log(10)"),
        ("log2(x) + heaviside(t)", "log(x)/log(2) + Heaviside(t)"),
        ("ceiling(x) + coth(x)", "ceil(x) + 1/tanh(x)"),
    ],
)
def test_other_spellings(text, same):
    sides = [sp.expand(parse(each).residuals[0].rewrite(sp.tanh)) for each in (text, same)]
    assert sides[0] == sides[1]


def test_equals_the_sympy_problem():
    wanted = REFERENCE["lotka_volterra"]()
    found = Problem.from_strings(
        rhs={"x": "x*(1.5 - y)", "y": "-y*(3 - x)"},
        initial={"y": "y0", "x": "x0"},
        parameters={"x0": (8, 12), "y0": (4, 6)},
        time=(0, 6),
    )
    assert found.residuals == wanted.residuals
    assert found.unknowns == wanted.unknowns
    assert found.initial == wanted.initial
    assert found.parameters == wanted.parameters
    assert found.time == wanted.time
    assert separate(found) == separate(wanted)


@pytest.mark.parametrize(
    ("condition", "other"),
    [
        ("~(x > 1)", "x <= 1"),
        ("~((x > 1) & ~(k < 2))", "(x <= 1) | (k < 2)"),
        ("Not(x > 1)", "x <= 1"),
        ("And(x > 1, k < 2, t > 3)", "(x > 1) & (k < 2) & (t > 3)"),
        ("Or(x > 1, Not(k < 2))", "(x > 1) | (k >= 2)"),
    ],
)
def test_conditions_by_operators_and_functions(condition, other):
    names = {name: sp.Symbol(name, real=True) for name in "xkt"}
    one, two = (
        parse_expression(f"Piecewise((1, {text}), (0, True))", names, where="rate")
        for text in (condition, other)
    )
    assert sp.simplify_logic(sp.Equivalent(one.args[0][1], two.args[0][1])) == sp.true


@pytest.mark.parametrize("condition", ["~x", "Not(x > 1, k < 2)", "Xor(x > 1, k < 2)", "And(x)"])
def test_what_is_no_condition(condition):
    with pytest.raises(ProblemError, match="is not a condition"):
        parse_expression(
            f"Piecewise((1, {condition}), (0, True))",
            dict.fromkeys("xk", sp.Symbol("x")),
            where="rate",
        )


def test_any_name_is_a_plain_name():
    names = ["S", "N", "E", "I", "Q", "O", "beta", "gamma", "zeta", "lambda", "in", "pi", "Symbol"]
    problem = Problem.from_strings(
        rhs={name: f"-rate*{name}" for name in names},
        initial=dict.fromkeys(names, 1),
        parameters={"rate": (1, 2)},
        time=(0, 1),
    )
    assert [u.func.__name__ for u in problem.unknowns] == names
    rate = sp.Symbol("rate")
    assert first_order(problem).rhs == tuple(-rate * u for u in problem.unknowns)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("-k*x**2 + 1/3", "-k*x**2 + Rational(1, 3)"),
        ("k*x(t)*sin(2*pi*t)", "k*x*sin(2*pi*t)"),
        ("sqrt(k) + exp(-k) + log(k) + tanh(k)", "sqrt(k) + exp(-k) + log(k) + tanh(k)"),
        ("+k - (-x)", "k + x"),
        ("1e-3*k", "k/1000"),
        ("max(k, t)", "Max(k, t)"),
        ("k\n  * x", "k*x"),
        ("0*k + k", "k"),
    ],
)
def test_formulas(text, expected):
    problem = parse(text)
    t, k = sp.symbols("t k")
    assert first_order(problem).rhs[0] == sp.sympify(
        expected, {"x": sp.Function("x")(t), "t": t, "k": k}
    )


def test_numbers_are_welcome():
    problem = parse("k", initial={"x": "1/10"})
    assert problem.initial == {problem.unknowns[0]: sp.Rational(1, 10)}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("k*y", "equation 1: unknown name `y` in the right-hand side of `x`, `k\\*y`"),
        ("kk*x", r"unknown name `kk` \(did you mean `k`\?\)"),
        ("k*x +", r"`k\*x \+`, is not a formula \(invalid syntax\)"),
        ("", "is not a formula"),
        ("x' = -k*x", "not a formula.*remedy: give what stands on the right of `=` alone"),
        ("-2x*k", r"not a formula.*remedy: write products with `\*`"),
        ("k if x > 1 else 0", "remedy: write Piecewise"),
        ("np.exp(x)", "`np.exp` is not understood.*remedy: write exp"),
        ("pow(x)", "`pow` takes two arguments, not 1"),
        ("sinn(k)", r"unknown function `sinn` \(did you mean `sin`\?\)"),
        ("sin(k, x)", "`sin` takes one argument, not 2"),
        ("sqrt()", "`sqrt` takes one argument, not 0"),
        ("k*exp", "function `exp` has no argument"),
        ("x(k)", r"`x\(k\)` is not understood"),
        ("x(t - 1)", r"`x\(t - 1\)` is an unknown at another time.*delays are not supported"),
        ("k/0", "division by zero"),
        ("9**9**9", "too large a number"),
        ("(" * 300 + "k" + ")" * 300, "is not a formula"),
        ("-" * 100_000 + "k", "nested too deep"),
        ("__import__('os').system('true')", "is not understood"),
        ("exp.__class__(k)", "is not understood"),
        ("k.real", "`k.real` is not understood"),
        ("[k]", "is not understood"),
        ("k < x", "is not understood"),
        ("lambda x: x", "is not a formula"),
        ("(y := k)", "is not understood"),
        ("'k'", "is not understood"),
        ("1j*k", "is not understood"),
        ("1e999*k", "the number 1e999 is too large"),
        ("k; k", "is not a formula"),
        ("-k*x # decay\n + k", "begins no comment.*remedy: leave comments out"),
    ],
)
def test_bad_formulas(text, message):
    with pytest.raises(ProblemError, match=message):
        parse(text)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"initial": {"y": 1}}, "value for `y`, which has no equation"),
        ({"initial": {}}, r"no initial value for `x\(t\)`"),
        ({"initial": {"x": "t"}}, "names the time"),
        ({"initial": {"x": "x"}}, "names the unknown"),
        ({"initial": {"x": [1]}}, "neither text nor a number"),
        ({"parameters": {"x": (1, 2)}}, "`x` belongs both to parameter"),
        ({"parameters": {"t": (1, 2)}}, "`t` belongs both to the time"),
        ({"rhs": {"t": "1"}, "initial": {"t": 1}}, "`t` belongs both to the time"),
        ({"rhs": {}, "initial": {}}, "list of equations is empty"),
        ({"rhs": ["k*x"]}, "not a mapping from names"),
        ({"time": 1}, "time is `1`"),
        ({"time": (1, 0)}, "negative"),
    ],
)
def test_bad_ingredients(changes, message):
    with pytest.raises(ProblemError, match=message):
        parse("k*x", **changes)
