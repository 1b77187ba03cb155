"""Generated pointwise functions against the interpreter and finite differences."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import sympy as sp
from hypothesis import given, settings
from hypothesis import strategies as st

from rankone.compiler.codegen.layout import load_module
from rankone.compiler.codegen.module import generate_source
from rankone.compiler.codegen.pointwise import PointwiseFunction, PointwiseWriter
from rankone.compiler.codegen.rates import SeparatedWriter
from rankone.compiler.codegen.sums import quadratic_system
from rankone.problem.forms import Coordinate, SeparatedForm, State
from rankone.support.arrays import Array
from rankone.trajectories.system.system import System
from tests.compiler.codegen.interpreter import Interpreter
from tests.compiler.codegen.strategies import forms
from tests.compiler.codegen.systems import REFERENCE, driven, lotka_volterra, separated

RTOL = 1e-11


def load(form: SeparatedForm) -> System:
    return load_module(generate_source(form), "generated")


def points(system: System, seed: int, *shape: int) -> tuple[Array, Array, Array]:
    rng = np.random.default_rng(seed)
    t = rng.uniform(0.1, 1.0, shape)
    u = rng.uniform(-1.5, 1.5, (system.n_differential, *shape))
    p = rng.uniform(0.5, 2.0, (len(system.parameters), *shape))
    return t, u, p


@given(form=forms(), seed=st.integers(0, 2**32 - 1))
@settings(max_examples=40)
def test_rhs_and_jacobian_equal_the_interpreted_form(form: SeparatedForm, seed: int) -> None:
    system, oracle = load(form), Interpreter(form)
    t, u, p = points(system, seed, 5)
    np.testing.assert_allclose(system.rhs(t, u, p), oracle.rhs(t, u, p), RTOL, 1e-12)
    np.testing.assert_allclose(system.jacobian(t, u, p), oracle.jacobian(t, u, p), RTOL, 1e-12)


@given(form=forms(), seed=st.integers(0, 2**32 - 1))
@settings(max_examples=20)
def test_jacobians_are_the_derivatives_of_what_they_belong_to(
    form: SeparatedForm, seed: int
) -> None:
    system = load(form)
    t, u, p = points(system, seed)
    step = 1e-6
    differences = [
        (system.rhs(t, u + step * e, p) - system.rhs(t, u - step * e, p)) / (2 * step)
        for e in np.eye(len(u))
    ]
    np.testing.assert_allclose(system.jacobian(t, u, p), np.transpose(differences), 1e-5, 1e-6)


@given(form=forms(), seed=st.integers(0, 2**32 - 1))
@settings(max_examples=20)
def test_quadratic_jacobian_reduces_to_the_jacobian(form: SeparatedForm, seed: int) -> None:
    """Eliminating the products by their own rows leaves df/du."""
    system = load(form)
    t, u, p = points(system, seed)
    n = system.n_differential
    full = system.quadratic_jacobian(t, system.with_products(u), p)
    slaved = np.linalg.solve(-full[n:, n:], full[n:, :n])  # dw/du
    reduced = full[:n, :n] + full[:n, n:] @ slaved
    np.testing.assert_allclose(reduced, system.jacobian(t, u, p), 1e-9, 1e-10)


@given(form=forms(), seed=st.integers(0, 2**32 - 1))
@settings(max_examples=20)
def test_lift_appends_the_products(form: SeparatedForm, seed: int) -> None:
    system = load(form)
    _, u, _ = points(system, seed, 3)
    x = system.with_products(u)
    assert x.shape == (len(system.states), 3)
    np.testing.assert_array_equal(x[: len(u)], u)
    for k, (a, b) in enumerate(system.products, start=len(u)):
        np.testing.assert_array_equal(x[k], x[a] * x[b])


@pytest.mark.parametrize("name", REFERENCE)
def test_arguments_broadcast(name: str) -> None:
    form = REFERENCE[name]()
    system, oracle = load(form), Interpreter(form)
    rng = np.random.default_rng(0)
    n, d = system.n_differential, len(system.parameters)
    u, p = rng.uniform(0.5, 1, (n, 4, 1)), rng.uniform(0.5, 1, (d, 3))
    t = rng.uniform(size=(2, 1, 1))
    np.testing.assert_allclose(system.rhs(t, u, p), oracle.rhs(t, u, p), RTOL)
    np.testing.assert_allclose(system.jacobian(t, u, p), oracle.jacobian(t, u, p), RTOL)
    scalar = system.rhs(0.5, [*u[:, 0, 0]], tuple(p[:, 0]))
    assert scalar.shape == (n,)
    np.testing.assert_allclose(scalar, oracle.rhs(0.5, u[:, 0, 0], p[:, 0]), RTOL)


def test_lift_copies() -> None:
    u = np.ones(2)
    load(lotka_volterra()).with_products(u)[0] = 2.0
    assert u[0] == 1.0


def test_factors_taken_out_and_products_shared() -> None:
    source = generate_source(driven())
    assert "out[0] = t_1 * (0.5 * y + 0.25) - lambda_1 * x * x * x" in source
    assert "c0 = lambda_ * x" in source


def test_more_arguments_than_numpy_broadcasts_at_once() -> None:
    states = [f"s{c}" for c in range(70)]
    form = separated({state: [(1.0 + c, {}, [state])] for c, state in enumerate(states)})
    np.testing.assert_array_equal(load(form).rhs(0.0, np.ones(70), ()), 1.0 + np.arange(70))


class ScalarPrinter:
    """Writes functions of one point with the module math: another language than NumPy's."""

    reserved = ("math", "t", "u", "p")

    def expressions(self, expressions, names, temporaries):
        local = {symbol: sp.Symbol(name) for symbol, name in names.items()}
        return [], [sp.pycode(expression.xreplace(local)) for expression in expressions]

    def function(self, function: PointwiseFunction) -> list[str]:
        (block,) = function.statements
        lines = [f"def {function.name}({', '.join(function.arguments)}):"]
        for names, argument in ((function.parameters, "p"), (function.states, "u")):
            lines += [
                f"    {name} = {argument}[{k}]" for k, name in enumerate(names) if name != "_"
            ]
        lines += [f"    {name} = {text}" for name, text in block.intermediate]
        entries = ", ".join(f"{entry.index}: {' '.join(entry.terms)}" for entry in block.entries)
        return [*lines, f"    return {{{entries}}}"]


def test_what_occurs_often_is_written_over_real_symbols_once() -> None:
    t, f = sp.Symbol("t"), sp.Function("f")
    x = sp.Function("x")(t)
    writer = PointwiseWriter([Coordinate("t", t, 0.0, 1.0)], [State("x", x)])
    expression, expected = x, sp.Symbol("x", real=True)
    for _ in range(24):
        expression, expected = f(expression, expression), f(expected, expected)
    assert writer.real(expression) == expected


def test_another_printer_writes_the_same_rates() -> None:
    form = driven()
    writer = SeparatedWriter(quadratic_system(form), ScalarPrinter())
    names: dict[str, Any] = {"math": math}
    exec("\n".join(writer.rhs(2)), names)
    rates = names["rhs"](0.3, [0.5, 1.5], [1.2, 0.7])
    expected = Interpreter(form).rhs(0.3, np.array([0.5, 1.5]), np.array([1.2, 0.7]))
    np.testing.assert_allclose([rates[(0,)], rates[(1,)]], expected, RTOL)
