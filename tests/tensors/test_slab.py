"""Slabs are evaluated at pairs, and on grids with the part of the parameters formed once."""

from __future__ import annotations

import numpy as np

from rankone.tensors import ChebyshevBasis
from rankone.tensors.evaluator import TrainEvaluator
from rankone.tensors.slab import SlabTrain, sharing
from rankone.tensors.train import Train


def test_on_a_grid_as_at_pairs():
    generator = np.random.default_rng(1)
    bases = (ChebyshevBasis(0.0, 1.0, 4), ChebyshevBasis(-1.0, 2.0, 5))
    cores = tuple(generator.standard_normal(s) for s in ((2, 3, 4), (4, 4, 3), (3, 5, 1)))
    slab = SlabTrain(0.5, 1.5, Train(cores), bases)
    times, points = np.array([0.5, 0.9, 1.4]), generator.random((2, 7))
    found = slab.on_grid(times, slab.over_parameters(points))
    for i, time in enumerate(times):
        np.testing.assert_allclose(found[..., i], slab(np.full(7, time), points), rtol=1e-12)
    later = SlabTrain(1.5, 2.0, Train((generator.standard_normal((2, 3, 4)), *cores[1:])), bases)
    assert later.shares_parameters(slab)
    loaded = SlabTrain(2.0, 3.0, Train(tuple(map(np.copy, cores))), bases)
    assert loaded.shares_parameters(slab)
    other = SlabTrain(3.0, 4.0, Train(tuple(2.0 * core for core in cores)), bases)
    assert not other.shares_parameters(slab)
    assert [len(run) for run in sharing([slab, later, loaded, other])] == [3, 1]


def test_cores_wider_on_one_side_at_many_points():
    """The order of the products, and the parts of the points, change nothing but rounding."""
    generator = np.random.default_rng(2)
    bases = (ChebyshevBasis(0.0, 1.0, 30), ChebyshevBasis(-1.0, 2.0, 25))
    cores = tuple(generator.standard_normal(s) for s in ((2, 3, 6), (6, 30, 40), (40, 25, 1)))
    slab = SlabTrain(0.5, 1.5, Train(cores), bases)
    points = generator.random((2, 3000))
    k, c = (basis.modal_values(row) for basis, row in zip(bases, points, strict=True))
    exact = np.einsum("lir,mi,rjo,mj->lm", cores[1], k, cores[2], c, optimize=True)
    np.testing.assert_allclose(slab.over_parameters(points), exact, rtol=1e-9, atol=1e-9)
    evaluator, times = TrainEvaluator([slab]), np.full(3000, 0.9)
    found = evaluator.many(np.concatenate([times[None], points]), slice(0, 2))
    np.testing.assert_allclose(found, slab(times, points), rtol=1e-9, atol=1e-9)
