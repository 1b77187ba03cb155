"""Every stage of the pipeline is printed, and each is computed from the one before."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import pytest
import sympy as sp

import rankone as ro
from rankone.compiler.codegen.module import generate_source
from rankone.compiler.codegen.sums import quadratic_system
from rankone.compiler.passes import first_order, separate, weak_form
from rankone.problem.expressions.notation import exact
from tests.problems import REFERENCE

GOLDEN = Path(__file__).parents[1] / "golden" / "stages"
STAGES = ("first_order", "weak_form", "separated", "quadratic", "source")


@pytest.mark.parametrize("name", REFERENCE)
def test_golden(name: str, request: pytest.FixtureRequest) -> None:
    compiled = ro.compile(REFERENCE[name]())
    text = "\n".join(f"# {stage}\n\n{getattr(compiled, stage)}\n" for stage in STAGES)
    path = GOLDEN / f"{name}.txt"
    if request.config.getoption("--update-golden"):
        path.parent.mkdir(exist_ok=True)
        path.write_text(text)
    assert path.read_text() == text, "if the change is meant: pytest --update-golden"


def test_a_change_of_one_stage_arrives_in_the_next() -> None:
    compiled = ro.compile(REFERENCE["decay"]())
    k = compiled.first_order.coordinates[1].symbol
    (u,) = compiled.first_order.functions

    system = replace(compiled.first_order, rhs=(-3 * k * u,))
    (residual,) = weak_form(system).residuals
    assert residual == u.diff(compiled.first_order.coordinates[0].symbol) + 3 * k * u

    weak = replace(compiled.weak_form, residuals=(residual + sp.Rational(1, 7),))
    assert [term.coefficient for term in separate(weak).terms] == [1, Fraction(1, 7), 3]

    derivative, rest = compiled.separated.terms
    form = replace(compiled.separated, terms=(derivative, replace(rest, coefficient=Fraction(5))))
    assert [term.coefficient for term in quadratic_system(form).rhs] == [-5]

    (group,) = compiled.quadratic.groups
    doubled = replace(group, linear=(replace(group.linear[0], coefficient=Fraction(-2)),))
    assert "y[0] = -2.0 * x[0]" in generate_source(replace(compiled.quadratic, groups=(doubled,)))


def test_the_public_functions_start_anywhere() -> None:
    problem = REFERENCE["lotka_volterra"]()
    assert ro.weak_form(problem) == weak_form(first_order(problem))
    assert ro.separate(problem) == separate(weak_form(problem))
    form = ro.separate(problem)
    assert ro.generate_source(form) == ro.generate_source(quadratic_system(form))


@pytest.mark.parametrize(
    ("function", "message"),
    [
        (ro.compile, "compile needs a Problem, not {}; remedy: build one"),
        (ro.solve, "compile needs a Problem, not {}; remedy: build one"),
        (ro.first_order, "first_order needs a Problem, not {}; remedy: build one"),
        (ro.weak_form, "weak_form needs a FirstOrderSystem or a Problem, not {}; remedy: give a"),
        (ro.separate, "separate needs a WeakForm or a Problem, not {}; remedy: give a problem or"),
        (ro.quadratic_system, "quadratic_system needs a SeparatedForm, not {}; remedy: give sep"),
        (ro.generate_source, "generate_source needs a QuadraticSystem or a SeparatedForm, not {};"),
    ],
)
def test_anything_else_is_refused(function: Callable[[object], object], message: str) -> None:
    for wrong in (None, 3, "x' = -x", GOLDEN):
        with pytest.raises(ro.OptionError, match=re.escape(message.format(type(wrong).__name__))):
            function(wrong)


def test_a_stage_of_another_place_is_refused() -> None:
    compiled = ro.compile(REFERENCE["decay"]())
    with pytest.raises(ro.OptionError, match=r"compiled already; call its \.solve"):
        ro.solve(compiled)  # type: ignore[arg-type]
    with pytest.raises(ro.OptionError, match=r"not CompiledProblem; .* has `\.separated`"):
        ro.quadratic_system(compiled)  # type: ignore[arg-type]
    with pytest.raises(ro.OptionError, match="load_module needs a str, not QuadraticSystem"):
        ro.load_module(compiled.quadratic, "decay")  # type: ignore[arg-type]
    with pytest.raises(ro.OptionError, match="load_module needs a str, not int"):
        ro.load_module(compiled.source, 3)  # type: ignore[arg-type]


def test_rationals_stay_exact() -> None:
    x = sp.Function("x")(sp.Symbol("t"))
    t, k = sp.symbols("t k")
    equation = sp.Eq(3 * x.diff(t), k * x + 0.1 * x + 0.2 * x + sp.sqrt(2))
    compiled = ro.compile(ro.Problem([equation], (t, 0, 1), {k: (1, 2)}, {x: 1}))
    coefficients = {term.coefficient for term in compiled.quadratic.rhs}
    assert {Fraction(1, 3), Fraction(1, 10)} <= coefficients  # 0.1 + 0.2 is 0.3, over 3
    assert "1/3*k*x" in compiled.source
    assert "1 / 3" in compiled.source


@pytest.mark.parametrize(
    ("number", "wanted"),
    [(0.1 + 0.2, "3/10"), (0.6 - 0.9, "-3/10"), (1 / 3, "3333333333333333/10000000000000000")],
)
def test_decimal_numbers_mean_what_they_say(number: float, wanted: str) -> None:
    assert exact(sp.Float(number)) == sp.Rational(wanted)
