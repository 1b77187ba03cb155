"""Climbing comes to where it should."""

import numpy as np
import pytest

from rankone.solvers.verification.points import Climb, climbed

BOX = np.array([[0.0, 1.0], [2.0, 6.0]])


def hill(points):
    """Highest at (0.3, 6): inside in one direction, at the border in the other."""
    return points[:, 1] - 40 * (points[:, 0] - 0.3) ** 2


@pytest.mark.parametrize("patient", [False, True])
def test_climbers_come_to_the_top_of_the_box(patient):
    start = np.array([[0.9, 2.5], [0.1, 3.0], [0.5, 5.0]])
    climb = Climb(rounds=60, tries=16, first_step=0.25, shrinkage=0.8, patient=patient)
    points, heights = climbed(hill, start, hill(start), BOX, climb)
    np.testing.assert_allclose(points, np.tile([0.3, 6.0], (3, 1)), atol=1e-3)
    np.testing.assert_array_equal(heights, hill(points))


def test_climbers_never_go_down_and_stay_where_nothing_is_higher():
    start = np.array([[0.3, 6.0], [0.8, 2.0]])
    climb = Climb(rounds=3, tries=4, first_step=0.25, shrinkage=0.8)
    points, heights = climbed(hill, start, hill(start), BOX, climb)
    np.testing.assert_array_equal(points[0], start[0])
    assert heights[1] >= hill(start)[1]
