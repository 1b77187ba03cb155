"""The weak form as the slides show it."""

from __future__ import annotations

import sympy as sp

from rankone.compiler.passes import weak_form


def test_text(reference):
    assert repr(weak_form(reference["decay"]())).splitlines() == [
        "∫_t ∫_k  u* (du/dt + k*u) dk dt = 0",
        "u(0) = 1",
    ]


def test_one_line_for_each_equation(reference):
    lines = str(weak_form(reference["lotka_volterra"]())).splitlines()
    assert lines == [
        "∫_t ∫_x0 ∫_y0  x* (dx/dt - x*(1.5 - y)) dy0 dx0 dt = 0",
        "∫_t ∫_x0 ∫_y0  y* (dy/dt + y*(3 - x)) dy0 dx0 dt = 0",
        "x(0) = x0",
        "y(0) = y0",
    ]


def test_latex(reference):
    assert weak_form(reference["decay"]())._repr_latex_() == (
        "$$\\begin{aligned}\n"
        r"\int_{t} \int_{k} {u}^{*} \left(\frac{d u}{d t} + k u\right) \, dk \, dt &= 0 \\"
        "\nu(0) &= 1"
        "\n\\end{aligned}$$"
    )


def test_integrands_are_residual_times_test_function(reference):
    problem = reference["linear"]()
    (integrand,) = weak_form(problem).integrands
    k = next(iter(problem.parameters))
    (u,) = problem.unknowns
    assert sp.expand(integrand - sp.Symbol("u*") * (u.diff(problem.time[0]) + 1 - 10 / k)) == 0
