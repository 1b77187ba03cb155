"""The reference set: asked for more points it integrates those alone."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest

import rankone as ro
from rankone.solvers.request import Check, Domain, Observation, SolveRequest
from rankone.solvers.verification.measure import measure
from rankone.solvers.verification.reference_set import ReferenceSet
from rankone.support.budget import limited, memory_left
from tests.problems import REFERENCE

TIMES = np.linspace(0.0, 2.0, 11)


def reference_set(
    name: str = "decay", check: int = 4, domain: Domain | None = None
) -> ReferenceSet:
    system = ro.compile(REFERENCE[name]()).system
    return ReferenceSet.of(system, SolveRequest(1e-6, domain or Domain.of(system), Check(check)))


def test_more_points_are_integrated_alone() -> None:
    first = reference_set()
    points = np.array([[0.7], [4.4]])
    more = first.with_points(points)
    assert more.reference.batches[0] is first.reference.batches[0]
    counts = [batch.state.shape[1] for batch in more.reference.batches]
    assert counts == [len(first.reference.points), 2]
    np.testing.assert_array_equal(more.reference.points[-2:], points)
    old, new = first.reference(TIMES), more.reference(TIMES)
    np.testing.assert_array_equal(new[:, : old.shape[1]], old)
    np.testing.assert_allclose(new[0, -2:], np.exp(-points * TIMES), rtol=1e-6)


def test_the_error_at_added_points_counts() -> None:
    slabs = ro.solve(REFERENCE["decay"](), rtol=1e-8).outcome.slabs
    unchecked = reference_set(check=0)
    assert measure(unchecked, slabs) is None
    measured = measure(unchecked.with_points(np.array([[0.9]])), slabs)
    assert measured is not None
    assert measured.points == 2
    assert max(measured.interior) < 1e-6


def test_the_earliest_blow_up_of_all_points_is_kept() -> None:
    domain = Domain((0.0, 0.7), ((0.5, 1.0),) * 3)
    first = reference_set("coupled", 0, domain)
    assert first.blow_up is None
    assert first.end == 0.7
    more = first.with_points(np.array([[0.6, 0.6, 0.6], [-6.0, 6.0, 6.0]]))
    assert more.blow_up is not None
    assert more.blow_up[1] == (-6.0, 6.0, 6.0)
    assert more.end < more.reference.end < 0.7
    later = more.with_points(np.array([[0.7, 0.7, 0.7]]))
    assert later.blow_up == more.blow_up


@pytest.mark.parametrize("check", [0, 3])
def test_sizes_leave_the_corners_out(check: int) -> None:
    held = reference_set("lotka_volterra", check)
    assert held.corners == (4 if check else 0)
    inside = np.delete(held.reference(np.linspace(0, 6, 201)), np.s_[1 : 1 + held.corners], axis=1)
    np.testing.assert_array_equal(held.sizes, np.abs(inside).max(axis=(1, 2)))


@pytest.mark.parametrize("observed", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_sizes_hold_a_block_at_a_time(observed: bool) -> None:
    """Where little memory is left, a block is the states at one time: their maxima are as many."""
    chain = {f"x{i}": f"k*(x{i - 1} - x{i})" if i else "-k*x0" for i in range(40)}
    problem = ro.Problem.from_strings(chain, dict.fromkeys(chain, "1"), {"k": (1, 2)}, (0, 1))
    system = ro.compile(problem).system
    names, rows = tuple(chain), tuple(range(len(chain)))
    quantities = Observation(names, names, rows, lambda t, u, p: 2.0 * u) if observed else None
    request = SolveRequest(1e-3, Domain.of(system), Check(60), observed=quantities)
    held = ReferenceSet.of(system, request)
    expected = replace(held).states
    state = 8 * len(held.reference.points) * len(system.states)
    with limited(memory=10 * state):
        assert held.reference.times_held == 1
        tracemalloc.start()
        sizes = replace(held).states
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        assert peak < memory_left()
    np.testing.assert_array_equal(sizes, expected)
