"""The prepared evaluation against the plain one of the slabs."""

from __future__ import annotations

import numpy as np
import pytest

from rankone.discretization import Basis1D, ChebyshevBasis, LegendreBasis
from rankone.tensors.evaluator import TrainEvaluator
from rankone.tensors.slab import SlabTrain

BASES = {
    "equal": (ChebyshevBasis(-2.0, 3.0, 6, 3), LegendreBasis(0.1, 0.7, 5)),
    "unequal": (
        ChebyshevBasis(-2.0, 3.0, 6, breaks=(-1.9, 0.3, 1.0 / 3.0)),
        LegendreBasis(0.1, 0.7, 5, breaks=(0.6,)),
    ),
    "mixed": (ChebyshevBasis(-2.0, 3.0, 6, 2), LegendreBasis(0.1, 0.7, 5, breaks=(0.2, 0.5))),
}


def random_slab(bases: tuple[Basis1D, ...]) -> SlabTrain:
    rng = np.random.default_rng(1)
    ranks, sizes = (2, 3, 4, 1), (7, *(basis.size for basis in bases))
    cores = tuple(rng.standard_normal((ranks[j], sizes[j], ranks[j + 1])) for j in range(3))
    return SlabTrain(0.0, 1.5, cores, bases)


def assert_all_agree(slab: SlabTrain, points: np.ndarray) -> None:
    wanted = slab(points[0], points[1:])
    scale = 1e-13 * np.abs(wanted).max()
    evaluator, rows = TrainEvaluator([slab]), slice(None)
    np.testing.assert_allclose(evaluator.many(points, rows), wanted, atol=scale)
    one = np.stack([evaluator.one(point.tolist(), rows) for point in points.T], axis=1)
    np.testing.assert_allclose(one, wanted, atol=scale)
    grid = evaluator.grid(list(points), rows)
    diagonal = np.arange(points.shape[1])
    np.testing.assert_allclose(grid[:, diagonal, diagonal, diagonal], wanted, atol=scale)


@pytest.mark.parametrize("name", BASES)
def test_at_random_points(name: str) -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform([[0], [-2], [0.1]], [[1.5], [3], [0.7]], (3, 60))
    assert_all_agree(random_slab(BASES[name]), points)


def test_a_break_belongs_to_the_later_element() -> None:
    slab = random_slab(BASES["unequal"])
    edges = [basis.edges for basis in slab.bases]
    points = np.array([[0.7, p, q] for p in edges[0] for q in edges[1]]).T
    assert_all_agree(slab, points)
    upper = np.array([3.0, 0.7])[:, None]
    just_after = np.minimum(points[1:] + 1e-12, upper)
    np.testing.assert_allclose(
        slab(points[0], points[1:]), slab(points[0], just_after), rtol=1e-6, atol=1e-6
    )


def test_without_points_in_some_elements() -> None:
    slab = random_slab(BASES["unequal"])
    assert_all_agree(slab, np.array([[0.2, 0.3], [-1.95, -1.92], [0.65, 0.66]]))
    assert TrainEvaluator([slab]).many(np.empty((3, 0)), slice(None)).shape == (2, 0)
