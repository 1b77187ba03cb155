"""Names at the ends of lines keep apart from each other and from ticks, at any size."""

from __future__ import annotations

import itertools
import pickle

import matplotlib.pyplot as plt
import numpy as np
import pytest

from rankone.share.plotting import style
from rankone.share.plotting.line_ends import apart

ENDS = [[0.0, 0.0, 0.0], [1.0, 1.0, 0.99], [0.0, 0.5, 1.0, 0.51], [3e-3, 2e-3, 1e-3, 0, 0, 0.02]]


@pytest.mark.parametrize("ends", ENDS)
@pytest.mark.parametrize("size", [(5.6, 3.5), (3.0, 2.5)])
def test_names_do_not_touch(ends, size):
    """Also when limits change afterwards, as they do for indices, and the figure its size."""
    figure, ax = plt.subplots(layout="constrained")
    lines = [ax.plot([0, 1], [0.5, end])[0] for end in ends]
    style.name_ends(ax, lines, [f"k{i}" for i in range(len(ends))])
    ax.set(xlim=(0, 1), ylim=(0, 1.02))
    figure.set_size_inches(*size)
    figure.canvas.draw()
    renderer = figure.canvas.get_renderer()
    boxes = [text.get_window_extent(renderer) for text in ax.texts]
    ticks = [tick.get_window_extent(renderer) for tick in ax.get_xticklabels()]
    for one, other in itertools.combinations([*boxes, *ticks[-1:]], 2):
        assert not one.overlaps(other)
    order = [box.y0 for box in boxes]
    assert [*np.argsort(order, kind="stable")] == [*np.argsort(ends, kind="stable")]
    again = pickle.loads(pickle.dumps(figure))
    assert [text.get_text() for text in again.axes[0].texts] == [f"k{i}" for i in range(len(ends))]


def test_places_are_closest_to_heights():
    np.testing.assert_allclose(apart(np.array([5.0, 50.0]), 10.0, 0.0, 100.0), [5.0, 50.0])
    np.testing.assert_allclose(apart(np.array([51.0, 50.0]), 10.0, 0.0, 100.0), [55.5, 45.5])
    np.testing.assert_allclose(apart(np.array([0.0, 1.0]), 10.0, 0.0, 100.0), [5.0, 15.0])
    np.testing.assert_allclose(apart(np.array([99.0, 100.0]), 10.0, 0.0, 100.0), [85.0, 95.0])
    np.testing.assert_allclose(apart(np.array([3.0, 2.0, 1.0]), 10.0, 0.0, 20.0), [25.0, 15.0, 5.0])
