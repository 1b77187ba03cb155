"""What the data determine, by linearisation."""

import numpy as np

from rankone.inference.calibration.result import covariance_of, unidentified
from rankone.inference.estimation.identification import BOX_SHARE, UNIFORM_PRECISION


def test_what_the_box_decides_is_not_identified():
    """As in fits: with the larger share of the information in the box, and not in the data."""
    shares = np.array([0.9, 1.1]) * BOX_SHARE
    jacobian = np.diag(np.sqrt(UNIFORM_PRECISION * (1.0 / shares - 1.0)))
    deviations = np.sqrt(np.diag(covariance_of(jacobian, 1.0)))
    assert unidentified(("a", "b"), deviations) == ("b",)
