"""The canonical form against exact functions and against singular values."""

from __future__ import annotations

import math

import numpy as np
import pytest

from rankone.support.errors import OptionError, RankoneWarning
from rankone.tensors import ChebyshevBasis, LegendreBasis
from rankone.tensors.canonical import CanonicalForm, canonical_form
from rankone.tensors.slab import SlabTrain
from rankone.tensors.train import Train
from tests.solution.evaluation.functions import (
    TIME_MODES,
    Array,
    Known,
    known,
    one,
    slab_train,
    two_unknowns,
)


def form_of(example: Known, rtol: float, state: int = 0, max_rank: int = 500) -> CanonicalForm:
    solution = example.solution
    names = (solution.metadata.time, *solution.metadata.parameters)
    return canonical_form(solution.outcome.slabs, names, state, "u", rtol=rtol, max_rank=max_rank)


def heat(t: Array, p: Array, q: Array) -> Array:
    """A function of infinite rank."""
    return np.exp(-t * p * q) / (1.0 + t * (p + q))


def interpolated(slabs: int, degree: int) -> list[SlabTrain]:
    """`heat` over the box [0, 1]^2 and slabs of length one, as exact trains of its interpolant."""
    bases = (ChebyshevBasis(0.0, 1.0, degree), LegendreBasis(0.0, 1.0, degree))
    result = []
    for start in range(slabs):
        time = LegendreBasis(start, start + 1.0, TIME_MODES)
        values = heat(*np.meshgrid(time.nodes, *(b.nodes for b in bases), indexing="ij"))
        for axis, basis in enumerate((time, *bases)):
            modal = basis.to_modal * np.sqrt(basis.weights)
            values = np.moveaxis(np.tensordot(modal, values, ([1], [axis])), 0, axis)
        u, s, vt = np.linalg.svd(values.reshape(TIME_MODES, -1), full_matrices=False)
        middle = (s[:, None] * vt).reshape(-1, degree, degree)
        last = np.eye(degree)[:, :, None]
        result.append(SlabTrain(float(start), start + 1.0, Train((u[None], middle, last)), bases))
    return result


def orthonormality(form: CanonicalForm, name: str) -> Array:
    modes = form.factors[name] * np.sqrt(form.weights[name])[:, None]
    return np.abs(modes.T @ modes - np.eye(form.rank))


def test_one_parameter_is_the_singular_value_decomposition() -> None:
    example = known(
        [[(np.sin, np.exp), (np.cos, lambda p: p**2), (one, one)]], ["u"], {"p": (0.0, 1.0)}
    )
    form = form_of(example, 1e-10)
    assert form.rank == 3
    assert orthonormality(form, "t").max() < 1e-12
    assert orthonormality(form, "p").max() < 1e-12
    assert np.all(np.diff(form.amplitudes) < 0)
    assert np.all(form.amplitudes > 0)
    # an independent discretisation of the same integral operator
    times, weights_t = np.polynomial.legendre.leggauss(40)
    points, weights_p = np.polynomial.legendre.leggauss(40)
    values = example(1.5 * (times[:, None] + 1), 0.5 * (points + 1))[0]
    scaled = np.sqrt(0.5 * weights_t)[:, None] * values * np.sqrt(0.5 * weights_p)
    singular = np.linalg.svd(scaled, compute_uv=False)[:3]
    np.testing.assert_allclose(form.amplitudes, singular, rtol=1e-8)


def test_signs_are_fixed() -> None:
    form = form_of(two_unknowns(), 1e-5)
    for name in ("x0", "y0"):
        modes = form.factors[name] * np.sqrt(form.weights[name])[:, None]
        assert np.all(modes[np.argmax(np.abs(modes), axis=0), np.arange(form.rank)] > 0)


def test_elements_and_slabs_of_different_bases() -> None:
    example = two_unknowns(elements=2)
    form = form_of(example, 1e-8)
    rng = np.random.default_rng(0)
    t, p, q = rng.uniform([[0], [-1], [2]], [[3], [1], [3]], (3, 200))
    np.testing.assert_allclose(form(t, x0=p, y0=q), example(t, p, q)[0], atol=1e-6)


def test_slabs_of_different_breaks() -> None:
    """Jumps at breaks that differ from slab to slab are kept."""
    inside = [((-0.3, 0.3), ()), ((0.3 + 4e-16,), (2.25,)), ((), (2.1, 2.25))]
    rng = np.random.default_rng(3)
    slabs = []
    for k, breaks in enumerate(inside):
        bases = (
            ChebyshevBasis(-1.0, 1.0, 4, breaks=breaks[0]),
            LegendreBasis(2.0, 3.0, 3, *((2,) if k == 0 else (1, breaks[1]))),
        )
        shapes = [(1, 5, 2), (2, bases[0].size, 2), (2, bases[1].size, 1)]
        cores = tuple(rng.standard_normal(shape) for shape in shapes)
        slabs.append(SlabTrain(float(k), k + 1.0, Train(cores), bases))
    form = canonical_form(slabs, ("t", "p", "q"), 0, "u", rtol=1e-11)
    assert form.success
    np.testing.assert_allclose(form.axes[1].breaks, [-1.0, -0.3, 0.3, 1.0])
    np.testing.assert_allclose(form.axes[2].breaks, [2.0, 2.1, 2.25, 2.5, 3.0])
    points = rng.uniform([[0], [-1], [2]], [[3], [1], [3]], (3, 300))
    for k, slab in enumerate(slabs):
        t, p, q = points[:, points[0].astype(int) == k]
        np.testing.assert_allclose(form(t, p=p, q=q), slab(t, np.stack([p, q]))[0], atol=1e-8)


def test_no_parameters() -> None:
    form = form_of(known([[(np.exp,)]], ["u"], {}), 1e-10)
    assert form.rank == 1
    # the root of the mean of exp(2 t) over [0, 3]
    assert form.amplitudes[0] == pytest.approx(math.sqrt((math.exp(6) - 1) / 6), rel=1e-9)
    assert form(1.25) == pytest.approx(math.exp(1.25), rel=1e-9)


def test_zero() -> None:
    form = form_of(known([[(lambda t: 0 * t, one)]], ["u"], {"p": (0.0, 1.0)}), 1e-6)
    assert form.rank == 0
    assert form.error == 0.0
    assert form(1.0, p=0.5) == 0.0


@pytest.mark.parametrize("slabs", [1, 3])
@pytest.mark.parametrize("rtol", [1e-2, 1e-4, 1e-7])
def test_error_is_honest(rtol: float, slabs: int) -> None:
    trains = interpolated(slabs, 12)
    form = canonical_form(trains, ("t", "p", "q"), 0, "u", rtol=rtol)
    assert form.success
    grid = np.meshgrid(*form.nodes.values(), indexing="ij")
    weights = np.prod(np.meshgrid(*form.weights.values(), indexing="ij"), axis=0)
    exact = np.concatenate(
        [
            slab(piece[0].ravel(), np.reshape(piece[1:], (2, -1))).reshape(piece[0].shape)
            for slab, piece in zip(
                trains, zip(*(np.split(axis, slabs) for axis in grid), strict=True), strict=True
            )
        ]
    )
    square = np.sum(weights * (form(*grid[:1], {"p": grid[1], "q": grid[2]}) - exact) ** 2)
    true = math.sqrt(square / np.sum(weights * exact**2))
    assert true <= rtol
    # the error reported is a bound, and not much larger
    assert true <= form.error * (1 + 1e-6)
    assert form.error <= 2 * true + 0.2 * rtol


def test_least_squares_need_fewer_terms() -> None:
    """A sum of two products whose orthogonal splitting has four."""
    form = form_of(two_unknowns(), 1e-5)
    assert form.rank == 2


def test_too_few_terms_are_reported() -> None:
    with pytest.warns(RankoneWarning, match=r"2 terms leave a relative error of .*max_rank"):
        form = canonical_form(interpolated(1, 12), ("t", "p", "q"), 0, "u", rtol=1e-7, max_rank=2)
    assert not form.success
    assert form.rank == 2
    assert 1e-5 < form.error < 0.1


@pytest.mark.parametrize(
    "options",
    [
        {"rtol": 0.0},
        {"rtol": 1.0},
        {"rtol": math.nan},
        {"rtol": "a"},
        {"max_rank": 0},
        {"max_rank": "a"},
        {"max_rank": math.nan},
    ],
)
def test_bad_options(options: dict[str, float]) -> None:
    with pytest.raises(OptionError):
        two_unknowns().solution.to_canonical(**options)  # type: ignore[arg-type]


def test_tensors_of_the_same_slab_by_hand() -> None:
    slab = slab_train([[(np.sin, np.exp)]], 0.0, 2.0, [LegendreBasis(0.0, 1.0, 14)])
    form = canonical_form([slab], ("t", "p"), 0, "u", rtol=1e-9)
    assert form(1.0, p=0.5) == pytest.approx(math.sin(1.0) * math.exp(0.5), rel=1e-9)
    assert repr(form).startswith("CanonicalForm of u: 1 terms over t (14 nodes), p (14 nodes)")
