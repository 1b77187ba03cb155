"""Equations of SymPy, read into a table of terms: the same as without one."""

import numpy as np
import pytest
import scipy.sparse
import sympy as sp

import rankone as ro
from rankone.compiler.agreement import DisagreementError, check_table
from rankone.problem.algebra import tabulated as tabulated_equations
from rankone.problem.algebra.term_table import FEWEST_TABULATED

T, K, C = sp.symbols("t k c")
N = FEWEST_TABULATED
X = [sp.Function(f"x{i}")(T) for i in range(N)]
BOX = {K: (0.5, 1.5), C: (1, 2)}
A, B = X[:2]


def problem_of(rates, **further):
    """Two rates; the other states decay."""
    rates = [*rates, *(-x for x in X[len(rates) :])]
    equations = [sp.Eq(x.diff(T), rate, evaluate=False) for x, rate in zip(X, rates, strict=True)]
    arguments = {"initial": {x: sp.Rational(i + 1, 100) for i, x in enumerate(X)}} | further
    return ro.Problem(equations, (T, 0, 1), BOX, **arguments)


def without_table(rates, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(tabulated_equations, "FEWEST_TABULATED", N + 1)
        return problem_of(rates)


@pytest.mark.parametrize(
    "rates",
    [
        [-K * A * B + C * sp.cos(T) - 2.5 * A**3 / 3, K * (A - B) + sp.exp(-K) * C * B],
        [A**2 * B * (K + C) / (C * K), sp.pi * A - sp.sqrt(2) * B],
    ],
)
def test_products_compile_to_the_same_source(rates, monkeypatch):
    table, expressions = problem_of(rates), without_table(rates, monkeypatch)
    assert table.table is not None
    assert expressions.table is None
    assert ro.compile(table).source == ro.compile(expressions).source
    assert table == expressions


@pytest.mark.parametrize(
    "rates",
    [
        [C * A / (K + A) - 0.3 * B, A * B / ((K + A) * (sp.Rational(1, 3) + B))],
        [sp.tanh(A - 2 * B + K) / C, sp.exp(-C / (0.7 * A)) * B],
        [A ** sp.Symbol("k") / (1 + A**K), 1 / (1 + sp.exp((A - B) / 0.2)) - 1 / A**2],
        [sp.sqrt(A + C) - sp.log(1 + B), sp.erf(A) * sp.atan(B * sp.exp(-K * T))],
    ],
)
def test_laws_have_the_values_of_expressions(rates, monkeypatch):
    table = problem_of(rates)
    assert table.table is not None
    assert table.table.forms
    ours, theirs = ro.compile(table).system, ro.compile(without_table(rates, monkeypatch)).system
    generator = np.random.default_rng(3)
    u, p = generator.uniform(0.1, 1.0, (N, 5)), generator.uniform(1.0, 1.5, (2, 5))
    assert ours.rhs(0.4, u, p) == pytest.approx(theirs.rhs(0.4, u, p), rel=1e-13)
    assert ours.jacobian(0.4, u, p) == pytest.approx(theirs.jacobian(0.4, u, p), rel=1e-12)


@pytest.mark.parametrize(
    "rate",
    [
        sp.Abs(A) - B,
        sp.Piecewise((A, B > 0), (-A, True)),
        sp.Max(A, B),
        sp.Heaviside(T - K) * A,
        A.diff(T),
        ro.table([0, 1, 2], [0, 1, 0])(A),
    ],
)
def test_other_equations_are_left_to_the_general_way(rate):
    rates = [B, rate] if rate.has(sp.Derivative) else [rate, B]
    assert problem_of(rates).table is None


@pytest.mark.parametrize(
    ("rate", "message"),
    [
        (sp.Symbol("q") * A, "unknown symbol `q`"),
        (sp.I * A, "has complex coefficients"),
        (sp.Function("w")(T) * A, r"`w\(t\)` has no equation"),
        (A / (K - 1), "is not finite at k = 1"),
        (A.subs(T, T - 1), "takes the unknown at another time"),
    ],
)
def test_what_is_wrong_is_said_as_for_few_equations(rate, message):
    with pytest.raises(ro.ProblemError, match=f"equation 1: .*{message}"):
        ro.compile(problem_of([rate]))


def test_laws_of_reactions_are_read_as_such():
    ring = scipy.sparse.eye(N, k=-1) - scipy.sparse.eye(N)
    laws = [K * x / (C + x) for x in X]
    problem = ro.Problem.from_reactions(
        ring, laws, time=(T, 0, 1), parameters=BOX, initial=np.linspace(0.5, 1.5, N)
    )
    assert problem.table is not None
    assert len(problem.table.forms) == 1
    assert len(problem.table.values) == N
    u = np.linspace(0.1, 1.0, N)
    rates = 0.7 * u / (1.2 + u)
    expected = ring @ rates
    assert ro.compile(problem).system.rhs(0.0, u, [0.7, 1.2]) == pytest.approx(expected, rel=1e-13)


def test_tables_are_compared_with_the_equations():
    problem = problem_of([A / (K + A), B / (K + B)])
    other = problem_of([A / (K + A), B / (1.001 * K + B)])
    system = ro.compile(problem).system
    check_table(problem, problem.table, system)
    with pytest.raises(DisagreementError, match=r"rate of `x1\(t\)`"):
        check_table(problem, other.table, system)


def test_many_equations_are_shown_in_short():
    problem = problem_of([A / (K + A)])
    lines = repr(problem).splitlines()
    assert len(lines) < 25
    assert f"  ... {N - 16} more ..." in lines
    assert lines[1] == "  dx0/dt = x0/(k + x0)"
    assert f"x7(0) = 0.08, ... {N - 16} more ..., x{N - 8}(0)" in lines[-2]
    assert rf"\text{{ {N - 16} more}}" in problem._repr_latex_()
    text = ro.Problem.from_strings(
        {f"y{i}": f"-k*y{i}/(2 +  y{i})" for i in range(N)},
        {f"y{i}": 1 for i in range(N)},
        {"k": (1, 2)},
        (0, 1),
    )
    assert repr(text).splitlines()[1] == "  dy0/dt = -k*y0/(2 + y0)"


@pytest.mark.slow
def test_a_function_of_the_user_keeps_its_own_values():
    """It may have the name of a function of SymPy."""
    log = ro.function("log", np.log10, lambda v: 1 / (v * np.log(10)))
    t, k = sp.symbols("t k")
    states = [sp.Function(f"x{i}")(t) for i in range(FEWEST_TABULATED)]
    rates = [-k * x / (1 + y) for x, y in zip(states, states[1:] + states[:1], strict=True)]
    rates[1] += log(1 + states[1])
    equations = [sp.Eq(x.diff(t), rate) for x, rate in zip(states, rates, strict=True)]
    initial = dict.fromkeys(states, sp.Rational(1, 2))
    system = ro.compile(ro.Problem(equations, (t, 0, 1), {k: (0.5, 1.5)}, initial)).system
    at_half = system.rhs(0.0, np.full(len(states), 0.5), np.array([1.0]))
    assert at_half[1] == pytest.approx(-1 / 3 + np.log10(1.5), rel=1e-14)
