"""What parts of intervals are predicted to converge, from modes whose decay is known."""

import math

import numpy as np
import pytest

import rankone as ro
from rankone.solvers.remedies import Resolution, narrowed_box
from rankone.tensors import ChebyshevBasis
from rankone.tensors.coordinates import Logarithm
from rankone.trajectories.system.verdict import Status

RTOL = 1e-3


def resolution(ratio, size, lower=1.0, upper=3.0, **options):
    basis = ChebyshevBasis(lower, upper, size, **options)
    return Resolution.of(basis, ratio ** np.arange(size), RTOL)


def test_nodes_are_extrapolated_from_the_decay():
    assert resolution(0.5, 20).needed == 20
    rough = resolution(0.9, 20)
    tail = math.hypot(0.9**18, 0.9**19)
    assert rough.needed == pytest.approx(20 + math.log(tail / (0.3 * RTOL)) / math.log(1 / 0.9))
    assert rough.nodes(1.0) == rough.needed
    assert rough.nodes(rough.suffices) == pytest.approx(20)


def test_nodes_that_are_needed_fall_with_the_interval():
    """The rule holds for a function with a pole beside the interval."""
    wide, narrow = (
        ChebyshevBasis(-half, half, 200).relative_spectrum(
            1.0 / (1.0 + 100.0 * ChebyshevBasis(-half, half, 200).nodes[None, :] ** 2)
        )
        for half in (1.0, 0.5)
    )
    counts = [np.count_nonzero(np.maximum.accumulate(s[::-1]) > 1e-8) for s in (wide, narrow)]
    assert counts[1] / counts[0] == pytest.approx(0.5, abs=0.1)


def test_the_rough_parameter_is_narrowed_and_no_other():
    box = narrowed_box(["k", "c"], [resolution(0.5, 20), resolution(0.9, 20)], 1e9, 8e9)
    ((name, lower, upper),) = box.intervals
    assert name == "c"
    assert 1.0 < lower < 2.0 < upper < 3.0
    assert lower + upper == pytest.approx(4.0)


def test_less_budget_asks_for_a_narrower_interval():
    both = [resolution(0.5, 20), resolution(0.9, 20)]
    widths = [
        np.ptp(narrowed_box(["k", "c"], both, 1e9, budget).intervals[0][1:])
        for budget in (9e9, 6e9, 4.5e9)
    ]
    assert widths[0] > widths[1] > widths[2]
    assert narrowed_box(["k", "c"], both, 1e9, 1e6) is None  # too far to predict


def test_the_middle_is_that_of_the_scale():
    rough = resolution(0.9, 20, 1e-2, 1e2, scale=Logarithm())
    ((_, lower, upper),) = narrowed_box(["k"], [rough], 1e9, 8e9).intervals
    assert lower * upper == pytest.approx(1.0, rel=0.05)


@pytest.fixture(scope="module")
def compiled():
    return ro.compile(
        ro.Problem.from_strings(
            {"x": "a*x - b*x*y", "y": "-c*y + x*y"},
            {"x": "1", "y": "0.5"},
            {"a": (0.25, 1.0), "b": (0.5, 2), "c": (0.25, 1)},
            (0, 12),
        )
    )


def told(solution):
    return solution.outcome.verdict.narrower


@pytest.mark.parametrize("effort", [0.005, 0.0085, 0.012, 0.015])
def test_a_box_narrowed_as_told_converges(compiled, effort):
    """Predator and prey with a budget that is far too small for the whole box."""
    refused = compiled.solve(1e-4, method="cross", effort=effort)
    assert refused.status is Status.WORK_LIMIT
    narrower = told(refused)
    assert f"predicted to converge if you narrow `{next(iter(narrower))}` to [" in refused.message
    converged = compiled.solve(1e-4, method="cross", effort=effort, parameters=narrower)
    assert converged.success
    assert not told(converged)


def test_where_no_attempt_ended_lines_tell(compiled):
    """The budget ends in the first interpolation."""
    refused = compiled.solve(1e-5, method="cross", effort=0.005)
    assert "nothing was interpolated yet" in refused.message
    assert told(refused)


def test_limits_of_the_user_are_no_reason(compiled):
    limited = compiled.solve(1e-4, method="cross", max_rank=3, max_attempts=1)
    assert limited.status is Status.RANK_LIMIT
    assert not told(limited)
