"""The separated form, compared with hand-written lists and with the integrand itself."""

from __future__ import annotations

import math
import pickle
import random
from fractions import Fraction

import pytest
import sympy as sp
from hypothesis import given, settings
from hypothesis import strategies as st

import rankone as ro
from rankone.compiler.passes import separate
from rankone.problem.forms import SeparatedForm
from rankone.problem.problem import Problem
from rankone.support.errors import ProblemError, SeparationError

t, k, m, a, b = sp.symbols("t k m a b")
x, y = sp.Function("x")(t), sp.Function("y")(t)


def one_equation(rhs: sp.Expr, box=None, horizon=(0, 1)) -> Problem:
    box = {k: (1, 2), m: (1, 3)} if box is None else box
    used = {symbol: bounds for symbol, bounds in box.items() if symbol in rhs.free_symbols}
    return Problem([sp.Eq(x.diff(t), rhs, evaluate=False)], (t, *horizon), used, {x: 1})


def terms_of(rhs: sp.Expr, **kwargs) -> list[tuple]:
    """(coefficient in f, factors as text, monomial) of the right-hand side of x."""
    form = separate(one_equation(rhs, **kwargs))
    return [
        (
            -term.coefficient,
            *(str(f[i].expression) for f, i in zip(form.factors, term.factors, strict=True)),
            term.monomial,
        )
        for term in form.terms
        if term.derivative == 0
    ]


def value(form: SeparatedForm, terms, point: dict[sp.Symbol, float], states, rates=()) -> list:
    """Sum the separated terms of each equation at a point."""
    total = [0.0] * len(form.states)
    for term in terms:
        product = float(term.coefficient)
        for factors, i in zip(form.factors, term.factors, strict=True):
            product *= float(factors[i].expression.subs(point))
        if term.derivative:
            product *= rates[term.monomial[0]]
        else:
            product *= math.prod(states[i] for i in term.monomial)
        total[term.equation] += product
    return total


# -- hand-written lists -----------------------------------------------------------------------


def test_lotka_volterra_by_hand(reference):
    form = separate(reference["lotka_volterra"]())
    one = (0, 0, 0)
    assert [
        (e.equation, e.coefficient, e.factors, e.monomial, e.derivative) for e in form.terms
    ] == [
        (0, 1.0, one, (0,), 1),
        (0, -1.5, one, (0,), 0),
        (0, 1.0, one, (0, 1), 0),
        (1, 1.0, one, (1,), 1),
        (1, 3.0, one, (1,), 0),
        (1, -1.0, one, (0, 1), 0),
    ]
    assert [(e.equation, e.coefficient, e.factors, e.monomial) for e in form.initial] == [
        (0, 1.0, (0, 1, 0), ()),
        (1, 1.0, (0, 0, 1), ()),
    ]
    assert [[str(f.expression) for f in factors] for factors in form.factors] == [
        ["1"],
        ["1", "x0"],
        ["1", "y0"],
    ]


def test_linear_problem_is_solved_for_the_derivative(reference):
    form = separate(reference["linear"]())
    assert [(e.coefficient, e.factors, e.monomial, e.derivative) for e in form.terms] == [
        (1.0, (0, 0), (0,), 1),
        (1.0, (0, 0), (), 0),
        (-10.0, (0, 1), (), 0),
    ]
    assert str(form.factors[1][1].expression) == "1/k"
    assert form.initial == ()


@pytest.mark.parametrize(
    ("name", "terms", "initial", "factors"),
    [
        ("decay", 2, 1, 1),
        ("linear", 3, 0, 1),
        ("free_fall", 3, 0, 1),
        ("coupled", 9, 3, 3),
        ("lotka_volterra", 6, 2, 2),
        ("kirchhoff", 19, 6, 6),
        ("chain", 29, 1, 10),
    ],
)
def test_reference_problems(reference, name, terms, initial, factors):
    form = separate(reference[name]())
    assert len(form.terms) == terms
    assert len(form.initial) == initial
    assert sum(len(distinct) - 1 for distinct in form.factors) == factors


def test_higher_order_becomes_first_order():
    problem = Problem(
        [m * x.diff(t, 2) + k * x], (t, 0, 1), {k: (1, 2), m: (1, 2)}, {x: 1, x.diff(t): 0}
    )
    form = separate(problem)
    assert [state.name for state in form.states] == ["x", "x_t"]
    assert [(e.equation, e.coefficient, e.monomial, e.derivative) for e in form.terms] == [
        (0, 1.0, (0,), 1),
        (0, -1.0, (1,), 0),
        (1, 1.0, (1,), 1),
        (1, 1.0, (0,), 0),
    ]


def test_without_parameters_time_is_the_only_dimension():
    form = separate(Problem([sp.Eq(x.diff(t), sp.sin(t) * x)], (t, 0, 1), {}, {x: 1}))
    assert [str(f.expression) for f in form.factors[0]] == ["1", "sin(t)"]


# -- splitting --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("rhs", "expected"),
    [
        pytest.param(sp.exp(-k - m), [(1, "1", "exp(-k)", "exp(-m)", ())], id="exp of a sum"),
        pytest.param(
            sp.sqrt(k * m) * x, [(1, "1", "sqrt(k)", "sqrt(m)", (0,))], id="root of a product"
        ),
        pytest.param((k * m) ** 2, [(1, "1", "k**2", "m**2", ())], id="power of a product"),
        pytest.param(1 / (k * m), [(1, "1", "1/k", "1/m", ())], id="quotient"),
        pytest.param(1 / (k * (m + 1)), [(1, "1", "1/k", "1/(m + 1)", ())], id="sum below"),
        pytest.param(
            1 / sp.expand((k + 1) * (m + 1)),
            [(1, "1", "1/(k + 1)", "1/(m + 1)", ())],
            id="factored denominator",
        ),
        pytest.param(
            1 / (0.5 * k * m + 0.5 * k),
            [(2, "1", "1/k", "1/(m + 1)", ())],
            id="factored denominator with decimals",
        ),
        pytest.param(
            (1 + k) * (1 + m),
            [
                (1, "1", *factors, ())
                for factors in (("1", "1"), ("1", "m"), ("k", "1"), ("k", "m"))
            ],
            id="sums of monomials are distributed",
        ),
        pytest.param(
            2 ** (k + m + 1), [(2, "1", "2**k", "2**m", ())], id="number to the power of a sum"
        ),
        pytest.param(sp.Abs(k * m * t), [(1, "Abs(t)", "Abs(k)", "Abs(m)", ())], id="abs"),
        pytest.param(
            sp.log(k * m),
            [(1, "1", "1", "log(m)", ()), (1, "1", "log(k)", "1", ())],
            id="log of a product",
        ),
    ],
)
def test_what_separates(rhs, expected):
    assert terms_of(rhs) == expected


def test_phase_separates():
    assert terms_of(sp.sin(t + k)) == [
        (1, "sin(t)", "cos(k)", ()),
        (1, "cos(t)", "sin(k)", ()),
    ]


def test_switch_in_time_separates():
    dose = sp.Piecewise((k, t < 0.5), (x, True))
    assert terms_of(dose) == [
        (1, "Piecewise((1, t < 1/2), (0, True))", "k", ()),
        (1, "Piecewise((0, t < 1/2), (1, True))", "1", (0,)),
    ]


@pytest.mark.parametrize(
    "function",
    [
        sp.exp(-50 * (t - 5) ** 2),  # expanded it would overflow
        (t - 5) ** 20,  # expanded it would lose all digits
        (1 + sp.exp(-t - 1)) / (1 + t),
        sp.Piecewise((t, t < 1), (0, True)),
    ],
)
def test_functions_of_one_coordinate_stay_as_written(function):
    assert terms_of(function * x, horizon=(0, 10)) == [(1, str(function), (0,))]


def test_numbers_move_into_the_coefficient():
    rhs = 2 * k * x + 1 / (2 * k) + k / 3 + 1 / (3 * k + 3)
    found = terms_of(rhs)
    assert found == [
        (0.5, "1", "1/k", ()),
        (Fraction(1, 3), "1", "k", ()),
        (Fraction(1, 3), "1", "1/(k + 1)", ()),
        (2.0, "1", "k", (0,)),
    ]


def test_like_terms_merge_and_cancel():
    rhs = sp.Add(x * (1 + k), -k * x, 0.1 * k * x * x, -(x * k) * (x / 10), evaluate=False)
    assert terms_of(rhs) == [(1, "1", "1", (0,))]


def test_states_cancel_in_quotients():
    assert terms_of((x**2 + x) / x * k) == [(1, "1", "k", ()), (1, "1", "k", (0,))]


# -- what does not separate -------------------------------------------------------------------


@pytest.mark.parametrize(
    ("rhs", "message"),
    [
        (sp.exp(-k * t) * x, r"equation 1: .*`exp\(-k\*t\)`.*couples `t` and `k` and does not"),
        (1 / (k + m), r"term `1/\(k \+ m\)` couples `k` and `m`"),
        (k**t, r"`k\*\*t` couples"),
        (sp.sqrt(k + t), r"couples `t` and `k`"),
        (sp.Piecewise((x, t < k), (0, True)), r"couples `t` and `k`"),
        (sp.tanh(t * k), r"couples"),
        (k * sp.sin(x), r"`sin\(x\(t\)\)` in the term `k\*sin\(x\(t\)\)` is not polynomial in"),
        (1 / x, r"`1/x\(t\)` is not polynomial in `x\(t\)`"),
        (x / (1 + x), r"`1/\(x\(t\) \+ 1\)` in the term .* is not polynomial"),
        (
            sp.sqrt(x),
            r"not polynomial.*remedy: method='cross' takes it as it is",
        ),
        (x**k, r"not polynomial"),
        (sp.Abs(x), r"not polynomial"),
        (sp.Piecewise((1, x > 0), (0, True)), r"not polynomial"),
    ],
)
def test_separation_errors(rhs, message):
    with pytest.raises(SeparationError, match=message) as caught:
        separate(one_equation(rhs)).require_separated()
    assert caught.value.equation == 1
    assert caught.value.term == rhs
    assert caught.value.remedy


def test_initial_value_that_does_not_factor():
    problem = Problem([x.diff(t)], (t, 0, 1), {k: (1, 2), m: (1, 2)}, {x: 1 / (k + m)})
    with pytest.raises(SeparationError, match=r"initial value of `x\(t\)`: .* couples `k` and `m`"):
        separate(problem).require_separated()


def test_general_terms_are_listed_beside_what_separates():
    problem = Problem(
        [sp.Eq(x.diff(t), -k * sp.sin(x) + m * x + sp.exp(-k * t))],
        (t, 0, 1),
        {k: (1, 2), m: (1, 2)},
        {x: k + 1 / (k + m)},
    )
    form = separate(problem)
    found = {(g.equation, g.expression, g.initial, g.origin) for g in form.general}
    assert found == {
        (0, -k * sp.sin(x), False, 1),
        (0, sp.exp(-k * t), False, 1),
        (0, 1 / (k + m), True, None),
    }
    assert [(e.coefficient, e.monomial) for e in form.terms] == [(1, (0,)), (-1, (0,))]
    assert len(form.initial) == 1
    shown = str(form)
    assert "2 terms, 3 general terms, 3 dimensions" in shown
    listed = shown.partition("General terms, which do not separate:\n")[2].splitlines()
    assert "  x: `sin(x(t))` in the term `-k*sin(x(t))` is not polynomial in `x(t)`" in listed
    assert len(listed) == 3
    assert "which do not separate" in form._repr_html_()
    assert r"\sin" in form._repr_latex_()
    assert pickle.loads(pickle.dumps(form)) == form


def test_what_separates_needs_no_complaint():
    form = separate(one_equation(k * x))
    assert form.general == ()
    form.require_separated()
    assert "General" not in str(form)


@pytest.mark.parametrize(
    ("rhs", "box", "message"),
    [
        (x / k, (-1, 2), r"factor `1/k` is not finite at k = 0, inside the box .*`k` \[-1, 2\]"),
        (x / (k - 1.2345678) ** 2, (1, 2), r"not finite at k = 1\.23457"),
        (sp.sqrt(k) * x, (-1, 2), r"`sqrt\(k\)` is not real at k = -1"),
        (sp.log(k), (0, 1), r"`log\(k\)` is not finite at k = 0"),
        (sp.tan(k), (1, 2), r"`tan\(k\)` is not finite at k = 1\.5708"),
        (k / (t - 0.123), (1, 2), r"inside the horizon \[0, 1\]"),
        (sp.sqrt(k * t), (-1, 1), r"is not real for all t in \[0, 1\], k in \[-1, 1\]"),
        (sp.exp(1000 * k), (0, 1), r"`exp\(1000\*k\)` is not finite"),
        (sp.Integer(10) ** 400 * k, (0, 1), r"is not a finite real number"),
        (sp.Pow(-1, sp.Rational(1, 3)) * k, (0, 1), r"is not a finite real number"),
    ],
)
def test_factors_must_be_finite_and_real(rhs, box, message):
    with pytest.raises(ProblemError, match=message):
        separate(one_equation(rhs, {k: box}))


def test_guarded_pole_is_accepted():
    guarded = sp.Piecewise((1 / (k - 1.5), k > 1.7), (0, True))
    assert len(terms_of(guarded * x)) == 1


# -- agreement with the integrand ---------------------------------------------------------------


@pytest.mark.parametrize("seed", range(3))
def test_reference_residuals_at_random_points(reference_problem, seed):
    rng = random.Random(seed)
    form = separate(reference_problem)
    point = {c.symbol: rng.uniform(c.lower, c.upper) for c in form.coordinates}
    states = [rng.uniform(-1, 1) for _ in form.states]
    rhs = [-v for v in value(form, [e for e in form.terms if not e.derivative], point, states)]
    at_point = dict(zip([s.expression for s in form.states], states, strict=True))
    rates = {s.expression.diff(t): r for s, r in zip(form.states, rhs, strict=True)}
    # With the rates the separated form gives, the equations as written hold.
    for residual in reference_problem.residuals:
        assert float(residual.xreplace(rates).xreplace(at_point).subs(point)) == pytest.approx(
            0, abs=1e-12
        )


PLAIN = [t, k, m, x, y, sp.Rational(1, 3), sp.Float(0.3), sp.Integer(-2)]
FUNCTIONS = [sp.exp(-k), sp.sin(t), 1 / m, sp.sqrt(k), 1 / (2 * m + 2), sp.log(k + 1)]
MIXED = [sp.exp(-k - m), sp.cos(k + t), (k * m) ** 2, 1 / (k * (1 + t)), sp.sqrt(k * m)]
ATOMS = st.sampled_from([*PLAIN, *FUNCTIONS, *MIXED])
EXPRESSIONS = st.recursive(
    ATOMS,
    lambda inner: st.one_of(
        st.tuples(inner, inner).map(lambda pair: pair[0] + pair[1]),
        st.tuples(inner, inner).map(lambda pair: pair[0] * pair[1]),
        inner.map(lambda e: e**2),
    ),
    max_leaves=8,
)


@pytest.mark.slow
@settings(max_examples=30)
@given(f=EXPRESSIONS, g=EXPRESSIONS, seed=st.integers(0, 100))
def test_sum_of_separated_terms_is_the_integrand(f, g, seed):
    problem = Problem(
        [sp.Eq(x.diff(t), f + k + m, evaluate=False), sp.Eq(y.diff(t), g, evaluate=False)],
        (t, 0, 1),
        {k: (1, 2), m: (1, 3)},
        {x: k * m, y: sp.exp(k + m)},
    )
    form = separate(problem)
    rng = random.Random(seed)
    point = {c.symbol: rng.uniform(c.lower, c.upper) for c in form.coordinates}
    states, rates = [rng.uniform(-1, 1) for _ in "xy"], [rng.uniform(-1, 1) for _ in "xy"]
    written = {x.diff(t): rates[0], y.diff(t): rates[1]}, {x: states[0], y: states[1]}
    expected = [
        float(r.xreplace(written[0]).xreplace(written[1]).subs(point)) for r in problem.residuals
    ]
    assert value(form, form.terms, point, states, rates) == pytest.approx(
        expected, rel=1e-9, abs=1e-9
    )
    initial = [float(v.subs(point)) for v in problem.initial.values()]
    assert value(form, form.initial, point, states) == pytest.approx(initial)


def test_1200_raw_terms_group_correctly():
    rng = random.Random(0)
    states, rates = sp.symbols("s0:5"), sp.symbols("p0:3")
    unknowns = [sp.Function(f"s{i}")(t) for i in range(5)]
    factors = [[1, p, p**2, sp.exp(-p)] for p in rates]
    raw = [
        (rng.choice([-2, -1, 1, 2, 3]), *(rng.choice(f) for f in factors), rng.choice(states))
        for _ in range(1200)
    ]
    expected: dict[tuple, int] = {}
    for number, *key in raw:
        expected[tuple(key)] = expected.get(tuple(key), 0) + number
    rhs = sp.Add(*[sp.Mul(*term) for term in raw], evaluate=False)
    rhs = rhs.xreplace(dict(zip(states, unknowns, strict=True)))
    equations = [
        sp.Eq(unknowns[0].diff(t), rhs, evaluate=False),
        *(u.diff(t) for u in unknowns[1:]),
    ]
    form = separate(
        Problem(equations, (t, 0, 1), dict.fromkeys(rates, (1, 2)), dict.fromkeys(unknowns, 1))
    )
    found = {
        (
            *(f[i].expression for f, i in zip(form.factors[1:], e.factors[1:], strict=True)),
            states[e.monomial[0]],
        ): -e.coefficient
        for e in form.terms
        if e.equation == 0 and not e.derivative
    }
    assert found == {key: number for key, number in expected.items() if number}


def test_pickling(reference_problem):
    again = pickle.loads(pickle.dumps(reference_problem))
    assert again.equations == reference_problem.equations
    assert separate(again) == separate(reference_problem)


@pytest.mark.parametrize(
    ("rate", "at", "exact"),
    [
        ("-x + exp(1000.0*(a - 1.0))", 1.0, 1 - math.exp(-1)),
        ("-x + 1 + exp((cos(a - 0.9137) - 1)*1000.0)", 0.9137, 2 * (1 - math.exp(-1))),
        ("-x + 1/(1 + exp(-(t - 0.61234567)/0.001))", 0.95, 1 - math.exp(-1 + 0.61234567)),
    ],
)
def test_numbers_that_sympy_takes_out_of_exponentials(rate, at, exact):
    """No floating-point number is as small as exp(-1000)."""
    problem = ro.Problem.from_strings({"x": rate}, {"x": "0"}, {"a": (0.9, 1)}, (0, 1))
    solution = ro.solve(problem, 1e-4)
    assert solution.success
    assert solution(t=1, a=at)[0] == pytest.approx(exact, rel=5e-4)
