"""The check of generated code finds what is wrong with it, and nothing else."""

import re

import mpmath
import numpy as np
import pytest
import sympy as sp

import rankone as ro
from rankone.compiler.agreement import check_problem
from rankone.compiler.codegen.layout import load_module
from rankone.compiler.comparison import NoValueError, Program, number
from tests.problems import MEASURED

t, a = sp.symbols("t a")
x, y = sp.Function("x")(t), sp.Function("y")(t)


def doctored(compiled, pattern, replacement):
    """The system of a compiled problem with a change in its source."""
    source, count = re.subn(pattern, replacement, compiled.source, count=1)
    assert count, compiled.source
    return load_module(source, "doctored")


def problem(**changes):
    given = {
        "rhs": {"x": "a*y", "y": "1/(1 + exp((x - 310.15)/0.43)) - y"},
        "initial": {"x": "309 + a", "y": "0.25"},
        "parameters": {"a": (0.5, 1)},
        "time": (0, 2),
        "jumps": {1.0: {"y": "y/2 + a"}},
        **changes,
    }
    return ro.Problem.from_strings(**given)


@pytest.mark.parametrize(
    ("pattern", "replacement", "message"),
    [
        (r"special\.expit\((?!-)", "0 * special.expit(", r"equation 2: .*Eq\(.*as it is written"),
        (r"(?m)out\[1, 0\] = .*$", "out[1, 0] = 0.0", "equation 2: the generated Jacobian"),
        (r"out\[0\] = a \+ 309", "out[0] = a + 308", "initial value of `x"),
        (r"0\.5 \* y", "0.4 * y", r"after the jump at t = 1"),
    ],
)
def test_an_error_in_generated_code_is_found(pattern, replacement, message):
    compiled = ro.compile(problem())
    system = doctored(compiled, pattern, replacement)
    with pytest.raises(ro.ProblemError, match=message):
        check_problem(compiled.problem, compiled.first_order, system)


def test_a_mass_matrix_and_second_order_are_checked_as_written():
    b = sp.Symbol("b")
    equations = [
        sp.Eq((2 + b) * x.diff(t, 2) + y.diff(t), -3 * x + sp.sin(y)),
        sp.Eq(x.diff(t, 2) - 4 * y.diff(t), x.diff(t) * y),
    ]
    made = ro.Problem(equations, (t, 0, 1), {b: (0, 1)}, {x: 1, x.diff(t): 0, y: b})
    compiled = ro.compile(made)
    system = doctored(compiled, r"np\.sin\(y\)", "np.cos(y)")
    with pytest.raises(ro.ProblemError, match="as it is written: at t = "):
        check_problem(made, compiled.first_order, system)


@pytest.mark.parametrize(
    "rate",
    [
        "a*(sqrt(1 + x**2) - x)*1e9",
        "-x + exp(1000*(sqrt(x**2 + 1) - x))",
        "sin(1e8*x) - x",
        "-a*x*abs(x) + floor(3.5*t) - Mod(t, 0.1)",
        "exp(x)/(exp(x) + 2*exp(a*x))",
        "log(x)*x**a - x**1.7/(0.1 + x**2.5)",
        "Piecewise((x, x < 1.2), (a, t < 0.7), (-x, True))",
    ],
)
def test_rounding_is_no_error(rate):
    made = ro.Problem.from_strings({"x": rate}, {"x": "1 + a"}, {"a": (0.5, 1)}, (0, 1))
    ro.compile(made)


@pytest.mark.parametrize("name", MEASURED)
def test_reference_problems_agree(name):
    compiled = ro.compile(MEASURED[name]())
    assert compiled.timings["agreement"] >= 0.0
    broken = compiled.source.replace(
        "def rhs(t, u, p):", "def rhs(t, u, p):\n    return 2 * f(t, u, p)\n\n\ndef f(t, u, p):"
    )
    if np.any(
        ro.compile(MEASURED[name]()).system.rhs(
            0.1, np.ones(len(compiled.first_order.states)), np.mean(compiled.system.box, axis=1)
        )
    ):
        with pytest.raises(ro.ProblemError, match="as it is written"):
            check_problem(compiled.problem, compiled.first_order, load_module(broken, "doubled"))


@pytest.mark.parametrize(
    ("rate", "exact"),
    [
        ("-a*(x - 310)**4", lambda x, a: -a * (x - 310) ** 4),
        ("-a*(x - 310)**6", lambda x, a: -a * (x - 310) ** 6),
    ],
)
def test_what_multiplying_out_would_lose_is_left_as_it_is(rate, exact):
    made = ro.Problem.from_strings({"x": rate}, {"x": "310 + a"}, {"a": (0.5, 1)}, (0, 1))
    compiled = ro.compile(made)
    assert compiled.quadratic is None
    assert compiled.system.rhs(0.0, [310.75], [0.75])[0] == pytest.approx(exact(310.75, 0.75))


@pytest.mark.parametrize(
    "rate",
    [
        "(sqrt(x**2 + 1e20) - 1e10)*1e10 - a*x",
        "1e17*(log(1e17 + x) - log(1e17)) - 2*a*x",
        "1e18*(exp(1e-18*x)*a - a*exp(1e-18*t)) - x",
    ],
)
def test_a_rate_without_any_digits_is_refused(rate):
    made = ro.Problem.from_strings({"x": rate}, {"x": "1 + a"}, {"a": (0.5, 1)}, (0, 1))
    with pytest.raises(ro.ProblemError, match=r"equation 1: .* as it is written"):
        ro.compile(made)


def test_a_lifted_form_that_overflows_is_none():
    rate = "-k*exp(-6000*(1/T - 1/310.15))/(1 + exp((T - 310.15)/0.43))*S/(1 + S)"
    box = {"T": (306, 314), "k": (0.5, 1)}
    compiled = ro.compile(ro.Problem.from_strings({"S": rate}, {"S": "1"}, box, (0, 5)))
    assert compiled.lifted is None
    assert compiled.methods["cross"] is None
    with pytest.raises(ro.SeparationError, match="no lifted form"):
        compiled.solve(1e-4, method="train")


@pytest.mark.parametrize(
    ("value", "exact"),
    [
        ("0.5*(1 - tanh((T - 310.15)/0.43))", lambda T: 1 / (1 + np.exp(2 * (T - 310.15) / 0.43))),
        ("1 - 1/(1 + exp(-(T - 310.15)/0.43))", lambda T: 1 / (1 + np.exp((T - 310.15) / 0.43))),
        ("exp((T - 319)*1e-12) - 1", lambda T: np.expm1((T - 319) * 1e-12)),
    ],
)
def test_initial_values_far_from_one(value, exact):
    box = {"a": (1, 2), "T": (319, 320)}
    made = ro.Problem.from_strings({"x": "-a*x"}, {"x": value}, box, (0, 1))
    solution = ro.solve(made, rtol=1e-6)
    assert solution.success
    found = solution(t=0.0, a=1.5, T=319.4)[0]
    assert found == pytest.approx(exact(319.4), rel=1e-4, abs=1e-5 * abs(exact(319.0)))


def test_a_rate_that_is_a_tail():
    rates = {"x": "-a*x + 0.5*(1 - tanh((T - 310.15)/0.43))"}
    box = {"a": (1, 2), "T": (319, 320)}
    solution = ro.solve(ro.Problem.from_strings(rates, {"x": "0"}, box, (0, 1)), rtol=1e-5)
    tail = 1 / (1 + np.exp(2 * (319.5 - 310.15) / 0.43))
    assert solution.success
    assert solution(t=1.0, a=1.5, T=319.5)[0] == pytest.approx(
        tail * (1 - np.exp(-1.5)) / 1.5, rel=1e-3
    )


def test_terms_of_equal_states_that_cancel_are_rounding():
    """Complexes of an enzyme that all start from nothing, with constants that cancel there."""
    rates = {"a": "k*c - a", "b": "c - b", "c": "1000*a*b - 300*c", "d": "a - b - d"}
    ro.compile(
        ro.Problem.from_strings(
            rhs=rates, initial=dict.fromkeys(rates, 0.0), parameters={"k": (0.5, 1.0)}, time=(0, 1)
        )
    )


def test_special_functions_of_huge_arguments_have_no_value():
    """At `exp(1e18)` mpmath would need that many digits of pi."""
    program = Program([sp.besselk(a, x)], [a, x])
    (height,) = program([number(0.5), number(2.0)])
    assert height[1] > 0.0
    with pytest.raises(NoValueError):
        program([number(0.5), number(1e200)])


def test_rates_with_special_functions_of_huge_arguments_compile(monkeypatch):
    """Nowhere are their values asked for that take mpmath forever."""

    def besselk(order, at, evaluated=mpmath.besselk):
        if abs(at) > 1e100:
            pytest.fail(f"the value at {mpmath.nstr(at, 3)} was asked for")
        return evaluated(order, at)

    monkeypatch.setattr(mpmath, "besselk", besselk)
    peak = sp.besselk(a, sp.exp((sp.Integer(10) ** 9 * (x - a)) ** 2) + 1)
    rates = [sp.Eq(x.diff(t), 1), sp.Eq(y.diff(t), peak - y)]
    ro.compile(ro.Problem(rates, (t, 0, 3), {a: (0.5, 1)}, {x: sp.Rational(1, 100), y: 1}))
