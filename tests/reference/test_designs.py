"""The brute force behind the bar of intervals tells what is held from what is short by itself."""

import pytest

from tests.benchmarks.intervals import is_held
from tests.reference.designs import WIDE


@pytest.mark.parametrize(("interval", "held"), [((10.01, 13.88), False), ((9.57, 12.33), True)])
def test_a_short_interval_is_held_only_where_values_farther_out_fit(interval, held):
    """The profile of V in a data set that puts ka where it changes little; and with ka known."""
    (design,) = (each for each in WIDE if each.name == "oral dose from wide bounds")
    assert is_held(design, design.data(4), "V", interval) is held
