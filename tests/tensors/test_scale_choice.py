"""The coordinate of a parameter that needs the fewest nodes, chosen on lines."""

import numpy as np
import pytest

from rankone.tensors import IDENTITY, ChebyshevBasis, Logarithm, Reciprocal
from rankone.tensors.adaptive import (
    AdaptiveInterpolation,
    InterpolationLimits,
    KnownElements,
    Tightening,
    needed,
)
from rankone.tensors.slab import LineColumns, best_coordinates, candidates

TOLERANCE = 1e-6


def chosen(function, interval, scale, count=14, redrawn=None):
    """The coordinate chosen for a function; ``redrawn`` collects the lines drawn again."""
    basis = ChebyshevBasis(*interval, count, scale=scale)

    def redraw(places):
        if redrawn is None:
            raise AssertionError("no line is to be drawn again")
        redrawn.extend(places)
        return [function(x)[None, None, :] for _, x in places]

    line = LineColumns(basis, function(basis.nodes)[None, None, :])

    def nodes(spectrum):
        return needed(spectrum, TOLERANCE, np.inf)

    (best,) = best_coordinates([line], [True], redraw, nodes, TOLERANCE)
    return best.basis.scale


def test_a_resolved_line_tells_of_other_coordinates_for_nothing():
    box = (0.5, 20.0)
    assert chosen(lambda x: 2.0 * x - 1.0, box, Logarithm(), count=24) == IDENTITY
    assert chosen(lambda x: 1.0 / x + 2.0, box, Logarithm(), count=24) == Reciprocal()
    assert chosen(lambda x: np.log(x) ** 3, box, Logarithm(), count=24) == Logarithm()


def test_a_narrow_interval_has_no_other_coordinates():
    assert candidates(ChebyshevBasis(1.0, 2.5, 8)) == ()
    assert candidates(ChebyshevBasis(-1.0, 2.5, 8)) == ()
    assert candidates(ChebyshevBasis(0.0, 2.5, 8)) == ()
    assert candidates(ChebyshevBasis(-9.0, -1.0, 8)) == (Reciprocal(),)
    assert chosen(lambda x: np.sin(60 * x), (1.0, 2.5), IDENTITY) == IDENTITY


def test_lines_that_are_not_resolved_are_drawn_again():
    redrawn = []
    scale = chosen(lambda x: np.tanh(0.5 * np.log(x / 1e-2)), (1e-4, 1.0), IDENTITY, 8, redrawn)
    assert scale == Logarithm()
    assert len(redrawn) == 2


def test_a_coordinate_that_does_not_see_a_decade_is_not_taken():
    """At few nodes of the parameter itself nothing happens: all of it is below the first one."""

    def function(x):
        return np.tanh(4.0 * np.log(x / 3e-6))

    assert function(ChebyshevBasis(1e-7, 1.0, 14).nodes).min() > 0.999
    redrawn = []
    assert chosen(function, (1e-7, 1.0), Logarithm(), redrawn=redrawn) != IDENTITY
    assert redrawn


@pytest.mark.parametrize(
    ("box", "function", "expected"),
    [
        (((1e-6, 1e-2), (1.0, 2.0)), lambda x, y: np.sin(0.5 * np.log(x / 1e-4) * y), Logarithm()),
        (((1e-3, 1.0), (1.0, 2.0)), lambda x, y: x * y, IDENTITY),
        (((0.1, 5.0), (1.0, 2.0)), lambda x, y: y / x, Reciprocal()),
    ],
)
def test_an_interpolation_takes_the_coordinate(box, function, expected):
    limits = InterpolationLimits(ChebyshevBasis, 200, 50)
    tightening = Tightening(1.2, 0.7, 0.1, 0.7)
    adaptive = AdaptiveInterpolation(box, limits, 1e-6, tightening)
    train, limited = adaptive.interpolate(
        lambda points: function(*points.T)[None, :], lambda _: [KnownElements()] * 2
    )
    assert not limited
    assert adaptive.bases[0].scale == expected
    assert adaptive.bases[1].scale == IDENTITY
    lower, upper = np.log(np.array(box)).T
    points = np.exp(lower + (upper - lower) * np.random.default_rng(0).random((200, 2)))
    modes = [basis.modal_values(x) for basis, x in zip(adaptive.bases, points.T, strict=True)]
    values = np.einsum("ar,rms,pm,snb,pn->pa", *train.cores[:2], modes[0], train.cores[2], modes[1])
    assert values[:, 0] == pytest.approx(function(*points.T), abs=2e-5)


def test_known_elements_keep_the_first_coordinate():
    limits = InterpolationLimits(ChebyshevBasis, 200, 50)
    adaptive = AdaptiveInterpolation(
        ((1e-3, 1.0),), limits, 1e-6, Tightening(1.2, 0.7, 0.1, 0.7), [Logarithm()]
    )
    adaptive.interpolate(
        lambda points: np.abs(points.T - 0.25), lambda _: [KnownElements(borders=(0.25,))]
    )
    (basis,) = adaptive.bases
    assert basis.scale == Logarithm()
    assert 0.25 in basis.breaks
