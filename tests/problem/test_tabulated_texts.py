"""Right-hand sides as text, read into a table of terms: the same as by expressions."""

import dataclasses

import numpy as np
import pytest

import rankone as ro
from rankone.compiler.agreement import DisagreementError, check_table
from rankone.problem import text
from rankone.support.arrays import Deferred

BOX = {"k": (0.5, 1.5), "c": (1, 2)}
RHS = {
    "x": "-k*x + c",
    "y": "k*(x - y) - 0.1*c*y*z + 2/3",
    "z": "-(x + 2*y)*z/c + sin(2*t)*exp(-c)*x - +z",
    "u": "(k + 1)*(x - 3*u) - 1.5e-3*u^3*v + pi*k",
    "v": "-k**2*x**2*y*u + (k*c + 1)/(2*c)*v - sqrt(k)*cos(1.5)*v + 7",
    "w": "0",
}


@pytest.fixture(autouse=True)
def of_few_states(monkeypatch):
    """Tables of few states as well."""
    monkeypatch.setattr(text, "FEWEST_TABULATED", 2)


def problem_of(rhs, **further):
    initial = {name: f"{i} + k" if i % 2 else 0.5 for i, name in enumerate(rhs)}
    return ro.Problem.from_strings(rhs, initial, BOX, (0, 1), **further)


def by_expressions(rhs, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(text, "FEWEST_TABULATED", 1000)
        return problem_of(rhs)


@pytest.mark.parametrize("inflow", ["0", "exp(-k*t)"])
def test_texts_compile_to_the_same_source_as_expressions(monkeypatch, inflow):
    rhs = RHS | {"w": inflow}
    table, expressions = ro.compile(problem_of(rhs)), ro.compile(by_expressions(rhs, monkeypatch))
    assert table.problem.table is not None
    assert expressions.problem.table is None
    assert table.source == expressions.source
    assert table.separated == expressions.separated
    assert table.problem == expressions.problem


def test_random_polynomials_are_the_same_as_expressions(monkeypatch):
    generator = np.random.default_rng(3)
    names = [f"x{i}" for i in range(6)]

    def product():
        factors = generator.choice([*names, "k", "c", "t", "0.37", "3", "(k - 2*c)"], 3)
        return generator.choice(["*", "/2/"]).join(factors) if "/" in factors else "*".join(factors)

    def text_of():
        a, b, c, d = (product() for _ in range(4))
        return f"-{a} + ({b} - 1.25*{c})*{generator.choice([*names, 'k'])} - {d}/k"

    rhs = {name: text_of() for name in names}
    table, expressions = problem_of(rhs), by_expressions(rhs, monkeypatch)
    assert table.table is not None
    assert ro.compile(table).source == ro.compile(expressions).source


def test_nothing_is_written_out_until_it_is_read(monkeypatch):
    def never(self):
        raise AssertionError("an expression was written")

    monkeypatch.setattr(Deferred, "_items", property(never))
    system = ro.compile(problem_of(RHS)).system
    assert np.isfinite(system.rhs(0.5, np.ones((6, 1)), np.ones((2, 1)))).all()


@pytest.mark.parametrize(
    "rate",
    [
        "(x - 310)*(y - 310)",
        "(x - 310)**2",
        "x/y",
        "x**0.5",
        "x**k",
        "sin(x)",
        "x*Abs(k - 1)",
        "x(t)",
        "max(k, c)*x",
        "Heaviside(t - k)*x",
    ],
)
def test_other_texts_are_read_as_expressions(rate):
    problem = problem_of({"x": rate, "y": "-y"})
    assert problem.table is None
    assert len(problem.residuals) == 2


@pytest.mark.parametrize(
    ("rate", "message"),
    [
        ("k*q", "unknown name `q`"),
        ("x/0", "division by zero"),
        ("k*x +", "is not a formula"),
        ("2x", "is not a formula"),
        ("k*x # + k", "is not a formula"),
        ("x + sin", "has no argument"),
        ("x + 1e999", "too large"),
        ("x < 1", "not understood"),
    ],
)
def test_what_is_wrong_is_said_as_for_few_states(rate, message):
    with pytest.raises(ro.ProblemError, match=message):
        problem_of({"x": rate, "y": "-y"})


def test_a_coefficient_beyond_all_floats_is_named():
    with pytest.raises(ro.ProblemError, match="is not a finite real number"):
        ro.compile(problem_of({"x": "1e308*1e308*x", "y": "-y"}))


@pytest.mark.parametrize(
    "further",
    [{"constants": {"g": 1}}, {"jumps": {0.5: {"x": "x + 1"}}}, {"equations": ["z_t = -z"]}],
)
def test_problems_with_more_than_rates_are_read_as_expressions(further):
    initial = {"x": 1, "y": 1} | ({"z": 1} if "equations" in further else {})
    rhs = {"x": "-k*x", "y": "-c*y"}
    assert ro.Problem.from_strings(rhs, initial, BOX, (0, 1), **further).table is None


def test_tables_are_compared_with_the_texts():
    problem = problem_of(RHS)
    system = ro.compile(problem).system
    check_table(problem, problem.table, system)
    texts = ("-k*x + 1.001*c", *problem.table.texts[1:])
    with pytest.raises(DisagreementError, match="rate of `x"):
        check_table(problem, dataclasses.replace(problem.table, texts=texts), system)
