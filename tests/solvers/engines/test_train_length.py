"""The controller of the lengths of slabs, without any sweep."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import rankone as ro
from rankone.solvers.engines.train_length import Accuracy, Guess, SlabLengths, TrainSpan
from rankone.solvers.outcome import SlabRecord
from rankone.solvers.request import Check, Domain, SolveRequest
from rankone.solvers.verification.reference_set import ReferenceSet
from rankone.tensors import RadauCollocation
from rankone.trajectories.system.verdict import Status

COLLOCATION = RadauCollocation.of(8)


def lengths(
    rhs: str = "-k*x", end: float = 2.0, level: float = 1e-4, guesses: Any = ()
) -> SlabLengths:
    problem = ro.Problem.from_strings({"x": rhs}, {"x": "1"}, {"k": (1, 2)}, (0, end))
    system = ro.compile(problem).system
    reference_set = ReferenceSet.of(system, SolveRequest(1e-6, Domain.of(system), Check(0)))
    return SlabLengths(reference_set, COLLOCATION, Accuracy(level, lambda time: 1.0), guesses)


def trial(
    span: TrainSpan, solved: bool = True, sweeps: int = 4, tail: float = 1e-6, limits: Any = ()
) -> Any:
    residuals = (1e-6,) * sweeps
    record = SlabRecord(0, span.start, span.end, solved, 1e-4, residuals, (), ())
    modes = np.zeros((1, 9, 1))
    modes[0, -1] = tail
    return SimpleNamespace(record=record, limits=set(limits), time_modes=modes)


def proposed(controller: SlabLengths, start: float = 0.0) -> TrainSpan:
    span = controller.propose(start)
    assert isinstance(span, TrainSpan)
    return span


def test_a_smooth_problem_takes_one_slab() -> None:
    assert proposed(lengths()) == TrainSpan(0.0, 2.0, 2.0)


def test_the_reference_has_to_be_resolved() -> None:
    controller = lengths("-k*x + cos(40*t)")
    span = proposed(controller)
    assert 0.02 < span.length < 0.5
    assert controller.resolved(0.0, span.length) == span.length
    assert proposed(lengths("-k*x + cos(40*t)", level=1e-2)).length > span.length


def test_no_slab_crosses_a_jump() -> None:
    controller = lengths("-k*x + Heaviside(t - 0.7)")
    span = proposed(controller)
    assert span.end == pytest.approx(0.7, abs=1e-6)
    assert span.end in controller.borders
    controller.adapt(span, trial(span))
    assert proposed(controller, span.end).end == 2.0


def test_what_remains_is_halved_rather_than_left_short() -> None:
    controller = lengths()
    controller.length = 1.5
    assert proposed(controller).length == 1.0


@pytest.mark.parametrize(("sweeps", "factor"), [(3, 1.5), (4, 1.0), (6, 0.7)])
def test_few_sweeps_lengthen_and_many_shorten(sweeps: int, factor: float) -> None:
    controller = lengths()
    controller.length = 0.2
    span = proposed(controller)
    assert controller.adapt(span, trial(span, sweeps=sweeps))
    assert controller.length == pytest.approx(0.2 * factor)


def test_after_a_rejection_the_length_grows_slowly() -> None:
    controller = lengths()
    span = proposed(controller)
    assert not controller.adapt(span, trial(span, solved=False))
    assert controller.length == 1.0
    controller.length = 0.9
    span = proposed(controller)
    assert controller.adapt(span, trial(span, sweeps=1))
    assert controller.length == pytest.approx(1.15)


def test_a_slab_with_unresolved_time_modes_is_solved_again() -> None:
    controller = lengths()
    span = proposed(controller)
    assert not controller.adapt(span, trial(span, tail=1e-1))
    assert 0.4 < controller.length < 1.6


def test_giving_up() -> None:
    controller = lengths()
    controller.length = 1e-11
    assert controller.propose(0.0) is Status.NO_CONVERGENCE
    controller = lengths()
    controller.length = 3e-3
    span = proposed(controller)
    controller.adapt(span, trial(span, solved=False, limits=[Status.MEMORY_LIMIT]))
    assert controller.length == pytest.approx(1.5e-3)
    assert controller.propose(0.0) is Status.MEMORY_LIMIT


def test_the_slab_of_the_attempt_before_is_taken_again() -> None:
    guess = Guess(0.0, 0.4, (), ())
    controller = lengths(guesses=[guess])
    assert proposed(controller) == TrainSpan(0.0, 0.4, 0.4, guess)
    assert proposed(controller, 0.4).guess is None
    controller.length = 0.3
    assert proposed(controller).guess is None
