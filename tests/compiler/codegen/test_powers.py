"""Whole powers are written by squares, which NumPy makes by products."""

import numpy as np
import pytest
import sympy as sp

from rankone.compiler.codegen.printer import numpy_text

x, y = sp.symbols("x y", positive=True)
NAMES = {x: "x", y: "y"}


@pytest.mark.parametrize(
    ("expression", "text"),
    [
        (x**2, "x**2"),
        (x**3, "x**2 * x"),
        (x**4, "(x**2)**2"),
        (x**7, "(x**2 * x)**2 * x"),
        (x**9, "x**9"),
        (y / x**3, "y / (x**2 * x)"),
        (x**-3, "1 / (x**2 * x)"),
        (-(x**3), "-x**2 * x"),
        (y - x**3, "y - x**2 * x"),
        ((x + y) ** 3, "(x + y) ** 3"),  # nothing is computed twice
        ((x + y) ** 4, "((x + y) ** 2)**2"),
        ((x**3 + 1) ** sp.Rational(1, 2), "np.sqrt(x**2 * x + 1)"),
        (sp.Pow(sp.Symbol("z") ** 3, y, evaluate=False), "(z**2 * z)**y"),
    ],
)
def test_text(expression, text):
    written = numpy_text(expression, {**NAMES, sp.Symbol("z"): "z"})
    assert written.replace(" ** ", "**") == text.replace(" ** ", "**")


@pytest.mark.parametrize("degree", range(-9, 10))
@pytest.mark.parametrize("around", ["{}", "2 / (3 * {})", "-{} / {}", "{} - y * {}", "y**3 / {}"])
def test_value(around, degree):
    power = f"(x**({degree}))"
    expression = sp.sympify(around.format(power, power), {"x": x, "y": y})
    values = {"np": np, "x": np.linspace(0.5, 2.0, 40), "y": np.linspace(0.3, 3.0, 40)}
    computed = eval(numpy_text(expression, NAMES), values)
    np.testing.assert_allclose(
        computed, sp.lambdify((x, y), expression)(values["x"], values["y"]), rtol=1e-14, atol=1e-14
    )
