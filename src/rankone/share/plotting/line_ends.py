"""Names at the ends of lines, which are moved apart whenever a figure is drawn."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy.optimize
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backend_bases import RendererBase
from matplotlib.font_manager import FontProperties
from matplotlib.lines import Line2D
from matplotlib.text import Annotation

from rankone.support.arrays import Array

_LINE_HEIGHT = 1.25  # Height of a line of labels, in units of the size of their letters


class EndNames(Artist):
    """Names at the right ends of lines; the heights of the axes are known when they are drawn."""

    def __init__(self, ax: Axes, lines: Sequence[Line2D], names: Sequence[str]) -> None:
        super().__init__()
        self._letter = FontProperties(size="medium").get_size_in_points()
        self._names = [self._name(ax, *each) for each in zip(lines, names, strict=True)]
        self.set_zorder(-np.inf)  # before the names themselves
        ax.add_artist(self)
        ax.autoscale_view()
        self._move()

    def _name(self, ax: Axes, line: Line2D, name: str) -> Annotation:
        x, y = (float(np.asarray(row)[-1]) for row in line.get_data())
        return ax.annotate(
            name,
            (x, y),
            xytext=(0.5 * self._letter, 0.0),
            textcoords="offset points",
            color=line.get_color(),
            verticalalignment="center",
            annotation_clip=False,
        )

    def draw(self, renderer: RendererBase) -> None:
        """Move the names apart; they are drawn by the axes."""
        self._move()

    def _move(self) -> None:
        ax = self.axes
        assert isinstance(ax, Axes)
        figure = ax.get_figure()
        assert figure is not None
        points = 72.0 / figure.dpi
        ends = ax.transData.transform([name.xy for name in self._names])[:, 1] * points
        low, high = ax.transAxes.transform([(0, 0), (0, 1)])[:, 1] * points
        places = apart(ends, _LINE_HEIGHT * self._letter, low, high)
        for name, move in zip(self._names, places - ends, strict=True):
            name.set_position((0.5 * self._letter, float(move)))


def apart(heights: Array, gap: float, low: float, high: float) -> Array:
    """Places with gaps that are closest to heights, in the mean square, within their range.

    Half a gap is left at either end of the range; where that is too short, places begin at its low
    end.
    """
    order = np.argsort(heights, kind="stable")
    steps = gap * np.arange(len(order))
    first = low + 0.5 * gap
    last = max(high - 0.5 * gap - steps[-1], first)
    even = scipy.optimize.isotonic_regression(heights[order] - steps).x
    places = np.empty(len(order))
    places[order] = np.clip(even, first, last) + steps
    return places
