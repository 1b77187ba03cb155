"""Accuracy of the reference problems against independent trajectories."""

from __future__ import annotations

import numpy as np
import pytest

import rankone as ro
from examples import kirchhoff
from tests.problems import EXAMPLES
from tests.reference.measure import measured_errors
from tests.reference.systems import INDEPENDENT

SMOOTH = ("decay", "linear", "free_fall", "coupled", "lotka_volterra")
BARS = [(name, rtol) for name in SMOOTH for rtol in (1e-3, 1e-6, 1e-8)] + [
    ("kirchhoff", 1e-4),
    ("kirchhoff_long", 1e-3),
    ("robertson", 1e-4),
    ("chain", 1e-3),
    ("chain", 1e-4),
]


def _problem(name: str) -> ro.Problem:
    return kirchhoff.motion(3) if name == "kirchhoff_long" else EXAMPLES[name].problem


@pytest.mark.parametrize(("name", "rtol"), BARS)
def test_error_is_within_the_tolerance(name, rtol):
    solution = ro.solve(_problem(name), rtol=rtol)
    errors = measured_errors(solution, INDEPENDENT[name])
    assert solution.success, solution.message
    assert np.all(errors <= 5.0 * rtol), errors


@pytest.mark.parametrize("rtol", [1e-3, 1e-6, 1e-8])
def test_a_solution_of_one_product_is_exact(rtol):
    solution = ro.solve(EXAMPLES["linear"].problem, rtol=rtol)
    assert solution.rank <= 2
    assert measured_errors(solution, INDEPENDENT["linear"]).max() <= 1e-12
