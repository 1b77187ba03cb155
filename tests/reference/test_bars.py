"""Accuracy of the reference problems against independent trajectories.

At other tolerances than their own: with that, tests/examples solves each of them.
"""

from __future__ import annotations

import numpy as np
import pytest

import rankone as ro
from tests.problems import EXAMPLES
from tests.reference.measure import measured_errors
from tests.reference.systems import INDEPENDENT

SMOOTH = ("decay", "linear", "free_fall", "coupled", "lotka_volterra")
BARS = [*((name, rtol) for name in SMOOTH for rtol in (1e-3, 1e-8)), ("chain", 1e-3)]


@pytest.mark.parametrize(("name", "rtol"), BARS)
def test_error_is_within_the_tolerance(name, rtol):
    solution = ro.solve(EXAMPLES[name].problem, rtol=rtol)
    errors = measured_errors(solution, INDEPENDENT[name])
    assert solution.success, solution.message
    assert np.all(errors <= 5.0 * rtol), errors


@pytest.mark.parametrize("rtol", [1e-3, 1e-6, 1e-8])
def test_a_solution_of_one_product_is_exact(rtol):
    solution = ro.solve(EXAMPLES["linear"].problem, rtol=rtol)
    assert solution.rank <= 2
    assert measured_errors(solution, INDEPENDENT["linear"]).max() <= 1e-12
