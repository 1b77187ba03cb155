"""Refusals come soon, and their remedies succeed."""

from __future__ import annotations

import dataclasses
import math
import re

import pytest

import rankone as ro
from rankone.solvers.attempts import Progress
from rankone.solvers.remedies import Trials, remedied
from rankone.solvers.request import Domain, SolveRequest
from rankone.support.budget import (
    NORMAL,
    OutOfWorkError,
    charge,
    keeping_back,
    limited,
    patient,
    persisting,
    work_left,
)
from rankone.trajectories.system.verdict import (
    MeasuredError,
    NarrowBox,
    OtherEngines,
    Remedy,
    Status,
    SteepParameter,
    Verdict,
)
from tests.problems import REFERENCE
from tests.reference.kinetics import KINETICS
from tests.reference.refusals import REFUSALS

FIRST_END = re.compile(r"end the horizon before t = ([0-9.e+-]+)")


@pytest.mark.parametrize("name", ["separatrix that moves", "oblique step over two parameters"])
def test_the_part_beside_a_jump_is_solved(name):
    case = REFUSALS[name]
    inside = {"x0": (0.05, 0.95)} if "x0" in case.box else {}
    refused = ro.solve(case.problem(inside), case.rtol)
    assert not refused.success
    assert "as on a jump" in refused.message
    assert "loosen rtol" not in refused.message
    assert "try rtol" not in refused.message
    narrower = refused.outcome.verdict.narrower
    assert "it was solved there" in refused.message
    assert ro.solve(case.problem(inside | narrower), case.rtol).success


@pytest.mark.slow
def test_an_earlier_end_of_chaos_is_solved():
    case = REFUSALS["Lorenz"]
    refused = ro.solve(case.problem(), case.rtol)
    found = FIRST_END.search(refused.message)
    assert found
    assert ro.solve(case.problem(), case.rtol, t_final=float(found[1])).success


@pytest.mark.parametrize(
    ("succeed", "remedy"),
    [
        ((3e-3,), "try rtol=3e-03: it was solved to"),
        ((1e-2,), "try rtol=1e-02: it was solved to"),
        ((), "loosen rtol, narrow the box or shorten the horizon"),
    ],
)
def test_a_looser_tolerance_is_tried_before_it_is_offered(succeed, remedy):
    solution = ro.solve(REFERENCE["decay"](), rtol=1e-3, method="cross")
    measured = dataclasses.replace(solution.outcome.measured, interior=(1.7e-3,))
    vague = Remedy("loosen rtol, narrow the box or shorten the horizon")
    predicted = NarrowBox((("k", 1.4, 1.6),))
    missed = dataclasses.replace(
        solution.outcome, status=Status.TOLERANCE, measured=measured, notes=(predicted, vague)
    )
    request, tried = SolveRequest(1e-6, Domain((0.0, 2.0), ((1.0, 2.0),))), []

    def trial(request):
        tried.append(request.rtol)
        return solution.outcome if request.rtol in succeed else None

    told = remedied(missed, request, Trials(request, ("k",), trial))
    assert told.verdict.remedy.startswith(remedy)
    if succeed:
        assert tried[-1] == succeed[0]
        assert told.verdict.notes[-1] == predicted  # after what was tried
        assert told.error == solution.error  # the better of both
    front = SteepParameter("k", "x", 1.5, 1.5000001, 1.0, jump=True, at_end=True)
    jumps = dataclasses.replace(missed, status=Status.STEEP, cause=front)
    assert "try rtol" not in remedied(jumps, request, Trials(request, ("k",), trial)).message


@pytest.mark.parametrize("latest", [0.01, 0.04, 0.11, 0.6, 1.9])
def test_an_end_that_is_offered_is_at_least_half_of_what_is_solved(latest):
    solution = ro.solve(REFERENCE["decay"](), rtol=1e-3, method="cross")

    def trial(request):
        return solution.outcome if request.domain.horizon[1] <= latest else None

    request = SolveRequest(1e-6, Domain((0.0, 2.0), ((1.0, 2.0),)))
    end = Trials(request, ("k",), trial).end()
    assert 0.5 * latest <= end <= latest


@pytest.mark.slow
def test_a_refusal_takes_a_part_of_the_budget():
    case, effort = REFUSALS["two wells, shifted"], 0.2
    with limited() as account:
        refused = ro.solve(case.problem(), case.rtol, effort=effort)
    assert not refused.success
    assert account.done < 0.6 * effort * NORMAL
    assert "it was solved" in refused.message


@pytest.mark.slow
def test_a_dear_reference_leaves_patience_for_the_first_attempt():
    """It takes half of what the solve may: 5.4e9 of 11.1e9 operations."""
    with limited() as account:
        solution = ro.solve(KINETICS["coagulation"].problem(), 1e-4)
    assert solution.success
    assert account.done < 0.6 * NORMAL


def test_patience_ends_work_unless_it_persists():
    with limited(100.0), patient(40.0):
        charge(30.0)
        assert work_left() == 10.0
        with pytest.raises(OutOfWorkError):
            charge(20.0)
        with persisting(25.0):
            charge(20.0)
            with pytest.raises(OutOfWorkError):
                charge(20.0)
        assert work_left() < 0.0
        with pytest.raises(OutOfWorkError):
            charge(0.1)


def test_work_is_kept_back_from_both_limits():
    with limited(100.0), patient(40.0):
        with keeping_back(10.0):
            assert work_left() == 30.0
            with persisting():
                assert work_left() == 90.0
        assert work_left() == 40.0


@pytest.mark.parametrize(
    ("errors", "goes_on"),
    [
        ([1.0, 0.1, 0.01], True),
        ([1.0, 0.9, 0.85], False),
        ([1.0, 0.5, 0.25], False),
        ([1.0], False),
    ],
)
def test_only_an_error_that_falls_fast_enough_goes_on(errors, goes_on):
    progress, best = Progress(), math.inf
    for error in errors:
        progress.add(error, best)
        best = min(best, error)
    with limited(100.0), patient(10.0), progress.going_on(30.0, 1e-3):
        assert (work_left() > 10.0) == goes_on


def test_an_error_above_the_tolerance_is_told_from_it():
    note = MeasuredError(1.0000004e-3, 1e-3)
    text = str(Verdict(Status.TOLERANCE, None, (note,)))
    assert text.endswith("measured error 1.0000004e-03, asked 1.0000000e-03")
    assert "2.0e-03, asked 1.0e-03" in note.__class__(2e-3, 1e-3).sentence(Status.TOLERANCE)


def test_a_box_says_whether_it_was_tried():
    predicted = NarrowBox((("a", 0.5, 1.0),))
    assert (
        predicted.sentence(Status.STEEP)
        == "it is predicted to converge if you narrow `a` to [0.5, 1]"
    )
    tried = dataclasses.replace(predicted, tried=True)
    assert tried.sentence(Status.STEEP) == "narrow `a` to [0.5, 1]: it was solved there"
    ordered = dataclasses.replace(predicted, one_order=True)
    assert ordered.sentence(Status.STEEP).endswith("[0.5, 1]: events come in one order there")


def test_a_success_tells_other_engines_in_short():
    failed = Verdict(Status.RANK_LIMIT, None, (Remedy("raise max_rank"),))
    others = OtherEngines("cross", (("train", failed),))
    assert others.sentence(Status.CONVERGED) == ". Also tried train: the rank limit was reached"
    assert others.sentence(Status.TOLERANCE).endswith("raise max_rank")
