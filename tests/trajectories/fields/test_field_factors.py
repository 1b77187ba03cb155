"""Solves with the matrices of implicit steps."""

import functools

import numpy as np
import pytest
import scipy.sparse as ss

from rankone.trajectories.fields.field_factors import Factorisation


def step_matrix(cells, dimensions, step, wind=0.0):
    """1 - h L on a line, square or cube of cells, with a flow along its first side."""
    ones = np.ones(cells)
    line = ss.diags_array([ones[1:], -2.0 * ones, ones[1:]], offsets=(-1, 0, 1)) * cells**2
    first = ss.diags_array([-ones[1:], ones[1:]], offsets=(-1, 1)) * cells
    one = ss.eye_array(cells)
    total = 0
    for along in range(dimensions):
        factors = [one] * dimensions
        factors[along] = line + wind * first if along == 0 else line
        total = total + functools.reduce(ss.kron, factors)
    return ss.csc_array(ss.eye_array(cells**dimensions) - step * total)


def residual(matrix, factors):
    right = 1e-20 * np.random.default_rng(0).standard_normal(matrix.shape[0])
    solution = factors.solve(right)
    return np.linalg.norm(matrix @ solution - right) / np.linalg.norm(right)


@pytest.mark.parametrize(("cells", "dimensions", "iterates"), [(100, 2, False), (14, 3, True)])
@pytest.mark.parametrize("step", [1e-6, 1e-3, 1.0])
@pytest.mark.parametrize("wind", [0.0, 100.0])
def test_solutions_are_accurate(cells, dimensions, iterates, step, wind):
    matrix = step_matrix(cells, dimensions, step, wind)
    factorisation = Factorisation()
    factors = factorisation.of(matrix)
    assert residual(matrix, factors) < 1e-8
    assert (type(factors).__name__ == "_DiagonalFactors") == iterates


def test_exact_factors_are_made_where_an_iteration_does_not_converge():
    n = 3000
    coupled = ss.random_array((n, n), density=2.0 / n, rng=np.random.default_rng(0))
    turned = ss.diags_array([np.ones(n - 1), np.ones(1)], offsets=(1, 1 - n))
    matrix = ss.csc_array(turned + 2.0 * coupled)
    factorisation = Factorisation()
    assert residual(matrix, factorisation.of(matrix)) < 1e-6
    assert type(factorisation.of(matrix)).__name__ == "_OrderedFactors"
