"""Rates and exact solutions: what the discretisation promises, and no more."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from tests.problems import REFERENCE
from tests.solvers.engines.greedy_support import l2_error, solve


def rates(name: str, nodes: tuple[int, ...], **options: Any) -> list[float]:
    """Observed orders in L2 over time and the parameter."""
    exact = {
        "decay": lambda t, k: np.exp(-k * t),
        "linear": lambda t, k: (10 / k - 1) * t,
    }[name]
    problem = REFERENCE[name]()
    box = np.array({"decay": (0.5, 5.0), "linear": (1.0, 10.0)}[name])
    errors = [
        l2_error(
            solve(problem, 1e-5, 0, time_nodes=n, parameter_nodes=n, **options),
            exact,
            box,
        )
        for n in nodes
    ]
    return [float(np.log2(a / b)) for a, b in pairwise(errors)]


@pytest.mark.slow
def test_the_slides_choice_has_order_two_on_decay() -> None:
    """Linear elements, Galerkin on u' + k u = 0, amplitudes alone: limited by the elements."""
    orders = rates("decay", (11, 21, 41), preset="slides")
    assert orders == pytest.approx([2.0, 2.0], abs=0.2)


@pytest.mark.slow
def test_the_slides_choice_has_order_two_on_the_linear_problem() -> None:
    """Asymptotic only where the elements resolve 10/k at k = 1."""
    assert rates("linear", (41, 81, 161), preset="slides") == pytest.approx([2.0, 2.0], abs=0.2)


@pytest.mark.parametrize(
    "choice",
    [{"formulation": "volterra"}, {"projection": "minimal-residual", "formulation": "derivative"}],
    ids=["volterra", "minimal residual"],
)
def test_quadratic_elements_have_order_three(choice: dict[str, Any]) -> None:
    orders = rates("decay", (21, 41, 81), elements="quadratic", **choice)
    assert orders == pytest.approx([3.0, 3.0], abs=0.2)


def test_quadratic_elements_lose_an_order_with_galerkin_on_the_derivative() -> None:
    """Continuous elements of even order are suboptimal for u' tested with the shape functions."""
    orders = rates("decay", (21, 41, 81), elements="quadratic", formulation="derivative")
    assert orders == pytest.approx([2.0, 2.0], abs=0.1)


def plain_galerkin_error(elements: int, k: float = 2.0, end: float = 2.0) -> float:
    """L2 error of an ordinary Galerkin solve of u' + k u = 0 at one k, quadratic elements."""
    x, weights = np.polynomial.legendre.leggauss(6)
    h = end / elements
    phi = np.array([x * (x - 1) / 2, 1 - x**2, x * (x + 1) / 2])
    slope = np.array([x - 0.5, -2 * x, x + 0.5]) * 2 / h
    local = (phi * weights * h / 2) @ (slope + k * phi).T
    matrix = np.zeros((2 * elements + 1, 2 * elements + 1))
    for first in range(0, 2 * elements, 2):
        matrix[first : first + 3, first : first + 3] += local
    u = np.concatenate([[1.0], np.linalg.solve(matrix[1:, 1:], -matrix[1:, 0])])
    squared = 0.0
    for e in range(elements):
        exact = np.exp(-k * h * (e + (x + 1) / 2))
        squared += np.sum(weights * h / 2 * (u[2 * e : 2 * e + 3] @ phi - exact) ** 2)
    return float(np.sqrt(squared))


def test_the_lost_order_is_that_of_an_ordinary_solve() -> None:
    """Without any separation, at a single k, the same elements and test functions have order 2."""
    errors = [plain_galerkin_error(elements) for elements in (10, 20, 40)]
    orders = [float(np.log2(a / b)) for a, b in pairwise(errors)]
    assert orders == pytest.approx([2.0, 2.0], abs=0.05)


def test_quadratic_elements_have_order_three_on_the_linear_problem() -> None:
    orders = rates("linear", (81, 161), preset="slides", elements="quadratic")
    assert orders == pytest.approx([3.0], abs=0.2)


@pytest.mark.parametrize("name", [pytest.param("decay", marks=pytest.mark.slow), "linear"])
def test_the_slides_algorithm_on_legendre_elements_reaches_1e_8(name: str) -> None:
    nodes = {"decay": (20, 20), "linear": (4, 40)}[name]
    outcome = solve(
        REFERENCE[name](),
        1e-8,
        preset="slides",
        elements="legendre",
        time_nodes=nodes[0],
        parameter_nodes=nodes[1],
        max_modes=300,
    )
    assert outcome.measured is not None
    assert max(outcome.measured.interior) <= 1e-8


@pytest.mark.parametrize("options", [{}, {"preset": "slides", "elements": "legendre"}], ids=str)
def test_the_linear_problem_is_found_in_at_most_two_modes(options: dict[str, Any]) -> None:
    outcome = solve(REFERENCE["linear"](), 1e-8, **options)
    assert outcome.history[-1].ranks[0] <= 2
    assert outcome.measured is not None
    assert max(outcome.measured.interior) < 1e-11
