"""Timelines in words."""

import pytest

from rankone.trajectories.system.features import Ending
from rankone.trajectories.system.timeline import Timeline


@pytest.mark.parametrize(
    ("instants", "text"),
    [
        ((), "1 stretch over [0, 5], which ends with\n  the end of the horizon"),
        ((("hit",),), "2 stretches over [0, 5], which end with\n  hit\n  the end of the horizon"),
        (
            (*5 * (("hit",), ("top",)), *6 * (("hit",),)),
            "17 stretches over [0, 5], which end with\n  hit, then top, 5 times\n  hit, 6 times\n"
            "  the end of the horizon",
        ),
        (
            (("top",), *3 * (("hit",),)),
            "5 stretches over [0, 5], which end with\n  top\n  hit\n  hit\n  hit\n"
            "  the end of the horizon",
        ),
    ],
)
def test_a_timeline_tells_what_ends_each_stretch(instants, text):
    resets = (True,) * len(instants)
    timeline = Timeline(("hit",), instants, resets, Ending.HORIZON, False, (0.0, 5.0))
    assert str(timeline) == text
