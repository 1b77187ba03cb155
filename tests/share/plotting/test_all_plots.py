"""What all plots of values have in common: axes, labels, colours, docs."""

from __future__ import annotations

import functools
import inspect
import itertools
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.figure import Figure

import rankone as ro
from examples import coupled, decay, doses
from rankone import plotting
from tests.share.plotting.drawn import legend, lines, populations, with_units

DOCS = Path(__file__).parents[3] / "docs"
EACH = {
    "trajectories": functools.partial(plotting.plot_trajectories, x0=9, y0=5),
    "bands": functools.partial(plotting.plot_bands, t=np.linspace(0.0, 6.0, 7)),
    "surface": functools.partial(plotting.plot_surface, unknown="x", x="t", y="x0", y0=5),
    "sobol": plotting.plot_sobol,
    "effects": functools.partial(plotting.plot_main_effects, t=3.0),
}


@pytest.mark.parametrize("name", EACH)
def test_axes_are_used_and_returned(name):
    figure, ax = plt.subplots()
    before = plt.get_fignums()
    assert EACH[name](populations(), ax=ax) is ax
    assert plt.get_fignums() == before
    assert EACH[name](populations()).figure is not figure
    alone = Figure().subplots()
    assert EACH[name](populations(), ax=alone) is alone
    with pytest.raises(ro.OptionError, match="not axes of Matplotlib"):
        EACH[name](populations(), ax=figure)


@pytest.mark.parametrize("name", EACH)
def test_nothing_is_clipped(name):
    """All labels are inside of the figure."""
    ax = EACH[name](with_units())
    figure = ax.figure
    figure.draw_without_rendering()
    inside, drawn = figure.bbox, figure.get_tightbbox().transformed(figure.dpi_scale_trans)
    assert drawn.x0 >= inside.x0 - 1
    assert drawn.y0 >= inside.y0 - 1
    assert drawn.x1 <= inside.x1 + 1
    assert drawn.y1 <= inside.y1 + 1


@pytest.mark.parametrize("name", EACH)
def test_what_is_no_solution(name):
    with pytest.raises(ro.OptionError, match="not Problem; remedy: give what"):
        EACH[name](decay.problem)


@pytest.mark.slow
def test_colours_go_on():
    ax = plotting.plot_bands(populations(), "x")
    plotting.plot_trajectories(populations(), x0=9, y0=5, unknowns="x", ax=ax)
    first, second = ax.get_lines()
    assert first.get_color() != second.get_color()


@pytest.mark.slow
def test_jumps_are_upright():
    solution = ro.solve(doses.problem, rtol=1e-3)
    for ax in (plotting.plot_bands(solution, "c"), plotting.plot_sobol(solution, "c")):
        times, values = lines(ax)[0]
        steps = np.diff(times)[np.argsort(np.abs(np.diff(values)))[-5:]]
        assert steps.max() < 1e-9


def test_many_unknowns_are_in_a_legend():
    names = [f"x{i}" for i in range(10)]
    problem = ro.Problem.from_strings(
        {name: f"-k*{name}" for name in names},
        {name: str(i + 1) for i, name in enumerate(names)},
        {"k": (1, 2)},
        (0, 1),
    )
    ax = plotting.plot_trajectories(ro.solve(problem, rtol=1e-3), k=1.0)
    assert legend(ax) == names
    assert ax.get_ylabel() == "unknowns"
    assert len({line.get_color() for line in ax.get_lines()}) == 10


def test_names_at_the_ends_do_not_touch():
    solution = ro.solve(coupled.problem, rtol=1e-3)
    ax = plotting.plot_trajectories(solution, solution.sample(1, seed=3), t=[0.0, 1e-3])
    ax.figure.draw_without_rendering()
    boxes = sorted((text.get_window_extent() for text in ax.texts), key=lambda box: box.y0)
    assert len(boxes) == 3
    assert all(a.y1 <= b.y0 + 1 for a, b in itertools.pairwise(boxes))


def test_a_loaded_solution_is_drawn(tmp_path):
    solution = ro.solve(decay.problem, rtol=1e-3)
    loaded = ro.load(solution.save(tmp_path / "decay.npz"))
    first, second = (plotting.plot_trajectories(one, k=[1, 2]) for one in (solution, loaded))
    assert [v.tolist() for _, v in lines(first)] == [v.tolist() for _, v in lines(second)]


def test_the_reference_names_every_plot():
    text = (DOCS / "reference.md").read_text()
    for name in plotting.__all__:
        names = inspect.signature(getattr(plotting, name)).parameters
        (line,) = (line for line in text.splitlines() if line.startswith(f"| `{name}("))
        assert all(parameter in line for parameter in names)


def test_the_guide_shows_what_it_saves():
    text = (DOCS / "guide" / "plots.md").read_text()
    pictures = sorted((DOCS / "guide" / "plots").glob("*.png"))
    for path in pictures:
        assert f'savefig("{path.name}")' in text
        assert f"(plots/{path.name})" in text
        assert path.stat().st_size <= 60_000
    assert text.count(".savefig(") == len(pictures) + 1
    for name in plotting.__all__:
        assert f"`{name}" in text


def test_an_unknown_in_place_of_values_is_told_its_keyword():
    with pytest.raises(ro.OptionError, match="unknowns='u'"):
        ro.solve(decay.problem).plot("u")
