"""Solutions that tests of plots draw, and what is read from axes."""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np

import rankone as ro
from examples import lotka_volterra


@functools.cache
def populations():
    return ro.solve(lotka_volterra.problem, rtol=1e-3)


@functools.cache
def with_units():
    solution = populations()
    units = (("x", "1e3"), ("y", "1e3"), ("t", "a"), ("x0", "1e3"))
    return ro.Solution(solution.outcome, replace(solution.metadata, units=units))


@functools.cache
def product():
    """u = t (a + 2 b + a b) with a and b in [0, 1]."""
    rhs, box = {"u": "a + 2*b + a*b"}, {"a": (0, 1), "b": (0, 1)}
    return ro.solve(ro.Problem.from_strings(rhs, {"u": "0"}, box, (0, 1)), 1e-9)


def lines(ax):
    return [(np.asarray(line.get_xdata()), np.asarray(line.get_ydata())) for line in ax.get_lines()]


def texts(ax):
    return [text.get_text() for text in ax.texts]


def legend(ax):
    return [text.get_text() for text in ax.get_legend().get_texts()]


def band(ax, number=0):
    """Times, lower and upper end of a band."""
    (path,) = ax.collections[number].get_paths()
    corners = path.vertices
    times = np.unique(corners[:, 0])
    ends = [
        [corners[corners[:, 0] == t, 1].min(), corners[corners[:, 0] == t, 1].max()] for t in times
    ]
    return times, *np.transpose(ends)
