"""The attempt loop, led by a made-up engine whose error is known."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
import pytest

import rankone as ro
from rankone.solvers.attempts import Attempt, Progress, solve_in_attempts
from rankone.solvers.march import MarchResult
from rankone.solvers.outcome import Outcome, SlabRecord
from rankone.solvers.request import Check, Domain, SolveRequest
from rankone.solvers.verification.reference_set import ReferenceSet
from rankone.support.budget import Report, quiet
from rankone.support.errors import RankoneError
from rankone.support.options import Options, integer
from rankone.tensors.slab import SlabTrain
from rankone.tensors.train import Train
from rankone.trajectories.system.verdict import Status
from tests.problems import REFERENCE


@dataclass(frozen=True)
class FakeOptions(Options):
    max_attempts: int | None = integer(None)


@dataclass
class Fake:
    """Slabs of the true solution of decay, each time scaled by one plus the next error."""

    slabs: tuple[SlabTrain, ...]
    errors: list[float]
    limits: set[Status] = field(default_factory=set)
    patience: int = 9
    seen: list[int] = field(default_factory=list)
    remedies: ClassVar[dict[Status, str]] = {Status.TOLERANCE: "be patient"}

    def march(self, index: int, report: Report) -> MarchResult:
        factor = 1.0 + self.errors[index]
        slabs = [
            SlabTrain(s.start, s.end, Train((factor * s.cores[0], *s.cores[1:])), s.bases)
            for s in self.slabs
        ]
        record = SlabRecord(index, 0.0, 2.0, True, factor, (), (), ())
        return MarchResult(slabs, [record], set(self.limits))

    def refine(self, attempt: Attempt, progress: Progress) -> bool:
        self.seen.append(progress.stalls)
        return len(self.seen) < self.patience

    def explained(self, status: Status, attempt: Attempt) -> tuple[Status, None]:
        return status, None


@pytest.fixture(scope="module")
def system() -> Any:
    return ro.compile(REFERENCE["decay"]()).system


@pytest.fixture(scope="module")
def slabs() -> tuple[SlabTrain, ...]:
    return ro.solve(REFERENCE["decay"](), rtol=1e-9).outcome.slabs


def run(
    system: Any, fake: Fake, rtol: float = 1e-3, check: int = 5, most: int | None = 6
) -> Outcome:
    def marcher(reference_set: ReferenceSet) -> Fake:
        fake.reference_set = reference_set
        return fake

    request = SolveRequest(rtol, Domain.of(system), Check(check))

    def begun() -> Any:
        return marcher(ReferenceSet.of(system, request))

    return solve_in_attempts(begun, FakeOptions(most), system, request, quiet)


def test_attempts_end_with_the_first_that_fits(system: Any, slabs: Any) -> None:
    fake = Fake(slabs, [1e-1, 1e-2, 1e-4, 1e-5])
    outcome = run(system, fake)
    assert outcome.status is Status.CONVERGED
    assert outcome.measured is not None
    assert max(outcome.measured.interior) == pytest.approx(1e-4, rel=1e-3)
    assert [record.attempt for record in outcome.history] == [0, 1, 2]
    assert fake.seen == [0, 0]
    assert list(outcome.timings) == list(outcome.work) == ["reference", "march", "check"]


def test_stalls_are_counted_and_the_best_attempt_is_kept(system: Any, slabs: Any) -> None:
    fake = Fake(slabs, [1e-1, 2e-2, 3e-2, 1.9e-2, 1e-2, 0.5])
    outcome = run(system, fake)
    assert fake.seen == [0, 0, 1, 2, 0]
    assert outcome.status is Status.TOLERANCE
    assert outcome.measured is not None
    assert max(outcome.measured.interior) == pytest.approx(1e-2, rel=1e-3)
    assert outcome.message.startswith(Status.TOLERANCE.value)
    assert outcome.message.endswith("asked 1.0e-03; be patient")


def test_attempts_go_on_while_one_of_three_pays(system: Any, slabs: Any) -> None:
    stalled = [1e-1] * FakeOptions.usual_attempts
    assert len(run(system, Fake(slabs, stalled, patience=99), most=None).history) == len(stalled)
    falling = [0.5 * 0.8**k for k in range(9)] + [0.04, 0.039, 0.038, 0.02, 0.0199, 0.0199, 0.0199]
    outcome = run(system, Fake(slabs, falling, patience=99), most=None)
    assert len(outcome.history) == len(falling)


def test_an_engine_may_have_nothing_left_to_try(system: Any, slabs: Any) -> None:
    outcome = run(system, Fake(slabs, [1e-1, 1e-2], patience=1))
    assert len(outcome.history) == 1
    assert len(run(system, Fake(slabs, [1e-1, 1e-2]), most=2).history) == 2


def test_a_limit_explains_a_failure(system: Any, slabs: Any) -> None:
    outcome = run(system, Fake(slabs, [1e-1], {Status.RANK_LIMIT}, patience=1))
    assert outcome.status is Status.RANK_LIMIT


def test_without_points_there_is_one_attempt(system: Any, slabs: Any) -> None:
    outcome = run(system, Fake(slabs, [1e-1, 1e-2]), check=0)
    assert outcome.status is Status.UNCHECKED
    assert outcome.measured is None
    assert len(outcome.history) == 1


def test_an_early_end_is_said(system: Any, slabs: Any) -> None:
    class Stopped(Fake):
        def march(self, index: int, report: Report) -> MarchResult:
            result = super().march(index, report)
            return MarchResult(result.slabs[:1], result.records, set(), Status.SLAB_LIMIT)

    outcome = run(system, Stopped(slabs, [1e-1]))
    assert outcome.status is Status.SLAB_LIMIT
    assert "; stopped at t = " in outcome.message


def test_options_of_a_made_up_engine_are_checked() -> None:
    with pytest.raises(RankoneError, match="max_attempts=0 is not valid"):
        FakeOptions(0)
    with pytest.raises(RankoneError, match=r"did you mean `max_attempts`\?"):
        FakeOptions.of(max_attempt=3)
    assert np.isclose(FakeOptions.of(max_attempts=3).max_attempts, 3)
