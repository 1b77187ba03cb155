"""Boxes that tile a box: which one holds a point, and what is wrong where they do not tile."""

from itertools import pairwise

import numpy as np
import pytest

from rankone.support.errors import OptionError
from rankone.tensors.branch_evaluator import Tiling

# five rectangles around a square: no cut goes through the whole box
PINWHEEL = [
    ((0.0, 2.0), (0.0, 1.0)),
    ((2.0, 3.0), (0.0, 2.0)),
    ((1.0, 3.0), (2.0, 3.0)),
    ((0.0, 1.0), (1.0, 3.0)),
    ((1.0, 2.0), (1.0, 2.0)),
]


def holders(boxes, points):
    """The boxes that hold each point, edges included."""
    inside = [[(a <= x) & (x <= b) for (a, b), x in zip(box, points)] for box in boxes]
    return np.array([np.logical_and.reduce(axes) for axes in inside])


def test_points_belong_to_a_box_that_holds_them():
    tiling = Tiling.of(PINWHEEL, ["x", "y"])
    assert tiling.box == ((0.0, 3.0), (0.0, 3.0))
    points = np.concatenate(
        [np.random.default_rng(0).uniform(0, 3, (2, 200)), np.indices((4, 4)).reshape(2, -1)],
        axis=1,
    )
    owners = tiling.owners_at(points)
    assert holders(PINWHEEL, points)[owners, np.arange(owners.size)].all()
    grouped = np.full(owners.size, -1)
    for position, here in tiling.groups(points):
        grouped[here] = position
    assert (grouped == owners).all()


def test_an_edge_belongs_to_the_box_above():
    tiling = Tiling.of([((0.0, 1.0),), ((1.0, 2.0),)], ["x"])
    assert tiling.owners_at(np.array([[0.0, 1.0, 2.0]])).tolist() == [0, 1, 1]


def test_edges_may_differ_by_rounding():
    third = 1.0 / 3.0
    boxes = [((0.0, third),), ((third + 1e-16, 2 * third),), ((2 * third - 1e-16, 1.0),)]
    assert len(Tiling.of(boxes, ["x"]).edges[0]) == 4


def test_grids_are_taken_apart():
    tiling = Tiling.of(PINWHEEL, ["x", "y"])
    axes = [np.linspace(0, 3, 7), np.array([2.5, 0.5])]
    table = np.full((7, 2), -1)
    for position, here in tiling.on_axes(axes):
        table[np.ix_(*here)] = position
    points = np.stack(np.meshgrid(*axes, indexing="ij")).reshape(2, -1)
    assert (table.ravel() == tiling.owners_at(points)).all()


@pytest.mark.parametrize(
    ("boxes", "text"),
    [
        ([((0, 1),), ((2, 3),)], r"no piece covers the box where `x` is in \[1, 2\]"),
        ([((0, 1),), ((0.5, 3),)], r"pieces 0 and 1 overlap where `x` is in \[0.5, 1\]"),
        ([((0, 1),), ((0, 1),)], r"pieces 0 and 1 overlap"),
    ],
)
def test_gaps_and_overlaps_are_named(boxes, text):
    with pytest.raises(OptionError, match=text):
        Tiling.of(boxes, ["x"])


def test_gaps_of_a_missing_piece():
    with pytest.raises(OptionError, match=r"`x` is in \[1, 2\] and `y` is in \[1, 2\]"):
        Tiling.of(PINWHEEL[:-1], ["x", "y"])


def test_cuts_at_too_many_places():
    ends = np.linspace(0.0, 1.0, 300)
    boxes = [((a, b),) * 3 for a, b in pairwise(ends)]
    with pytest.raises(OptionError, match="cut at too many different places"):
        Tiling.of(boxes, ["x", "y", "z"])
