"""One reference for all engines that a solve tries."""

import numpy as np
import pytest

import rankone as ro
from rankone.solvers.request import Domain, SolveRequest
from rankone.solvers.stretches_by_markers import reference_set_of, sharing_references
from rankone.solvers.verification import reference_set as reference_sets
from rankone.solvers.verification.reference_set import ReferenceSet
from rankone.trajectories.integrators.workers import Workers
from tests.problems import EXAMPLES


@pytest.fixture(scope="module")
def compiled():
    return ro.compile(EXAMPLES["coupled"].problem)


def test_the_second_engine_takes_the_reference_of_the_first(compiled, monkeypatch):
    references, integrate = [], reference_sets.integrate_reference

    def counted(system, points, horizon, accuracy, *arguments):
        if len(points) > 64:  # others are a few further points
            references.append((points.tobytes(), accuracy))
        return integrate(system, points, horizon, accuracy, *arguments)

    monkeypatch.setattr(reference_sets, "integrate_reference", counted)
    solution = compiled.solve(1e-6, max_nodes=5, max_attempts=1)
    assert "Also tried" in solution.message
    assert references  # those of remedies that are tried have other boxes or tolerances
    assert len(set(references)) == len(references)


def test_lines_that_nobody_asks_for_are_left_out(compiled):
    system = compiled.system
    request = SolveRequest(1e-4, Domain.of(system))
    lines = np.full((3, 3), 0.75)
    with sharing_references():
        made = reference_set_of(system, request, lines, Workers(system))
        again = reference_set_of(system, request, lines, Workers(system))
        without = reference_set_of(system, request, None, Workers(system))
    alone = ReferenceSet.of(system, request)
    assert again.reference is made.reference
    np.testing.assert_array_equal(without.reference.points, alone.reference.points)
    times = np.linspace(0.0, 0.5, 5)
    np.testing.assert_allclose(without.reference(times), alone.reference(times), rtol=1e-6)
    np.testing.assert_array_equal(without.sizes, made.sizes)


def test_another_request_has_a_reference_of_its_own(compiled):
    system = compiled.system
    with sharing_references():
        sets = [
            reference_set_of(system, SolveRequest(rtol, Domain.of(system)), None, Workers(system))
            for rtol in (1e-3, 1e-5)
        ]
    assert sets[0].accuracy > sets[1].accuracy
