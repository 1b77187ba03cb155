"""Events of coefficients, and the comparison with full trajectories next to events."""

import itertools
import math

import numpy as np
import pytest
import sympy as sp

import rankone as ro
from rankone.compiler.field_lowering import field_system
from rankone.solvers.reduced.field_comparison import FieldComparison
from rankone.solvers.reduced.reduced_events import ReducedEvents
from rankone.trajectories.fields.field_crossings import Occurred
from rankone.trajectories.fields.field_trajectories import field_trajectory

N, R = 30, 4
t, k = sp.symbols("t k")
u = ro.field("u", N)
ROW = np.arange(1.0, N + 1)[None] / N
HALVED = ro.Event(ro.apply(ROW, u) - 5 * k, "rising", then={u: u / 2 + u**2 * k}, name="halved")
ENDED = ro.Event(ro.apply(ROW, u) - 20, terminal=True, name="ended")


def fields(*events, **further):
    problem = ro.Problem({u: k}, (t, 0, 1), {k: (0.5, 2)}, {u: 0}, events=events, **further)
    return field_system(problem)


def reduced(system):
    spread = np.sqrt(N) * np.linalg.qr(np.random.default_rng(0).random((N, R)))[0]
    return ReducedEvents.of(system, spread, spread.T / N), spread


def test_heights_and_resets_are_those_of_the_fields():
    system = fields(HALVED, ENDED)
    events, spread = reduced(system)
    rng = np.random.default_rng(1)
    times, a, p = rng.random(7), rng.random((R, 7)), 0.5 + rng.random((1, 7))
    values = (ROW @ spread @ a)[0]
    assert events.heights(times, a, p) == pytest.approx(np.array([values - 5 * p[0], values - 20]))
    full = spread @ a
    after = events.members()["after_event_0"](times, a, p)
    assert after == pytest.approx(spread.T @ (full / 2 + full**2 * p) / N)


def test_many_columns_are_reset_some_at_a_time(monkeypatch):
    events, _ = reduced(fields(HALVED))
    rng = np.random.default_rng(1)
    times, a, p = rng.random(7), rng.random((R, 7)), 0.5 + rng.random((1, 7))
    reset = events.members()["after_event_0"]
    together = reset(times, a, p)
    monkeypatch.setattr("rankone.solvers.reduced.reduced_events._NUMBERS_AT_ONCE", 2 * N)
    assert reset(times, a, p) == pytest.approx(together, rel=1e-12)


def test_known_times_are_affine():
    events, _ = reduced(fields(HALVED, jumps={k / 4 + 0.1: {u: 0}}))
    members = events.members()
    assert members["KNOWN_EVENTS"] == (1,)
    assert members["AFFINE_EVENT_TIMES"] == ((1, (0.1, 0.25)),)
    assert members["known_event_times"](np.array([[1.0, 2.0]])) == pytest.approx(
        np.array([[0.35, 0.6]])
    )


def test_systems_without_events_have_none():
    events, _ = reduced(fields())
    assert events.members() == {}


class TestComparison:
    system = fields(HALVED, ENDED)
    comparison = FieldComparison.of(system, 1e-2)

    def trajectory(self, beside=0.0):
        return field_trajectory(self.system, np.array([1.0]), np.ones(1), 1e-8, 1e-9, None, beside)

    def test_times_next_to_jumps_do_not_count(self):
        course = self.trajectory(self.comparison.beside)
        jumps = course.jumps(self.system)
        counted = self.comparison.counted(course)
        distances = np.abs(course.times[:, None] - jumps).min(axis=1)
        assert jumps.size > 1
        assert (distances[counted] >= 1e-2).all()
        assert (distances[~counted] < 1e-2).all()
        assert distances[counted].min() == pytest.approx(1e-2, rel=1e-2)

    def test_half_of_each_stretch_counts_where_jumps_are_many(self):
        loose = FieldComparison.of(self.system, 0.1)
        course = self.trajectory(loose.beside)
        jumps = course.jumps(self.system)
        assert np.diff(jumps).max() < 2 * loose.out
        counted = course.times[loose.counted(course)]
        for a, b in itertools.pairwise(jumps):
            inside = counted[(counted > a) & (counted < b)]
            assert inside.size
            assert inside.min() >= a + 0.2499 * (b - a)
            assert inside.max() <= b - 0.2499 * (b - a)

    def test_times_of_events_are_compared_one_by_one(self):
        exact = [Occurred(0, 0.3), Occurred(1, 0.4), Occurred(0, 0.6)]
        near = [Occurred(0, 0.3), Occurred(0, 0.62), Occurred(1, 0.4)]
        assert self.comparison.time_error(exact, exact) == 0.0
        assert self.comparison.time_error(near, exact) == pytest.approx(0.02)

    def test_other_events_are_infinitely_wrong(self):
        exact = [Occurred(0, 0.3), Occurred(0, 0.6)]
        for other in ([Occurred(0, 0.3)], [*exact, Occurred(1, 0.7)], [Occurred(1, 0.3), exact[1]]):
            assert self.comparison.time_error(other, exact) == math.inf

    def test_events_at_the_very_end_may_be_beyond_it(self):
        exact = [Occurred(0, 0.3), Occurred(0, 0.995)]
        assert self.comparison.time_error(exact[:1], exact) == 0.0

    def test_a_solution_that_goes_on_behind_the_end_is_wrong(self):
        ends = fields(ro.Event(ro.apply(ROW, u) - 5, "rising", terminal=True))
        comparison = FieldComparison.of(ends, 1e-2)
        course = field_trajectory(ends, np.array([1.0]), np.ones(1), 1e-8, 1e-9)
        assert course.end < 0.5
        assert comparison.goes_on(lambda times: np.zeros((R, times.size)), course)
        assert not comparison.goes_on(lambda times: np.full((R, times.size), np.nan), course)
