"""Points at which a solution is likely to be wrong are found."""

from __future__ import annotations

import numpy as np

import rankone as ro
from rankone.solvers.request import Domain
from rankone.solvers.verification.points import active_points, candidate_points
from rankone.tensors import ChebyshevBasis
from rankone.tensors.slab import SlabTrain
from rankone.tensors.train import Train


def system(rate: str, box: dict[str, tuple[float, float]]):
    return ro.compile(ro.Problem.from_strings({"x": rate}, {"x": 1}, box, (0, 1))).system


def test_rare_terms_are_looked_at_where_they_are_active():
    narrow = system("-x + a*b*exp(-((c - 0.3)/0.02)**2)", dict.fromkeys("abc", (0, 1)))
    points = active_points(narrow, Domain.of(narrow))
    assert len(points) >= 12
    assert np.abs(points[:, 2] - 0.3).max() < 0.1
    assert points[:, 0].mean() > 0.55


def test_terms_active_everywhere_need_no_more_points():
    usual = system("-a*x + b*c", dict.fromkeys("abc", (0.5, 1.5)))
    assert len(active_points(usual, Domain.of(usual))) == 0


def slab(nodes: int, parameters: int = 1) -> SlabTrain:
    """x(p) = T_1 in the first parameter, constant in the others."""
    bases = tuple(ChebyshevBasis(0.0, 1.0, nodes) for _ in range(parameters))
    cores = [np.ones((1, 1, 1)), np.zeros((1, nodes, 1)), *[np.eye(1, nodes)[..., None]] * 9]
    cores[1][0, 1] = 1.0
    return SlabTrain(0.0, 1.0, Train(tuple(cores[: 1 + parameters])), bases)


def test_smooth_solutions_of_few_parameters_are_not_looked_at():
    assert candidate_points([slab(9)], np.ones(1), 0, 1e-3) is None
    assert candidate_points([slab(60)], np.ones(1), 0, 1e-3) is None


def test_many_nodes_or_many_parameters_are_looked_at():
    assert len(candidate_points([slab(100)], np.ones(1), 0, 1e-3)) == 12
    assert candidate_points([slab(9, 4)], np.ones(1), 0, 1e-3).shape == (12, 4)
    one, two = (candidate_points([slab(100)], np.ones(1), number, 1e-3) for number in (0, 1))
    assert not np.array_equal(one, two)
