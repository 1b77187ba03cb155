"""The prepared evaluation against the plain one of the slabs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rankone.tensors import Basis1D, ChebyshevBasis, LegendreBasis
from rankone.tensors import evaluator as module
from rankone.tensors.evaluator import TrainEvaluator
from rankone.tensors.slab import SlabTrain
from rankone.tensors.train import Train

BASES = {
    "equal": (ChebyshevBasis(-2.0, 3.0, 6, 3), LegendreBasis(0.1, 0.7, 5)),
    "unequal": (
        ChebyshevBasis(-2.0, 3.0, 6, breaks=(-1.9, 0.3, 1.0 / 3.0)),
        LegendreBasis(0.1, 0.7, 5, breaks=(0.6,)),
    ),
    "mixed": (ChebyshevBasis(-2.0, 3.0, 6, 2), LegendreBasis(0.1, 0.7, 5, breaks=(0.2, 0.5))),
}


def random_slab(bases: tuple[Basis1D, ...], rng: np.random.Generator | None = None) -> SlabTrain:
    rng = rng or np.random.default_rng(1)
    ranks, sizes = (2, 3, 4, 1), (7, *(basis.size for basis in bases))
    cores = tuple(rng.standard_normal((ranks[j], sizes[j], ranks[j + 1])) for j in range(3))
    return SlabTrain(0.0, 1.5, Train(cores), bases)


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


STARTS = (0.0, 0.5, 0.75, 2.0, 2.25)


def jumping_slabs(shared: str) -> list[SlabTrain]:
    """Slabs with jumps between them; ``shared`` has a letter for the parameters' cores of each."""
    rng = np.random.default_rng(2)
    bases, made = BASES["mixed"], {}
    slabs = []
    for start, end, letter in zip(STARTS, (*STARTS[1:], 3.0), shared):
        made.setdefault(letter, random_slab(bases, rng).cores[1:])
        modes = 7 if letter == letter.lower() else 4
        first = rng.standard_normal((2, modes, 3))
        slabs.append(SlabTrain(start, end, Train((first, *made[letter])), bases))
    return slabs


def pointwise(slabs: list[SlabTrain], times: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Values (states, T, N) by the slabs themselves; between two the later one counts."""
    times = np.broadcast_to(times, (len(times), points.shape[1]))
    values = np.empty((2, *times.shape))
    owner = np.searchsorted(STARTS[1:], times, side="right")
    for k, slab in enumerate(slabs):
        at, columns = np.nonzero(owner == k)
        if at.size:
            values[:, at, columns] = slab(times[at, columns], points[:, columns])
    return values


@pytest.mark.parametrize("shared", ["abcde", "aaaaa", "aabbb", "abbba", "aaAAa"])
@pytest.mark.parametrize("chunk", [1024, 5])
def test_curves_of_slabs_that_share_cores_or_not(
    shared: str, chunk: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    slabs = jumping_slabs(shared)
    if shared == "aaAAa":  # the time cores of two slabs are shorter than the others'
        slabs = [
            SlabTrain(s.start, s.end, Train((s.cores[0], *slabs[0].cores[1:])), s.bases)
            for s in slabs
        ]
    evaluator, rows = TrainEvaluator(slabs), slice(None)
    assert len(evaluator.trains) == len({"abbba": "abc", "aaAAa": "aAa"}.get(shared, {*shared}))
    if chunk == 5:
        monkeypatch.setattr(module, "AT_ONCE", 5)
        monkeypatch.setattr(module, "_TIMES", 2)
        for train in evaluator.trains:
            train.chunk = 5
    rng = np.random.default_rng(3)
    edges = [basis.edges for basis in slabs[0].bases]
    p, q = (rng.permuted([*ends, *rng.uniform(ends[0], ends[-1], 9)])[:11] for ends in edges)
    points = np.array([p, q])
    some = np.array([*STARTS, 3.0, *rng.uniform(0, 3, 9)])
    own = rng.permuted(np.tile(some[:, None], 11), axis=0)
    for times in (some[:, None], some[:1, None], own, own[:1]):
        for columns in (slice(None), slice(0, 1), slice(0, 0)):
            mine = times if times.shape[1] == 1 else times[:, columns]
            wanted = pointwise(slabs, mine, points[:, columns])
            scale = 1e-13 * np.abs(wanted).max(initial=0.0)
            values = evaluator.curves(mine, points[:, columns], rows)
            np.testing.assert_allclose(values, wanted, atol=scale, rtol=0)
            last = evaluator.curves(mine, points[:, columns], np.array([1]))
            np.testing.assert_allclose(last, wanted[1:], atol=scale, rtol=0)
    np.testing.assert_allclose(
        evaluator.grid([some, p, q], rows)[:, :, np.arange(11), np.arange(11)],
        evaluator.curves(some[:, None], points, rows),
        rtol=1e-11,
    )
    for times in (np.empty((0, 1)), np.empty((0, 11))):
        assert evaluator.curves(times, points, rows).shape == (2, 0, 11)


@pytest.mark.parametrize("name", BASES)
def test_curves_whose_times_are_alike_for_some_rows(name):
    slab = random_slab(BASES[name])
    slabs = [slab, replace(slab, start=1.5, end=2.0)]
    evaluator, rng = TrainEvaluator(slabs), np.random.default_rng(5)
    points = np.array([[-1.95, 0.3, 2.9, 0.35], [0.15, 0.65, 0.3, 0.6]])
    alike = np.array([0.1, 1.9, 1.5, 0.7])
    times = np.concatenate([np.repeat(alike[:, None], 4, axis=1), 2.0 * rng.random((3, 4))])
    times = times[rng.permutation(len(times))]
    wanted = np.array(
        [
            [slabs[int(t >= 1.5)](np.array([t]), p[:, None])[:, 0] for t, p in zip(row, points.T)]
            for row in times
        ]
    )
    scale = 1e-13 * np.abs(wanted).max()
    curves = evaluator.curves(times, points, slice(None))
    np.testing.assert_allclose(curves, wanted.transpose(2, 0, 1), atol=scale)
    fixed = evaluator.at_times(alike, np.array([1]))
    np.testing.assert_allclose(
        fixed(points), evaluator.curves(alike[:, None], points, np.array([1])), atol=scale
    )
