"""Scales of a parameter, and bases whose modes are polynomials in them."""

import numpy as np
import pytest

from rankone.tensors import (
    BASES,
    IDENTITY,
    SCALES,
    ChebyshevBasis,
    LegendreBasis,
    Logarithm,
    Reciprocal,
)

CASES = [
    (Logarithm(), (1e-6, 1e-2)),
    (Logarithm(), (1e-19, 1.0)),
    (Reciprocal(), (0.5, 20.0)),
    (Reciprocal(), (-3.0, -0.2)),
]


@pytest.mark.parametrize(("scale", "interval"), CASES)
def test_a_scale_ascends_and_is_inverted(scale, interval):
    x = scale.from_scale(np.linspace(*scale.to_scale(np.array(interval)), 50))
    assert (np.diff(x) > 0.0).all()
    s = scale.to_scale(x)
    assert (np.diff(s) > 0.0).all()
    assert scale.from_scale(s) == pytest.approx(x, rel=1e-13, abs=1e-16)
    step = 1e-6 * np.minimum(np.abs(x) + 1e-30, 1.0 / scale.slope(x))
    quotient = (scale.to_scale(x + step) - scale.to_scale(x - step)) / (2.0 * step)
    assert quotient == pytest.approx(scale.slope(x), rel=1e-5)


@pytest.mark.parametrize(("scale", "interval"), CASES)
@pytest.mark.parametrize("kind", sorted(BASES))
@pytest.mark.parametrize("breaks", [0, 2])
def test_polynomials_in_the_scale_are_exact(scale, interval, kind, breaks):
    ends = scale.to_scale(np.array(interval))
    inside = tuple(scale.from_scale(ends[0] + np.ptp(ends) * np.array([0.2, 0.55])[:breaks]))
    basis = BASES[kind](*interval, 6, breaks=inside, scale=scale)

    def function(x):
        return (scale.to_scale(x) - ends[0]) ** 4 / np.ptp(ends) ** 4

    assert (np.diff(basis.nodes) > 0.0).all()
    assert (basis.edges[0], basis.edges[-1]) == interval
    x = scale.from_scale(np.linspace(*ends, 60)).clip(*interval)
    modes = basis.to_modal @ (np.sqrt(basis.weights) * function(basis.nodes))
    assert basis.modal_values(x) @ modes == pytest.approx(function(x), abs=1e-12)
    slopes = 4.0 * (scale.to_scale(x) - ends[0]) ** 3 / np.ptp(ends) ** 4 * scale.slope(x)
    errors = basis.modal_slopes(x) @ modes - slopes
    assert (np.abs(errors) <= 1e-11 * scale.slope(x)).all()
    derivative, finer = basis.derivative
    of_derivative = finer.modal_values(x) @ (derivative @ modes)
    assert of_derivative == pytest.approx(slopes, abs=1e-11 * scale.slope(x).max())


@pytest.mark.parametrize("elements", [1, 3])
def test_a_part_of_an_interval_holds_the_same_function(elements):
    basis = LegendreBasis(1e-4, 10.0, 7, elements, scale=Logarithm())
    assert np.diff(np.log(basis.edges)) == pytest.approx(np.log(1e5) / elements)
    part = basis.restricted(3e-4, 2.0)
    assert (part.scale, part.lower, part.upper) == (Logarithm(), 3e-4, 2.0)
    values = np.log(basis.nodes) ** 5
    on_part = basis.transfer(part) @ (np.sqrt(basis.weights) * values) / np.sqrt(part.weights)
    assert on_part == pytest.approx(np.log(part.nodes) ** 5, abs=1e-9)


def test_refined_elements_are_halved_in_the_scale():
    basis = ChebyshevBasis(1e-4, 1.0, 5, breaks=(1e-3,), scale=Logarithm())
    finer = basis.refined(5)
    assert finer.breaks == pytest.approx([10**-3.5, 1e-3, 10**-1.5])
    assert finer.scale == basis.scale


def test_a_scale_that_is_infinite_on_the_interval_is_refused():
    with pytest.raises(ValueError, match=r"Logarithm.* is not finite on 0.0, 1.0"):
        LegendreBasis(0.0, 1.0, 4, scale=Logarithm())
    with pytest.raises(ValueError, match="Reciprocal"):
        LegendreBasis(-1.0, 1.0, 4, scale=Reciprocal())


def test_the_scales_by_kind():
    assert list(SCALES) == ["linear", "log", "reciprocal"]
    assert SCALES["linear"] == IDENTITY
    assert LegendreBasis(0.0, 1.0, 4) == LegendreBasis(0.0, 1.0, 4, scale=IDENTITY)


@pytest.mark.parametrize(("scale", "interval"), CASES)
def test_the_slope_of_a_scale_is_resolved_by_few_modes(scale, interval):
    assert scale.slope_modes(*interval) < 150
    assert scale.slope_modes(*interval, inverse=True) < 150
