"""Solves whose events come in other orders, or more often, over the box."""

import numpy as np
import pytest

import rankone as ro

RTOL = 1e-4


def rising(when, then=None, name=""):
    return {"when": when, "direction": "rising", "then": then, "name": name}


def infused(t, length, k):
    """What an infusion of rate 1 from 1 on, of some length, comes to."""

    def filled(since):
        return -np.expm1(-k * np.maximum(since, 0)) / k

    return filled(t - 1) - filled(t - 1 - length)


@pytest.mark.slow
@pytest.mark.parametrize("start", [0, 0.001])
def test_a_state_that_is_zero_before_a_dose_does_not_fall(start):
    dosed = ro.Problem.from_strings(
        {"d": "r - k*d", "r": "0"},
        {"d": start, "r": 0},
        {"D": (6, 11), "k": (0.5, 2)},
        (0, 24),
        events=[
            rising("t - 1", {"r": "1"}, "on"),
            rising("t - 1 - D", {"r": "0"}, "off"),
            rising("t - 9", name="mark"),
        ],
    )
    solution = ro.solve(dosed, RTOL)
    assert solution.success, solution.message
    times = np.linspace(0, 24, 49)
    for length, k in ((6.5, 0.6), (8.2, 1.8), (10.7, 1.1)):
        exact = infused(times, length, k) + start * np.exp(-k * times)
        found = solution["d"](t=times, D=length, k=k)
        np.testing.assert_allclose(found, exact, atol=3 * RTOL)


def spikes(box, end):
    return ro.Problem.from_strings(
        {"x": "k - x"},
        {"x": 0},
        {"k": box},
        (0, end),
        events=[rising("x - 1", {"x": "0"}, "spike")],
    )


@pytest.mark.slow
def test_counts_that_differ_too_widely_are_refused_with_a_part_that_is_solved():
    """A part with several counts, where none of them alone holds in enough of the box."""
    with pytest.raises(ro.ConvergenceError, match=r"`spike` \d+ times, which holds") as refused:
        ro.solve(spikes((1.01, 3), 10), 1e-3)
    assert "it was solved there" in refused.value.remedy
    (part,) = refused.value.part
    assert part[1] - part[0] > 0.2
    assert ro.solve(spikes(part, 10), 1e-3).success


@pytest.mark.parametrize(
    ("box", "end"),
    [
        pytest.param((1.06, 2.5), 5, marks=pytest.mark.slow),
        pytest.param((1.03, 2), 6, marks=pytest.mark.slow),
    ],
)
def test_spikes_whose_counts_differ_widely(box, end):
    solution = ro.solve(spikes(box, end), RTOL)
    assert solution.success, solution.message
    times = np.linspace(0, end, 83)
    for share in (0.03, 0.3, 0.9):
        k = box[0] + share * (box[1] - box[0])
        period = np.log(k / (k - 1))
        since = np.mod(times, period)
        inside = np.minimum(since, period - since) > 1e-3 * end
        exact = -k * np.expm1(-since)
        found = solution["x"](t=times, k=k)
        np.testing.assert_allclose(found[inside], exact[inside], atol=3 * RTOL)
        assert np.isfinite(solution.event_times("spike", k=k)).sum() == int(end / period)
