"""Frequencies of leading eigenvalues, apart from rounding."""

import numpy as np
import pytest
import scipy.linalg
import scipy.stats

from rankone.trajectories.bifurcations import frequency_of


def turned(*blocks):
    """A block diagonal matrix in 30 other coordinates."""
    matrix = scipy.linalg.block_diag(*blocks)
    turns = scipy.stats.ortho_group.rvs(len(matrix), 30, np.random.default_rng(1))
    return [turn @ matrix @ turn.T for turn in turns]


@pytest.mark.parametrize("coupling", [1e-3, 1.0, 1e3])
def test_a_double_zero_is_no_pair(coupling):
    matrices = turned([[0.0, coupling], [0.0, 0.0]], -1.0, -30.0)
    assert any(np.abs(np.linalg.eigvals(each).imag).max() > 0.0 for each in matrices)
    assert [frequency_of(each) for each in matrices] == [0.0] * len(matrices)


@pytest.mark.parametrize("fast", [1.0, 1e3, 1e9])
def test_a_slow_pair_beside_fast_rates_is_one(fast):
    for each in turned([[0.0, 1.0], [-1.0, 0.0]], -fast):
        assert frequency_of(each) == pytest.approx(1.0, rel=1e-5)
