"""The generated module as a whole: tables, golden files, determinism, names."""

from __future__ import annotations

import ast
import subprocess
import sys
import traceback
from pathlib import Path

import numpy as np
import pytest
import sympy as sp

from rankone.compiler.codegen.kernels import plain_product
from rankone.compiler.codegen.layout import load_module
from rankone.compiler.codegen.module import generate_source
from rankone.compiler.codegen.printer import factor_text
from rankone.support.errors import OptionError
from tests.compiler.codegen.interpreter import Interpreter
from tests.compiler.codegen.systems import (
    REFERENCE,
    Separated,
    driven,
    lotka_volterra,
    separated,
    t,
)

ROOT = Path(__file__).parents[3]
GOLDEN = ROOT / "tests" / "golden"
HEAD = ("decay", "lotka_volterra", "driven", "kirchhoff")


@pytest.mark.parametrize("name", HEAD)
def test_golden(name: str, request: pytest.FixtureRequest) -> None:
    """The text is as it was, and the file as it stands runs."""
    form = REFERENCE[name]()
    path = GOLDEN / f"{name}.py"
    source = generate_source(form)
    if request.config.getoption("--update-golden"):
        path.write_text(source)
    assert path.read_text() == source, "if the change is meant: pytest --update-golden"
    system = load_module(path.read_text(), name)
    rng = np.random.default_rng(0)
    u = rng.uniform(size=(system.n_differential, 4))
    p = rng.uniform(1, 2, (len(system.parameters), 4))
    np.testing.assert_allclose(system.rhs(0.3, u, p), Interpreter(form).rhs(0.3, u, p), 1e-12)


def test_tables() -> None:
    system = load_module(generate_source(driven()), "driven")
    assert system.states == ("x", "y", "w0")
    assert system.n_differential == 2
    assert system.products == ((0, 0),)
    assert system.parameters == ("lambda", "x_{0}")
    assert system.horizon == (0.0, 2.0)
    assert system.box == ((1.0, 2.0), (0.0, 1.0))
    assert system.kernels.signatures == ((0, 0), (1, 0), (2, 0))
    assert system.initial_terms == ((1.0, 0, (0, 1)), (1.0, 1, (0, 0)))
    assert [kernel is None for kernel in system.kernels.constant] == [False, True, True]


@pytest.mark.parametrize("name", REFERENCE)
def test_factors(name: str) -> None:
    form = REFERENCE[name]()
    system, oracle = load_module(generate_source(form), name), Interpreter(form)
    at = np.linspace(0.1, 1.0, 5)
    for dimension, factors in enumerate(form.factors):
        rows = [oracle.factor(dimension, row, at) for row in range(len(factors))]
        if dimension:
            found = system.parameter_factors(dimension - 1, at)
        else:
            found = system.time_factors(at)
        assert found.dtype == np.float64
        np.testing.assert_allclose(found, rows, 1e-14)


@pytest.mark.parametrize("name", REFERENCE)
def test_lines_are_short_and_numpy_is_the_only_import(name: str) -> None:
    source = generate_source(REFERENCE[name]())
    assert max(map(len, source.splitlines())) <= 100
    imports = [node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.Import)]
    assert [alias.name for node in imports for alias in node.names] == ["numpy"]
    assert "from " not in source


def test_the_text_is_formatted_and_clean(tmp_path: Path) -> None:
    pytest.importorskip("ruff")
    for name, make in REFERENCE.items():
        (tmp_path / f"{name}.py").write_text(generate_source(make()))
    configured = ["--config", str(ROOT / "pyproject.toml"), "--no-cache", str(tmp_path)]
    for command in (["check"], ["format", "--diff"]):
        run = subprocess.run(
            [sys.executable, "-m", "ruff", *command, *configured], capture_output=True, text=True
        )
        assert run.returncode == 0, run.stdout + run.stderr


def test_long_sums_and_tables_are_wrapped() -> None:
    states = [f"a_rather_long_name_{c}" for c in range(30)]
    rhs: dict[str, list[Separated]] = {
        a: [(0.1 * (c + 1), {}, [a, b]) for c, b in enumerate(states)] for a in states
    }
    source = generate_source(separated(rhs))
    assert max(map(len, source.splitlines())) <= 100
    u = np.random.default_rng(0).normal(size=30)
    expected = u * (0.1 * np.arange(1, 31) @ u)
    np.testing.assert_allclose(load_module(source, "long").rhs(0.0, u, ()), expected, 1e-12)


def test_names_of_the_generator_are_free_for_the_user() -> None:
    """States and parameters called like arguments, locals and modules of the generated code."""
    labels = ["u", "p", "np", "out", "shape", "t_1", "c0", "w0", "x", "phi", "rhs", "class", "_"]
    parameters = sp.symbols("p u x q np c1 c0 len w0 k' factors \\alpha")
    form = separated(
        {
            a: [(2.0, {q: q, t: sp.sin(t)}, [a, b, b]), (1.0, {q: sp.exp(q)}, [a, b, b])]
            for a, b, q in zip(labels, labels[::-1], [*parameters, parameters[0]], strict=True)
        },
        dict.fromkeys(parameters, (0.0, 1.0)),
    )
    system, oracle = load_module(generate_source(form), "names"), Interpreter(form)
    assert tuple(symbol.name for symbol in parameters) == system.parameters
    assert len(set(system.states)) == len(system.states)
    rng = np.random.default_rng(0)
    u, p = rng.normal(size=(13, 3)), rng.uniform(size=(12, 3))
    np.testing.assert_allclose(system.rhs(0.3, u, p), oracle.rhs(0.3, u, p), 1e-12)
    np.testing.assert_allclose(system.jacobian(0.3, u, p), oracle.jacobian(0.3, u, p), 1e-12)
    assert system.quadratic_jacobian(0.3, system.with_products(u), p).shape[2:] == (3,)
    for j in range(12):
        system.parameter_factors(j, p[j])


def test_a_system_without_parameters_and_equations_without_terms() -> None:
    system = load_module(generate_source(REFERENCE["constant_and_zero"]()), "zero")
    assert system.parameters == ()
    assert system.box == ()
    assert system.kernels.signatures == ((),)
    np.testing.assert_array_equal(system.rhs(0.0, [2.0, 0.0, 0.0], ()), [0.0, 2.5, -2.0])
    still = load_module(generate_source(separated({"x": []})), "still")
    assert (still.kernels.signatures, still.kernels.paired, still.kernels.linear) == ((), (), ())
    np.testing.assert_array_equal(still.rhs(0.0, np.ones((1, 3)), ()), np.zeros((1, 3)))


def test_titles_and_names_with_quotes_and_backslashes() -> None:
    form = separated({"x": [(1.0, {}, ["x"])]}, {sp.Symbol('\\"""q'): (0.0, 1.0)})
    source = generate_source(form, title='Ends in "')
    system = load_module(source, "quotes")
    assert system.parameters == ('\\"""q',)
    assert (ast.get_docstring(ast.parse(source)) or "").startswith('Ends in "')


def test_tracebacks_show_the_generated_line() -> None:
    system = load_module(generate_source(lotka_volterra()), "traced")
    with pytest.raises(ValueError, match="unpack") as caught:
        system.rhs(0.0, np.ones(3), (1.0, 1.0))
    assert "x, y = u" in "".join(traceback.format_exception(caught.value))
    assert "traced" not in sys.modules


def test_products_are_written_as_quotients():
    assert plain_product("1", ["cos(t)", "1/m"]) == "cos(t)/m"
    assert plain_product("10", ["1/k"]) == "10/k"
    assert plain_product("1", ["1/k"]) == "1/k"
    assert plain_product("1", ["1/k", "x", "1/(2*m)", "(k/3)"]) == "x*(k/3)/(k*(2*m))"
    assert plain_product("1", ["(1 + k)", "x"]) == "(1 + k)*x"
    assert plain_product("1", []) == "1"
    k, m = sp.symbols("k m")
    texts = [factor_text(e) for e in (1 / k, 1 / (k * m), k / m, 1 + k, 1 / k + m)]
    assert texts == ["1/k", "1/(k*m)", "(k/m)", "(k + 1)", "(m + 1/k)"]


@pytest.mark.parametrize("name", ["rhs", "INITIAL", "TERMS", "KERNELS", "TIME"])
def test_a_module_without_a_name_that_every_system_has_is_refused(name):
    source = generate_source(lotka_volterra()).replace(f"{name} = ", "other = ")
    source = source.replace(f"def {name}(", "def other(")
    with pytest.raises(OptionError, match=f"defines no `?{name}`?"):
        load_module(source, "incomplete")
