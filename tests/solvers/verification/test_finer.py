"""A reference that finer trajectories do not confirm is integrated again."""

import numpy as np
import pytest

import rankone as ro
from rankone.solvers import attempts
from rankone.solvers.request import Check, Domain, SolveRequest
from rankone.solvers.verification.reference_set import ReferenceSet
from rankone.solvers.verification.worst_points import _finer, confirmed
from rankone.support.budget import OutOfWorkError, limited, work_done
from rankone.trajectories.integrators.integrator import Tolerances
from rankone.trajectories.integrators.single import SingleIntegrator
from tests.reference.published import PUBLISHED

RTOL = 4e-3
LAYER = "1/(1800*k*Heaviside(x - 0.5443)*Heaviside(0.5444 - x) + 1)"
"""The state stays between 0.5443 and 0.5444 for 0.18*k time units, as long as for all the rest."""


def problem(rate=LAYER, **options):
    return ro.Problem.from_strings({"x": rate}, {"x": "0"}, {"k": (0.5, 1.5)}, (0, 2.5), **options)


def reference_set(given, rtol=RTOL):
    system = ro.compile(given).system
    return ReferenceSet.of(system, SolveRequest(rtol, Domain.of(system), Check(24)))


def error(of):
    """The error of the states at the end, behind the layer, over the tolerance."""
    exact = 2.5 - 0.18 * of.reference.points[:, 0]
    return np.abs(of.reference(np.array([2.5]))[0, :, 0] - exact).max() / (2.5 * RTOL)


@pytest.mark.slow
def test_a_state_that_nearly_stops_is_followed_again():
    first = reference_set(problem())
    finer, hidden = confirmed(first)
    assert hidden is None
    assert error(first) > 5.0
    assert error(finer) < 0.1
    assert finer.accuracy < first.accuracy


@pytest.mark.slow
def test_a_solve_is_measured_against_the_finer_reference():
    solution = ro.solve(problem(), RTOL)
    k = np.linspace(0.5, 1.5, 11)
    missed = np.abs(solution(t=2.5, k=k)[0] - (2.5 - 0.18 * k)).max() / 2.5
    assert solution.outcome.measured.error > 0.5 * missed
    assert solution.success == (solution.outcome.measured.error <= RTOL)


@pytest.mark.parametrize("rate", ["1/(1 + k*x)", "sin(k*x) + 0.1", "Heaviside(x - 0.5)*k + 1"])
def test_smooth_references_are_confirmed(rate):
    first = reference_set(problem(rate), 1e-5)
    assert confirmed(first) == (first, None)


@pytest.mark.parametrize("rate", ["1/(1 + k*x)", "Heaviside(x - 0.5)*k + 1"])
def test_references_with_a_jump_at_a_compared_time_are_confirmed(rate):
    first = reference_set(problem(rate, jumps={1.25: {"x": "x/3"}}), 1e-5)
    assert confirmed(first) == (first, None)


@pytest.mark.slow
def test_references_as_fine_as_rounding_are_taken_as_they_are():
    first = reference_set(problem(), 1e-11)
    assert confirmed(first) == (first, None)


@pytest.mark.parametrize(("name", "maker"), [("kepler", "stack"), ("duffing", "single")])
def test_lsoda_follows_them_for_as_much_work_as_a_stack_would(name, maker):
    first = reference_set(PUBLISHED[name].problem(), 1e-3)
    few, times = np.arange(2), np.linspace(0.0, first.end, 7)
    with limited(1e10):
        samples = first.sampled_again(few, times, 1e-2 * first.accuracy)
        taken = work_done()
    assert samples.integrator == maker
    assert taken < 4.0 * first._stacked_work(few.size, times.size, 1e-2 * first.accuracy)


def test_no_success_where_the_limit_leaves_no_comparison(monkeypatch):
    def without_end(reference_set):
        raise OutOfWorkError

    monkeypatch.setattr(attempts, "confirmed", without_end)
    solution = ro.solve(problem("1/(1 + k*x)"), RTOL)
    assert solution.status is ro.Status.WORK_LIMIT
    assert solution.error < RTOL


def test_lsoda_is_not_asked_for_what_makes_its_steps_short():
    """Below about 3e-12 it never returns from its stiff method."""
    finer = [_finer(each) for each in (3e-6, 3e-8, 5e-9, 1e-9)]
    assert finer == pytest.approx([3e-8, 3e-10, 3e-10, 1e-11], rel=1e-9, abs=0.0)
    rates = {"v": "v - v**3/3 - w + a", "w": "0.08*(v + 0.7 - 0.8*w)"}
    start = {"v": "-1", "w": "-0.5"}
    given = ro.Problem.from_strings(rates, start, {"a": (0.45, 0.55)}, (0, 150))
    system, points = ro.compile(given).system, np.array([[0.5]])
    steps = []
    for accuracy in (1e-9, 3e-10, 1e-10, 3e-11, 1e-11):
        tolerances = Tolerances(accuracy, np.full((2, 1), 1e-3 * accuracy))
        steps.append(SingleIntegrator().run(system, points, [0.0, 150.0], tolerances).steps)
    assert steps[1] < 1.3 * steps[0]
    assert max(steps[2:]) > 2.0 * steps[1]
