"""The controller of the lengths of slabs, without any solve."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from rankone.solvers.engines.engine_options import GreedyOptions
from rankone.solvers.engines.greedy_engine import SlabLengths
from rankone.solvers.march import Span
from rankone.trajectories.system.verdict import Status


def trial(accepted: bool, iterations: int = 12, limits: Any = ()) -> Any:
    record = SimpleNamespace(accepted=accepted, residuals=(0.1,) * iterations)
    return SimpleNamespace(record=record, limits=set(limits))


def test_equal_slabs_fill_the_horizon() -> None:
    lengths = SlabLengths(0.0, 2.0, GreedyOptions(time_slabs=4), 0.1)
    assert lengths.propose(0.0) == Span(0.0, 0.5, 0.5)
    assert lengths.propose(1.5) == Span(1.5, 0.5, 2.0)
    assert SlabLengths(0.0, 2.0, GreedyOptions(), 0.6).propose(0.0) == Span(0.0, 0.5, 0.5)


@pytest.mark.parametrize(
    ("iterations", "limits", "factor"),
    [(10, (), 1.5), (12, (), 1.0), (17, (), 0.7), (10, (Status.RANK_LIMIT,), 0.5)],
)
def test_lengths_follow_the_iterations(iterations: int, limits: Any, factor: float) -> None:
    lengths = SlabLengths(0.0, 2.0, GreedyOptions(), 0.5)
    span = lengths.propose(0.0)
    assert lengths.adapt(span, trial(True, iterations, limits))
    assert lengths.length == 0.5 * factor


def test_fixed_slabs_are_not_halved_and_short_ones_given_up() -> None:
    for options, longest in ((GreedyOptions(time_slabs=1), 1.0), (GreedyOptions(), 1.5e-9)):
        lengths = SlabLengths(0.0, 1.0, options, longest)
        assert not lengths.adapt(lengths.propose(0.0), trial(False))
        assert lengths.propose(0.0) is Status.NO_CONVERGENCE
    lengths = SlabLengths(0.0, 1.0, GreedyOptions())
    assert not lengths.adapt(lengths.propose(0.0), trial(False))
    assert lengths.propose(0.0) == Span(0.0, 0.5, 0.5)
