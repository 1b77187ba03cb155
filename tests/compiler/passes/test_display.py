"""How a separated form is shown."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import sympy as sp

import rankone.problem.forms
import rankone.support.errors
from rankone.compiler.passes import separate
from rankone.problem.problem import Problem

t, k = sp.symbols("t k")
x = sp.Function("x")(t)


def test_text_table(reference):
    assert str(separate(reference["linear"]())) == "\n".join(
        [
            "Separated form: 1 equation, 3 terms, 2 dimensions, 1 factor (residual u' - f = 0)",
            "equation  coefficient  monomial  t  k",
            "u                   1  du/dt     1  1",
            "u                   1  1         1  1",
            "u                 -10  1         1  1/k",
        ]
    )


def test_initial_values_follow(reference):
    last = repr(separate(reference["lotka_volterra"]())).splitlines()[-1]
    assert last.split() == ["y(0)", "1", "1", "1", "1", "y0"]


def test_large_forms_fit_a_screen():
    rhs = sum(sp.Integer(i + 1) * t**i * k * x for i in range(100))
    form = separate(Problem([sp.Eq(x.diff(t), rhs)], (t, 0, 1), {k: (1, 2)}, {x: 1}))
    lines = str(form).splitlines()
    assert len(lines) == 43
    assert lines[22] == "... 62 more ..."


def test_html(reference):
    text = separate(reference["decay"]())._repr_html_()
    assert "<th>coefficient</th><th>monomial</th><th>t</th><th>k</th>" in text
    assert text.count("<tr>") == 1 + 3
    assert "u&#x27; - f" in text


def test_latex(reference):
    assert separate(reference["decay"]())._repr_latex_() == "\n".join(
        [
            r"$$\begin{aligned}",
            r"\frac{d}{d t} {u} + \left[k\right] {u} &= 0 \\",
            r"u \Big|_{t = 0} &= 1",
            r"\end{aligned}$$",
        ]
    )


@pytest.mark.parametrize("module", [rankone.support.errors, rankone.problem.forms])
def test_no_import_of_sympy_at_runtime(module):
    source = Path(module.__file__).read_text(encoding="utf-8")
    assert not re.search(r"^(import|from) (sympy|rankone\.compiler)", source, re.MULTILINE)
