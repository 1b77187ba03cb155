"""How a part of a box is told in which events come in one order."""

import numpy as np
import pytest

from rankone.solvers.remedies import narrowing_text


@pytest.mark.parametrize(
    ("whole", "part", "said"),
    [
        ((1000.2, 1000.9), (1000.2312, 1000.8871), "[1000.24, 1000.88]"),
        ((270, 290), (275.41, 281.96), "[275.5, 281.9]"),
        ((-4, 3), (-3.14159, 2.7182), "[-3.1, 2.7]"),
        ((0, 0.5), (0.24571, 0.5), "[0.25, 0.5]"),
        ((0, 1e-8), (1.13e-9, 3.27e-9), "[1.2e-09, 3.2e-09]"),
    ],
)
def test_ends_are_told_with_digits_of_the_width_and_inside(whole, part, said):
    bounds = np.array([whole], dtype=float)
    assert narrowing_text(["k"], bounds, [part]) == f"`k` to {said}"
