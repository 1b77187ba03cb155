"""What an attempt with other nodes costs at least."""

import pytest

from rankone.solvers.engines.engine_options import AttemptCost


def ratio(before, after, ranks, trajectories):
    return AttemptCost(before, ranks, trajectories, 1.0 / 0.9).least(after)


def test_the_same_nodes_cost_the_same():
    assert ratio([20, 10], [20, 10], (30, 5), 400) == pytest.approx(1.0)


def test_nodes_of_the_first_bond_count_by_its_share():
    """Of 400 trajectories 20 x 5 are at the first bond."""
    assert ratio([20, 20], [40, 20], (30, 5), 400) == pytest.approx(0.25 * 2 + 0.75)
    assert ratio([20], [50], (8,), 20) == pytest.approx(2.5)


def test_ranks_of_a_front_grow_with_the_nodes_behind_it():
    assert ratio([50, 20], [50, 30], (9, 5), 250) == pytest.approx(1.0)
    assert ratio([50, 20], [50, 30], (9, 12), 600) == pytest.approx(1.5)
